"""Milliseconds of four exact columns of T: what a light costs that moves to texels it has not met.

From camera paths that are kept (``transport/path_vertices.py``), and with these paths traced anew each time.
Kernels are warm; medians. Nothing else may run on the machine.
"""

import drjit as dr
import numpy as np

from envedit import inputs, renderers
from experiments import puresky
from experiments.engine.timing import side_by_side
from experiments.harness import Experiment, calling

PATHS = 8, 48
"""Camera paths a pixel, the fewest and the most that columns of layers have."""
PLACE = 20, 30
"""Row and column of the first of the 2 x 2 texels."""


def times(settings, folder) -> dict:
    """Return ``rows``: milliseconds by paths a pixel, "kept" and "anew"."""
    lit = inputs.load_scene(settings.scene)
    original, _ = inputs.load_map(settings.input, lit)
    transport = renderers.trace(settings, lit, original.shape[:2])
    transport.resolve(original)
    rows, columns = np.meshgrid(*(start + np.arange(2) for start in PLACE), indexing="ij")
    texels = (rows * original.shape[1] + columns).ravel()
    found = []
    for count in PATHS:
        taken = side_by_side({
            "kept": lambda n=count: traced(transport, texels, n),
            "anew": lambda n=count: traced(transport, texels, n, anew=True),
        })  # fmt: skip
        found.append({"paths": count} | {way: 1000 * taken[way]["median_s"] for way in taken})
    return {"rows": found}


def traced(transport, texels, count, anew=False):
    """Trace columns from paths that are kept, or ``anew``: then paths of this number are forgotten before."""
    exact = transport._exact
    if anew:
        exact._kept.pop((count, transport.seed), None)
    exact.trace(texels, count, transport.seed)
    dr.sync_thread()


def cases(given):
    tables = {"input": {"envmap": puresky.file("sunflowers")}}
    return [
        calling(
            scene, "experiments.solver.columns:times", tables | {"scene": {"file": scene}}, {"scene": scene}
        )
        for scene in ("sphere", "statue")
    ]


EXPERIMENT = Experiment(
    "solver.columns",
    "Milliseconds of four exact columns of T, from camera paths that are kept and from new ones.",
    cases,
    lambda done: done.metrics["rows"],
    {
        "scene": "{scene}",
        "paths a pixel": "{paths}",
        "paths kept, ms": "{kept:.1f}",
        "paths anew, ms": "{anew:.1f}",
    },
    alone=True,
)
