"""Measure what speed costs in accuracy: every setting in every cell, one run at a time.

A call that has anything to run also runs the standard preset before, amid and after it; times are compared
with those of the same call. Nothing else should run on the machine meanwhile.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi

from envedit.core.atomic_files import write_atomically
from envedit.core.errors import ConfigError, EnveditError, InputError
from envedit.sweep import DONE
from experiments.harness import Case, Done, Experiment, done_of, make

from . import plan, plot
from .analyse import disturbed, flat, ratios, tables
from .plan import Cell, Setting

QUICK_SPP = 512
"""Samples a pixel of the judge in a quick run."""
JOINT, JOINT_QUICK = 5, 2


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--maps", type=Path, metavar="DIR", help="folder of the maps ($ENVEDIT_DATA/puresky)")
    parser.add_argument(
        "--quick", action="store_true", help="two cells, few settings, fewer samples to judge"
    )
    parser.add_argument("--joint", type=int, metavar="N", help="combinations of several knobs")
    parser.add_argument("--paper", choices=("one", "all", "none"), default="one", help="cells of this preset")
    scenes = tuple(plan.SCENES)
    parser.add_argument("--siren-scenes", nargs="+", choices=scenes, default=["glossy"], help="of SIRENs")


def folder_of_maps(given) -> Path:
    """Return the folder of ``--maps``, or of ENVEDIT_DATA."""
    if given.maps is None and not (root := os.environ.get("ENVEDIT_DATA")):
        raise InputError("no maps: name their folder with --maps, or set ENVEDIT_DATA")
    return given.maps or Path(root) / "puresky"


def pairs(given) -> list[tuple[Cell, Setting]]:
    """List all cells and settings that are asked for, but for the standard preset's own runs."""
    cells = plan.cells(folder_of_maps(given))
    if given.quick:  # one with a sun, one without, and each scene once
        cells = [c for c in cells if (c.map, c.scene) in ((plan.MAPS[0], "matte"), (plan.MAPS[-1], "glossy"))]
    joint = (JOINT_QUICK if given.quick else JOINT) if given.joint is None else given.joint
    if joint < 0:
        raise ConfigError(f"--joint: got {joint}, expected 0 or more")
    settings = plan.settings(joint, given.quick)
    found = [
        (cell, s)
        for s in settings
        for cell in cells
        if given.quick or s.group != "siren" or cell.scene in given.siren_scenes
    ]
    if given.paper != "none" and not given.quick:
        some = cells if given.paper == "all" else [c for c in cells if c.map == plan.MAPS[-1]][-1:]
        found += [(cell, plan.PAPER) for cell in some]
    return found


def cases(given) -> list[Case]:
    """List what is asked for; ``run`` puts runs of the standard preset around what is not done."""
    out, asked = given.out.absolute(), pairs(given)

    def is_done(case):
        return (case.job(given.sets).folder(out) / DONE).exists()

    done, todo = [], []
    for one in asked:
        case = plan.case_of(*one)
        if is_done(case):
            done.append(case)
        else:
            todo.append(one)
    kept = out / "references.json"
    sessions = json.loads(kept.read_text()) if kept.exists() else []
    cells = {(cell.map, cell.scene): cell for cell, _ in asked}
    seeds = {setting.name: setting for setting in map(plan.references, range(plan.REFERENCES))}
    references = [
        plan.case_of(cells[ref["map"], ref["scene"]], seeds[ref["setting"]], ref["session"], own=True)
        for ref in sessions
        if (ref["map"], ref["scene"]) in cells
    ]
    done += filter(is_done, references)
    if given.action != "run" or not todo:
        return done + [plan.case_of(*one) for one in todo]
    work = session_cases(todo, time.strftime("%Y%m%dT%H%M%S", time.gmtime()))
    settings = [case.about["setting"] for case in work]
    minutes = sum(setting.seconds for setting in settings) / 60
    print(f"about {minutes:.0f} minutes on two cores for {len(work)} runs", file=sys.stderr)
    if not given.dry_run:
        sessions += [
            {"map": case.about["cell"].map, "scene": case.about["cell"].scene}
            | {"setting": setting.name, "session": case.command[-1]}
            for case, setting in zip(work, settings, strict=True)
            if setting.group == "standard"
        ]
        write_atomically(make(out) / kept.name, (json.dumps(sessions, indent=1) + "\n").encode())
    return done + work


def session_cases(todo: Sequence[tuple[Cell, Setting]], session: str) -> list[Case]:
    """Order a session's work: the standard preset, in all its cells, before, amid and after the rest."""
    cells = list(dict.fromkeys(cell for cell, _ in todo))
    cuts = [len(todo) * n // (plan.REFERENCES - 1) for n in range(plan.REFERENCES)]
    order = []
    for n, cut in enumerate(cuts):
        order += [plan.case_of(cell, plan.references(n), session, own=True) for cell in cells]
        some = todo[cut : cuts[n + 1] if n + 1 < len(cuts) else cut]
        order += [plan.case_of(*one, session) for one in some]
    return order


def collect(done: Sequence[Done], out: Path, judge) -> dict:
    """Judge all that is done, and write ``results.json``.

    Parameters
    ----------
    done : sequence of Done
        Cases of :func:`cases`.
    out : Path
        Folder of the runs.
    judge : callable
        As :class:`.judge.Judge`.

    Returns
    -------
    dict
        ``runs``: as :func:`.analyse.ratios` takes them, with what they were judged by; ``cells``: bounds of
        each; ``about``: machine and versions.
    """
    from experiments.engine.run import about

    runs, met = [], {}
    for i, one in enumerate(done):
        cell, setting, folder = one.case.about["cell"], one.case.about["setting"], one.folder
        print(f"\rjudging {i + 1} of {len(done)}", end="", file=sys.stderr, flush=True)
        cost = one.metrics
        try:
            judged = judge(cell, folder)
        except EnveditError as error:  # one map that cannot be judged is no reason to judge none
            print(f"\n{cell.name}: {setting.name}: not judged: {error}", file=sys.stderr)
            continue
        runs.append(
            {"setting": setting.name, "group": setting.group, "map": cell.map, "scene": cell.scene}
            | flat(cost, judged)
            | {"session": cost["session"], "folder": folder.name}
            | {"changes": {} if setting.group == "standard" else setting.table}
            | {"cost": cost, "judged": judged}
        )
        met[cell.map, cell.scene] = cell
    print(file=sys.stderr)
    bounds = [{"map": cell.map, "scene": cell.scene, **judge.bounds(cell)} for cell in met.values()]
    if alone := len(runs) - len(ratios(runs)):
        print(f"{alone} runs are left out: beside them no run of the standard preset ended", file=sys.stderr)
    for run in disturbed(runs):
        print(
            f"{run['map']}, {run['scene']}: {run['setting']}: had less of the processor than others of its "
            f"setting: if something else ran beside it, remove {out / run['folder']} and run again",
            file=sys.stderr,
        )
    for run in runs:
        if not run["judged"].get("full", True):
            print(f"{run['map']}, {run['scene']}: {run['setting']}: judged by its working map: no full one")
    results = {"about": about(), "runs": runs, "cells": bounds}
    write_atomically(out / "results.json", (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
    return results


def judge_of(given, out: Path):
    """Return the judge of a call."""
    from .judge import SPP, TRUE_SPP, Judge

    mi.set_log_level(mi.LogLevel.Error)
    return Judge(out, *((QUICK_SPP, 4 * QUICK_SPP) if given.quick else (SPP, TRUE_SPP)))


def in_order(done: list[Done], given) -> list[Done]:
    """Sort what is asked for as the tables have it, whenever it was run; the standard preset last."""
    place = {f"{cell.name}: {setting.name}": i for i, (cell, setting) in enumerate(pairs(given))}
    return sorted(done, key=lambda one: place.get(one.case.name, len(place)))


def tabulate(made, out: Path, given) -> str:
    if not (done := in_order(done_of(made, out), given)):
        return "no run is done"
    results = collect(done, out, judge_of(given, out))
    if not ratios(results["runs"]):
        raise InputError("no run of the standard preset to compare with; run the experiment to its end")
    return "\n\n".join(f"<!-- table: {name} -->\n\n{text}" for name, text in tables(results).items())


def draw(made, out: Path, to: Path, given) -> list[Path]:
    return plot.draw(collect(in_order(done_of(made, out), given), out, judge_of(given, out)), to)


EXPERIMENT = Experiment(
    "tradeoff",
    "Measure what speed costs in accuracy: every setting in every cell, one run at a time.",
    cases,
    options=options,
    tabulate=tabulate,
    draw=draw,
    file=lambda given: "tables",
    alone=True,
)
