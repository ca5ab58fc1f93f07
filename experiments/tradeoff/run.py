r"""Measure what speed costs in accuracy: every setting in every cell, one run at a time.

    ENVEDIT_DATA=... python -m experiments.tradeoff.run [--out runs/tradeoff] [--maps DIR] [--quick] \
        [--joint 12] [--paper one|all|none] [--siren-scenes glossy] [--workers 1] [--plan]

What is done is skipped. A call that has anything to run also runs the standard preset before, amid and after
it; times are told as ratios to those of the same call. Nothing else should run on the machine meanwhile.
``python -m experiments.tradeoff.plot`` draws what was measured.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from envedit.cli import sweep as options
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError, InputError
from envedit.sweep import Job, sweep

from . import plan
from .analyse import disturbed, flat, ratios
from .plan import Cell, Setting

COMMAND = ("{python}", "-S", str(Path(__file__).with_name("measured.py")), "{folder}", "{threads}")
"""What carries out a job; the session is added to it."""
QUICK_SPP = 512
"""Samples a pixel of the judge in a quick run."""
JOINT, JOINT_QUICK = 12, 2


def pairs(given) -> list[tuple[Cell, Setting]]:
    """List all cells and settings that are asked for, but for the standard preset's own runs."""
    cells = plan.cells(given.maps)
    if given.quick:  # one with a sun, one without, and each scene once
        cells = [c for c in cells if (c.map, c.scene) in ((plan.MAPS[0], "matte"), (plan.MAPS[-1], "glossy"))]
    settings = plan.settings(given.joint, given.quick)
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


def session_jobs(todo: Sequence[tuple[Cell, Setting]], session: str) -> list[tuple[Cell, Setting, Job]]:
    """Order a session's work: the standard preset, in all its cells, before, amid and after the rest."""
    cells = list(dict.fromkeys(cell for cell, _ in todo))
    cuts = [len(todo) * n // (plan.REFERENCES - 1) for n in range(plan.REFERENCES)]
    order: list[tuple[Cell, Setting, str]] = []
    for n, cut in enumerate(cuts):
        order += [(cell, plan.references(n), session) for cell in cells]
        order += [(*one, "") for one in todo[cut : cuts[n + 1] if n + 1 < len(cuts) else cut]]
    return [(cell, setting, plan.job_of(cell, setting, own)) for cell, setting, own in order]


def carry_out(given, command: Sequence[str] = COMMAND) -> int:
    """Run what is not done; returns how many jobs did not end well.

    Raises
    ------
    ConfigError, InputError
        As :func:`envedit.sweep.sweep`; also if a map is missing.
    """
    out = given.out.absolute()
    wanted = [(cell, setting, plan.job_of(cell, setting)) for cell, setting in pairs(given)]
    todo = [(cell, s) for cell, s, job in wanted if not (job.folder(out) / "done.json").exists()]
    seconds = sum(s.seconds for _, s in todo)
    cells = len({cell for cell, _ in todo})
    seconds += sum(plan.references(n).seconds for n in range(plan.REFERENCES)) * cells
    print(
        f"{len(wanted)} runs, {len(wanted) - len(todo)} done before; about {seconds / 60:.0f} minutes for "
        f"the rest on two cores, with {plan.REFERENCES * cells} of the standard preset beside them",
        flush=True,
    )
    if given.plan:
        for cell, setting in todo:
            print(f"{setting.seconds:6.0f} s  {cell.name}: {setting.name}")
        return 0
    if not todo:
        return 0
    session = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    work = session_jobs(todo, session)
    kept = out / "references.json"
    told = json.loads(kept.read_text()) if kept.exists() else []
    told += [
        {"key": job.key, "map": cell.map, "scene": cell.scene, "setting": setting.name, "session": session}
        for cell, setting, job in work
        if setting.group == "standard"
    ]
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(kept, (json.dumps(told, indent=1) + "\n").encode())
    ended = sweep(
        [job for *_, job in work], out, given.workers, command=(*command, session), stream=sys.stderr
    )
    return sum(one.state not in ("done", "skipped") for one in ended)


def collect(given, judge=None) -> dict:
    """Judge all that is done, and write ``results.json``.

    Parameters
    ----------
    given : namespace
        The command line's.
    judge : judge.Judge, optional
        Another one.

    Returns
    -------
    dict
        ``runs``: as :func:`.analyse.ratios` takes them, with what they were judged by; ``cells``: bounds of
        each; ``about``: machine and versions.
    """
    from experiments.engine.run import about

    out = given.out.absolute()
    if judge is None:
        judge = _judge(given, out)
    wanted = pairs(given)
    cells = {(cell.map, cell.scene): cell for cell, _ in wanted}
    jobs = [(cell, s.name, s.group, s.table, plan.job_of(cell, s).folder(out)) for cell, s in wanted]
    kept = out / "references.json"
    for told in json.loads(kept.read_text()) if kept.exists() else []:
        if cell := cells.get((told["map"], told["scene"])):
            jobs.append((cell, told["setting"], "standard", {}, out / told["key"]))
    runs = []
    for i, (cell, setting, group, table, folder) in enumerate(jobs):
        if not (folder / "done.json").exists():
            continue
        print(f"\rjudging {i + 1} of {len(jobs)}", end="", file=sys.stderr, flush=True)
        cost = json.loads((folder / "cost.json").read_text())
        try:
            judged = judge(cell, folder)
        except EnveditError as error:  # one map that cannot be judged is no reason to judge none
            print(f"\n{cell.name}: {setting}: not judged: {error}", file=sys.stderr)
            continue
        runs.append(
            {"setting": setting, "group": group, "map": cell.map, "scene": cell.scene}
            | flat(cost, judged)
            | {"session": cost["session"], "folder": folder.name, "changes": table}
            | {"cost": cost, "judged": judged}
        )
    print(file=sys.stderr)
    met = {(run["map"], run["scene"]) for run in runs}
    bounds = [
        {"map": cell.map, "scene": cell.scene, **judge.bounds(cell)}
        for key, cell in cells.items()
        if key in met
    ]
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


def _judge(given, out):
    from envedit.cli import doctor

    doctor.ensure("llvm_ad_rgb")
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    from .judge import SPP, TRUE_SPP, Judge

    spp = (QUICK_SPP, 4 * QUICK_SPP) if given.quick else (SPP, TRUE_SPP)
    return Judge(out, *spp)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.tradeoff.run", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--out", type=Path, metavar="DIR", help="runs/tradeoff, or runs/tradeoff-quick")
    parser.add_argument("--maps", type=Path, metavar="DIR", help="folder of the maps ($ENVEDIT_DATA/puresky)")
    parser.add_argument(
        "--quick", action="store_true", help="two cells, few settings, fewer samples to judge"
    )
    parser.add_argument("--joint", type=int, metavar="N", help="combinations of the joint sweep")
    parser.add_argument(
        "--paper", choices=("one", "all", "none"), default="one", help="cells of the paper preset"
    )
    parser.add_argument(
        "--siren-scenes", nargs="+", choices=tuple(plan.SCENES), default=["glossy"], help="where SIRENs run"
    )
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="runs at a time: more than one")
    parser.add_argument("--plan", action="store_true", help="only say what would be run, and for how long")
    given = parser.parse_args(argv)
    if given.workers < 1:
        parser.error(f"--workers: came {given.workers}, wanted 1 or more")
    if given.out is None:
        given.out = Path("runs/tradeoff-quick" if given.quick else "runs/tradeoff")
    if given.joint is None:
        given.joint = JOINT_QUICK if given.quick else JOINT
    if given.joint < 0:
        parser.error(f"--joint: came {given.joint}, wanted 0 or more")
    return given


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns 0, 1 if a run failed, or the exit code of a user's error."""
    given = parse(argv)

    def tell():
        if given.maps is None:
            if not (root := os.environ.get("ENVEDIT_DATA")):
                raise InputError("no maps: name their folder with --maps, or set ENVEDIT_DATA")
            given.maps = Path(root) / "puresky"
        failed = carry_out(given)
        if not given.plan:
            collect(given)
            hint = f"python -m experiments.tradeoff.plot --out {given.out}"
            print(f"{given.out / 'results.json'}: draw it with {hint}")
        return 1 if failed else 0

    return options.exit_code("tradeoff", tell)


if __name__ == "__main__":
    sys.exit(main())
