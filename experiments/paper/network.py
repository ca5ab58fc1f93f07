"""One network for Figures 4 and 5, a stock SIREN or a fit by a configuration, with and without noise."""

from __future__ import annotations

import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.images import images
from envedit.inputs import active_rows, load_map
from envedit.losses import metrics, optimizer
from envedit.representations.siren import fit
from envedit.representations.siren import network as siren

NOISE, NOISE_SEEDS = 1e-3, 5
"""Standard deviation of the noise on weights and biases (Fig. 5), and how many draws are measured."""


def stock(
    crop: np.ndarray, network: config.Representation, settings: config.Fit, seed: int, scaled: bool
) -> tuple[dict, tuple[float, float]]:
    """Train a stock SIREN: linear last layer, mean squared error of linear radiance, all texels a step.

    Parameters
    ----------
    crop : ndarray (H, W, 3)
        Linear radiance.
    network, settings
        Size and frequency; epochs, rate, its schedule and Adam's decay. Nothing else of the recipe counts.
    seed : int
        Of the initial weights: those of the other fits.
    scaled : bool
        Train on radiance mapped to [-1, 1], as Sitzmann et al. do with photographs, or as it is.

    Returns
    -------
    params : dict
        Weights, as of :func:`envedit.representations.siren.network.init`.
    range : (float, float)
        (low, span): radiance is low + span * output.
    """
    low, high = (float(crop.min()), float(crop.max())) if scaled else (0.0, 1.0)
    span = (high - low) / 2 or 1.0
    low, span = (low + span, span) if scaled else (0.0, 1.0)
    wanted = ((crop.astype(np.float64) - low) / span).astype(np.float32).reshape(-1, 3)
    wanted = dr.opaque(mi.TensorXf(wanted))
    x = fit.points(network, crop.shape[:2])
    params = siren.init(seed, network.hidden, network.depth, network.omega)
    adam = optimizer.Adam(params, settings.lr, (0.9, settings.beta2))
    for epoch in range(settings.epochs):
        z, tape = linear(adam.params, x, network.omega)
        grads = backward(adam.params, tape, (2 / len(wanted.array)) * (z - wanted))
        adam.step(grads, lr=fit.learning_rate(settings, settings.lr, epoch))
    return adam.params, (low, span)


def linear(params: siren.Params, x, omega: float):
    """Evaluate a SIREN without its sigmoid: values (N, 3), and the tape of :func:`.network.forward`."""
    _, tape = siren.forward(params, x, omega)
    last = siren.layers(params) - 1
    z = dr.matmul(tape[-1][0], params[f"{last}.weight"], Bt=True) + params[f"{last}.bias"]
    dr.eval(z)
    return z, tape


def backward(params: siren.Params, tape: list, grad) -> siren.Params:
    """Pull a gradient of :func:`linear`'s values back to the parameters."""
    # The reverse pass of a sigmoid at 1/2 is a factor of 1/4, exactly: four times that is none.
    half = dr.full(mi.TensorXf, 0.5, grad.shape)
    return siren.backward(params, [*tape[:-1], (tape[-1][0], half)], 4 * grad)


def perturbed(params: dict, seed: int) -> dict:
    """Add N(0, :data:`NOISE`) to all weights and biases: the same to every network of one size."""
    rng = np.random.default_rng(1000 + seed)
    return {
        name: mi.TensorXf((value.numpy() + rng.normal(0, NOISE, value.shape)).astype(np.float32))
        for name, value in params.items()
    }


def measure(settings: config.Config, folder: Path, recipe: str) -> dict:
    """Fit the active rows of a map; write ``original.exr``, ``fitted.exr``, and ``noisy.exr``.

    Parameters
    ----------
    recipe : str
        "configured": by the configuration's own; "stock" or "stock-scaled": a stock SIREN (:func:`stock`).

    Returns
    -------
    dict
        ``log_psnr`` (dB), ``peak_ratio`` and ``mean_ratio`` of luminance; ``noisy``: log-PSNR with noise on
        the weights, of each draw; ``seconds``.
    """
    original, _ = load_map(settings.input)
    active = active_rows(settings.input.rows, original.shape[0])
    crop, network = np.ascontiguousarray(original[active.slice]), settings.representation
    shape, rows = crop.shape[:2], active.place
    if recipe == "configured":
        found = fit.fit(crop, network, settings.fit, settings.seed, rows, folder=fit.default_folder())
        params = {name: mi.TensorXf(value) for name, value in found.params.items()}
        seconds, x = found.seconds, fit.points(network, shape, rows)

        def picture(weights):
            return fit.evaluate(weights, found.normalisation, x, shape, network.omega).numpy()
    else:
        begun = time.perf_counter()
        params, (low, span) = stock(crop, network, settings.fit, settings.seed, recipe == "stock-scaled")
        dr.eval(params)
        dr.sync_thread()
        seconds, x = time.perf_counter() - begun, fit.points(network, shape)

        def picture(weights):
            z = linear(weights, x, network.omega)[0].numpy().reshape(*shape, 3)
            return np.maximum(low + span * z, 0).astype(np.float32)

    fitted = picture(params)
    noisy = [picture(perturbed(params, seed)) for seed in range(NOISE_SEEDS)]
    for name, content in (("original", crop), ("fitted", fitted), ("noisy", noisy[0])):
        images.write_exr(folder / f"{name}.exr", content, panorama=False)
    return {
        "log_psnr": metrics.log_psnr(fitted, crop),
        "peak_ratio": metrics.peak_ratio(fitted, crop),
        "mean_ratio": metrics.mean_luminance_ratio(fitted, crop),
        "noisy": [metrics.log_psnr(one, crop) for one in noisy],
        "seconds": seconds,
    }
