"""Structural similarity with a hand-written gradient, and the sums that all losses share.

Images are ``(H, W, C)`` tensors of any Dr.Jit precision; a ``weight`` is ``(H, W, 1)`` or ``(H, W, C)``.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

from envedit.core.types import DrArray, Shape, Tensor, Views

# ---- Weights and sums, shared with the other losses --------------------------------------------------------


def expand(weight: Tensor, shape: Shape) -> DrArray:
    """Return the weight as a flat array with one entry per texel and channel."""
    if weight.shape == shape:
        return weight.array
    index = dr.arange(dr.uint32_array_t(type(weight.array)), math.prod(shape)) // shape[2]
    return dr.gather(type(weight.array), weight.array, index)


def total(values: DrArray) -> DrArray:
    """Sum a flat array in double precision, returned in double precision."""
    return dr.sum(dr.float64_array_t(type(values))(values))


# ---- Structural similarity ---------------------------------------------------------------------------------

WINDOW = 11
"""Texels along a side of the Gaussian window."""
C1, C2 = 0.01**2, 0.03**2
"""Constants of the two factors, for a data range of 1."""


class Ssim:
    r"""Structural similarity to a fixed reference, with a hand-written gradient.

    Wang et al. 2004 ("Image quality assessment: from error visibility to structural similarity", Eq. 13):
    Gaussian window of 11 x 11, sigma 1.5, K1 = 0.01, K2 = 0.03, population covariance, windows that lie
    wholly inside the image, one map per channel, averaged. It is scikit-image's ``structural_similarity``
    with ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False``. In an image smaller than 11 along
    an axis the window shrinks along that axis to the largest odd size that fits, down to one texel.

    Images are display values, whose data range is 1. With ``d = x - y`` the map is ``(1 - a)(1 - b)``,
    ``a = mu_d^2 / (mu_x^2 + mu_y^2 + C1)``, ``b = var_d / (var_x + var_y + C2)``, and the loss the mean of
    ``a + b - ab``: identical images give exactly 0 and near ones keep their digits. Variances are merged from
    columns of squared deviations, never ``E[x^2] - E[x]^2``, which loses digits to the offset of the image.
    Squares must be representable: ``|x|`` up to 1e18 in single precision, NaN beyond.

    The ``reference`` (H, W, C), y, is not differentiated. A ``weight``, (H, W, 1) or (H, W, C), not negative,
    is that of the window centred there; windows that cross an edge do not exist.
    """

    def __init__(self, reference: Tensor, weight: Tensor | None = None):
        self.shape = height, width, channels = tuple(reference.shape)
        self._rows, self._columns = _gaussian(height), _gaussian(width)
        self.map_shape = height - len(self._rows) + 1, width - len(self._columns) + 1, channels
        self._y = dr.detach(reference.array)
        self._mean_y, self._variance_y = self._window(self._moments(self._y))
        self._weight = 1 / math.prod(self.map_shape)
        if weight is not None:
            self._weight = self._normalised(dr.detach(weight))
        dr.eval(self._y, self._mean_y, self._variance_y, self._weight)

    def __call__(self, x: Tensor) -> DrArray:
        """Return ``1 - mean SSIM`` of the image ``(H, W, C)`` as a size-1 array, differentiable in ``x``."""
        if not dr.grad_enabled(x):
            return self._evaluate(x.array, False)[0]
        return dr.custom(KnownGradient, x.array, self)

    def _normalised(self, weight):
        """Crop the weights to the window centres and let them sum to one (or all be zero)."""
        top, left = len(self._rows) // 2, len(self._columns) // 2
        height, width, _ = self.map_shape
        values = type(weight)(expand(weight, self.shape), self.shape)
        values = values[top : top + height, left : left + width].array
        mass = total(values)
        return dr.select(mass > 0, values / type(values)(mass), 0)

    def _moments(self, *fields):
        """Filter along columns: mean and variance of each field."""
        row = self.shape[1] * self.shape[2]
        F = type(self._y)
        index = dr.arange(dr.uint32_array_t(F), self.map_shape[0] * row)
        moments = []
        for field in fields:
            taps = [dr.gather(F, field, index + j * row) for j in range(len(self._rows))]
            moments += _mean_and_variance(self._rows, taps)
        dr.eval(moments)
        return moments

    def _window(self, moments):
        """Merge the moments of the columns of a window into its means and variances."""
        height, width, step = self.map_shape
        F = type(self._y)
        index = dr.arange(dr.uint32_array_t(F), height * width * step)
        # The first column of each window, in an array whose rows have full length.
        start = index + index // (width * step) * ((self.shape[1] - width) * step)
        merged = []
        for mean, variance in zip(moments[::2], moments[1::2], strict=True):
            means = [dr.gather(F, mean, start + j * step) for j in range(len(self._columns))]
            inner = (dr.gather(F, variance, start + j * step) for j in range(len(self._columns)))
            mean, between = _mean_and_variance(self._columns, means)
            merged += [mean, between + sum(k * v for k, v in zip(self._columns, inner, strict=True))]
        return merged

    def _evaluate(self, x, with_gradient):
        """Return the loss and, if asked for, its gradient, both without derivatives attached."""
        x = dr.detach(x)
        mean_x, variance_x, mean_d, variance_d = self._window(self._moments(x, x - self._y))
        scale_a = 1 / (dr.square(mean_x) + dr.square(self._mean_y) + C1)
        scale_b = 1 / (variance_x + self._variance_y + C2)
        a = dr.square(mean_d) * scale_a
        b = variance_d * scale_b
        values = self._weight * (a + b - a * b)
        loss = type(x)(total(values))
        if not with_gradient:
            return loss, None
        # Derivatives of a window's term in its two means and two variances. A variance acts on a texel as
        # 2 (x - mean), which is split: one field is filtered, one filtered and then multiplied by the texel.
        wa, wb = self._weight * (1 - b) * scale_a, self._weight * (1 - a) * scale_b
        grad_x = -wb * b
        offset = 2 * (wa * (mean_d - a * mean_x) - wb * mean_d - grad_x * mean_x)
        offset, grad_d, grad_x = self._spread([offset, wb, grad_x])
        gradient = offset + 2 * ((x - self._y) * grad_d + x * grad_x)
        dr.eval(loss, gradient)
        return loss, gradient

    def _spread(self, fields):
        """Apply the transposed window filter: along rows first, then along columns."""
        (height, width, channels), (full_height, full_width, _) = self.map_shape, self.shape
        F = type(self._y)
        dr.eval(fields)
        index = dr.arange(dr.int32_array_t(F), height * full_width * channels)
        row = index // (full_width * channels)
        column = index - row * (full_width * channels)
        base, length = row * (width * channels), width * channels
        fields = _scatter_filter(self._columns, fields, column, base, channels, length)
        dr.eval(fields)
        index = dr.arange(dr.int32_array_t(F), full_height * full_width * channels)
        step = full_width * channels
        return _scatter_filter(self._rows, fields, index, 0, step, height * step)


class StackedSsim:
    r"""Structural similarity of pictures below each other: no window crosses from one to the next.

    ``sum_k s_k (1 - SSIM_k)``, where s_k is picture k's share of the weight; ``rows`` are those of each
    picture, from the top, without gaps.
    """

    def __init__(self, reference: Tensor, weight: Tensor, rows: Views):
        self._rows = rows
        self._parts = [Ssim(reference[some], weight[some]) for some in rows]
        masses = [total(weight[some].array)[0] for some in rows]
        mass = max(sum(masses), 1e-30)
        self._shares = [dr.opaque(type(reference.array), float(part / mass)) for part in masses]

    def __call__(self, x: Tensor) -> DrArray:
        """Return the loss of the image ``(H, W, C)`` as a size-1 array, differentiable in ``x``."""
        parts = zip(self._shares, self._rows, self._parts, strict=True)
        return sum(share * ssim(x[rows]) for share, rows, ssim in parts)


class KnownGradient(dr.CustomOp):
    """A measure of a flat array as one node of the AD graph: its gradient is known as soon as its value is.

    ``measure._evaluate(x, True)`` returns both.
    """

    def eval(self, x: DrArray, measure: Any) -> DrArray:
        """Return the value; keep the gradient."""
        value, self.gradient = measure._evaluate(dr.detach(x), True)
        return value

    def backward(self) -> None:
        """Scale the gradient by the loss's."""
        self.set_grad_in("x", self.gradient * self.grad_out())

    def name(self) -> str:
        """Name the node in Dr.Jit's graphs."""
        return "measure"


def _gaussian(length):
    """Gaussian window, sigma 1.5, of the largest odd size up to :data:`WINDOW` that fits, with sum one."""
    radius = (min(WINDOW, length) - 1) // 2
    taps = [math.exp(-0.5 * (i / 1.5) ** 2) for i in range(-radius, radius + 1)]
    return [tap / sum(taps) for tap in taps]


def _mean_and_variance(taps, values):
    mean = sum(k * v for k, v in zip(taps, values, strict=True))
    return mean, sum(k * dr.square(v - mean) for k, v in zip(taps, values, strict=True))


def _scatter_filter(taps, fields, position, base, step, length):
    """Gather each field against the reversed window, taking nothing from outside ``[0, length)``."""
    F = type(fields[0])
    sums = [0] * len(fields)
    for j, tap in enumerate(taps):
        source = position - j * step
        inside = (source >= 0) & (source < length)
        index = dr.uint32_array_t(F)(source + base)
        sums = [s + tap * dr.gather(F, field, index, inside) for s, field in zip(sums, fields, strict=True)]
    return sums
