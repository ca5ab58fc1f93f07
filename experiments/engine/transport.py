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

from envedit.core import latlong
from envedit.scene import scene
from envedit.scene.path_tracer import PathTracer
from envedit.transport.light_transport import RESOLVE_EVERY, LightTransport

from . import floors, maps
from .timing import compiled, side_by_side

PIXELS, WIDTH, PRB_SPP = 256, 256, 16


def measure(quick: bool = False, bandwidth: dict | None = None) -> dict:
    """Measure the scenes ``sphere`` and, with data, ``mesh``.

    Parameters
    ----------
    quick : bool
        One scene at a tiny size.
    bandwidth : dict, optional
        :func:`.floors.bandwidth` of this run; measured if it is not given.

    Returns
    -------
    dict
        ``read``: the bandwidth, bytes a second; ``scenes``: a row each, see :func:`one_scene`; ``skipped``.
    """
    bandwidth = bandwidth or floors.bandwidth(1 << 20 if quick else None)
    chosen, skipped = {"sphere": {}}, []
    if not quick:
        if mesh := maps.mesh():
            chosen["mesh"] = mesh
        else:
            skipped.append("scene mesh: ENVEDIT_DATA names no folder with meshes")
    size = (32, 32, 64) if quick else (PIXELS, WIDTH, "auto")
    rows = [
        one_scene(name, parameters, *size, bandwidth["read"], quick) for name, parameters in chosen.items()
    ]
    return {"read": bandwidth["read"], "scenes": rows, "skipped": skipped}


def one_scene(name, parameters, pixels, width, spp, read, quick=False) -> dict:
    """Measure one scene under a clear sky.

    Returns
    -------
    dict
        What was traced (``spp``, ``depth``, ``columns``, ``choices``), seconds (``trace``, ``resolve_s``,
        ``disk``), bytes (``held``, and those that ``apply`` and ``adjoint`` read), times of everything, and:

        ``floor_s``
            the seconds that reading these bytes once takes;
        ``step_s``
            a rendering and its gradient through T, with its share of looking for texels grown bright;
        ``prb_step_s``
            the same by path tracing, map set as an edit has to (Mitsuba builds its sampling table anew);
            ``prb_bare_step_s`` is without setting the map, which no edit can do.
    """
    lit = scene.load(name, pixels, pixels, parameters, sampler="independent")  # Mitsuba's default
    height = width // 2
    map_name, sky = maps.sunny(width, real=not quick)
    transport, first = build(lit, height, width, spp)
    del transport
    disk = from_disk(lit, height, width, spp)
    gc.collect()
    transport, again = build(lit, height, width, spp)

    env = dr.opaque(mi.TensorXf(sky))
    weight = np.random.default_rng(0).random((*transport.shape, 3), np.float32)
    weight = dr.opaque(mi.TensorXf(weight))
    repeats = 3 if quick else 11
    applied = {"apply": lambda: transport.apply(env), "adjoint": lambda: transport.adjoint(weight)}
    coarse = side_by_side(applied, repeats)

    start = time.perf_counter()
    transport.resolve(sky)
    resolve = time.perf_counter() - start
    depth = transport.bounces + 1
    tracer = PathTracer(lit, PRB_SPP, depth, one_thread=False)
    steps, bare = itertools.count(), bare_prb(lit.path, parameters, pixels, sky, depth, weight)
    times = side_by_side(
        {
            **applied,
            "T step": lambda: gradient(transport.apply, env, weight),
            # Every time, as in an edit: the map is read back to the host.
            "T look": lambda: transport.resolve(dr.detach(env).numpy()),
            "prb forward": lambda: tracer.render(env, next(steps)),
            "prb step": lambda: gradient(lambda e: tracer.render(e, next(steps)), env, weight),
            "prb bare step": bare,
        },
        repeats,
    )
    reads = bytes_read(transport)
    floor = (reads["apply"] + reads["adjoint"]) / read
    both = times["apply"]["median_s"] + times["adjoint"]["median_s"]
    look = times["T look"]["median_s"] / RESOLVE_EVERY
    step = times["T step"]["median_s"] + look
    prb, prb_bare = (times[key]["median_s"] for key in ("prb step", "prb bare step"))
    return {
        "scene": name,
        "pixels": pixels,
        "texels": [height, width],
        "map": map_name,
        "spp": transport.spp,
        "depth": depth,
        "columns": len(transport.columns),
        "choices": transport.choices,
        "trace": {"first_s": first, "again_s": again},
        "resolve_s": resolve,
        "disk": disk,
        "bytes": {"held": transport.memory_bytes, **reads},
        "coarse": coarse,
        "times": times,
        "floor_s": floor,
        "above_floor": both / floor,
        "step_s": step,
        "look_s": look,
        "look_every": RESOLVE_EVERY,
        "prb_spp": PRB_SPP,
        "prb_step_s": prb,
        "prb_bare_step_s": prb_bare,
        "ratio": prb / step,
        "ratio_bare": prb_bare / step,
        "trace_in_prb_steps": again / prb,
        "adjointness": adjointness(transport),
        "kernels": compiled(lambda: gradient(transport.apply, env, weight)),
    }


def from_disk(lit, height: int, width: int, spp, repeats: int = 3) -> dict | None:
    """Measure how long T takes from its file, which the system still has in memory.

    Returns
    -------
    dict or None
        ``load_s`` (median) and ``file_bytes``; None if T was not kept.
    """
    with tempfile.TemporaryDirectory() as folder:
        LightTransport.build(lit, height, width, spp=spp, memory_gb=2.0, folder=Path(folder))
        taken = []
        for _ in range(repeats):
            gc.collect()
            built, seconds = build(lit, height, width, spp, Path(folder))
            if not built.cached:
                return None
            taken.append(seconds)
            del built
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
    return {"load_s": float(np.median(taken)), "file_bytes": size}


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


def bare_prb(file, parameters, pixels, sky, depth, weight):
    """Return a function that renders and differentiates by prb under a map that was set once."""
    lit = scene.load(
        file, pixels, pixels, parameters, sampler="independent"
    )  # its own: the other one's map is set at every step
    leaf = mi.TensorXf(latlong.to_envmap_data(sky))
    dr.enable_grad(leaf)
    lit.params[lit.envmap_key] = leaf
    lit.params.update()
    integrator = mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": depth + 1})
    seeds = itertools.count()

    def run():
        dr.set_grad(lit.params[lit.envmap_key], 0)
        seed = next(seeds)
        picture = mi.render(
            lit.mi, lit.params, integrator=integrator, spp=PRB_SPP, seed=2 * seed, seed_grad=2 * seed + 1
        )
        dr.backward(dr.sum(picture * weight, axis=None))
        return dr.detach(picture), dr.grad(lit.params[lit.envmap_key])

    return run


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
