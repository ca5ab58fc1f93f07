"""The curve through which losses see a picture: the metrics' display values, with a slope everywhere."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.types import ArrayLike

LOW = 1e-3
"""Below this the root is too steep, and the curve is linear."""
ABOVE_WHITE = 0.1
"""How much differences count above what was shown white: ``docs/decisions/paint_above_white.md`` has what
other values do."""


def to_display(radiance: mi.TensorXf, white: float = np.inf) -> mi.TensorXf:
    """Map linear radiance to display values, differentiably.

    x^(1/2.2) as the metrics' tonemap, but linear below :data:`LOW`, and 1 + log(x) / 2.2 above 1, where a
    clip would leave a highlight no way back. Continuous, at 1 with its first derivative. Above ``white``, at
    least 1, it rises :data:`ABOVE_WHITE` times as fast.
    """
    opaque = dr.opaque(mi.Float, white)  # one kernel for all pictures
    return mi.TensorXf(shown(radiance.array, opaque), radiance.shape)


def values(radiance: ArrayLike, white: float = np.inf) -> np.ndarray:
    """Return the display values of linear radiance (h, w, 3), float32, as of :func:`to_display`."""
    return to_display(tensor(radiance), white).numpy()


def shown(x: mi.Float, white: mi.Float) -> mi.Float:
    """Return the values of :func:`to_display` of plain arrays."""
    middle = dr.power(dr.clip(x, LOW, 1), 1 / 2.2)
    toe = LOW ** (1 / 2.2) / LOW
    above = dr.log(dr.clip(x, 1, white)) + ABOVE_WHITE * dr.log(dr.maximum(x / white, 1))
    return dr.select(x <= LOW, x * toe, dr.select(x > 1, 1 + above / 2.2, middle))


def slope(radiance: ArrayLike, white: float = np.inf) -> np.ndarray:
    """Return the derivative of :func:`to_display` at linear radiance (h, w, 3)."""
    x = tensor(radiance)
    with dr.isolate_grad():
        dr.enable_grad(x)
        dr.backward(dr.sum(to_display(x, white).array))
        return dr.grad(x).numpy()
