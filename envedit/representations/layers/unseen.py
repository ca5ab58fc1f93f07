"""Changes that no display shows are no changes: such texels keep the original's bits."""

from __future__ import annotations

import numpy as np

UNSEEN = 1 / 512
"""Relative change of radiance below a display's resolution. Derived: a step of 8 bits is at least four times
this."""
_TINY = np.finfo(np.float32).tiny  # what is less, Dr.Jit takes as 0


def unseen_kept(original: np.ndarray, edited: np.ndarray) -> np.ndarray:
    """Give texels of an edited image the original's bits where no channel changes by over :data:`UNSEEN`."""
    visible = np.abs(edited - original) > np.maximum(UNSEEN * original, _TINY)
    return np.where(visible.any(axis=2, keepdims=True), edited, original)
