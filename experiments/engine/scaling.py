"""How T grows: with the pixels, the texels and the samples, one at a time."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.scene import scene

from . import maps
from .timing import side_by_side
from .transport import build, bytes_read

BASE = {"pixels": 128, "width": 256, "spp": "auto"}
RANGES = {"pixels": (64, 128, 256, 512), "width": (128, 256, 512), "spp": (16, 32, 64, 128, 256)}
SLOW = 20
"""Seconds above which T is not traced a second time to leave out compilation."""


def measure(quick: bool = False) -> dict:
    """Return ``rows``, one for each value of each variable, see :func:`one_size`; the others as in BASE."""
    base, ranges = BASE, RANGES
    if quick:
        base = {"pixels": 16, "width": 32, "spp": 16}
        ranges = {"pixels": (16, 32), "width": (16, 32), "spp": (16, 32)}
    return {
        "base": base,
        "rows": [
            {"variable": variable, "value": value, **one_size(**base | {variable: value}, quick=quick)}
            for variable, values in ranges.items()
            for value in values
        ],
    }


def one_size(pixels: int, width: int, spp, quick: bool = False) -> dict:
    """Trace the scene ``sphere`` at one size and measure it under a clear sky with its exact columns.

    Returns
    -------
    dict
        ``trace_s`` and ``cold``, whether kernels were compiled in it; ``spp``, ``columns``, ``bytes`` that
        both products read, ``held``, ``apply``, ``adjoint``, ``choices``.
    """
    lit = scene.load("sphere", pixels, pixels, sampler="independent")
    height = width // 2
    transport, trace = build(lit, height, width, spp)
    cold = trace > SLOW
    if not cold:
        del transport
        gc.collect()
        transport, trace = build(lit, height, width, spp)
    _, sky = maps.sunny(width, real=not quick)
    transport.resolve(sky)
    env = dr.opaque(mi.TensorXf(sky))
    picture = np.random.default_rng(0).random((*transport.shape, 3), np.float32)
    picture = dr.opaque(mi.TensorXf(picture))
    taken = side_by_side(
        {"apply": lambda: transport.apply(env), "adjoint": lambda: transport.adjoint(picture)},
        3 if quick else 7,
    )
    reads = bytes_read(transport)
    return {
        "pixels": pixels,
        "texels": [height, width],
        "spp": transport.spp,
        "columns": len(transport.columns),
        "trace_s": trace,
        "cold": cold,
        "bytes": reads["apply"] + reads["adjoint"],
        "held": transport.memory_bytes,
        "apply": taken["apply"],
        "adjoint": taken["adjoint"],
        "choices": transport.choices,
    }
