"""Whether an edited map still looks like a photograph of a sky, in numbers that PSNR does not see."""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.losses.metrics import LOG_EPS, high_frequency_energy

PERCENTILES, MARGIN = (1, 99), 0.1
"""Range of log chroma that a sky has, and by how much a texel may leave it."""


def natural(edited: np.ndarray, original: np.ndarray, true: np.ndarray | None = None) -> dict:
    """Compare an edited map with the original, and with the true map where that is known.

    Parameters
    ----------
    edited, original : ndarray (H, W, 3)
        Whole maps, linear radiance.
    true : ndarray (H, W, 3), optional
        The map that makes the target.

    Returns
    -------
    dict
        ``colours_outside``: share of the upper half's solid angle whose log chroma (log radiance less its
        mean over channels) lies outside the 1st to 99th percentile of original and true map together, by
        more than 0.1, in any channel. ``seam``: mean |log luminance step| across the horizon over the
        original's. ``high_frequency``: energy of high frequencies (:func:`.high_frequency_energy`) over the
        larger of the original's and the true map's. None where the denominator is 0.
    """
    known = [original] if true is None else [original, true]
    sharp = max(high_frequency_energy(one) for one in known)
    step = _step(original)
    return {
        "colours_outside": colours_outside(edited, known),
        "seam": _step(edited) / step if step > 0 else None,
        "high_frequency": high_frequency_energy(edited) / sharp if sharp > 0 else None,
    }


def colours_outside(edited: np.ndarray, known: list[np.ndarray]) -> float:
    """Return the share of the upper half's solid angle in colours that none of the known maps has."""
    half = max(1, edited.shape[0] // 2)
    omega = np.repeat(latlong.solid_angles(*edited.shape[:2])[:half], edited.shape[1])
    both = np.concatenate([_chroma(one[:half]) for one in known])
    low, high = np.percentile(both, PERCENTILES, axis=0)
    chroma = _chroma(edited[:half])
    outside = ((chroma < low - MARGIN) | (chroma > high + MARGIN)).any(axis=1)
    return float((omega * outside).sum() / omega.sum())


def _chroma(image):
    logs = np.log(np.maximum(np.float64(image.reshape(-1, 3)), 1e-4))
    return logs - logs.mean(axis=1, keepdims=True)


def _step(image):
    """Mean absolute step of log luminance between the rows on either side of the horizon."""
    below = min(image.shape[0] // 2, image.shape[0] - 1)
    rows = np.log(np.maximum(luminance(image[[max(below - 1, 0), below]]), 0) + LOG_EPS)
    return float(np.abs(rows[1] - rows[0]).mean())
