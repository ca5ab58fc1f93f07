"""Times and errors of nine edits, to compare two versions of the solver.

Every edit is run twice and the second time counts: kernels, T and the target's rendering are on disk then.
Run it on either version, in one go, where nothing else runs.
"""

import numpy as np

from experiments import puresky
from experiments.harness import Experiment, calling, markdown

EDITS = (  # map, scene, target (degrees or another map), whether the sky may turn
    ("sunflowers", "sphere", "60", False),
    ("sunflowers", "sphere", "autumn_field", True),
    ("rustig_koppie", "statue", "140", False),
    ("kloofendal_48d_partly_cloudy", "sphere", "140", False),
    ("wasteland_clouds", "statue", "60", False),
    ("evening_road_01", "sphere", "snow_field", True),
    ("mud_road", "statue", "sunflowers", True),
    ("syferfontein_18d_clear", "pair", "kloofendal_48d_partly_cloudy", True),
    ("kloppenheim_06", "sphere", "60", True),
)
NUMBERS = {
    "solve, s": "{solve_s:.2f}",
    "total, s": "{total_s:.2f}",
    "steps": "{iterations:.1f}",
    "a step, ms": "{per_iteration_ms:.0f}",
    "rendering, dB": "{render:.2f}",
    "map, dB": "{envmap:.2f}",
}


def tables(files, name, scene, target, turn) -> dict:
    """Return the configuration of an edit."""
    wanted = {"rotate_degrees": float(target)} if target.isdigit() else {"file": str(files[target])}
    return {
        "input": {"envmap": str(files[name])},
        "scene": {"file": scene},
        "target": wanted,
        "representation": {"turn": "auto" if turn else False},
    }


def cases(given):
    files = puresky.find()
    return [
        calling(f"{name}, {scene}, {target}", "experiments.solver.growth:second", tables(files, *edit))
        for edit in EDITS
        for name, scene, target, _ in [edit]
    ]


def measure(done) -> dict:
    found, timing = done.metrics, done.metrics["timing"]
    return {
        "edit": done.case.name,
        "solve_s": timing["solve_s"],
        "total_s": timing["total_s"],
        "iterations": found["iterations"],
        "per_iteration_ms": timing["per_iteration_ms"] or 0,
        "render": found["render"]["psnr"],
        "envmap": found["envmap"]["psnr"],
    }


def summary(rows) -> str:
    means = {key: np.mean([row[key] for row in rows]) for key in rows[0] if key != "edit"}
    lines = [[f"mean of {len(rows)}", *(form.format_map(means) for form in NUMBERS.values())]]
    return markdown(["", *NUMBERS], lines)


EXPERIMENT = Experiment(
    "solver.edits",
    "Times and errors of nine edits, to compare two versions of the solver.",
    cases,
    measure,
    {"edit": "{edit}"} | NUMBERS,
    summary=summary,
    alone=True,
)
