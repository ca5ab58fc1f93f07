"""What the checks of files, caches and plugins cost: runs with and without them, in turn, on a quiet machine.

Two runs: ``quickstart`` with empty caches, and ``quickstart --preset standard`` with full ones. A pair is one
run with the checks and one without, in a process each, in an order that alternates. Shown are the medians of
the seconds from start to end of the process, and of the quotient within pairs with its quartiles. Also: a
path-traced step with gradients by one thread, whose sums have a fixed order, and by all.
"""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.harness import Experiment, calling

from .timing import side_by_side

PARTS = ("checks", "film+checks")
"""What is switched off, as of :mod:`.without_checks`."""
RUNS = {"quickstart, caches empty": ([], False), "standard, caches full": (["--preset", "standard"], True)}
"""Options of the run, and whether its caches are full."""
MOST = 1.03
"""Median quotient above which the checks cost too much."""
MODULE = "experiments.engine.cost_of_checks"


def seconds(off: str, options: list[str], caches: Path, out: Path) -> float:
    """Time one run in a process of its own."""
    shutil.rmtree(out, ignore_errors=True)
    program = [sys.executable, "-m", "experiments.engine.without_checks", off]
    command = [*program, "quickstart", "--quiet", "--out", str(out), *options]
    environment = os.environ | {"XDG_CACHE_HOME": str(caches)}
    begun = time.perf_counter()
    subprocess.run(command, env=environment, cwd=Path(__file__).parents[2], check=True)
    return time.perf_counter() - begun


def compare(settings, folder, off: str, options: list[str], warm: bool, pairs: int) -> dict:
    """Return ``seconds`` of every pair, (with, without), their medians, and those of the quotient."""
    sides, found = {"with": "", "without": off}, []
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        for name, parts in sides.items():  # kernels, and caches where they are to be full
            seconds(parts, options, place / name, place / "run")
        for i in range(pairs):
            pair = {}
            for name in sorted(sides, reverse=bool(i % 2)):
                if not warm:
                    shutil.rmtree(place / name, ignore_errors=True)
                pair[name] = seconds(sides[name], options, place / name, place / "run")
            found.append((pair["with"], pair["without"]))
    quotients = sorted(one / other for one, other in found)
    return {
        "seconds": found,
        "medians": [statistics.median(side) for side in zip(*found, strict=True)],
        "quotient": statistics.median(quotients),
        "quartiles": (quotients[pairs // 4], quotients[-1 - pairs // 4]),
    }


def path_steps(settings, folder, pairs: int) -> dict:
    """Time path-traced steps on a statue of 128 x 128 pixels, by one thread and by all in turn."""
    from envedit.scene import scene
    from envedit.scene.path_tracer import PathTracer

    from .transport import gradient

    lit = scene.load("statue", 128, 128)
    envmap = dr.opaque(mi.TensorXf(np.random.default_rng(0).random((128, 256, 3), dtype=np.float32)))
    weight = dr.opaque(mi.TensorXf, 1, (lit.height, lit.width, 3))

    def step(one_thread):
        tracer = PathTracer(lit, one_thread=one_thread)
        return lambda: gradient(lambda e: tracer.render(e, 0), envmap, weight)

    return side_by_side({"one": step(True), "all": step(False)}, pairs)


def cases(given):
    found = [calling("path", f"{MODULE}:path_steps", {}, {"group": "path-traced steps"}, pairs=given.pairs)]
    for off in PARTS:
        for run, (options, warm) in RUNS.items():
            name, about = f"{run}, without {off}", {"group": "runs", "pairs": given.pairs}
            how = {"off": off, "options": options, "warm": warm, "pairs": given.pairs}
            found.append(calling(name, f"{MODULE}:compare", {}, about | {"name": name}, **how))
    return found


def failures(rows) -> list[str]:
    slow = [row for row in rows if row.get("quotient", 0) > MOST]
    return [f"{row['name']}: {row['quotient']:.3f} of the time, expected at most {MOST}" for row in slow]


EXPERIMENT = Experiment(
    "engine.cost_of_checks",
    "What the checks of files, caches and plugins cost: runs with and without them, in turn.",
    cases,
    columns={
        "runs": {
            "run": "{name}",
            "pairs": "{pairs}",
            "with, s": "{medians[0]:.2f}",
            "without, s": "{medians[1]:.2f}",
            "with / without": "{quotient:.3f}",
            "quartiles": "{quartiles[0]:.3f} to {quartiles[1]:.3f}",
        },
        "path-traced steps": {
            "by one thread, s": "{one[median_s]:.3f}",
            "by all threads, s": "{all[median_s]:.3f}",
        },
    },
    group=lambda row: row["group"],
    failures=failures,
    options=lambda parser: parser.add_argument("--pairs", type=int, default=15, help="(%(default)s)"),
    alone=True,
)
