"""Functions of the cases: runs, each timed as a process of its own, and then judged."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import drjit as dr

from envedit import config, sweep
from envedit.cli import budget
from envedit.config.presets import overlaid
from envedit.core.errors import EnveditError
from experiments.harness import Case

from . import measured, plan
from .judge import Judge


def carry_out(folder: Path) -> dict:
    """Carry out the run of a folder's ``job.toml`` there; returns what it cost, as :func:`.measured.measure`.

    Raises
    ------
    EnveditError
        It failed.
    """
    # Not by this process: what it occupies would count as the run's.
    filled = {"python": sys.executable, "folder": folder, "threads": dr.thread_count()}
    run = [part.format(**filled) for part in sweep.COMMAND if part != "--resume"]
    argv = [sys.executable, "-S", measured.__file__, str(folder), *run, "--quiet"]
    starts = measured.die_with_parent if sys.platform == "linux" else None
    if code := subprocess.run(argv, check=False, preexec_fn=starts).returncode:
        raise EnveditError(f"{folder}: the run ended with exit code {code}; see above in log.txt")
    return json.loads((folder / measured.COST).read_text())


def cell(settings: config.Config, folder: Path, scene: str, part: str, sets: list[str]) -> dict:
    """Carry out all runs of a cell, one after another, and judge what they left.

    Parameters
    ----------
    settings : Config
        Of the standard preset: the map, the scene and the turn that all runs have.
    scene, part : str
        As of :func:`.plan.settings`.
    sets : list of str
        Overrides of every run, ``table.key=value``.

    Returns
    -------
    dict
        ``runs``: ``setting``, ``group``, ``cost`` and ``judged`` of each; ``unedited`` and ``ceiling`` as
        :meth:`.Judge.bounds`.
    """
    runs, standard = [], plan.base(settings.input.envmap, scene)
    for one in plan.settings(part, scene):
        inside = folder / one.name
        inside.mkdir(exist_ok=True)
        job = Case(one.name, overlaid(standard, one.tables)).job(sets)
        (inside / "job.toml").write_text(job.toml)
        runs.append({"setting": one.name, "group": one.group, "cost": carry_out(inside)})
    judge = Judge(settings)
    for run in runs:
        run["judged"] = judge(folder / run["setting"])
    return {"runs": runs} | judge.bounds()


def level(settings: config.Config, folder: Path) -> dict:
    """Carry out a run of a level of ``--budget``, just after the machine's speed, which varies, was measured.

    Returns
    -------
    dict
        As :class:`.Judge`, with ``calibration``, a :class:`.budget.Calibration`.
    """
    calibration = budget.calibrate(settings, folder)
    carry_out(folder)
    judge = Judge(settings, spp=512, true_spp=2048)
    return {"calibration": dataclasses.asdict(calibration)} | judge(folder)
