"""Losses against plain numpy and finite differences in double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.losses.losses import LOSSES, luminance
from envedit.losses.ssim import Ssim
from tests.oracles.devices import on_cpu
from tests.oracles.plain import double, gradient, plain_ssim_loss, single

REC709 = np.array([0.2126, 0.7152, 0.0722])


def numpy_tv(x, w):
    across = np.abs(np.roll(x, -1, axis=1) - x)
    down = np.zeros_like(x)
    down[:-1] = np.abs(x[1:] - x[:-1])
    return np.sum(w * (across + down)) / np.sum(w)


def numpy_change(x, y, w):
    floor = 0.01 * y.mean()
    d = np.log((x + floor) / (y + floor))
    return np.sum(w * (np.sqrt(d * d + 0.05**2) - 0.05)) / np.sum(w)


PLAIN = {
    "luminance": lambda x, y, w: abs(np.sum(w * x * REC709) - np.sum(w * y * REC709)),
    "l1": lambda x, y, w: np.sum(w * np.abs(x)),
    "tv": lambda x, y, w: numpy_tv(x, w),
    "change": numpy_change,
    "image_l1": lambda x, y, w: np.sum(w * np.abs(x - y)) / np.sum(w),
    "image_l2": lambda x, y, w: np.sum(w * (x - y) ** 2) / np.sum(w),
    "ssim": plain_ssim_loss,
}
PICTURES = ("image_l1", "image_l2", "ssim")  # which take a weight
NAMES = (*LOSSES, "ssim")


def loss(name, x, y, *weight):
    return Ssim(y, *weight)(x) if name == "ssim" else LOSSES[name](x, y, *weight)


@pytest.mark.parametrize(
    "name, weighted",
    [(name, "no") for name in NAMES] + [(name, each) for name in PICTURES for each in ("texel", "channel")],
)
def test_value_is_the_plain_formula(name, weighted, rng):
    x, y = rng.random((14, 19, 3)), rng.random((14, 19, 3))
    w = rng.random((14, 19, 1 if weighted == "texel" else 3))
    w[3, 4] = 0
    weight = [] if weighted == "no" else [w]
    w = np.ones((14, 19, 3)) if weighted == "no" else np.broadcast_to(w, x.shape)
    value = loss(name, double(x), double(y), *map(double, weight))
    assert len(value) == 1 and type(value) is mi.Float64
    np.testing.assert_allclose(value[0], PLAIN[name](x, y, w), rtol=1e-12)
    narrow = loss(name, single(x), single(y), *map(single, weight))
    assert type(narrow) is mi.Float
    np.testing.assert_allclose(narrow[0], value[0], rtol=3e-6)


@pytest.mark.parametrize("name, weighted", [(n, False) for n in NAMES] + [(n, True) for n in PICTURES])
def test_gradient_is_the_finite_difference(name, weighted, rng):
    x, y, d = (rng.random((13, 16, 3)) for _ in range(3))
    weight = [double(rng.random((13, 16, 1)))] if weighted else []
    _, g = gradient(lambda t: loss(name, t, double(y), *weight), double(x))
    # Small enough that no absolute value changes sign, fourth order for the smooth ones.
    h = 1e-5
    v = {k: loss(name, double(x + k * h * d), double(y), *weight)[0] for k in (-2, -1, 1, 2)}
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
def test_weights_that_are_all_zero_give_zero_not_nan(name, rng):
    x, y = rng.random((12, 12, 3)), rng.random((12, 12, 3))
    w = dr.opaque(mi.TensorXf, 0, (12, 12, 1))
    value, g = gradient(lambda t: loss(name, t, single(y), w), single(x))
    assert value == 0 and not g.any()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_texel_is_not_hidden(name, bad, rng):
    x, y = rng.random((12, 15, 3)), rng.random((12, 15, 3))
    x[5, 8, 1] = bad
    assert not np.isfinite(loss(name, single(x), single(y))[0])
    if name in PICTURES:
        w = np.ones((12, 15, 1))
        w[:, 8] = 0
        assert not np.isfinite(loss(name, single(x), single(y), single(w))[0])


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"l1", "tv"}))
def test_shapes_must_agree(name):
    x = dr.zeros(mi.TensorXf, (12, 15, 3))
    with pytest.raises(InputError, match=r"image \(12, 15, 3\) and reference \(15, 12, 3\) differ in shape"):
        loss(name, x, dr.zeros(mi.TensorXf, (15, 12, 3)))
    with pytest.raises(InputError, match=r"expected an image of shape \(H, W, C\), got \(12, 15\)"):
        loss(name, x[..., 0], x[..., 0])


@pytest.mark.parametrize("name", PICTURES)
def test_weight_must_fit(name):
    x = dr.zeros(mi.TensorXf, (12, 15, 3))
    with pytest.raises(InputError, match=r"weight \(12, 14, 1\) fits neither"):
        loss(name, x, x, dr.zeros(mi.TensorXf, (12, 14, 1)))


def test_luminance_needs_rgb():
    x = dr.zeros(mi.TensorXf, (4, 4, 1))
    with pytest.raises(InputError, match="luminance needs RGB"):
        luminance(x, x)
