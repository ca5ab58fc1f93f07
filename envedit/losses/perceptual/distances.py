"""Perceptual measures on feature stacks, natively in Dr.Jit: DISTS, with its gradient, and LPIPS v0.1.

Both compare display images ``(H, W, 3)``, nominally in [0, 1]; values beyond are taken as they are. Both are
sums of squared differences, in double precision: identical images give exactly 0, near ones keep their
digits, and NaN gives NaN. A step of DISTS, forward and back, makes 20 GFLOP of matrix products at 256 x 64
pixels and holds some 140 MB beside the weights, which are not part of the package (`Backbone.load`).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.errors import InputError
from envedit.core.types import DrArray, FilePath, Shape, Tensor
from envedit.losses.perceptual import weights
from envedit.losses.perceptual.backbones import Backbone, Stack
from envedit.losses.perceptual.convolution import Divisor
from envedit.losses.ssim import KnownGradient

DISTS_SOURCE = "https://github.com/dingkeyan93/DISTS, DISTS_pytorch/weights.pt"
LPIPS_SOURCE = "https://github.com/richzhang/PerceptualSimilarity, lpips/weights/v0.1/{}.pth"

C1 = C2 = 1e-6
"""Constants of DISTS, of its texture and of its structure."""
NORM_EPS = 1e-10
"""What LPIPS adds to the length of a feature before it divides by it."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of the images that the networks were trained on, in [0, 1]; LPIPS says the same of images in [-1, 1]."""


# ---- Images ------------------------------------------------------------------------------------------------


def _normalised(x: DrArray) -> DrArray:
    """Return a flat image as the networks take it."""
    F = type(x)
    return (x - _along(F(MEAN), len(x))) / _along(F(DEVIATION), len(x))


def _along(values: DrArray, length: int) -> DrArray:
    """Repeat a number for each channel along a flat image or feature map."""
    _, channel = Divisor(len(values)).split(dr.arange(mi.Int32, length))
    return dr.gather(type(values), values, mi.UInt32(channel))


# ---- DISTS -------------------------------------------------------------------------------------------------


class Dists:
    r"""Deep image structure and texture similarity, a distance: the regulariser L_dists of Eq. 10.

    Ding et al. 2020 ("Image quality assessment: unifying structure and texture similarity"), as in the
    authors' PyTorch code: the image itself and five feature maps of VGG16 whose max poolings are replaced by
    Hanning L2 poolings. With means mu, variances var and covariance cov over the pixels of a channel,

        DISTS = 1 - sum of alpha (2 mu_x mu_y + c1) / (mu_x^2 + mu_y^2 + c1)
                         + beta (2 cov_xy + c2) / (var_x + var_y + c2),

    alpha and beta divided by the sum of both. As these then sum to 1, this is evaluated as the sum of
    ``alpha (mu_x - mu_y)^2 / (mu_x^2 + mu_y^2 + c1) + beta var_(x - y) / (var_x + var_y + c2)``.

    The backbone is VGG16, the weights' file an ``npz`` with ``alpha`` and ``beta``, each (1, 1475, 1, 1);
    errors as of :func:`.weights.read`.
    """

    def __init__(self, backbone: Backbone, weights_file: FilePath):
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
        """Return the distance to an image ``(H, W, 3)``: ``x -> size-1 array``, differentiable in x.

        The image itself is not differentiated.
        """
        return _DistsTo(self, reference)


class _DistsTo:
    """The distance to a fixed image: value, and gradient by hand."""

    def __init__(self, dists, reference):
        height, width, _ = reference.shape
        self._stack = Stack(dists.backbone, height, width, "hanning")
        self._weights = dists.weights
        self._reference = []
        for y, channels in self._features(dr.detach(reference.array))[0]:
            mean = _means(y, channels)
            self._reference.append((y, mean, _variances(y, mean)))

    def __call__(self, x: Tensor) -> DrArray:
        if not dr.grad_enabled(x):
            return self._evaluate(dr.detach(x.array), False)[0]
        return dr.custom(KnownGradient, x.array, self)

    def _features(self, x):
        tape = self._stack.forward(_normalised(x))
        dr.eval(x)
        return [(x, 3), *((tap, channels) for tap, _, channels in self._stack.taps(tape))], tape

    def _evaluate(self, x, with_gradient):
        features, tape = self._features(x)
        score = 0
        gradients = []
        for (value, channels), (y, mean_y, variance_y), (alpha, beta) in zip(
            features, self._reference, self._weights, strict=True
        ):
            d = mi.Float64(value) - y
            mean_x, mean_d = _means(value, channels), _means(d, channels)
            scale_1 = 1 / (dr.square(mean_x) + dr.square(mean_y) + C1)
            scale_2 = 1 / (_variances(value, mean_x) + variance_y + C2)
            texture = dr.square(mean_d) * scale_1
            structure = _variances(d, mean_d) * scale_2
            score += dr.sum(alpha * texture + beta * structure)
            if with_gradient:
                pixels = len(value) // channels
                # Of the mean, of d - its mean, and of x - its mean: affine in x and d for each channel.
                slope = 2 / pixels * alpha * scale_1 * (mean_d - texture * mean_x)
                slope_d = 2 / pixels * beta * scale_2
                slope_x = -slope_d * structure
                slope -= slope_d * mean_d + slope_x * mean_x
                slopes = [type(x)(column) for column in (slope, slope_d, slope_x)]
                dr.eval(slopes)
                slope, slope_d, slope_x = (_along(column, len(value)) for column in slopes)
                gradients.append(slope + slope_d * (value - y) + slope_x * value)
        score = type(x)(score)
        if not with_gradient:
            return score, None
        gradient = self._stack.backward(tape, gradients[1:]) / _along(type(x)(DEVIATION), len(x))
        gradient += gradients[0]
        dr.eval(score, gradient)
        return score, gradient


def _means(values, channels):
    """Return the mean of each channel over the pixels of a feature map, in double precision."""
    pixels = len(values) // channels
    rows = mi.TensorXd(mi.Float64(values), (pixels, channels))
    mean = dr.matmul(dr.full(mi.TensorXd, 1 / pixels, (1, pixels)), rows).array
    dr.eval(mean)
    return mean


def _variances(values, mean):
    """Return the mean square of each channel's difference from its mean."""
    return _means(dr.square(values - _along(mean, len(values))), len(mean))


# ---- LPIPS -------------------------------------------------------------------------------------------------


class Lpips:
    """LPIPS v0.1: how different two images look to features that were calibrated on people's judgements.

    Zhang et al. 2018 ("The unreasonable effectiveness of deep features as a perceptual metric", Eq. 1), as in
    the authors' PyTorch code with ``normalize=True``: features of every tapped layer, divided by their length
    at each pixel; squared differences, weighted by channel, averaged over pixels, summed over layers.

    ``kind`` is "alex" or "vgg", ``backbone`` the network, the heads' file an
    ``npz`` with ``lin0.model.1.weight`` (1, C, 1, 1) and so on, one for every layer; errors as of
    :func:`.weights.read`.
    """

    def __init__(self, kind: str, backbone: Backbone, heads_file: FilePath):
        self.backbone = backbone
        shapes: dict[str, Shape] = {
            f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(self.backbone.channels)
        }
        read = weights.read(heads_file, shapes, f"the heads of LPIPS ({kind})", LPIPS_SOURCE.format(kind))
        self.heads = [dr.opaque(mi.Float(read[name].ravel())) for name in shapes]

    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Compare two images ``(H, W, 3)`` in single precision."""
        return float(self.distance(tensor(a), tensor(b))[0])

    def distance(self, a: Tensor, b: Tensor) -> DrArray:
        """Return the distance of two images ``(H, W, 3)`` in their precision, as a size-1 array."""
        stack = Stack(self.backbone, *a.shape[:2])
        features = [stack.taps(stack.forward(_normalised(image.array))) for image in (a, b)]
        score = mi.Float64(0)
        for (x, pixels, channels), (y, _, _), head in zip(*features, self.heads, strict=True):
            difference = _unit(x, pixels, channels) - _unit(y, pixels, channels)
            head = type(x)(head)
            score += dr.sum(mi.Float64(_rowwise(dr.square(difference), head, channels))) / pixels
        return type(a.array)(score)


def _unit(value, pixels, channels):
    """Divide features by their length at each pixel."""
    F = type(value)
    norm = dr.sqrt(_rowwise(dr.square(value), dr.ones(F, channels), channels))
    dr.eval(norm)
    pixel, _ = Divisor(channels).split(dr.arange(mi.Int32, pixels * channels))
    # A length beyond the largest number would leave a direction of zeros.
    length = dr.select(dr.isinf(norm), np.nan, norm + NORM_EPS)
    unit = value / dr.gather(F, length, mi.UInt32(pixel))
    dr.eval(unit)
    return unit


def _rowwise(values, factors, channels):
    """Sum over the channels of each pixel, weighted."""
    tensor = dr.tensor_t(type(values))
    rows = tensor(values, (len(values) // channels, channels))
    return dr.matmul(rows, tensor(factors, (channels, 1))).array
