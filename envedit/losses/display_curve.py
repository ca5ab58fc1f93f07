"""The curve through which losses see a picture: the metrics' display values, with a slope everywhere."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.types import ArrayLike

LOW = 1e-3
"""Below this the root is too steep, and the curve is linear."""


def to_display(radiance: mi.TensorXf) -> mi.TensorXf:
    """Map linear radiance to display values, differentiably.

    x^(1/2.2) as the metrics' tonemap, but linear below :data:`LOW`, and 1 + log(x) / 2.2 above 1, where a
    clip would leave a highlight no way back. Continuous, at 1 with its first derivative.
    """
    return mi.TensorXf(shown(radiance.array), radiance.shape)


def shown(x: mi.Float) -> mi.Float:
    """Return the values of :func:`to_display` of plain arrays."""
    middle = dr.power(dr.clip(x, LOW, 1), 1 / 2.2)
    toe = LOW ** (1 / 2.2) / LOW
    return dr.select(x <= LOW, x * toe, dr.select(x > 1, 1 + dr.log(dr.maximum(x, 1)) / 2.2, middle))


def slope(radiance: ArrayLike) -> np.ndarray:
    """Return the derivative of :func:`to_display` at linear radiance (h, w, 3)."""
    x = tensor(radiance)
    with dr.isolate_grad():
        dr.enable_grad(x)
        dr.backward(dr.sum(to_display(x).array))
        return dr.grad(x).numpy()
