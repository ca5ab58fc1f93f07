"""The light transport: what T costs beside memory bandwidth and Mitsuba's prb, and what it gets wrong.

The hardest map is one bright texel over a dim sky. The reference is Mitsuba's path tracer without a bound on
the depth; it samples the map by its light, so that a one-texel sun costs it no more than any other. Two
independent halves measure its noise.
"""

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
from envedit.renderers import RESOLVE_EVERY
from envedit.scene import scene
from envedit.scene.path_tracer import AUTO_DEPTH, PathTracer
from envedit.transport.light_transport import LightTransport
from envedit.transport.sampling_plan import COLUMNS_STORED

from . import floors
from .timing import compiled, side_by_side

PRB_SPP, PRB_SEEDS = 16, 4


def measure(
    settings, sun=None, reference_spp: int = 0, prb_spp: int = PRB_SPP, disk=False, quick=False
) -> dict:
    """Measure T in a scene under a map, and steps of prb beside it.

    A ``sun``, [elevation, across] of :func:`one_texel_sun`, takes the place of the map, and is compared with
    a reference. With ``disk`` loading from there is measured as well, and the bandwidth.

    Returns
    -------
    dict
        ``transport``: a row with what was traced (``spp``, ``depth``, ``columns``, ``choices``), seconds
        (``first_s``, ``again_s`` of tracing, ``resolve_s``, ``load_s`` from disk), bytes (``held``, and
        ``read`` by both products); seconds of the products, and of a step, a rendering and its gradient:
        through T with its share of looking for texels grown bright, and by path tracing with the map set as
        an edit has to (Mitsuba builds its sampling table anew). Under a sun also :func:`compared`.
        ``quality-parts``: :func:`without_caustics` of a scene with a mirror, under a sun.
    """
    # ---- tracing -----------------------------------------------------------------------------------------
    bandwidth = floors.bandwidth(1 << 20 if quick else None)["read"] if disk else None
    lit = load_scene(settings)
    sky = one_texel_sun(settings.input.width, *sun) if sun else load_map(settings.input)[0]
    height, width, _ = sky.shape
    _, first = build(lit, height, width, settings.renderer)
    load = from_disk(lit, height, width, settings.renderer) if disk else None
    gc.collect()
    transport, again = build(lit, height, width, settings.renderer)
    start = time.perf_counter()
    transport = transport.resolved(sky)
    transport.apply(sky)
    resolve = time.perf_counter() - start

    # ---- products and steps ------------------------------------------------------------------------------
    env = dr.opaque(mi.TensorXf(sky))
    weight = np.random.default_rng(0).random((*transport.shape, 3), np.float32)
    weight = dr.opaque(mi.TensorXf(weight))
    depth = transport.bounces + 1
    # Beside a reference of any depth no less than a run takes, beside T alone the same.
    prb_depth = max(AUTO_DEPTH, depth) if sun else depth
    tracer = PathTracer(lit, prb_spp, prb_depth, one_thread=False)
    steps = itertools.count()
    times = side_by_side(
        {
            "apply": lambda: transport.apply(env),
            "adjoint": lambda: transport.adjoint(weight),
            "step": lambda: gradient(transport.apply, env, weight),
            # Every time, as in an edit: the map is read back to the host.
            "look": lambda: transport.resolved(dr.detach(env).numpy()).apply(env),
            "prb": lambda: gradient(lambda e: tracer.render(e, next(steps)), env, weight),
        },
        3 if quick else 7,
    )
    median = {name: found["median_s"] for name, found in times.items()}
    step = median["step"] + median["look"] / RESOLVE_EVERY
    read = bytes_read(transport)
    floor = read / bandwidth if bandwidth else None
    row = {
        "pixels": lit.width,
        "texels": [height, width],
        "spp": transport.spp,
        "depth": depth,
        "columns": len(transport.columns),
        "choices": transport.choices,
        "first_s": first,
        "again_s": again,
        "resolve_s": resolve,
        "load_s": load,
        "held": transport.memory_bytes,
        "read": read,
        "bandwidth": bandwidth,
        "above_floor": (median["apply"] + median["adjoint"]) / floor if floor else None,
        "apply_s": median["apply"],
        "adjoint_s": median["adjoint"],
        "step_s": step,
        "prb_samples": prb_spp,
        "prb_step_s": median["prb"],
        "prb_ratio": median["prb"] / step,
        "trace_in_prb_steps": again / median["prb"],
        "adjointness": adjointness(transport),
        "kernels": compiled(lambda: gradient(transport.apply, env, weight)),
    }
    if not sun:
        return {"transport": [row]}

    # ---- errors ------------------------------------------------------------------------------------------
    halves = reference(lit, sky, reference_spp)
    prb = [tracer.render(env, next(steps)).numpy() for _ in range(PRB_SEEDS)]
    found = compared(transport.apply(env).numpy(), prb, halves)
    found["prb_needs"] = prb_spp * found["prb_times"]
    found["equal_error"] = found["prb_times"] * row["prb_ratio"]
    mirror = any(mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Delta) for s in lit.mi.shapes())
    parts = without_caustics(lit, sky, reference_spp) if mirror else []
    return {"transport": [row | found], "quality-parts": parts}


# ---- T -----------------------------------------------------------------------------------------------------


def load_scene(settings):
    """Load a configuration's scene in a square picture, with Mitsuba's default sampler."""
    file = settings.scene.file
    width = settings.scene.width
    return scene.load(file, width, width, settings.scene.parameters, sampler="independent")


def build(lit, height: int, width: int, renderer, folder: Path | None = None):
    """Build T as for SIREN and pixels, kept in ``folder`` or nowhere; returns it with the seconds."""
    start = time.perf_counter()
    sizes = {"spp": renderer.spp, "memory_gb": renderer.memory_gb}
    built = LightTransport.build(lit, height, width, folder=folder, **sizes)
    dr.sync_thread()
    return built, time.perf_counter() - start


def from_disk(lit, height: int, width: int, renderer) -> float | None:
    """Return the median seconds in which T comes from its file, which the system still has in memory.

    None if T was not kept.
    """
    with tempfile.TemporaryDirectory() as folder:
        build(lit, height, width, renderer, Path(folder))
        taken = []
        for _ in range(3):
            gc.collect()
            built, seconds = build(lit, height, width, renderer, Path(folder))
            if not built.cached:
                return None
            taken.append(seconds)
            del built
    return float(np.median(taken))


def gradient(render, env: mi.TensorXf, weight: mi.TensorXf):
    """Render and pull ``weight`` back to the map: what an edit does at every step."""
    leaf = mi.TensorXf(env)
    dr.enable_grad(leaf)
    with dr.isolate_grad():
        picture = render(leaf)
        dr.backward(dr.sum(picture * weight, axis=None))
    return dr.detach(picture), dr.grad(leaf)


def bytes_read(transport: LightTransport) -> int:
    """Count the bytes that T E and T' I have to read: entries, columns in use, map and picture once each."""
    entries = transport.forward.bytes + transport.reverse.bytes
    stored = transport.memory_bytes - entries
    columns = stored * len(transport.columns) // max(COLUMNS_STORED * transport.capacity, 1)
    vectors = 12 * (transport.grid.texels + transport.shape[0] * transport.shape[1])
    return entries + 2 * (columns + vectors)


def adjointness(transport: LightTransport) -> float:
    """Return |<T E, I> - <E, T' I>| / <T E, I> for positive random E and I, summed in double precision."""
    rng = np.random.default_rng(1)
    env = rng.random((transport.grid.height, transport.grid.width, 3), np.float32)
    picture = rng.random((*transport.shape, 3), np.float32)
    dark = transport.apply(mi.TensorXf(np.zeros_like(env))).numpy()  # light of other lamps is not T's
    one = np.vdot(transport.apply(mi.TensorXf(env)).numpy().astype(np.float64) - dark, picture)
    other = np.vdot(env.astype(np.float64), transport.adjoint(mi.TensorXf(picture)).numpy())
    return float(abs(one - other) / abs(one))


# ---- errors ------------------------------------------------------------------------------------------------


def one_texel_sun(width: int, elevation: float, across: float) -> np.ndarray:
    """Return a grey sky (width / 2, width, 3) of 0.1 with a sun of 1e5 in one texel.

    It is ``elevation`` degrees above the horizon, and ``across`` from the left edge, 0 to 1: at 0 behind the
    object, at 1/2 behind the camera of the shipped scenes.
    """
    height = width // 2
    picture = np.full((height, width, 3), 0.1, np.float32)
    # Rows are aligned to the corners: row 0 is the zenith, the last one the nadir.
    picture[round((90 - elevation) / 180 * (height - 1)), int(across * width)] = 1e5
    return picture


def reference(lit, sky: np.ndarray, spp: int, depth: int = -1) -> list[np.ndarray]:
    """Render the independent halves (h, w, 3) of a reference, whose mean it is."""
    halves = [lit.render(sky, spp=spp // 2, seed=seed, max_depth=depth) for seed in (1, 2)]
    return [half.astype(np.float64) for half in halves]


def errors(got: np.ndarray, halves: list[np.ndarray], pixels=...) -> dict[str, float]:
    """Compare some pixels of a picture with a reference.

    Returns root mean squares relative to the mean of the whole reference: ``rmse``; ``noise`` of the
    reference, half of the difference of its halves, which differ by sqrt(2) times the noise of one where
    their mean has 1/sqrt(2) of it; ``corrected``: sqrt(rmse^2 - noise^2), as the two are independent.
    """
    wanted = (halves[0] + halves[1]) / 2
    differences = got[pixels] - wanted[pixels], (halves[0] - halves[1])[pixels] / 2
    rmse, noise = (float(np.sqrt(np.square(one).mean()) / wanted.mean()) for one in differences)
    return {"rmse": rmse, "noise": noise, "corrected": float(np.sqrt(max(rmse**2 - noise**2, 0)))}


def compared(picture: np.ndarray, prb: list[np.ndarray], halves: list[np.ndarray]) -> dict[str, float]:
    """Compare T's picture, and several of prb, with a reference.

    Returns :func:`errors` of T; ``prb_rmse``, corrected; ``prb_times``: how many times as many samples prb
    would need for T's error, as its squared error falls with their number. T's error is not corrected there,
    which counts against T.
    """
    found = errors(picture, halves)
    square = np.mean([errors(one, halves)["rmse"] for one in prb]) ** 2
    square = max(square - found["noise"] ** 2, 0)
    return found | {"prb_rmse": float(np.sqrt(square)), "prb_times": float(square / found["rmse"] ** 2)}


def without_caustics(lit, sky: np.ndarray, spp: int) -> list[dict]:
    """Compare direct light alone (path depth 2), in the pixels that see a mirror and in those that do not.

    A caustic takes three segments or more. No unidirectional path tracer finds the sun through it but by
    chance, so that neither T nor the reference converges there. With two segments there is none; what stays
    hard is the sun's own image in the mirror, smaller than a pixel, which is why the pixels are kept apart.
    """
    transport = LightTransport.build(lit, *sky.shape[:2], max_depth=2).resolved(sky)
    halves = reference(lit, sky, spp, depth=2)
    got = transport.apply(mi.TensorXf(sky)).numpy()
    mirror = sees_mirror(lit)
    return [
        {"part": part, "seen": int(mask.sum())} | errors(got, halves, mask)
        for part, mask in (("matte pixels", ~mirror), ("mirror pixels", mirror))
    ]


def sees_mirror(lit, across: int = 8) -> np.ndarray:
    """Mark the pixels (h, w) any of whose across^2 camera rays hits a mirror or clear glass."""
    x, y = ((np.arange(size * across) + 0.5) / (size * across) for size in (lit.width, lit.height))
    places = mi.Point2f(*(mi.Float(one.ravel()) for one in np.meshgrid(x, y)))
    ray, _ = lit.mi.sensors()[0].sample_ray(0, 0, places, mi.Point2f(0.5))
    hit = lit.mi.ray_intersect(ray)
    mirror = hit.is_valid() & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Delta)
    return mirror.numpy().reshape(lit.height, across, lit.width, across).any(axis=(1, 3))
