"""Compare what may carry the gain of the sky: grids of quadratic B-splines, or a small SIREN on the sphere.

Every variant starts from the same lights, those that the search finds, and from a gain of zero; the last one
is the product's, whose gain starts from the search's too. Rendering and map PSNR are against the truth, by
Mitsuba with fresh samples; "sharp" is the energy of high frequencies over the original's.
"""

import time
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config, inputs
from envedit.core import array_cache, latlong
from envedit.losses import metrics
from envedit.representations.layers.layers import Layers
from envedit.representations.siren import network as siren
from envedit.solve import adam_loop, map_problem, search
from envedit.transport.light_transport import LightTransport
from experiments import puresky
from experiments.harness import Experiment, calling

ITERATIONS = 150
AMPLITUDE = 6.0
PRESENT = "gain.0"
"""By this parameter, the first grid's, layers know that there is a gain; a SIREN does not use it."""


class SirenGain:
    """Log gain by a SIREN on directions, its last layer zero at the start: 2 A (sigmoid - 1/2).

    A first-layer weight w makes omega |w| cycles around a great circle; |w| <= sqrt(3) / 3 for three inputs.
    """

    def __init__(self, omega, hidden, depth, rate):
        self.omega, self.hidden, self.depth, self.rate = omega, hidden, depth, rate

    def init(self):
        """Weights whose field is zero."""
        params = siren.init(0, self.hidden, self.depth, self.omega, inputs=3)
        last = siren.layers(params) - 1
        found = {f"gain.{k}": v.numpy() for k, v in params.items()}
        for part in ("weight", "bias"):
            found[f"gain.{last}.{part}"] *= 0
        found[PRESENT] = np.zeros(1, np.float32)
        return {k: v / self.rate for k, v in found.items()}

    def scales(self):
        """One rate for all weights."""
        return {name: self.rate for name in self.init()}

    def prepare(self, shape, rows):
        """Directions of the texels."""
        d = latlong.directions(rows[1], shape[1])[rows[0] : rows[0] + shape[0]]
        return dr.opaque(mi.TensorXf(d.reshape(-1, 3).astype(np.float32)))

    def evaluate(self, params, x):
        """Return the log gain at every texel."""
        weights = {k.removeprefix("gain."): v for k, v in params.items() if k.startswith("gain.")}
        del weights[PRESENT.removeprefix("gain.")]
        y = siren.evaluate(weights, x, self.omega).array
        i = dr.arange(mi.UInt32, x.shape[0]) * 3
        return mi.Color3f(*(2 * AMPLITUDE * (dr.gather(mi.Float, y, i + c) - 0.5) for c in range(3)))


VARIANTS = {
    "grids, 12 cycles": None,
    "SIREN 32x1, omega 8 (5 cycles)": SirenGain(8.0, 32, 1, 0.1),
    "SIREN 32x1, omega 16 (9 cycles)": SirenGain(16.0, 32, 1, 0.1),
    "SIREN 64x2, omega 16": SirenGain(16.0, 64, 2, 0.05),
    "SIREN 64x2, omega 30": SirenGain(30.0, 64, 2, 0.05),
}


SEARCHED = "grids, from the search's gain"


def compare(settings, folder, variant) -> dict:
    """Edit a map with one kind of gain; returns PSNRs in dB, sharpness and milliseconds."""
    lit = inputs.load_scene(settings.scene)
    original, _ = inputs.load_map(settings.input, lit)
    height, width, _ = original.shape
    true = np.ascontiguousarray(latlong.rotate(original, settings.target.degrees), np.float32)
    picture = lit.render(true, spp=2048, seed=7)
    kept = array_cache.cache_folder("transport")
    transport = LightTransport.build(lit, height, width, few=True, folder=kept)
    crop, rows = original[: height // 2], (0, height)
    plain = Layers.of(crop, rows)
    problem = map_problem.Problem(plain, transport, original, picture)
    begun = problem.found(search.search(problem, problem.state(plain.start())).run.state)
    layers = replace(plain, gain=VARIANTS.get(variant) or plain.gain)
    params = layers.start()
    params |= {k: v for k, v in begun.items() if variant == SEARCHED or not k.startswith("gain")}
    chosen = config.Optimizer(iterations=ITERATIONS)
    objective = adam_loop.Objective(config.Loss(), picture, None, crop, ITERATIONS)
    start = time.perf_counter()
    params, _ = adam_loop.optimise(layers, params, transport, objective, original, 0, chosen)
    ms = 1000 * (time.perf_counter() - start) / ITERATIONS
    edited = original.copy()
    edited[: height // 2] = layers.decode(params).numpy()
    final = lit.render(edited, spp=2048, seed=11)
    sharp = [metrics.high_frequency_energy(m[: height // 2]) for m in (edited, original)]
    return {
        "render": metrics.compare(final, picture)["psnr"],
        "psnr": metrics.compare(edited[: height // 2], true[: height // 2])["psnr"],
        "sharp": sharp[0] / sharp[1],
        "ms": ms,
    }


def cases(given):
    return [
        calling(
            f"{name}: {variant}",
            "experiments.layers.gain:compare",
            {
                "input": {"envmap": str(file), "width": 256},
                "scene": {"file": "sphere", "width": 128, "parameters": {"roughness": 0.3}},
                "target": {"rotate_degrees": 140},
            },
            {"map": name, "gain": variant},
            variant=variant,
        )
        for name, file in puresky.find().items()
        for variant in (*VARIANTS, SEARCHED)
    ]


EXPERIMENT = Experiment(
    "layers.gain",
    "Compare what may carry the gain of the sky: grids, or a small SIREN on the sphere.",
    cases,
    columns={
        "gain": "{gain}",
        "map": "{map}",
        "rendering PSNR": "{render:.1f} dB",
        "map PSNR": "{psnr:.1f} dB",
        "sharp": "{sharp:.2f}",
        "ms a step": "{ms:.0f}",
    },
    alone=True,
)
