"""Damage files of every kind that the package reads, and see that reading them ends well.

Case i of a kind and of the configuration's ``seed`` is always the same file, whichever others are made.
Linux only: memory is read from /proc.
"""

from collections import Counter

from experiments.fuzz.drive import FAULTS
from experiments.fuzz.kinds import KINDS
from experiments.harness import Experiment, calling

PIECE = 2500
"""Files of a case of the harness."""


def options(parser):
    parser.add_argument("--count", type=int, default=10000, help="damaged files of each kind (%(default)s)")
    parser.add_argument("--heap-check", default="", help="library to preload, such as libc_malloc_debug.so.0")


def cases(given):
    found = []
    for what, kind in KINDS.items():
        total = given.count // kind.one_in
        for first in range(0, total, PIECE):
            count = min(PIECE, total - first)
            files = {"what": what, "first": first, "count": count, "heap_check": given.heap_check}
            name = f"{what} {first}-{first + count - 1}"
            found.append(calling(name, "experiments.fuzz.drive:piece", {}, {"what": what}, **files))
    return found


def combine(rows: list[dict]) -> list[dict]:
    """Add up the pieces of each kind."""
    sums = {}
    for row in rows:
        empty = {"what": row["what"], "counts": Counter(), "errors": Counter(), "beyond": 0}
        total = sums.setdefault(row["what"], empty)
        total["counts"].update(row["counts"])
        total["errors"].update(row["errors"])
        total["beyond"] = max(total["beyond"], row["beyond"])
    return list(sums.values())


def refused(row: dict) -> str:
    """Name the errors of the refused files, the most frequent first."""
    return ", ".join(f"{number} {error}" for error, number in row["errors"].most_common()) or "0"


def failures(rows: list[dict]) -> list[str]:
    return [
        f"{row['what']} {index}: {outcome}: {error[:300]} (kept in {row['folder']})"
        for row in rows
        for index, outcome, error in row["faults"]
    ]


EXPERIMENT = Experiment(
    "fuzz",
    "Damage files of every kind that the package reads, and see that reading them ends well.",
    cases,
    lambda done: done.metrics | {"folder": done.folder},
    {
        "what": "{what}",
        "cases": lambda row: str(row["counts"].total()),
        "read whole": "{counts[read]}",
        "refused": refused,
    }
    | {fault: f"{{counts[{fault}]}}" for fault in FAULTS}
    | {"most memory beyond the declared image": lambda row: f"{row['beyond'] / 2**20:.1f} MiB"},
    failures=failures,
    combine=combine,
    options=options,
)
