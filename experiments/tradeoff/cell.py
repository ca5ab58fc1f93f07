"""The function of the cases: the runs of a cell, each timed as a process of its own, and then judged."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import drjit as dr

from envedit import config, sweep
from envedit.config.presets import overlaid
from envedit.core.errors import EnveditError
from experiments.harness import Case

from . import cost, plan
from .judge import Judge

AGAIN_BELOW = 180.0
"""Seconds up to which a run that had to compile kernels is made again: beyond, compiling is a small part."""


def kernels() -> int:
    """Count the kernels that Dr.Jit keeps on disk."""
    return sum(1 for _ in (Path.home() / ".drjit").glob("*.bin"))


def carry_out(folder: Path) -> dict:
    """Carry out the run of a folder's ``job.toml`` there; returns what it cost, as :func:`.cost.main`.

    EnveditError if it failed.
    """
    filled = {"python": sys.executable, "folder": folder, "threads": dr.thread_count()}
    run = [part.format(**filled) for part in sweep.COMMAND if part != "--resume"]
    file = folder / "cost.json"
    for _ in range(2):
        before = kernels()
        # In a process between this one and the run, whose peak of memory would else be no less than ours.
        code = subprocess.run([sys.executable, "-S", cost.__file__, file, *run, "--quiet"]).returncode
        if code:
            raise EnveditError(f"{folder}: the run ended with exit code {code}; see above in log.txt")
        spent = json.loads(file.read_text())
        if kernels() == before or spent["wall_s"] >= AGAIN_BELOW:
            break
    return spent


def cell(settings: config.Config, folder: Path, scene: str, sets: list[str]) -> dict:
    """Carry out all runs of a cell, one after another, and judge what they left.

    ``settings`` have the map, the scene, one of :data:`.plan.SCENES`, and the turn of all runs, ``sets``
    their overrides. Returns ``runs``: ``setting``, ``cost`` and ``judged`` of each, as :class:`.Judge`;
    ``bounds`` as :meth:`.Judge.bounds`.
    """
    runs = []
    standard = plan.base(settings.input.envmap, scene)
    for name, tables in plan.settings().items():
        inside = folder / name
        inside.mkdir(exist_ok=True)
        (inside / "job.toml").write_text(Case(name, overlaid(standard, tables)).job(sets).toml)
        runs.append({"setting": name, "cost": carry_out(inside)})
    judge = Judge(settings)
    for run in runs:
        run["judged"] = judge(folder / run["setting"])
    return {"runs": runs, "bounds": judge.bounds()}
