"""Pictures at another size, in linear radiance."""

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
