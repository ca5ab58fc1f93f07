"""Damage files of every kind that the package reads, and see that reading them ends well.

Case i of a kind and of the configuration's ``seed`` is always the same file, whichever others are made.
Linux only: memory is read from /proc.
"""

import tempfile
from collections import Counter
from pathlib import Path

from experiments.fuzz.declared import declared as declared_bytes
from experiments.fuzz.kinds import KINDS, case, seeds
from experiments.fuzz.worker import Worker
from experiments.harness import Experiment, calling
from experiments.summary import Summary

FAULTS = ("crashed", "hung", "traceback", "unclear", "wrong", "memory", "printed")
"""Outcomes that must not be."""
OUTCOMES = ("read", "refused", *FAULTS)
PIECE = 2500
"""Files of a case of the harness."""
WHOLE = -2
"""The index of a seed itself, which must be read."""
UNREAD = "deep.exr"
"""A whole file that is refused."""


def options(parser):
    parser.add_argument("--count", type=int, default=10000, help="damaged files of each kind (%(default)s)")


def cases(given):
    found = []
    for what, kind in KINDS.items():
        total = given.count // kind.one_in
        for first in range(0, total, PIECE):
            files = {"what": what, "first": first, "count": min(PIECE, total - first)}
            name = f"{what} {first}-{first + files['count'] - 1}"
            found.append(calling(name, piece, {}, {"what": what}, **files))
    return found


def piece(settings, folder, what: str, first: int, count: int, reader=None) -> dict:
    """Read damaged files of one of ``kinds.KINDS``; those that go wrong, and why, are kept in ``folder``.

    Every worker reads all whole files first; one that is not read is a fault as well. ``reader`` takes the
    place of that of ``what``.

    Returns
    -------
    dict
        ``counts``: files by outcome; ``errors``: refusals by the name of the error; ``beyond``: the most
        memory that a file took beyond the image that it declares, bytes; ``faults``: [index, outcome, error]
        of every file that went wrong.
    """
    whole = seeds(what)
    counts = Counter()
    errors = Counter()
    beyond = 0
    faults = []
    with tempfile.TemporaryDirectory() as work, Worker(reader or KINDS[what].read) as process:

        def read(name, data, index):
            (path := Path(work) / name).write_bytes(data)
            return process.read(path, index, declared_bytes(data))

        for index in range(first, first + count):
            if process.process is None:  # a reader's first call takes memory that later ones do not
                for name, data in whole:
                    answer = read(name, data, WHOLE)
                    if answer["outcome"] != "read" and name != UNREAD:
                        faults.append((name, answer["outcome"], answer.get("error", "")))
            name, data = case(what, whole, settings.seed, index)
            answer = read(name, data, index)
            outcome = answer["outcome"]
            counts[outcome] += 1
            if outcome == "refused":
                errors[answer["kind"]] += 1
            beyond = max(beyond, answer.get("peak", 0) - declared_bytes(data))
            if outcome in FAULTS:
                faults.append((index, outcome, answer["error"]))
                kept = folder / f"{index}-{outcome}-{name}"
                kept.write_bytes(data)
                kept.with_name(kept.name + ".txt").write_text(answer["error"], errors="replace")
    return {"counts": counts, "errors": errors, "beyond": beyond, "faults": faults}


def measure(done) -> dict:
    """Return how many files of a piece had each outcome, and the most memory that one took, MiB."""
    found = done.metrics
    outcomes = {outcome: found["counts"].get(outcome, 0) for outcome in OUTCOMES}
    outcomes["cases"] = sum(outcomes.values())
    return outcomes | {"mib": found["beyond"] / 2**20, "faults": found["faults"], "folder": done.folder}


def failures(rows: list[dict]) -> list[str]:
    return [
        f"{row['what']} {index}: {outcome}: {error[:300]} (kept in {row['folder']})"
        for row in rows
        for index, outcome, error in row["faults"]
    ]


EXPERIMENT = Experiment(
    cases,
    measure,
    summary=Summary(
        {"what": "{what}"},
        {"cases": "{cases.sum:.0f}", "read whole": "{read.sum:.0f}", "refused": "{refused.sum:.0f}"}
        | {fault: f"{{{fault}.sum:.0f}}" for fault in FAULTS}
        | {"most memory beyond the declared image": "{mib.max:.1f} MiB"},
    ),
    failures=failures,
    options=options,
)
