"""Losses against plain numpy and finite differences in double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.losses.losses import LOSSES
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
    """Without weights the values and gradients of all losses are in test_extremes_precision."""
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
