"""Changes that no display shows are no changes: such texels keep the original's bits."""

from __future__ import annotations

import numpy as np

UNSEEN = 1 / 512
"""Relative change of radiance below a display's resolution: a step of 8 bits is at least four times this."""


def unseen_kept(original: np.ndarray, edited: np.ndarray) -> np.ndarray:
    """Give texels of an edited image the original's bits where no channel changes by over :data:`UNSEEN`."""
    seen = np.abs(edited - original) > UNSEEN * original
    return np.where(seen.any(axis=2, keepdims=True), edited, original)
