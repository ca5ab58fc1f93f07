"""Single precision against double: every loss and reduction, over ten orders of magnitude and more.

References are plain float64; those of SSIM are the same code in double precision, which test_ssim compares
with the formula window by window.
"""

import math

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import color, latlong
from envedit.losses import losses, metrics
from envedit.representations.layers import lights
from tests.oracles.extremes_stages import LOSSES, LUMINANCE, loss_and_gradient, plain, single

SCALES = [10.0**k for k in range(-5, 6)]


def error(got, wanted) -> float:
    """Return the largest error relative to the largest reference value."""
    got, wanted = np.asarray(got, np.float64), np.asarray(wanted, np.float64)
    return float(np.abs(got - wanted).max() / (np.abs(wanted).max() or 1.0))


def pairs():
    """Yield two images at every scale, and two whose texels are even in their logarithms, 1e-5 to 1e5."""
    shape = 16, 32, 3
    for scale in SCALES:
        rng = np.random.default_rng(7)
        yield tuple((scale * rng.random(shape)).astype(np.float32) for _ in range(2))
    rng = np.random.default_rng(8)
    yield tuple((10 ** rng.uniform(-5, 5, shape)).astype(np.float32) for _ in range(2))


# Relative to the largest value: a rounding (6e-8) a texel where the sum is double.
VALUES = dict.fromkeys(("image_l1", "luminance", "l1"), 2e-7)
VALUES |= dict.fromkeys(("image_l2", "tv", "change", "ssim"), 3e-7)
# SSIM: 1e-6 times level over local contrast; change: quotients and a root in single precision.
GRADIENTS = dict.fromkeys(VALUES, 3e-7) | {"ssim": 3e-6, "change": 1e-5}


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_and_its_gradient(name):
    for x, y in pairs():
        got, expected = loss_and_gradient(name, x, y), plain(name, x, y)
        assert error(got[0], expected[0]) <= VALUES[name]
        assert error(got[1], expected[1]) <= GRADIENTS[name]


def test_sums_over_a_sun_and_a_dark_sky():
    dark = np.full((512, 512, 3), 1e-3, np.float32)
    dark[100, 200] = 1e6
    wide = dark.astype(np.float64)
    assert error(losses.luminance(single(dark), single(0 * dark))[0], (wide @ LUMINANCE).sum()) <= 1e-7
    assert error(color.luminance(dark).sum(), (wide @ LUMINANCE).sum()) <= 1e-7
    assert error(losses.l1(single(dark))[0], wide.sum()) <= 1e-7
    brighter = np.where(dark < 1, np.float32(1.001e-3), dark)
    change = ((brighter - wide) @ LUMINANCE).sum()
    assert error(losses.luminance(single(brighter), single(dark))[0], change) <= 1e-6


@pytest.mark.parametrize("scale", [1e-20, *SCALES, 1e20, 1e38])
def test_flux_of_a_light_that_is_shared_out(scale):
    """Integers of 40 bits, then rounded."""
    omega = latlong.lookup_solid_angles(16, 32)
    row, column = mi.Float([3.3, 7.8]), mi.Float([9.2, 31.7])
    flux = mi.Color3f(scale * 0.02) + mi.Color3f(mi.Float(0, 0))
    got = lights.shared_out(row, column, mi.Float([1.0, 1.5]), flux, 1.0, (16, 32), (0, 16)).numpy()
    light = (got.astype(np.float64) * omega[:, None, None]).sum(axis=(0, 1))
    assert error(light, np.full(3, 2 * np.float64(np.float32(scale * 0.02)))) <= 1e-6


def high_pass(a):
    y = np.log(a @ LUMINANCE + 0.01)
    taps, out = np.array([1, 4, 6, 4, 1]) / 16, np.zeros_like(y)
    for i in range(5):
        for j in range(5):
            rows = np.clip(np.arange(y.shape[0]) + i - 2, 0, y.shape[0] - 1)
            out += taps[i] * taps[j] * np.roll(y[rows], 2 - j, axis=1)
    return math.fsum(((y - out) ** 2).ravel()) / y.size


def test_high_frequency_energy():
    for image, _ in pairs():
        assert error(metrics.high_frequency_energy(image), high_pass(np.float64(image))) <= 1e-12
