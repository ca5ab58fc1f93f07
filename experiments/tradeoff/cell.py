"""The function of the cases: the runs of a cell, each timed as a process of its own, and then judged.

A cell is a map in a scene; ``settings.toml`` says what its runs change in the standard preset.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import drjit as dr

from envedit import config, sweep
from envedit.config.presets import overlaid
from experiments.harness import Case

from . import cost
from .judge import Judge

SETTINGS = tomllib.loads(Path(__file__).with_name("settings.toml").read_text())
"""Tables of each run by its name."""


def kernels() -> int:
    """Count the kernels that Dr.Jit keeps on disk."""
    return sum(1 for _ in (Path.home() / ".drjit").glob("*.bin"))


def carry_out(folder: Path) -> dict:
    """Carry out the run of a folder's ``job.toml`` there; returns what it cost, as :func:`.cost.main`.

    A run that had to compile kernels is made again. EnveditError if it failed.
    """
    filled = {"python": sys.executable, "folder": folder, "threads": dr.thread_count()}
    run = [part.format(**filled) for part in sweep.COMMAND if part != "--resume"]
    for _ in range(2):
        before = kernels()
        spent = cost.measured([*run, "--quiet"], folder)
        if kernels() == before:
            break
    return spent


def cell(settings: config.Config, folder: Path, standard: dict, sets: list[str]) -> dict:
    """Carry out all runs of a cell, one after another, and judge what they left.

    ``standard`` are the tables that the runs change, ``sets`` their overrides. Returns ``runs``: ``setting``,
    ``cost`` and ``judged`` of each, as :class:`.Judge`; ``bounds`` as :meth:`.Judge.bounds`.
    """
    runs = []
    for name, tables in SETTINGS.items():
        inside = folder / name
        inside.mkdir(exist_ok=True)
        (inside / "job.toml").write_text(Case(name, overlaid(standard, tables)).job(sets).toml)
        runs.append({"setting": name, "cost": carry_out(inside)})
    judge = Judge(settings)
    for run in runs:
        run["judged"] = judge(folder / run["setting"])
    return {"runs": runs, "bounds": judge.bounds()}
