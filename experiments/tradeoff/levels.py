r"""Measure the levels of ``--budget``: what each costs and loses, for the table in ``envedit/cli/budget.py``.

    ENVEDIT_DATA=... python -m experiments.tradeoff.levels [--out runs/levels] [--maps DIR]

Three maps in two scenes, every level once, the transport traced anew; a run that compiled kernels is made
again. Seconds are of the run's own stages; what is lost is judged alike for all (``judge.py``). Nothing else
should run on the machine.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from envedit import config
from envedit.cli import budget

from . import measured
from .judge import Judge
from .plan import ANGLE, SCENES, cells


def settings_of(cell, level) -> dict:
    """Return the configuration of a cell's run at a level."""
    return {
        "input": {"envmap": str(cell.file), "width": level.map},
        "scene": {**SCENES[cell.scene], "width": level.film},
        "target": {"rotate_degrees": ANGLE, "spp": level.spp},
        "optimizer": {"iterations": level.iterations},
        "output": {"spp": level.spp, "report": True},
        "renderer": {"cache": False},
    }


def run(cell, level, out: Path) -> tuple[dict, Path]:
    """Carry out a run that is missing; returns its metrics and folder, which is named by what was asked."""
    asked = settings_of(cell, level)
    text = config.to_toml(config.from_dict(asked, out))
    folder = out / f"{cell.map}-{cell.scene}-{level.name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    if not (folder / "metrics.json").exists():
        out.mkdir(parents=True, exist_ok=True)
        file = folder.with_suffix(".toml")
        file.write_text(text)
        command = [sys.executable, "-m", "envedit.run", str(file), "--out", str(folder), "--quiet"]
        before = measured.kernels()
        subprocess.run(command, check=True)
        if measured.kernels() > before:
            shutil.rmtree(folder)
            subprocess.run(command, check=True)
    return json.loads((folder / "metrics.json").read_text()), folder


def parts(timing: dict) -> dict:
    """Seconds of rendering, of tracing and search, and of all else, as :class:`.budget.Level` has."""
    return {
        "rendering": timing["target_s"] + timing["judge_s"],
        "tracing": timing["transport_s"] + timing["start_s"],
        "numbers": timing["fit_s"] + timing["edit_s"] + timing["report_s"],
    }


def main():
    """Compute and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/levels"))
    data = os.environ.get("ENVEDIT_DATA")
    parser.add_argument("--maps", type=Path, default=Path(data) / "puresky" if data else None)
    given = parser.parse_args()
    if given.maps is None:
        sys.exit("ENVEDIT_DATA is not set: give the folder of the maps with --maps")
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    out, found = given.out.absolute(), {}
    work = cells(given.maps)
    for level in budget.LEVELS:
        for cell in work:
            told, folder = found[level.name, cell] = run(cell, level, out)
            print(folder.name, json.dumps(parts(told["timing"])), flush=True)
    judge = Judge(out, spp=512, true_spp=2048)
    lost = {key: judge(key[1], folder) for key, (_, folder) in found.items()}
    print(
        "| level | rendering s | tracing s | numbers s | total s | rendering dB | map dB |\n"
        + "|---" * 7
        + "|"
    )
    for level in budget.LEVELS:
        mine = [found[level.name, cell][0]["timing"] for cell in work]
        columns = [np.array([parts(t)[part] for t in mine]) for part in ("rendering", "tracing", "numbers")]
        columns.append(np.array([t["total_s"] for t in mine]))
        db = [
            np.mean([pick(lost["standard", cell]) - pick(lost[level.name, cell]) for cell in work])
            for pick in (lambda j: j["render"]["psnr_without_noise"], lambda j: j["map"]["psnr"])
        ]
        told = " | ".join(f"{c.mean():.1f} to {c.max():.1f}" for c in columns)
        print(f"| {level.name} | {told} | {db[0]:.1f} | {db[1]:.1f} |")


if __name__ == "__main__":
    main()
