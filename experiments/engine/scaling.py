"""How T grows: with the pixels, the texels and the samples, one at a time."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.inputs import load_map

from .timing import side_by_side
from .transport import build, bytes_read, load_scene


def measure(settings, quick: bool = False) -> dict:
    """Trace a scene at one size and measure T under a clear sky with its exact columns.

    Returns
    -------
    dict
        ``scaling``: a row with ``trace_s`` (kernels compiled), ``spp``, ``columns``, ``bytes`` that both
        products read, ``held``, and seconds ``apply_s`` and ``adjoint_s``.
    """
    lit, (sky, _) = load_scene(settings), load_map(settings.input)
    height, width, _ = sky.shape
    transport, _ = build(lit, height, width, settings.renderer.spp)
    del transport
    gc.collect()
    transport, trace = build(lit, height, width, settings.renderer.spp)
    transport.resolve(sky)
    env = dr.opaque(mi.TensorXf(sky))
    picture = np.random.default_rng(0).random((*transport.shape, 3), np.float32)
    picture = dr.opaque(mi.TensorXf(picture))
    taken = side_by_side(
        {"apply": lambda: transport.apply(env), "adjoint": lambda: transport.adjoint(picture)},
        3 if quick else 7,
    )
    reads = bytes_read(transport)
    row = {
        "pixels": lit.width,
        "texels": [height, width],
        "spp": transport.spp,
        "columns": len(transport.columns),
        "trace_s": trace,
        "bytes": reads["apply"] + reads["adjoint"],
        "held": transport.memory_bytes,
        "apply_s": taken["apply"]["median_s"],
        "adjoint_s": taken["adjoint"]["median_s"],
        "choices": transport.choices,
    }
    return {"scaling": [row]}
