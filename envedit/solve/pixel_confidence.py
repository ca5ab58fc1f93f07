"""How far each pixel is to be trusted: less where the target or T is mostly noise.

A caustic of a small sun, or its image in a facet of a mirror, falls on few of a pixel's samples. Which, is
chance: in the target other pixels are hit than in T, and a loss that compares them pulls the map to nothing.
Both noises are measured, that of T by a second recording, and such pixels are down-weighted.
"""

from __future__ import annotations

import numpy as np

from envedit.core.types import Views
from envedit.losses import display_curve
from envedit.solve.likelihood import SIGMA

AVERAGED_PIXELS = 2
"""Pixels to each side over which noise is averaged: paths that have hit nothing give no estimate."""
NOISE_FLOOR_VARIANCES = 4.0
"""Noise floor, in multiples of the picture's median variance."""
LIGHT_BRIGHTNESS = 3.0
"""Multiples of the target's median brightness from which on a noisy pixel shows a light itself."""
LEAST_BRIGHTNESS = 0.01
"""Multiples of the target's mean brightness from which on a pixel counts in medians: not a black backdrop."""


def weights(
    first: np.ndarray,
    second: np.ndarray,
    share: float,
    picture: np.ndarray,
    noise: np.ndarray = None,
    views: Views = (),
) -> np.ndarray | None:
    """Weigh pixels by what is known of them.

    Parameters
    ----------
    first, second : ndarray (h, w, 3)
        The same picture through T and through a second recording, linear radiance.
    share : float
        Samples of the second recording over the first's, n2 / n1. As Var(d1 - d2) = v1 (1 + n1 / n2), the
        first's variance v1 is (d1 - d2)^2 share / (1 + share).
    picture : ndarray (h, w, 3)
        The target, linear radiance.
    noise : ndarray (h, w), optional
        Standard error of the target's display values.
    views : sequence of slice
        Rows of each view, where the pictures are of several: no window crosses from one to the next.

    Returns
    -------
    ndarray (h, w, 1) or None
        s^2 / (s^2 + v), s = :data:`.likelihood.SIGMA`, v the variance around a pixel beyond
        :data:`NOISE_FLOOR_VARIANCES` times its median, and 0 at those over or beside
        :data:`LIGHT_BRIGHTNESS`; medians are over pixels that are :data:`LEAST_BRIGHTNESS`. None where no
        pixel is below 1/2, or none that is lit is above 0.
    """
    shown = [display_curve.values(p) for p in (first, second)]
    variance = np.square(shown[0].astype(np.float64) - shown[1]).mean(axis=2) * share / (1 + share)
    if noise is not None:
        variance += np.square(noise)
    views = views or (slice(None),)
    around = np.concatenate([_windows(variance[rows], AVERAGED_PIXELS).mean(axis=(2, 3)) for rows in views])
    brightness = picture.max(axis=2)
    bright = brightness > LEAST_BRIGHTNESS * brightness.mean(dtype=np.float64)
    if not bright.any():
        return None
    beyond = np.maximum(around - NOISE_FLOOR_VARIANCES * np.median(around[bright]), 0)
    trust = SIGMA**2 / (SIGMA**2 + beyond)
    if trust.min() >= 0.5:
        return None
    brightest = np.concatenate([_windows(brightness[rows], 1).max(axis=(2, 3)) for rows in views])
    shows_light = (brightest >= LIGHT_BRIGHTNESS * np.median(brightness[bright])) & (beyond > 0)
    trust = np.where(shows_light, 0, trust)
    return trust[..., None].astype(np.float32) if trust[bright].any() else None


def _windows(values, reach):
    """Windows around each pixel: (h, w, 2 reach + 1, 2 reach + 1)."""
    size = 2 * reach + 1
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="edge"), (size, size))
