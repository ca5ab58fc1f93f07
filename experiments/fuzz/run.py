r"""Damage files of every kind that the package reads, and see that reading them ends well.

    python -m experiments.fuzz.run [--cases 10000] [--seed 0] [--first 0] \
        [--what exr hdr toml painted weights checkpoint scene mesh texture entry state] [--keep DIR] \
        [--record FILE] [--heap-check LIBRARY]

Case i of a kind and seed is always the same file: ``--first`` and ``--cases`` take a run to pieces, and
``--record`` adds them up. Exits with 1 if any case went wrong. Linux only: memory is read from /proc.
"""

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

from tqdm import tqdm

from envedit.core.atomic_files import write_atomically
from experiments.harness import markdown

from . import drive
from .readers import READERS


def table(tallies: dict[str, drive.Tally]) -> str:
    """Lay out the outcome of all kinds as a Markdown table."""
    head = ["what", "cases", "read whole", "refused", *drive.FAULTS, "most memory beyond the declared image"]
    rows = []
    for what, tally in tallies.items():
        kinds = ", ".join(f"{n} {kind}" for kind, n in tally.kinds.most_common()) or "0"
        counts = [str(tally.counts[fault]) for fault in drive.FAULTS]
        beyond = f"{tally.beyond / 2**20:.1f} MiB"
        rows.append([what, str(tally.counts.total()), str(tally.counts["read"]), kinds, *counts, beyond])
    return markdown(head, rows)


def recorded(file: Path, pieces: dict[str, tuple[range, int, drive.Tally]]) -> dict[str, drive.Tally]:
    """Add pieces, what -> (cases, seed, tally), to a record; returns the sums of all that it holds."""
    record = json.loads(file.read_text()) if file.exists() else {}
    for what, (cases, seed, tally) in pieces.items():
        record[f"{what} {seed} {cases.start} {cases.stop}"] = vars(tally)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, json.dumps(record, indent=1).encode())
    sums = {}
    for key, piece in sorted(record.items()):
        total = sums.setdefault(key.split()[0], drive.Tally())
        total.counts += Counter(piece["counts"])
        total.kinds += Counter(piece["kinds"])
        total.peak, total.beyond = max(total.peak, piece["peak"]), max(total.beyond, piece["beyond"])
        total.faults += piece["faults"]
    return sums


def counted_twice(file: Path, what: str, cases: range, seed: int) -> str:
    """Say which piece of a record overlaps with these cases and is not the same; empty if none is."""
    for key in json.loads(file.read_text()) if file.exists() else {}:
        *about, start, stop = key.split()
        piece = range(int(start), int(stop))
        meet = piece.start < cases.stop and cases.start < piece.stop
        if about == [what, str(seed)] and meet and piece != cases:
            last = piece.stop - 1
            return f"{file}: holds cases {start} to {last} of {what}: give another --first or --record"
    return ""


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.fuzz.run", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--cases", type=int, default=10000, help="damaged files of each kind")
    parser.add_argument("--first", type=int, default=0, help="index of the first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--what", nargs="+", choices=list(READERS), default=list(READERS), help="kinds of files"
    )
    parser.add_argument("--keep", type=Path, help="folder for the files that went wrong")
    parser.add_argument("--record", type=Path, help="JSON file that adds up the pieces of a run")
    parser.add_argument("--heap-check", default="", help="library to preload, such as libc_malloc_debug.so.0")
    chosen = parser.parse_args(argv)
    cases, tallies = range(chosen.first, chosen.first + chosen.cases), {}
    for what in chosen.what if chosen.record else ():
        if twice := counted_twice(chosen.record, what, cases, chosen.seed):
            parser.error(twice)
    for what in chosen.what:
        with tqdm(total=len(cases), desc=what, mininterval=1) as bar:
            tallies[what] = drive.fuzz(
                what, cases, chosen.seed, chosen.keep, heap_check=chosen.heap_check, tick=bar.update
            )
        for index, outcome, error in tallies[what].faults:
            print(f"{what} {index}: {outcome}: {error[:300]}")
        shown = tallies
        if chosen.record:
            shown = recorded(chosen.record, {what: (cases, chosen.seed, tallies[what])})
    print(table(shown))
    return int(any(tally.faults for tally in shown.values()))


if __name__ == "__main__":
    sys.exit(main())
