"""What T gets wrong: one bright texel over a dim sky, the hardest map, against converged renderings.

The reference is Mitsuba's path tracer without a bound on the depth; it samples the map by its light, so that
a one-texel sun costs it no more than any other. Its own noise is told by two independent halves.
"""

from __future__ import annotations

import itertools
import time

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.config import Config
from envedit.core import shipped
from envedit.scene import scene
from envedit.scene.path_tracer import AUTO_DEPTH, PathTracer
from envedit.transport.light_transport import LightTransport

from . import maps
from .timing import side_by_side
from .transport import gradient

SUNS = {"80 degrees": (80, 0.62), "45 degrees": (45, 0.40), "10 degrees": (10, 0.70)}
"""Elevation in degrees, and place across the map."""
REFERENCE_SPP = 4096
PRB_SPP, PRB_SEEDS = 16, 4
CURVE_SPP, CURVE_SAMPLES = (4, 16, 64, 256), (16, 64, 256)


def measure(quick: bool = False) -> dict:
    """Measure T in every shipped scene, as the standard preset has it for SIREN and pixels.

    Returns
    -------
    dict
        ``rows``: one for each scene and sun, see :func:`one_sun`; ``parts``: for scenes with a mirror, the
        same without the light that comes to a matte surface by way of it, see :func:`without_caustics`;
        ``curve``: error against time, see :func:`curve`; ``choices`` by scene; ``skipped``.
    """
    chosen, skipped = {name: {} for name in shipped.scenes() if name != "mesh"}, []
    if mesh := maps.mesh():
        chosen["mesh"] = mesh
    elif not quick:
        skipped.append("scene mesh: ENVEDIT_DATA names no folder with meshes")
    settings, suns, spp = Config(), SUNS, REFERENCE_SPP
    pixels, width, samples = settings.scene.width, settings.input.width, settings.renderer.spp
    if quick:
        chosen, suns, pixels, width, spp = {"sphere": {}}, {"45 degrees": SUNS["45 degrees"]}, 24, 32, 2048
    rows, parts, choices = [], [], {}
    for name, parameters in chosen.items():
        lit = scene.load(name, pixels, pixels, parameters, sampler="independent")
        shape = (width // 2, width)
        # A T for each sun: columns stay, and would make the next sun's T better than an edit's.
        for sun, place in suns.items():
            sky = maps.one_texel_sun(width, *place)
            transport = LightTransport.build(lit, *shape, spp=samples, memory_gb=settings.renderer.memory_gb)
            choices[name] = transport.choices
            rows.append({"scene": name, "sun": sun, **one_sun(lit, transport, sky, spp, quick)})
            if any(mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Delta) for s in lit.mi.shapes()):
                parts += [{"scene": name, "sun": sun, **row} for row in without_caustics(lit, sky, spp)]
    first = next(iter(chosen))
    return {
        "pixels": pixels,
        "texels": [width // 2, width],
        "rows": rows,
        "parts": parts,
        "curve": curve(first, pixels, maps.one_texel_sun(width, *SUNS["45 degrees"]), spp, quick),
        "choices": choices,
        "skipped": skipped,
    }


def one_sun(lit, transport: LightTransport, sky: np.ndarray, spp: int, quick: bool = False) -> dict:
    """Compare T's picture with a reference, and with what prb has at the same time.

    Returns
    -------
    dict
        Errors relative to the picture's mean: ``rmse`` of T, ``noise`` of the reference, ``corrected``, which
        is sqrt(rmse^2 - noise^2), and ``prb_rmse`` at 16 samples a pixel, corrected. ``prb_spp``: samples
        that prb would need for T's error, as its squared error falls with their number; T's error is not
        corrected there, which counts against T. ``equal_error``: time of a prb step with so many samples over
        that of a T step.
    """
    traced = time.perf_counter()
    transport.resolve(sky)
    traced = time.perf_counter() - traced
    env = dr.opaque(mi.TensorXf(sky))
    wanted, noise = reference(lit, sky, spp)
    rmse = relative(transport.apply(env).numpy(), wanted)
    depth = max(AUTO_DEPTH, transport.bounces + 1)
    tracer, steps = PathTracer(lit, PRB_SPP, depth, one_thread=False), itertools.count()
    weight = dr.opaque(mi.TensorXf, 1, (*transport.shape, 3))
    times = side_by_side(
        {
            "T": lambda: gradient(transport.apply, env, weight),
            "prb": lambda: gradient(lambda e: tracer.render(e, next(steps)), env, weight),
        },
        3 if quick else 7,
    )
    found = [relative(tracer.render(env, next(steps)).numpy(), wanted) for _ in range(PRB_SEEDS)]
    prb_square = max(np.mean(np.square(found)) - noise**2, 0)
    t, prb = times["T"]["median_s"], times["prb"]["median_s"]
    needed = PRB_SPP * prb_square / rmse**2
    return {
        "columns": len(transport.columns),
        "resolve_s": traced,
        "rmse": rmse,
        "noise": noise,
        "corrected": corrected(rmse, noise),
        "prb_rmse": float(np.sqrt(prb_square)),
        "t_step_s": t,
        "prb_step_s": prb,
        "prb_spp": float(needed),
        "equal_error": float(needed / PRB_SPP * prb / t),
    }


def without_caustics(lit, sky: np.ndarray, spp: int) -> list[dict]:
    """Compare direct light alone (path depth 2), in the pixels that see a mirror and in those that do not.

    A caustic reaches a matte surface by way of a mirror and takes three segments or more. No unidirectional
    path tracer finds the sun through it but by chance, so that neither T nor the reference converges there.
    With two segments there is none; what stays hard is the sun's own image in the mirror, smaller than a
    pixel and met by chance by camera rays, which is why the pixels are told apart.
    """
    height, width, _ = sky.shape
    transport = LightTransport.build(lit, height, width, max_depth=2)
    transport.resolve(sky)
    wanted, halves = reference(lit, sky, spp, depth=2, split=True)
    got = transport.apply(mi.TensorXf(sky)).numpy()
    matte = sees_no_mirror(lit)
    rows = []
    for part, mask in (("matte pixels", matte), ("mirror pixels", ~matte)):
        rmse = relative(got[mask], wanted[mask], wanted.mean())
        noise = relative(halves[0][mask], halves[1][mask], wanted.mean()) / 2
        rows.append(
            {
                "part": part,
                "pixels": int(mask.sum()),
                "rmse": rmse,
                "noise": noise,
                "corrected": corrected(rmse, noise),
            }
        )
    return rows


def curve(name: str, pixels: int, sky: np.ndarray, spp: int, quick: bool = False) -> list[dict]:
    """Measure error against time of a step: T of several sizes, prb at several samples a pixel."""
    lit = scene.load(name, pixels, pixels, sampler="independent")
    height, width, _ = sky.shape
    wanted, noise = reference(lit, sky, spp)
    env = dr.opaque(mi.TensorXf(sky))
    weight = dr.opaque(mi.TensorXf, 1, (lit.height, lit.width, 3))
    rows = []

    def add(kind, samples, render, picture):
        taken = side_by_side({"it": lambda: gradient(render, env, weight)}, 3 if quick else 7)["it"]
        rmse = relative(picture, wanted)
        rows.append(
            {
                "kind": kind,
                "samples": samples,
                "step_s": taken["median_s"],
                "rmse": rmse,
                "corrected": corrected(rmse, noise),
                "noise": noise,
            }
        )

    for samples in CURVE_SAMPLES[:1] if quick else CURVE_SAMPLES:
        transport = LightTransport.build(lit, height, width, spp=samples)
        transport.resolve(sky)
        add("T", samples, transport.apply, transport.apply(env).numpy())
    depth = max(AUTO_DEPTH, transport.bounces + 1)
    for samples in CURVE_SPP[:2] if quick else CURVE_SPP:
        tracer, steps = PathTracer(lit, samples, depth, one_thread=False), itertools.count()
        picture = tracer.render(env, next(steps)).numpy()
        add("prb", samples, lambda e, t=tracer, s=steps: t.render(e, next(s)), picture)
    return rows


# ---------------------------------------------------------------------- errors


def reference(lit, sky: np.ndarray, spp: int, depth: int = -1, split: bool = False):
    """Render a reference (h, w, 3) from two halves, and its noise relative to its mean.

    The halves differ by sqrt(2) times the noise of one, and their mean has 1/sqrt(2) of it: half of their RMS
    difference. With ``split`` the halves are returned in the noise's place.
    """
    halves = [lit.render(sky, spp=spp // 2, seed=seed, max_depth=depth) for seed in (1, 2)]
    mean = (halves[0].astype(np.float64) + halves[1]) / 2
    return mean, halves if split else relative(halves[0], halves[1], mean.mean()) / 2


def relative(got, wanted, mean: float | None = None) -> float:
    """Return the root of the mean squared difference over the reference's mean, or over ``mean``."""
    difference = np.square(np.asarray(got, np.float64) - wanted)
    return float(np.sqrt(difference.mean()) / (wanted.mean() if mean is None else mean))


def corrected(rmse: float, noise: float) -> float:
    """Take the reference's noise, which is independent, out of an error."""
    return float(np.sqrt(max(rmse**2 - noise**2, 0)))


def sees_no_mirror(lit, across: int = 8) -> np.ndarray:
    """Mark the pixels (h, w) none of whose across^2 camera rays hits a mirror or clear glass."""
    rays = dr.arange(mi.UInt32, lit.width * lit.height * across**2)
    pixel, within = rays // across**2, rays % across**2
    x = (mi.Float(pixel % lit.width) + (mi.Float(within % across) + 0.5) / across) / lit.width
    y = (mi.Float(pixel // lit.width) + (mi.Float(within // across) + 0.5) / across) / lit.height
    ray, _ = lit.mi.sensors()[0].sample_ray(0, 0, mi.Point2f(x, y), mi.Point2f(0.5))
    hit = lit.mi.ray_intersect(ray)
    mirror = hit.is_valid() & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Delta)
    return ~mirror.numpy().reshape(lit.height, lit.width, across**2).any(axis=2)
