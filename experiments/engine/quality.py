"""What T gets wrong: one bright texel over a dim sky, the hardest map, against converged renderings.

The reference is Mitsuba's path tracer without a bound on the depth; it samples the map by its light, so that
a one-texel sun costs it no more than any other. Two independent halves measure its noise.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.scene.path_tracer import AUTO_DEPTH, PathTracer
from envedit.transport.light_transport import LightTransport

from .timing import side_by_side
from .transport import gradient, load_scene

PRB_SPP, PRB_SEEDS = 16, 4
CURVE_SPP, CURVE_SAMPLES = (4, 16, 64, 256), (16, 64, 256)


def measure(settings, sun: list, spp: int, quick: bool = False) -> dict:
    """Compare T's picture under one sun with a reference, and with what prb has at the same time.

    Parameters
    ----------
    settings : Config
        Scene, widths and transport, as an edit with SIREN or pixels has them.
    sun : [float, float]
        As of :func:`one_texel_sun`.
    spp : int
        Samples a pixel of the reference.

    Returns
    -------
    dict
        ``quality`` and ``equal-error``, of one row: :func:`errors` of T; ``prb_rmse`` at 16 samples a pixel,
        corrected; ``prb_spp``: samples that prb would need for T's error, as its squared error falls with
        their number; T's error is not corrected there, which counts against T. ``equal_error``: time of a prb
        step with so many samples over that of a T step.
        ``quality-parts``: :func:`without_caustics` of a scene with a mirror.
    """
    lit, sky = load_scene(settings), one_texel_sun(settings.input.width, *sun)
    samples, memory = settings.renderer.spp, settings.renderer.memory_gb
    transport = LightTransport.build(lit, *sky.shape[:2], spp=samples, memory_gb=memory)
    transport.resolve(sky)
    env = dr.opaque(mi.TensorXf(sky))
    halves = reference(lit, sky, spp)
    found = errors(transport.apply(env).numpy(), halves)
    tracer, steps = path_tracer(lit, PRB_SPP, transport), itertools.count()
    weight = dr.opaque(mi.TensorXf, 1, (*transport.shape, 3))
    times = side_by_side(
        {
            "T": lambda: gradient(transport.apply, env, weight),
            "prb": lambda: gradient(lambda e: tracer.render(e, next(steps)), env, weight),
        },
        3 if quick else 7,
    )
    prb = [errors(tracer.render(env, next(steps)).numpy(), halves)["rmse"] for _ in range(PRB_SEEDS)]
    prb_square = max(np.mean(np.square(prb)) - found["noise"] ** 2, 0)
    needed, (t, prb) = prb_square / found["rmse"] ** 2, (times[name]["median_s"] for name in ("T", "prb"))
    row = found | {
        "columns": len(transport.columns),
        "choices": transport.choices,
        "prb_rmse": float(np.sqrt(prb_square)),
        "t_step_s": t,
        "prb_step_s": prb,
        "prb_spp": float(PRB_SPP * needed),
        "equal_error": float(needed * prb / t),
    }
    mirror = any(mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Delta) for s in lit.mi.shapes())
    parts = without_caustics(lit, sky, spp) if mirror else []
    return {"quality": [row], "equal-error": [row], "quality-parts": parts}


def without_caustics(lit, sky: np.ndarray, spp: int) -> list[dict]:
    """Compare direct light alone (path depth 2), in the pixels that see a mirror and in those that do not.

    A caustic takes three segments or more. No unidirectional path tracer finds the sun through it but by
    chance, so that neither T nor the reference converges there. With two segments there is none; what stays
    hard is the sun's own image in the mirror, smaller than a pixel, which is why the pixels are kept apart.
    """
    transport = LightTransport.build(lit, *sky.shape[:2], max_depth=2)
    transport.resolve(sky)
    halves = reference(lit, sky, spp, depth=2)
    got, mirror = transport.apply(mi.TensorXf(sky)).numpy(), sees_mirror(lit)
    return [
        {"part": part, "pixels": int(mask.sum())} | errors(got, halves, mask)
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


def path_tracer(lit, samples: int, transport: LightTransport) -> PathTracer:
    """Return prb with samples a pixel and with the path depth of T, or more."""
    return PathTracer(lit, samples, max(AUTO_DEPTH, transport.bounces + 1), one_thread=False)


def one_texel_sun(width: int, elevation: float, across: float) -> np.ndarray:
    """Return a grey sky (width / 2, width, 3) of 0.1 with a sun of 1e5 in one texel.

    Parameters
    ----------
    width : int
        Texels across.
    elevation : float
        Degrees above the horizon, to the nearest row.
    across : float
        Place in the map from its left edge, 0 to 1: at 0 behind the object, at 1/2 behind the camera of the
        shipped scenes.
    """
    height = width // 2
    picture = np.full((height, width, 3), 0.1, np.float32)
    # Rows are aligned to the corners: row 0 is the zenith, the last one the nadir.
    picture[round((90 - elevation) / 180 * (height - 1)), int(across * width)] = 1e5
    return picture


def curve(settings, sun: list, spp: int, quick: bool = False) -> dict:
    """Measure ``error-time``: error against time of a step, T of several sizes, prb at several samples."""
    lit, sky = load_scene(settings), one_texel_sun(settings.input.width, *sun)
    halves = reference(lit, sky, spp)
    env = dr.opaque(mi.TensorXf(sky))
    weight = dr.opaque(mi.TensorXf, 1, (lit.height, lit.width, 3))
    rows = []

    def add(kind, samples, render):
        found = errors(render(env).numpy(), halves)
        taken = side_by_side({"step": lambda: gradient(render, env, weight)}, 3 if quick else 7)["step"]
        rows.append({"kind": kind, "samples": samples, "step_s": taken["median_s"]} | found)

    for samples in CURVE_SAMPLES[:1] if quick else CURVE_SAMPLES:
        transport = LightTransport.build(lit, *sky.shape[:2], spp=samples)
        transport.resolve(sky)
        add("T", samples, transport.apply)
    for samples in CURVE_SPP[:2] if quick else CURVE_SPP:
        tracer, steps = path_tracer(lit, samples, transport), itertools.count()
        add("prb", samples, lambda e, t=tracer, s=steps: t.render(e, next(s)))
    return {"error-time": rows}


def reference(lit, sky: np.ndarray, spp: int, depth: int = -1) -> list[np.ndarray]:
    """Render the independent halves (h, w, 3) of a reference, whose mean it is."""
    halves = [lit.render(sky, spp=spp // 2, seed=seed, max_depth=depth) for seed in (1, 2)]
    return [half.astype(np.float64) for half in halves]


def errors(got: np.ndarray, halves: list[np.ndarray], pixels=...) -> dict[str, float]:
    """Compare some pixels of a picture with a reference.

    Returns
    -------
    dict
        Root mean squares relative to the mean of the whole reference: ``rmse``; ``noise`` of the reference,
        half of the difference of its halves, which differ by sqrt(2) times the noise of one where their mean
        has 1/sqrt(2) of it; ``corrected``: sqrt(rmse^2 - noise^2), as the two are independent.
    """
    wanted = (halves[0] + halves[1]) / 2
    differences = got[pixels] - wanted[pixels], (halves[0] - halves[1])[pixels] / 2
    rmse, noise = (float(np.sqrt(np.square(one).mean()) / wanted.mean()) for one in differences)
    return {"rmse": rmse, "noise": noise, "corrected": float(np.sqrt(max(rmse**2 - noise**2, 0)))}
