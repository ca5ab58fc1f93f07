"""Losses of the edit and of the fit, natively in Dr.Jit, behind one signature.

``loss(x, reference)`` returns a size-1 array of the tensor's own type, differentiable in ``x``; losses of
pictures take a ``weight`` too. Images are ``(H, W, C)`` tensors (C = 3 unless said otherwise) of any Dr.Jit
precision; a weight is ``(H, W, 1)`` or ``(H, W, C)``, not negative. A weighted mean divides by the sum of the
weights and is 0 where all weights are 0. Sums run in double precision. A non-finite texel makes the loss
non-finite, whatever its weight; nothing is clipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr

from envedit.core.color import LUMINANCE
from envedit.core.types import DrArray, Tensor
from envedit.losses.ssim import expand, total

CHANGE_SOFT = 0.05
"""Factors less than 5 % from 1 count by their square."""
CHANGE_FLOOR = 0.01
"""Share of a map's mean below which radiance is as good as black."""

# ---- Differences, light and smoothness ---------------------------------------------------------------------


def image_l1(x: Tensor, reference: Tensor, weight: Tensor | None = None) -> DrArray:
    """Compute the mean absolute error of two images ``(H, W, C)``: also the last term of Eq. 4, of radiance.

    The subgradient where they are equal is 0.
    """
    return _mean(dr.abs(x.array - reference.array), x.shape, weight)


def image_l2(x: Tensor, reference: Tensor, weight: Tensor | None = None) -> DrArray:
    """Compute the mean squared error of two images ``(H, W, C)``: also the first term of Eq. 4."""
    return _mean(dr.square(x.array - reference.array), x.shape, weight)


def luminance(x: Tensor, reference: Tensor) -> DrArray:
    r"""Compare total luminance, ``|Lum(E) - Lum(E')|`` (Eq. 8) of RGB images.

    ``Lum(E) = sum of 0.2126 R + 0.7152 G + 0.0722 B`` over texels (Eq. 7), not weighted by solid angle, as
    in the paper. The subgradient where the sums are equal is 0.
    """
    difference = _luminance_sum(x) - _luminance_sum(reference)
    return type(x.array)(dr.abs(difference))


def _luminance_sum(x):
    wide = dr.float64_array_t(type(x.array))  # 0.2126 in single precision is itself off by 1e-8
    channel = dr.arange(dr.uint32_array_t(wide), math.prod(x.shape)) % 3
    return dr.sum(wide(x.array) * dr.gather(wide, wide(LUMINANCE), channel))


def l1(x: Tensor, reference: Tensor | None = None) -> DrArray:
    """Sum ``|E|`` over texels and channels (Eq. 9); ``reference`` is not used, the subgradient at 0 is 0."""
    return type(x.array)(total(dr.abs(x.array)))


def tv(x: Tensor, reference: Tensor | None = None) -> DrArray:
    """Compute the anisotropic total variation of a lat-long image, as a mean; ``reference`` is not used.

    The sum of ``|x[i, j+1] - x[i, j]| + |x[i+1, j] - x[i, j]|``, columns periodic, rows not, divided by the
    number of texels and channels.
    """
    height, width, channels = x.shape
    row = width * channels
    values = x.array
    index = dr.arange(dr.uint32_array_t(type(values)), height * row)
    column = index % row
    right = dr.select(column < row - channels, index + channels, index + channels - row)
    below = dr.select(index < (height - 1) * row, index + row, column)
    across = dr.abs(dr.gather(type(values), values, right) - values)
    down = dr.abs(dr.gather(type(values), values, below) - values)
    return _mean(across + dr.select(index < (height - 1) * row, down, 0), x.shape)


def change(x: Tensor, reference: Tensor) -> DrArray:
    """Compare the logarithms of two maps: mean of sqrt(d^2 + s^2) - s, d = log((x + e) / (reference + e)).

    A sun that moves counts as a few texels, a sky that takes on another colour as many. s is
    :data:`CHANGE_SOFT`, e :data:`CHANGE_FLOOR` of the mean of the reference; x must not be negative.
    """
    values = type(x.array)
    floor = CHANGE_FLOOR * total(dr.detach(reference.array)) / math.prod(x.shape)
    floor = values(dr.maximum(floor, 1e-12))
    distance = dr.log((x.array + floor) / (reference.array + floor))
    return _mean(dr.sqrt(dr.square(distance) + CHANGE_SOFT**2) - CHANGE_SOFT, x.shape)


def _mean(values, shape, weight=None):
    if weight is None:
        return type(values)(total(values) / math.prod(shape))
    weight = expand(weight, shape)
    mass = total(weight)
    # Not a select of the quotient: its derivative at 0 / 0 would be NaN.
    return type(values)(total(values * weight) / dr.select(mass == 0, 1, mass))


LOSSES: dict[str, Callable[..., DrArray]] = {
    "luminance": luminance,
    "l1": l1,
    "tv": tv,
    "change": change,
    "image_l1": image_l1,
    "image_l2": image_l2,
}
"""Name in the configuration -> loss; ``ssim`` is a class of its own."""
