"""Measure the levels of ``--budget``: what each costs and loses, for the table in ``envedit/cli/budget.py``.

Three maps in two scenes, every level once, the transport traced anew; a run that compiled kernels is made
again. Seconds are of the run's own stages, on the reference machine of ``budget.py``, as this one's speed is
measured before every run; what is lost is judged alike for all (``experiments/tradeoff/judge.py``). Nothing
else should run on the machine.
"""

import numpy as np

from envedit.cli import budget
from envedit.config.presets import overlaid
from experiments.harness import Experiment, calling, number
from experiments.tradeoff import plan
from experiments.tradeoff.analyse import by


def tables_of(base: dict, level: budget.Level) -> dict:
    """Return the configuration of a run at a level, in the cell of a configuration of :func:`.plan.cells`."""
    return overlaid(base, plan.sizes(level.map, level.film) | plan.samples(level.spp))


def cases(given):
    return [
        calling(
            f"{', '.join(names)}: {level.name}",
            "experiments.tradeoff.runs:level",
            tables_of(base, level),
            {"cell": names, "level": level.name},
        )
        for level in budget.LEVELS
        for names, base in plan.cells().items()
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


def measure(done) -> dict:
    found = done.metrics
    seconds = parts(found["timing"], found["calibration"])
    psnr = {"rendering": found["render"]["psnr_without_noise"], "map": found["map"]["psnr"]}
    return {"seconds": seconds | {"total": sum(seconds.values())}, "psnr": psnr}


def combine(rows: list[dict]) -> list[dict]:
    """Return a row for each level: seconds, mean to most of the cells, and mean losses."""
    best, found = {row["cell"]: row["psnr"] for row in rows if row["level"] == "standard"}, []
    for some in by(rows, "level"):
        seconds = {part: [row["seconds"][part] for row in some] for part in some[0]["seconds"]}
        paired = [(best[row["cell"]], row["psnr"]) for row in some if row["cell"] in best]
        lost = {k: np.mean([a[k] - b[k] for a, b in paired]) if paired else None for k in some[0]["psnr"]}
        spent = {part: f"{np.mean(values):.1f} to {max(values):.1f}" for part, values in seconds.items()}
        found.append({"level": some[0]["level"], "runs": len(some), "lost": lost} | spent)
    return found


EXPERIMENT = Experiment(
    "levels",
    "Measure the levels of --budget: what each costs and loses.",
    cases,
    measure,
    {"level": "{level}, {runs} runs"}
    | {f"{part} s": f"{{{part}}}" for part in ("rendering", "tracing", "numbers", "total")}
    | {"rendering dB": lambda row: number(row["lost"]["rendering"])}
    | {"map dB": lambda row: number(row["lost"]["map"])},
    combine=combine,
    alone=True,
)
