"""Losses against plain numpy and finite differences in double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.color import LUMINANCE
from envedit.core.color import luminance as luminance_of
from envedit.losses.losses import LOSSES, luminance
from envedit.losses.ssim import Ssim
from tests.oracles.devices import on_cpu
from tests.oracles.plain import double, gradient, plain_ssim_loss, single

PLAIN = {
    "image_l1": lambda x, y, w: np.sum(w * np.abs(x - y)) / np.sum(w),
    "image_l2": lambda x, y, w: np.sum(w * (x - y) ** 2) / np.sum(w),
    "ssim": plain_ssim_loss,
}
PICTURES = ("image_l1", "image_l2", "ssim")  # which take a weight
NAMES = (*LOSSES, "ssim")


def loss(name, x, y, *weight):
    return Ssim(y, *weight)(x) if name == "ssim" else LOSSES[name](x, y, *weight)


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("channels", [1, 3])
def test_value_with_weights_is_the_plain_formula(name, channels, rng):
    x, y = rng.random((14, 19, 3)), rng.random((14, 19, 3))
    w = rng.random((14, 19, channels))
    w[3, 4] = 0
    value = loss(name, double(x), double(y), double(w))
    assert len(value) == 1 and type(value) is mi.Float64
    np.testing.assert_allclose(value[0], PLAIN[name](x, y, np.broadcast_to(w, x.shape)), rtol=1e-12)
    narrow = loss(name, single(x), single(y), single(w))
    assert type(narrow) is mi.Float
    np.testing.assert_allclose(narrow[0], value[0], rtol=3e-6)


@pytest.mark.parametrize("name", PICTURES)
def test_gradient_with_weights_is_the_finite_difference(name, rng):
    x, y, d = (rng.random((13, 16, 3)) for _ in range(3))
    weight = double(rng.random((13, 16, 1)))
    _, g = gradient(lambda t: loss(name, t, double(y), weight), double(x))
    # Small enough that no absolute value changes sign, fourth order for the smooth ones.
    h = 1e-5
    v = {k: loss(name, double(x + k * h * d), double(y), weight)[0] for k in (-2, -1, 1, 2)}
    slope = (8 * (v[1] - v[-1]) - (v[2] - v[-2])) / (12 * h)
    np.testing.assert_allclose(np.sum(g * d), slope, rtol=1e-6)


@on_cpu
@pytest.mark.parametrize("name", NAMES)
def test_equal_images_are_a_stationary_point(name, rng):
    x = single(rng.random((12, 12, 3)) * (name != "l1"))
    if name == "tv":
        x = dr.full(mi.TensorXf, 0.7, (12, 12, 3))
    value, g = gradient(lambda t: loss(name, t, type(x)(x)), x)
    assert value == 0 and not g.any()


@pytest.mark.parametrize("name", PICTURES)
def test_weights_that_are_all_zero_give_zero(name, rng):
    x, y = rng.random((12, 12, 3)), rng.random((12, 12, 3))
    w = dr.opaque(mi.TensorXf, 0, (12, 12, 1))
    value, g = gradient(lambda t: loss(name, t, single(y), w), single(x))
    assert value == 0 and not g.any()


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_texel_is_not_hidden_by_its_weight(name, bad, rng):
    x, y, w = rng.random((12, 15, 3)), rng.random((12, 15, 3)), np.ones((12, 15, 1))
    x[5, 8, 1] = bad
    w[:, 8] = 0
    assert not np.isfinite(loss(name, single(x), single(y), single(w))[0])


# ---- single precision --------------------------------------------------------------------------------------

SCALES = [10.0**k for k in range(-5, 6)]
# Relative to the largest value: a rounding (6e-8) a texel where the sum is double.
VALUES = dict.fromkeys(("image_l1", "luminance", "l1"), 2e-7)
VALUES |= dict.fromkeys(("image_l2", "tv", "change", "ssim"), 3e-7)
# SSIM: 1e-6 times level over local contrast; change: quotients and a root in single precision.
GRADIENTS = dict.fromkeys(VALUES, 3e-7) | {"ssim": 3e-6, "change": 1e-5}


def error(got, wanted) -> float:
    """Return the largest error relative to the largest reference value."""
    got, wanted = np.asarray(got, np.float64), np.asarray(wanted, np.float64)
    return float(np.abs(got - wanted).max() / (np.abs(wanted).max() or 1.0))


def pairs():
    """Return two images at every scale, and two whose texels are even in their logarithms, 1e-5 to 1e5."""
    rng = np.random.default_rng(7)
    shape = 2, 16, 32, 3
    scaled = [scale * rng.random(shape) for scale in SCALES]
    return [np.float32(both) for both in (*scaled, 10 ** rng.uniform(-5, 5, shape))]


def plain_gradient(name, x, y):
    """Return value and gradient of a loss in float64; SSIM by the same code in double precision."""
    if name == "ssim":
        return gradient(Ssim(double(y)), double(x))
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    d, n = x - y, x.size
    if name == "image_l1":
        return np.abs(d).mean(), np.sign(d) / n
    if name == "image_l2":
        return np.square(d).mean(), 2 * d / n
    if name == "luminance":
        difference = (d @ LUMINANCE).sum()
        return abs(difference), np.broadcast_to(np.sign(difference) * np.array(LUMINANCE), x.shape)
    if name == "l1":
        return np.abs(x).sum(), np.sign(x)
    if name == "tv":
        across, down = np.roll(x, -1, axis=1) - x, np.diff(x, axis=0, append=x[-1:])
        slope = np.roll(np.sign(across), 1, axis=1) - np.sign(across) - np.sign(down)
        slope[1:] += np.sign(down)[:-1]
        return (np.abs(across) + np.abs(down)).mean(), slope / n
    assert name == "change"
    floor = max(0.01 * y.mean(), 1e-12)
    distance = np.log((x + floor) / (y + floor))
    root = np.sqrt(np.square(distance) + 0.05**2)
    return (root - 0.05).mean(), distance / root / (x + floor) / n


@pytest.mark.parametrize("name", NAMES)
def test_value_and_gradient_are_as_in_double_precision(name):
    """The loss of SSIM is compared with its formula in test_ssim."""
    for x, y in pairs():
        got = gradient(lambda t, y=y: loss(name, t, single(y)), single(x))
        expected = plain_gradient(name, x, y)
        assert error(got[0], expected[0]) <= VALUES[name]
        assert error(got[1], expected[1]) <= GRADIENTS[name]


def test_sums_over_a_sun_and_a_dark_sky():
    dark = np.full((512, 512, 3), 1e-3, np.float32)
    dark[100, 200] = 1e6
    wide = dark.astype(np.float64)
    assert error(luminance(single(dark), single(0 * dark))[0], (wide @ LUMINANCE).sum()) <= 1e-7
    assert error(luminance_of(dark).sum(), (wide @ LUMINANCE).sum()) <= 1e-7
    assert error(LOSSES["l1"](single(dark))[0], wide.sum()) <= 1e-7
    brighter = np.where(dark < 1, np.float32(1.001e-3), dark)
    change = ((brighter - wide) @ LUMINANCE).sum()
    assert error(luminance(single(brighter), single(dark))[0], change) <= 1e-6
