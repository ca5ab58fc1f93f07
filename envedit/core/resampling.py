"""Pictures at another size, in linear radiance, and a smooth step."""

from __future__ import annotations

import numpy as np

from envedit.core.types import ArrayLike


def fit(image: ArrayLike, height: int, width: int) -> np.ndarray:
    """Scale an image (H, W, C) to (height, width, C) float32: always a copy.

    An axis that shrinks is averaged over the area of each new pixel; one that grows repeats the nearest.
    """
    scaled = np.array(image, np.float32)
    old_height, old_width, channels = scaled.shape
    with np.errstate(invalid="ignore"):  # BLAS has been seen to raise the flag for finite operands
        if old_height != height:
            scaled = _resampling(old_height, height) @ scaled.reshape(old_height, -1)
            scaled = scaled.reshape(height, old_width, channels)
        if old_width != width:
            scaled = np.matmul(_resampling(old_width, width), scaled)
    return scaled


def _resampling(old, new):
    """Make the (new, old) matrix of one axis; its rows sum to 1."""
    if new >= old:
        nearest = ((np.arange(new) + 0.5) * old / new).astype(int)
        return np.eye(old, dtype=np.float32)[nearest]
    edges = np.arange(new + 1) * (old / new)
    texel = np.arange(old)
    overlap = np.minimum(edges[1:, None], texel + 1) - np.maximum(edges[:-1, None], texel)
    return (np.clip(overlap, 0, None) * (new / old)).astype(np.float32)


def bilinear(image: np.ndarray, row: np.ndarray, column: np.ndarray, around: bool = False) -> np.ndarray:
    """Interpolate an image (H, W, C) at places in pixels from the centre of the first one.

    ``row`` and ``column`` broadcast against each other to (...); returns (..., C). Beyond its border the
    image goes on as there; ``around``: at the other side, left and right.
    """
    height, width, _ = image.shape
    row = np.clip(row, 0, height - 1)
    column = column if around else np.clip(column, 0, width - 1)
    top, left = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    down, right = (row - top)[..., None], (column - left)[..., None]
    bottom = np.minimum(top + 1, height - 1)
    beside = (left + 1) % width if around else np.minimum(left + 1, width - 1)
    left = left % width
    upper = (1 - right) * image[top, left] + right * image[top, beside]
    lower = (1 - right) * image[bottom, left] + right * image[bottom, beside]
    return (1 - down) * upper + down * lower


def smooth_step(x: np.ndarray) -> np.ndarray:
    """Return 0 up to 0, 1 from 1 on, and 3 x^2 - 2 x^3 between."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
