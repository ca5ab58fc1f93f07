"""How well a network fits a map, and what is left of the fit when its weights are moved."""

import mitsuba as mi
import numpy as np

from envedit.inputs import active_rows, load_map
from envedit.losses import metrics
from envedit.representations.siren import fit

NOISE, NOISE_SEEDS = 1e-3, 5


def measure(settings, quick: bool = False) -> dict:
    """Fit the map of a configuration by its recipe.

    Returns ``fits``: a row with ``peak`` of the map's luminance, ``log_psnr`` (dB), ``peak_ratio``,
    ``mean_ratio`` of luminance, ``fitted_s``; ``noisy_mean`` and ``noisy_worst``: log-PSNR with N(0, 1e-3)
    added to all weights and biases, over five seeds.
    """
    original, _ = load_map(settings.input)
    rows = active_rows(settings.input.rows, original.shape[0])
    image = original[rows.slice]
    network = settings.representation
    shape = image.shape[:2]
    fitted = fit.fit(image, network, settings.fit, settings.seed, rows.place)
    x = fit.points(network, shape, rows.place)

    def picture(params):
        params = {key: mi.TensorXf(value) for key, value in params.items()}
        return fit.evaluate(params, fitted.normalisation, x, shape, network.omega).numpy()

    noisy = []
    for seed in range(NOISE_SEEDS):
        rng = np.random.default_rng(1000 + seed)
        moved = {
            key: (value + rng.normal(0, NOISE, value.shape)).astype(np.float32)
            for key, value in fitted.params.items()
        }
        noisy.append(metrics.log_psnr(picture(moved), image))
    row = {
        "preset": settings.preset,
        "texels": list(shape),
        "peak": float(metrics.luminance(image).max()),
        "log_psnr": fitted.log_psnr,
        "peak_ratio": fitted.peak_ratio,
        "mean_ratio": metrics.mean_luminance_ratio(picture(fitted.params), image),
        "noisy_mean": None if None in noisy else float(np.mean(noisy)),
        "noisy_worst": None if None in noisy else float(min(noisy)),
        "fitted_s": fitted.seconds,
    }
    return {"fits": [row]}
