"""The light transport: applying T and its adjoint, against memory bandwidth and against Mitsuba's prb."""

from __future__ import annotations

import gc
import itertools
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.inputs import load_map
from envedit.scene import scene
from envedit.scene.path_tracer import PathTracer
from envedit.transport.light_transport import RESOLVE_EVERY, LightTransport

from . import floors
from .tables import si
from .timing import compiled, side_by_side

PRB_SPP = 16


def load_scene(settings):
    """Load a configuration's scene in a square picture, with Mitsuba's default sampler."""
    file, width = settings.scene.file, settings.scene.width
    return scene.load(file, width, width, settings.scene.parameters, sampler="independent")


def measure(settings, quick: bool = False) -> dict:
    """Measure one scene under a clear sky.

    Returns
    -------
    dict
        ``transport``: a row with what was traced (``spp``, ``depth``, ``columns``, ``choices``), seconds
        (``first_s``, ``again_s`` of tracing, ``resolve_s``, ``load_s``), bytes (``held``, and those that
        ``apply`` and ``adjoint`` read), and ``floor_s``: the seconds that reading these bytes once takes.
        ``transport-time``: rows ``what``, ``median_s`` and ``note``. A step is a rendering and its gradient;
        through T with its share of looking for texels grown bright, and by path tracing with the map set as
        an edit has to (Mitsuba builds its sampling table anew).
    """
    bandwidth = floors.bandwidth(1 << 20 if quick else None)["read"]
    lit, spp = load_scene(settings), settings.renderer.spp
    sky, _ = load_map(settings.input)
    height, width, _ = sky.shape
    transport, first = build(lit, height, width, spp)
    del transport
    load = from_disk(lit, height, width, spp)
    gc.collect()
    transport, again = build(lit, height, width, spp)

    env = dr.opaque(mi.TensorXf(sky))
    weight = np.random.default_rng(0).random((*transport.shape, 3), np.float32)
    weight = dr.opaque(mi.TensorXf(weight))
    start = time.perf_counter()
    transport.resolve(sky)
    resolve = time.perf_counter() - start
    depth = transport.bounces + 1
    tracer, steps = PathTracer(lit, PRB_SPP, depth, one_thread=False), itertools.count()
    times = side_by_side(
        {
            "T E": lambda: transport.apply(env),
            "T' I": lambda: transport.adjoint(weight),
            "T step": lambda: gradient(transport.apply, env, weight),
            # Every time, as in an edit: the map is read back to the host.
            "T look": lambda: transport.resolve(dr.detach(env).numpy()),
            "prb step": lambda: gradient(lambda e: tracer.render(e, next(steps)), env, weight),
        },
        3 if quick else 11,
    )
    reads = bytes_read(transport)
    read = reads["apply"] + reads["adjoint"]
    floor = read / bandwidth
    median = {name: found["median_s"] for name, found in times.items()}
    look = median["T look"] / RESOLVE_EVERY
    step = median["T step"] + look
    above = (median["T E"] + median["T' I"]) / floor
    spent = [
        {"what": "T E", **times["T E"]},
        {"what": "T' I", **times["T' I"]},
        {
            "what": f"floor of both: {si(read, 'B')} at {si(bandwidth, 'B/s')}",
            "median_s": floor,
            "above_floor": above,
        },
        {"what": "a step through T", "median_s": step},
        {"what": "of it: looking for bright texels", "median_s": look, "every": RESOLVE_EVERY},
        {"what": f"prb, {PRB_SPP} spp, a step", **times["prb step"], "ratio": median["prb step"] / step},
    ]
    size = {"pixels": lit.width, "texels": [height, width]}
    row = {
        "spp": transport.spp,
        "depth": depth,
        "columns": len(transport.columns),
        "choices": transport.choices,
        "first_s": first,
        "again_s": again,
        "resolve_s": resolve,
        "load_s": load,
        "bytes": {"held": transport.memory_bytes, **reads},
        "floor_s": floor,
        "trace_in_prb_steps": again / median["prb step"],
        "adjointness": adjointness(transport),
        "kernels": compiled(lambda: gradient(transport.apply, env, weight)),
    }
    return {"transport": [size | row], "transport-time": [size | line for line in spent]}


def scaling(settings, quick: bool = False) -> dict:
    """Trace a scene at one size and measure T under a clear sky with its exact columns.

    Returns
    -------
    dict
        ``scaling``: a row with ``trace_s`` (kernels compiled), ``spp``, ``columns``, ``bytes`` that both
        products read, ``held``, and seconds ``apply_s`` and ``adjoint_s``.
    """
    lit = load_scene(settings)
    sky, _ = load_map(settings.input)
    height, width, _ = sky.shape
    build(lit, height, width, settings.renderer.spp)
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


def from_disk(lit, height: int, width: int, spp, repeats: int = 3) -> float | None:
    """Return the median seconds in which T comes from its file, which the system still has in memory.

    None if T was not kept.
    """
    with tempfile.TemporaryDirectory() as folder:
        build(lit, height, width, spp, Path(folder))
        taken = []
        for _ in range(repeats):
            gc.collect()
            built, seconds = build(lit, height, width, spp, Path(folder))
            if not built.cached:
                return None
            taken.append(seconds)
            del built
    return float(np.median(taken))


def build(lit, height: int, width: int, spp, folder: Path | None = None):
    """Build T as for SIREN and pixels, kept in ``folder`` or nowhere; returns it with the seconds."""
    start = time.perf_counter()
    built = LightTransport.build(lit, height, width, spp=spp, memory_gb=2.0, folder=folder)
    dr.sync_thread()
    return built, time.perf_counter() - start


def gradient(render, env: mi.TensorXf, weight: mi.TensorXf):
    """Render and pull ``weight`` back to the map: what an edit does at every step."""
    leaf = mi.TensorXf(env)
    dr.enable_grad(leaf)
    with dr.isolate_grad():
        picture = render(leaf)
        dr.backward(dr.sum(picture * weight, axis=None))
    return dr.detach(picture), dr.grad(leaf)


def bytes_read(transport: LightTransport) -> dict:
    """Count the bytes that T E and T' I have to read: entries, columns in use, map and picture once."""
    stored = transport.memory_bytes - transport.forward.bytes - transport.reverse.bytes
    columns = stored * len(transport.columns) // max(transport.capacity, 1)
    vectors = 12 * (transport.grid.texels + transport.shape[0] * transport.shape[1])
    return {
        "apply": transport.forward.bytes + columns + vectors,
        "adjoint": transport.reverse.bytes + columns + vectors,
    }


def adjointness(transport: LightTransport) -> float:
    """Return |<T E, I> - <E, T' I>| / <T E, I> for positive random E and I, summed in double precision."""
    rng = np.random.default_rng(1)
    env = rng.random((transport.grid.height, transport.grid.width, 3), np.float32)
    picture = rng.random((*transport.shape, 3), np.float32)
    dark = transport.apply(mi.TensorXf(np.zeros_like(env))).numpy()  # light of other lamps is not T's
    one = np.vdot(transport.apply(mi.TensorXf(env)).numpy().astype(np.float64) - dark, picture)
    other = np.vdot(env.astype(np.float64), transport.adjoint(mi.TensorXf(picture)).numpy())
    return float(abs(one - other) / abs(one))
