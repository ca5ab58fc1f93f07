"""How much the pixels of a painted picture count: those that were painted, and the rest."""

from __future__ import annotations

import numpy as np

from envedit import config
from envedit.core.errors import InputError
from envedit.scene.scene import Scene

FOLLOWING = 0.1
"""Weight, beside paint, of what was not painted and follows: its pattern, as its mean has a term of its own
(``docs/decisions/experiment_painted_likelihood.md`` has what other values do)."""


def first_hold(settings: config.Config) -> float:
    """Return the weight of what was not painted that an edit begins with.

    Only Gauss-Newton steps keep the mean of what was not painted by itself: with them its pattern may follow.
    """
    chosen = settings.target
    if chosen.hold != "auto":
        return float(chosen.hold)
    return FOLLOWING if chosen.rest == "follow" and settings.newton else 1.0


def hidden_pixels(scene: Scene) -> np.ndarray:
    """Return the pixels, bool (h, w), that see no surface where emitters are hidden: they do not count."""
    return np.zeros((scene.height, scene.width), bool) if scene.alpha is None else scene.alpha == 0


def pixel_weight(coverage: np.ndarray, excluded: np.ndarray, paint: float, hold: float) -> np.ndarray:
    """Share the weights of paint and rest among their pixels: (h, w, 1) float32, 1 on average.

    weight = paint c / sum(c) + hold (1 - c) / sum(1 - c), where c is coverage, over the pixels that are not
    ``excluded``.
    """
    counted = ~np.asarray(excluded, bool)[..., None]
    weight = np.zeros(counted.shape)
    for share, part in ((paint, coverage * counted), (hold, (1 - coverage) * counted)):
        total = part.sum(dtype=np.float64)
        if total > 0:
            weight += share * part / total
    if not weight.any():
        raise InputError(
            "target: no pixel counts: set target.paint above 0, or target.hold if pixels are left unpainted"
        )
    return (weight / weight.mean()).astype(np.float32)
