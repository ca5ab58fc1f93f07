"""Measure what speed costs in accuracy: every setting in every cell, one run at a time.

A case is all runs of a cell, with the standard preset before, amid and after them: times are compared with
those of the same call. Nothing else should run on the machine meanwhile.
"""

from __future__ import annotations

from experiments.harness import Experiment, calling, done_of, rows_of

from . import analyse, plan, plot


def cases(given):
    cells = plan.cells()
    asked = [(*names, "settings") for names in cells] + [(plan.MAPS[-1], "glossy", "paper")]
    return [
        calling(
            f"{name}, {scene}: {part}",
            "experiments.tradeoff.runs:cell",
            cells[name, scene],
            {"cell": f"{name}, {scene}"},
            **{"scene": scene, "part": part, "sets": given.sets},
        )
        for name, scene, part in asked
    ]


EXPERIMENT = Experiment(
    "tradeoff",
    "Measure what speed costs in accuracy: every setting in every cell, one run at a time.",
    cases,
    analyse.compared,
    analyse.COLUMNS,
    group=lambda row: row["table"],
    summary=analyse.summary,
    combine=analyse.combine,
    draw=lambda cases, out, to, given: plot.draw(rows_of(EXPERIMENT, done_of(cases, out)), to),
    alone=True,
)
