"""Perceptual measures on feature stacks, natively in Dr.Jit: DISTS and LPIPS v0.1, with their gradients.

Both compare display images ``(H, W, 3)``, nominally in [0, 1]; values beyond are taken as they
are. Identical images give exactly 0, and NaN gives NaN. Both are evaluated as sums of squared differences,
so that near images keep their digits; sums over pixels run in double precision. Each measure is one node
of the AD graph, in forward and reverse mode, whose gradient is computed by hand together with its value.

A step of DISTS, forward and back, makes 20 GFLOP of matrix products at 256 x 64 pixels, growing with their
number, and takes about 1.2 times as long as these; it holds some 140 MB beside the weights.

Weights are not part of the package: see `features.Backbone.load`, `DISTS_SOURCE` and `LPIPS_SOURCE`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.errors import ConfigError, InputError
from envedit.core.types import DrArray, FilePath, Shape, Tensor
from envedit.losses.perceptual import weights
from envedit.losses.perceptual.backbones import Backbone, title
from envedit.losses.perceptual.convolution import Divisor
from envedit.losses.perceptual.measure import DEVIATION, Measure, by_channel, normalised, single

DISTS_SOURCE = "https://github.com/dingkeyan93/DISTS, DISTS_pytorch/weights.pt"
LPIPS_SOURCE = "https://github.com/richzhang/PerceptualSimilarity, lpips/weights/v0.1/{}.pth"

C1 = C2 = 1e-6
"""Constants of DISTS, of its texture and of its structure."""
NORM_EPS = 1e-10
"""What LPIPS adds to the length of a feature before it divides by it."""


# ---- DISTS -------------------------------------------------------------------------------------------------


class Dists:
    r"""Deep image structure and texture similarity, a distance: the regulariser L_dists of Eq. 10.

    .. code-block:: python

       dists = Dists(Backbone.load("vgg", "vgg16.npz"), "dists_alpha_beta.npz")
       to_original = dists.against(original)      # the original's features are computed once
       loss = to_original(x)                      # differentiable in x

    Ding et al. 2020 ("Image quality assessment: unifying structure and texture similarity"), as in the
    authors' PyTorch code: the image itself and five feature maps of VGG16 whose max poolings are replaced by
    Hanning L2 poolings. With means mu, variances var and covariance cov over the pixels of a channel,

        DISTS = 1 - sum of alpha (2 mu_x mu_y + c1) / (mu_x^2 + mu_y^2 + c1)
                         + beta (2 cov_xy + c2) / (var_x + var_y + c2),

    alpha and beta divided by the sum of both. As these then sum to 1, this is evaluated as the sum of
    ``alpha (mu_x - mu_y)^2 / (mu_x^2 + mu_y^2 + c1) + beta var_(x - y) / (var_x + var_y + c2)``.
    Any image of at least one pixel will do.

    Parameters
    ----------
    backbone : Backbone
        VGG16.
    weights_file : path-like
        ``safetensors`` or ``npz`` with ``alpha`` and ``beta``, each (1, 1475, 1, 1).

    Raises
    ------
    ConfigError
        If the network is another.
    InputError
        If the file does not hold the weights; see :func:`envedit.losses.perceptual.weights.read`.
    """

    def __init__(self, backbone: Backbone, weights_file: FilePath):
        if backbone.kind != "vgg":
            raise ConfigError(f"DISTS needs the features of VGG16, not those of {backbone.title}")
        self.backbone = backbone
        channels = [3, *backbone.channels]
        shape = (1, sum(channels), 1, 1)
        read = weights.read(weights_file, {"alpha": shape, "beta": shape}, "DISTS", DISTS_SOURCE)
        alpha, beta = (read[name].astype(np.float64).ravel() for name in ("alpha", "beta"))
        mass = alpha.sum() + beta.sum()
        if not mass > 0:
            raise InputError(
                f"{weights_file}: alpha and beta of DISTS have the sum {mass}, not a positive one."
            )
        ends = np.cumsum(channels)[:-1]
        self.weights = [
            (dr.opaque(mi.Float64(a)), dr.opaque(mi.Float64(b)))
            for a, b in zip(np.split(alpha / mass, ends), np.split(beta / mass, ends), strict=True)
        ]

    def against(self, reference: Tensor) -> Callable[[Tensor], DrArray]:
        """Return the distance to an image ``(H, W, 3)`` as a callable: ``x -> size-1 array``.

        Raises
        ------
        InputError
            If it is no image, or gradients are expected of it.
        """
        return _DistsTo(self, reference)

    def __call__(self, x: Tensor, reference: Tensor) -> DrArray:
        """Return the distance of two images ``(H, W, 3)`` as a size-1 array, differentiable in ``x``.

        Raises
        ------
        InputError
            If the shapes differ, or gradients are expected of the reference.
        """
        return self.against(reference)(x)


class _DistsTo(Measure):
    def __init__(self, dists, reference):
        super().__init__(dists.backbone, reference, "hanning", "DISTS")
        self._weights = dists.weights
        self._reference = []
        for y, pixels, channels in self._features(dr.detach(reference.array))[0]:
            zero = dr.zeros(mi.Float64, channels)
            mean = _sums(y, y, zero, zero, pixels, channels)[0] / pixels
            variance = _sums(y, y, mean, zero, pixels, channels)[2] / pixels
            dr.eval(mean, variance)
            self._reference.append((y, mean, variance))

    def _features(self, x):
        tape = self._stack.forward(normalised(x))
        dr.eval(x)
        return [(x, self.shape[0] * self.shape[1], 3), *self._stack.taps(tape)], tape

    def _evaluate(self, x, with_gradient):
        features, tape = self._features(x)
        score = 0
        gradients = []
        for (value, pixels, channels), (y, mean_y, variance_y), (alpha, beta) in zip(
            features, self._reference, self._weights, strict=True
        ):
            zero = dr.zeros(mi.Float64, channels)
            mean_x, mean_d = (s / pixels for s in _sums(value, y, zero, zero, pixels, channels)[:2])
            dr.eval(mean_x, mean_d)
            sums = _sums(value, y, mean_x, mean_d, pixels, channels)
            scale_1 = 1 / (dr.square(mean_x) + dr.square(mean_y) + C1)
            scale_2 = 1 / (sums[2] / pixels + variance_y + C2)
            texture, structure = dr.square(mean_d) * scale_1, sums[3] / pixels * scale_2
            score += dr.sum(alpha * texture + beta * structure)
            if with_gradient:
                slopes = (
                    2 / pixels * alpha * scale_1 * (mean_d - texture * mean_x),  # of the mean
                    2 / pixels * beta * scale_2,  # of d - its mean
                    -2 / pixels * beta * scale_2 * structure,  # of x - its mean
                )
                gradients.append(_channelwise(value, y, mean_x, mean_d, slopes, channels))
        score = type(x)(score)
        if not with_gradient:
            return score, None
        gradient = self._stack.backward(tape, gradients[1:]) / by_channel(type(x), len(x), DEVIATION)
        gradient += gradients[0]
        dr.eval(score, gradient)
        return score, gradient


def _channelwise(x, y, mean_x, mean_d, slopes, channels):
    """Gradient of the share that a feature map has in DISTS: affine in x and d = x - y for each channel."""
    F = type(x)
    _, channel = Divisor(channels).split(dr.arange(mi.Int32, len(x)))
    columns = [F(values) for values in (mean_x, mean_d, *slopes)]
    dr.eval(columns)
    mean_x, mean_d, a, b, c = (dr.gather(F, values, mi.UInt32(channel)) for values in columns)
    return a + b * (x - y - mean_d) + c * (x - mean_x)


_STRETCHES = 32


def _sums(x, y, mean_x, mean_d, pixels, channels):
    """Sum x - mean_x, d - mean_d and their squares over the pixels of a channel; d = x - y, in double."""
    parts = _sums_of_stretches(
        x,
        y,
        mean_x,
        mean_d,
        dr.arange(mi.UInt32, channels * _STRETCHES),
        dr.opaque(mi.UInt32, channels),
        dr.opaque(mi.UInt32, pixels),
        dr.opaque(mi.UInt32, -(-pixels // _STRETCHES)),
    )
    dr.eval(parts)
    lane, step = dr.arange(mi.UInt32, channels), dr.opaque(mi.UInt32, channels)
    sums = [sum(dr.gather(mi.Float64, part, lane + i * step) for i in range(_STRETCHES)) for part in parts]
    dr.eval(sums)
    return sums


@dr.syntax
def _sums_of_stretches(x, y, mean_x, mean_d, lane, channels, pixels, rows):
    stretch = lane // channels
    channel = lane - stretch * channels
    mx, md = dr.gather(mi.Float64, mean_x, channel), dr.gather(mi.Float64, mean_d, channel)
    i = stretch * rows * channels + channel
    stop = dr.minimum((stretch + 1) * rows, pixels) * channels
    sum_x, sum_d, square_x, square_d = mi.Float64(0), mi.Float64(0), mi.Float64(0), mi.Float64(0)
    while i < stop:
        a = mi.Float64(dr.gather(type(x), x, i))
        b = a - mi.Float64(dr.gather(type(y), y, i)) - md
        a -= mx
        sum_x += a
        sum_d += b
        square_x += a * a
        square_d += b * b
        i += channels
    return sum_x, sum_d, square_x, square_d


# ---- LPIPS -------------------------------------------------------------------------------------------------


class Lpips:
    """LPIPS v0.1: how different two images look to features that were calibrated on people's judgements.

    .. code-block:: python

       lpips = Lpips("alex", "alexnet.safetensors", "lpips_v0.1_alex.npz")
       lpips(a, b)                                # a float
       lpips.against(b)(x)                        # a size-1 array, differentiable in x

    Zhang et al. 2018 ("The unreasonable effectiveness of deep features as a perceptual metric",
    Eq. 1), as in the authors' PyTorch code, version 0.1: features of every tapped layer, divided by
    their length at each pixel; squared differences, weighted by channel, averaged over pixels, summed
    over layers. Images in [0, 1] are mapped to [-1, 1] first, which is the authors' ``normalize=True``.

    Parameters
    ----------
    kind : str
        "alex", "vgg" or "squeeze".
    backbone_file : path-like or Backbone
        Weights of the network; see `features.Backbone.load`.
    heads_file : path-like
        ``safetensors`` or ``npz`` with ``lin0.model.1.weight`` (1, C, 1, 1) and so on, one for every layer.

    Raises
    ------
    ConfigError
        If there is no such network here, or the backbone is another one.
    InputError
        If a file does not hold the weights; see :func:`envedit.losses.perceptual.weights.read`.
    """

    def __init__(self, kind: str, backbone_file: FilePath | Backbone, heads_file: FilePath):
        words = title(kind)
        self.kind = kind
        self.backbone = _backbone(kind, backbone_file)
        if self.backbone.kind != kind:
            raise ConfigError(
                f"LPIPS '{kind}' needs the features of {words}, not those of {self.backbone.title}"
            )
        shapes: dict[str, Shape] = {
            f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(self.backbone.channels)
        }
        read = weights.read(heads_file, shapes, f"the heads of LPIPS ({kind})", LPIPS_SOURCE.format(kind))
        self.heads = [dr.opaque(mi.Float(read[name].ravel())) for name in shapes]

    def against(self, reference: Tensor) -> Callable[[Tensor], DrArray]:
        """Return the distance to an image as :meth:`.Dists.against`; InputError also of one too small."""
        return _LpipsTo(self, reference)

    def __call__(self, a: Any, b: Any) -> float:
        """Compare two images ``(H, W, 3)``, arrays or tensors, in single precision.

        Raises
        ------
        InputError
            If they differ in shape, are too small for the network, or hold values that are not finite or so
            large that their features are not.
        """
        a, b = (single(image, f"LPIPS: {name} image") for image, name in ((a, "first"), (b, "second")))
        distance = float(self.against(b)(a)[0])
        if not np.isfinite(distance):
            raise InputError("LPIPS: the images hold values too large to compare; give display values.")
        return distance


def _backbone(kind: str, backbone: FilePath | Backbone) -> Backbone:
    return backbone if isinstance(backbone, Backbone) else Backbone.load(kind, backbone)


class _LpipsTo(Measure):
    def __init__(self, lpips, reference):
        super().__init__(lpips.backbone, reference, "max", "LPIPS")
        self._heads = lpips.heads
        tape = self._stack.forward(normalised(dr.detach(reference.array)))
        self._reference = [_unit(*tap)[0] for tap in self._stack.taps(tape)]
        dr.eval(self._reference)

    def _evaluate(self, x, with_gradient):
        F = type(x)
        score = 0
        gradients = []
        tape = self._stack.forward(normalised(x))
        for (value, pixels, channels), y, head in zip(
            self._stack.taps(tape), self._reference, self._heads, strict=True
        ):
            unit, norm, pixel, channel = _unit(value, pixels, channels)
            difference = unit - y
            head = F(head)
            score += dr.sum(mi.Float64(_rowwise(dr.square(difference), head, channels))) / pixels
            if with_gradient:
                slope = 2 / pixels * dr.gather(F, head, channel) * difference
                along = _rowwise(value * slope, dr.ones(F, channels), channels) / (norm + NORM_EPS)
                along = dr.select(norm == 0, 0, along / norm)  # features of 0, or whose squares are
                length = dr.gather(F, norm, pixel) + NORM_EPS
                gradients.append((slope - value * dr.gather(F, along, pixel)) / length)
                dr.eval(gradients[-1])
        score = F(score)
        if not with_gradient:
            return score, None
        gradient = self._stack.backward(tape, gradients) / by_channel(F, len(x), DEVIATION)
        dr.eval(score, gradient)
        return score, gradient


def _unit(value, pixels, channels):
    """Divide features by their length at each pixel; also return lengths, and pixel and channel of each."""
    F = type(value)
    norm = dr.sqrt(_rowwise(dr.square(value), dr.ones(F, channels), channels))
    dr.eval(norm)
    pixel, channel = (mi.UInt32(i) for i in Divisor(channels).split(dr.arange(mi.Int32, pixels * channels)))
    # A length beyond the largest number would leave a direction of zeros.
    length = dr.select(dr.isinf(norm), np.nan, norm + NORM_EPS)
    unit = value / dr.gather(F, length, pixel)
    dr.eval(unit)
    return unit, norm, pixel, channel


def _rowwise(values, factors, channels):
    """Sum over the channels of each pixel, weighted."""
    tensor = dr.tensor_t(type(values))
    rows = tensor(values, (len(values) // channels, channels))
    return dr.matmul(rows, tensor(factors, (channels, 1))).array
