"""Measure the levels of ``--budget``: what each costs and loses, for the table in ``envedit/cli/budget.py``.

Three maps in two scenes, every level once, the transport traced anew; a run that compiled kernels is made
again. Seconds are of the run's own stages, on the reference machine of ``budget.py``, as this one's speed is
measured before every run; what is lost is judged alike for all
(``experiments/tradeoff/judge.py``). Nothing else should run on the machine.
"""

import hashlib
import json
from pathlib import Path

import numpy as np

from envedit.cli import budget
from experiments.harness import Case, Experiment, done_of, markdown
from experiments.tradeoff import plan
from experiments.tradeoff.experiment import folder_of_maps


def options(parser):
    parser.add_argument("--maps", type=Path, metavar="DIR", help="folder of the maps ($ENVEDIT_DATA/puresky)")


def tables_of(cell, level) -> dict:
    """Return the configuration of a cell's run at a level."""
    return {
        "input": {"envmap": str(cell.file), "width": level.map},
        "scene": {**plan.SCENES[cell.scene], "width": level.film},
        "target": {"rotate_degrees": plan.ANGLE, "spp": level.spp},
        "representation": {"turn": False},  # what the target is made by; other targets take as long
        "output": {"spp": level.spp, "report": True},
        "renderer": {"cache": False},
    }


def cases(given):
    command, version = (*plan.COMMAND, "levels"), hashlib.sha256(plan.MEASURED.read_bytes()).hexdigest()
    return [
        Case(
            f"{cell.name}: {level.name}",
            tables_of(cell, level),
            {"cell": cell, "level": level.name},
            command,
            version,
        )
        for level in budget.LEVELS
        for cell in plan.cells(folder_of_maps(given))
    ]


def parts(timing: dict, found: dict) -> dict:
    """Seconds of rendering, of tracing and search, and of all else, as :class:`.budget.Level` has.

    They are those of the reference machine: what was measured, over how much slower this one was just
    before (``found``, a :class:`.budget.Calibration`).
    """
    slower = found["render"] / budget.REFERENCE_RENDER
    return {
        "rendering": (timing["target_s"] + timing["judge_s"]) / slower,
        "tracing": (timing["transport_s"] + timing["start_s"]) / slower,
        "numbers": (timing["fit_s"] + timing["edit_s"] + timing["report_s"]) / found["machine"],
    }


def tabulate(made, out, given) -> str:
    """Return a line for each level: seconds, mean to most of the cells, and mean losses."""
    from experiments.tradeoff.judge import Judge

    judge, judged, seconds = Judge(out, spp=512, true_spp=2048), {}, {}
    done = done_of(made, out)
    for one in done:
        level, cell = one.case.about["level"], one.case.about["cell"]
        found, timing = judge(cell, one.folder), one.metrics["timing"]
        calibration = json.loads((one.folder / "cost.json").read_text())["calibration"]
        spent = list(parts(timing, calibration).values())
        judged[level, cell] = found["render"]["psnr_without_noise"], found["map"]["psnr"]
        seconds.setdefault(level, []).append([*spent, sum(spent)])
    lines = []
    for level in seconds:
        told = [f"{column.mean():.1f} to {column.max():.1f}" for column in np.transpose(seconds[level])]
        cells = [cell for name, cell in judged if name == level and ("standard", cell) in judged]
        lost = [np.subtract(judged["standard", cell], judged[level, cell]) for cell in cells]
        loss = [f"{value:.1f}" for value in np.mean(lost, axis=0)] if lost else ["-", "-"]
        lines.append([f"{level}, {len(seconds[level])} runs", *told, *loss])
    return markdown(
        ["level", "rendering s", "tracing s", "numbers s", "total s", "rendering dB", "map dB"], lines
    )


EXPERIMENT = Experiment(
    "levels",
    "Measure the levels of --budget: what each costs and loses.",
    cases,
    options=options,
    tabulate=tabulate,
    alone=True,
)
