"""A picture of the scene under other light, made by a renderer: how it differs from paint, and its noise.

Who paints on a rendering keeps its Monte Carlo noise; a picture that was rendered anew has noise of its own.
With A the rendering that could have been painted on, B another one of the same map with other samples, and h
a high-pass filter, the sums over pixels of |h(picture) - h(A)|^2 and |h(picture) - h(B)|^2 are then equally
large but for chance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envedit.core.types import Views
from envedit.losses import display_curve

CHANGED = 0.9
"""Share of the pixels that differ from the initial rendering from which on a picture may be rendered anew."""
DEVIATIONS = 5.0
"""Standard deviations by which the picture must be nearer to A than to B to be painted on A: chance does it
once in three million pictures."""
MOST_SAMPLES = 1024
"""More look like a picture without noise, such as one that was denoised."""
_IMMERKAER = np.outer([1, -2, 1], [1, -2, 1]) / 6
"""The filter of Immerkaer (1996), which takes out what is linear in rows or columns; of white noise it leaves
the standard deviation."""


def is_rendered_anew(
    picture: np.ndarray,
    painted_on: np.ndarray,
    coverage: np.ndarray,
    another: Callable[[], np.ndarray],
    views: Views = (slice(None),),
) -> bool:
    """Say whether a picture was rendered under other light, and not painted.

    ``picture`` and ``painted_on``, A, are (h, w, 3) linear radiance, ``coverage`` (h, w, 1) where the two
    differ. ``another`` returns B, the rendering of the same map with other samples, and is called only where
    it is needed. ``views`` are the rows of each view.
    """
    lit = (painted_on > 0).any(axis=2)
    if not lit.any() or (coverage[lit] > 0).mean() < CHANGED:
        return False
    filtered = [high_pass(image, views) for image in (picture, painted_on, another())]
    nearer = (np.square(filtered[0] - filtered[2]) - np.square(filtered[0] - filtered[1])).mean(axis=2)
    blocks = _block_means(nearer)
    error = blocks.std() / np.sqrt(len(blocks))
    return bool(error > 0 and blocks.mean() < DEVIATIONS * error)


def noise(picture: np.ndarray, views: Views = (slice(None),)) -> np.ndarray:
    """Estimate the standard error of a picture's display values from the picture itself: (h, w).

    One number for the whole picture: the lower quartile, over blocks of pixels, of the root mean square of
    :func:`high_pass`. Blocks with edges and texture have more.
    """
    squares = _block_means(np.square(high_pass(picture, views)).mean(axis=2))
    return np.full(picture.shape[:2], np.sqrt(np.quantile(squares, 0.25)))


def samples(known: np.ndarray, initial: np.ndarray, spp: int, views: Views = (slice(None),)) -> int:
    """Return how many samples a pixel a picture of the scene seems to have been rendered with.

    By its noise (``known``, of :func:`noise`) and that of an ``initial`` rendering (h, w, 3) of the same
    scene with ``spp`` samples, as the variance falls as 1 / samples; from 1 to :data:`MOST_SAMPLES`.
    """
    ratio = float(np.median(noise(initial, views))) / max(float(np.median(known)), 1e-6)
    return int(np.clip(round(spp * ratio**2), 1, MOST_SAMPLES))


def high_pass(picture: np.ndarray, views: Views = (slice(None),)) -> np.ndarray:
    """Return display values (h, w, 3) without what is smooth in them, view by view."""
    shown = display_curve.values(picture).astype(np.float64)
    parts = []
    for rows in views:
        padded = np.pad(shown[rows], ((1, 1), (1, 1), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1))
        parts.append(np.einsum("hwcij,ij->hwc", windows, _IMMERKAER))
    return np.concatenate(parts)


def _block_means(values):
    """Return the means of blocks of 8 x 8 pixels, whose errors are independent: (blocks,)."""

    def sums(image):
        for axis in (0, 1):
            image = np.add.reduceat(image, np.arange(0, image.shape[axis], 8), axis=axis)
        return image

    return (sums(values) / sums(np.ones_like(values))).ravel()
