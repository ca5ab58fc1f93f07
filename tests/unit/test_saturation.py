"""Saturation of a sky's colours, against its formula in plain numpy."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.representations.layers.layers import Layers
from envedit.representations.layers.saturation import LEAST, saturated

LUMINANCE = [0.212671, 0.715160, 0.072169]  # Mitsuba's


def of(radiance, exponent):
    """Return what :func:`saturated` makes of (n, 3)."""
    made = saturated(mi.Color3f(np.ascontiguousarray(np.float32(radiance).T)), mi.Float(exponent))
    return np.stack([made.x.numpy(), made.y.numpy(), made.z.numpy()], axis=1)


def plain(radiance, exponent):
    radiance = np.float64(radiance)
    if exponent == 1:
        return radiance
    light = radiance @ LUMINANCE
    chroma = radiance / light[:, None]
    chroma = np.maximum(chroma + (1 - exponent) * 0.2 * (1 - chroma), LEAST) ** exponent
    return chroma * (light / (chroma @ LUMINANCE))[:, None]


@pytest.mark.parametrize("exponent", [0.0, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("value", [1e-30, 1e-3, 1.0, 65504.0, 1e6])
def test_it_is_the_formula_and_keeps_luminance(exponent, value, rng):
    radiance = np.float32(value * rng.random((50, 3)))
    radiance[:3] = value * np.eye(3)  # channels that are black
    made = of(radiance, exponent)
    np.testing.assert_allclose(made, plain(radiance, exponent), rtol=1e-4)
    np.testing.assert_allclose(made @ LUMINANCE, radiance @ LUMINANCE, rtol=1e-5)


@pytest.mark.parametrize("horizon", ["mirror", "keep", "free"])
def test_a_sky_of_one_colour_stays_that_colour_and_photographed_ground_stays_as_it_is(horizon, rng):
    """What follows the sky's mirror loses its colours with it, ground does not."""
    image = np.float32(0.2 + rng.random((16, 32, 3)))
    layers = Layers.of(image, cycles=3, horizon=horizon)
    params = layers.start()
    assert layers.parts(params)[0].numpy().shape == image.shape
    grey = params | {"saturation": mi.TensorXf(np.full((1, 1), -9, np.float32))}
    made, up = layers.decode(grey).numpy(), 8
    spread = np.ptp(made, axis=2) / made.mean(axis=2)
    assert spread[:up].max() < 1e-2
    if horizon != "keep":
        assert spread[up:].max() < 1e-2
    else:
        assert np.median(np.abs(np.log(made[-4:] / image[-4:]))) < 0.3 and np.median(spread[-4:]) > 0.2


def test_its_derivative_is_the_finite_difference_of_black_channels_that_to_less_saturation(rng):
    radiance = np.float32(0.05 + rng.random((20, 3)))
    exponent = mi.Float(0.6)
    dr.enable_grad(exponent)
    made = saturated(mi.Color3f(np.ascontiguousarray(radiance.T)), exponent)
    dr.backward(dr.sum(made.x - 2 * made.z))

    def f(k):
        found = plain(radiance, k)
        return (found[:, 0] - 2 * found[:, 2]).sum()

    assert dr.grad(exponent)[0] == pytest.approx((f(0.601) - f(0.599)) / 0.002, rel=1e-3)
    radiance, exponent, step = np.float32([[0.0, 0.5, 1.0]]), mi.Float(1.0), 0.01
    dr.enable_grad(exponent)
    made = saturated(mi.Color3f(np.ascontiguousarray(radiance.T)), exponent)
    dr.backward(dr.sum(made.x))
    slope = (plain(radiance, 1.0) - plain(radiance, 1 - step))[0, 0] / step
    assert slope < -0.05 and dr.grad(exponent)[0] == pytest.approx(slope, rel=0.2)
