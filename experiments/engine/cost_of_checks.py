r"""What do the checks of files, caches and plugins cost? Runs with and without them, in turn.

    python -m experiments.engine.cost_of_checks [--pairs 15] [--parts checks film] [--out FOLDER]
    python -m experiments.engine.cost_of_checks --path [--pairs 15]

Two runs: ``quickstart`` with empty caches, and ``quickstart --preset standard`` with full ones. A pair is one
run with the checks and one without, in a process each, in an order that alternates. Shown are the medians of
the seconds from start to end of the process, and of the quotient within pairs with its quartiles; exits with
1 if a median quotient is above 1.03. Without ``checks``: digests of cache entries and their types, shapes and
ranges; meshes, textures and volumes; references, required properties and names of plugins; the metrics of log
radiance. Without ``film``: Mitsuba's own film in place of sums in a fixed order. ``--path``: a path-traced
step with gradients by one thread, whose sums have a fixed order, and by all. On a quiet machine only.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PARTS = ("checks", "film")
RUNS = {"quickstart, caches empty": ([], False), "standard, caches full": (["--preset", "standard"], True)}
MOST = 1.03


def without(part: str) -> None:
    """Switch a part off in this process."""
    from envedit.core import array_cache, installed_plugins
    from envedit.losses import metrics
    from envedit.scene import film, parser, scene_files, scene_text

    if part == "checks":
        array_cache._digest = lambda array: ""
        array_cache.holds = lambda arrays, wanted: True
        installed_plugins.check = scene_files.check = lambda *_: None
        scene_text.check_references = parser.check_required = lambda *_: None
        metrics.log_rmse = metrics._beyond_display = lambda *_: 0.0
    else:
        film.render = _own_film


def _own_film(scene, integrator, spp, seed, medium=None, view=0):
    import mitsuba as mi
    import numpy as np

    picture = np.array(mi.render(scene, sensor=view, integrator=integrator, spp=spp, seed=seed), np.float64)
    return np.concatenate([picture[..., :3], np.ones_like(picture[..., :1])], axis=2)


def child(parts: list[str], arguments: list[str]) -> int:
    """Carry out a run without some parts."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    for part in parts:
        without(part)
    from envedit.cli import run

    return run.main(arguments)


def seconds(off: list[str], options: list[str], caches: Path, out: Path) -> float:
    """Time one run in a process of its own."""
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "experiments.engine.cost_of_checks", "--child", *off, "--"]
    begun = time.perf_counter()
    subprocess.run(
        [*command, "quickstart", "--quiet", "--out", str(out), *options],
        env=os.environ | {"XDG_CACHE_HOME": str(caches)},
        check=True,
    )
    return time.perf_counter() - begun


def compare(parts: list[str], options: list[str], warm: bool, pairs: int, folder: Path):
    """Return the seconds of every pair, (with, without)."""
    sides = {"with": [], "without": parts}
    for name, off in sides.items():  # kernels, and caches where they are to be full
        seconds(off, options, folder / name, folder / "run")
    found = []
    for i in range(pairs):
        pair = {}
        for name in sorted(sides, reverse=bool(i % 2)):
            if not warm:
                shutil.rmtree(folder / name, ignore_errors=True)
            pair[name] = seconds(sides[name], options, folder / name, folder / "run")
        found.append((pair["with"], pair["without"]))
    return found


def path_steps(pairs: int) -> dict:
    """Time path-traced steps on a statue of 128 x 128 pixels, by one thread and by all in turn."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    from envedit.scene import scene
    from envedit.scene.path_tracer import PathTracer
    from experiments.engine.timing import side_by_side
    from experiments.engine.transport import gradient

    lit = scene.load("statue", 128, 128)
    envmap = dr.opaque(mi.TensorXf(np.random.default_rng(0).random((128, 256, 3), dtype=np.float32)))
    weight = dr.opaque(mi.TensorXf, 1, (lit.height, lit.width, 3))

    def step(one_thread):
        tracer = PathTracer(lit, one_thread=one_thread)
        return lambda: gradient(lambda e: tracer.render(e, 0), envmap, weight)

    return side_by_side({"one thread": step(True), "all threads": step(False)}, pairs)


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.engine.cost_of_checks", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=["checks"], help="what is switched off")
    parser.add_argument("--out", type=Path, help="folder for runs and caches (default: a temporary one)")
    parser.add_argument("--path", action="store_true", help="time path-traced steps instead")
    chosen = parser.parse_args(argv)
    if chosen.path:
        for name, times in path_steps(chosen.pairs).items():
            print(f"gradient by {name}: {1000 * times['median_s']:.0f} ms a step")
        return 0
    print("| run | pairs | with, s | without, s | with / without | quartiles |\n|---|---|---|---|---|---|")
    worst = 0.0
    with tempfile.TemporaryDirectory() as temporary:
        for i, (name, (options, warm)) in enumerate(RUNS.items()):
            folder = (chosen.out or Path(temporary)) / str(i)
            found = compare(chosen.parts, options, warm, chosen.pairs, folder)
            quotients = sorted(one / other for one, other in found)
            middle = statistics.median(quotients)
            ends = quotients[len(found) // 4], quotients[-1 - len(found) // 4]
            with_s, without_s = (statistics.median(side) for side in zip(*found, strict=True))
            shown = f"{with_s:.2f} | {without_s:.2f} | {middle:.3f} | {ends[0]:.3f} to {ends[1]:.3f}"
            print(f"| {name} | {chosen.pairs} | {shown} |", flush=True)
            worst = max(worst, middle)
    return int(worst > MOST)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        end = sys.argv.index("--")
        sys.exit(child(sys.argv[2:end], sys.argv[end + 1 :]))
    sys.exit(main())
