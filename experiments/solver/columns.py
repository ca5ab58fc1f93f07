r"""Milliseconds of four exact columns of T: what a light costs that moves to texels it has not met.

    ENVEDIT_DATA=... python -m experiments.solver.columns [--scenes sphere statue] [--map sunflowers]

From camera paths that are kept (``transport/path_vertices.py``), and with these paths traced anew each time.
Kernels are warm; medians. Nothing else may run on the machine.
"""

import argparse

import drjit as dr
import mitsuba as mi
import numpy as np

PATHS = 8, 48
"""Camera paths a pixel, the fewest and the most that columns of layers have."""
PLACE = 20, 30
"""Row and column of the first of the 2 x 2 texels."""


def main(arguments=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["sphere", "statue"])
    parser.add_argument("--map", default="sunflowers")
    given = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    from envedit import config, inputs, renderers  # after the variant
    from experiments import puresky
    from experiments.engine.timing import side_by_side

    print("| scene | paths a pixel | paths kept, ms | paths anew, ms |\n|---|---|---|---|")
    file = str(puresky.of_script([given.map])[given.map])
    for name in given.scenes:
        settings = config.from_dict({"input": {"envmap": file}, "scene": {"file": name}})
        lit = inputs.load_scene(settings.scene)
        original, _ = inputs.load_map(settings.input, lit)
        transport = renderers.trace(settings, lit, original.shape[:2])
        transport.resolve(original)
        rows, columns = np.meshgrid(*(start + np.arange(2) for start in PLACE), indexing="ij")
        texels = (rows * original.shape[1] + columns).ravel()
        for count in PATHS:
            found = side_by_side({
                "kept": lambda n=count, t=transport, at=texels: traced(t, at, n),
                "anew": lambda n=count, t=transport, at=texels: traced(t, at, n, anew=True),
            })  # fmt: skip
            cells = " | ".join(f"{1000 * found[way]['median_s']:.1f}" for way in ("kept", "anew"))
            print(f"| {name} | {count} | {cells} |", flush=True)


def traced(transport, texels, count, anew=False):
    """Trace columns from paths that are kept, or ``anew``: then paths of this number are forgotten before."""
    exact = transport._exact
    if anew:
        exact._kept.pop((count, transport.seed), None)
    exact.trace(texels, count, transport.seed)
    dr.sync_thread()


if __name__ == "__main__":
    main()
