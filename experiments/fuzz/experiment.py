"""Damage files of every kind that the package reads, and see that reading them ends well.

Case i of a kind and of the configuration's ``seed`` is always the same file, whichever others are made.
Linux only: memory is read from /proc.
"""

from experiments.fuzz.drive import FAULTS, piece
from experiments.fuzz.kinds import KINDS
from experiments.harness import Experiment, calling
from experiments.summary import Summary

OUTCOMES = ("read", "refused", *FAULTS)
PIECE = 2500
"""Files of a case of the harness."""


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
