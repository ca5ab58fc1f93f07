"""Every representation gives back what it was given, stays finite and lets gradients through."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import double
from test_siren import numpy_forward

from envedit import config, envmap, fit

EXTREMES = np.array([0, 1e-30, 1e-4, 0.01, 0.5, 65504, 1e6, 123456.789, 1.0] * 2, np.float32).reshape(2, 3, 3)
QUICK = config.Fit(epochs=5, awp_gamma=0.0)


def sky(rng, shape=(8, 16)):
    return (rng.random((*shape, 3)) ** 4 * 20).astype(np.float32)


def make(kind, folder=None):
    network = config.Representation(kind=kind, hidden=10, depth=1)
    return envmap.make(config.Config(representation=network, fit=QUICK), folder)


KINDS = ("pixels", "log-pixels", "siren")


def test_pixels_give_back_every_bit():
    image = EXTREMES.copy()
    image[0, 0, 0] = 3e38
    decoded = make("pixels").decode(make("pixels").encode(image)).numpy()
    assert decoded.tobytes() == image.tobytes()


def test_log_pixels_give_back_the_map():
    log_pixels = make("log-pixels")
    decoded = log_pixels.decode(log_pixels.encode(EXTREMES)).numpy()
    # A logarithm of 14 rounds at 5e-7; next to black what is left is the rounding of 0.01.
    np.testing.assert_allclose(decoded, EXTREMES, rtol=1e-5, atol=1e-8)
    assert (decoded >= 0).all()


def test_siren_gives_back_what_was_fitted(rng):
    image, representation = sky(rng), make("siren")
    params = representation.encode(image, seed=4)
    fitted = fit.fit(image, representation.network, QUICK, seed=4)
    assert representation.fitted.log_psnr == fitted.log_psnr
    assert all(np.array_equal(params[name].numpy(), fitted.params[name]) for name in fitted.params)
    decoded = representation.decode(params)
    expected = fit.evaluate(params, fitted.normalisation, (8, 16), representation.network.omega)
    np.testing.assert_array_equal(decoded.numpy(), expected.numpy())


@pytest.mark.parametrize("shape", [(8, 16), (16, 32), (5, 7), (1, 1)])
def test_siren_is_one_function_at_any_resolution(shape, rng):
    """The network in float64 at the texel centres, and Eq. 2-3."""
    representation = make("siren")
    params = representation.encode(sky(rng))
    height, width = shape
    y, x = (2 * np.arange(height) + 1) / height - 1, (2 * np.arange(width) + 1) / width - 1
    grid = np.stack(np.meshgrid(y, x, indexing="ij")).reshape(2, -1)
    values = numpy_forward({name: value.numpy() for name, value in params.items()}, grid, 30.0)
    normalisation = representation.fitted.normalisation
    expected = np.exp(values.T.reshape(height, width, 3) * normalisation.span + normalisation.low) - 0.01
    np.testing.assert_allclose(representation.decode(params, shape).numpy(), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_decoded_map_is_an_image_of_finite_radiance(kind):
    representation = make(kind)
    image = np.repeat(EXTREMES, 4, axis=0).repeat(4, axis=1)
    decoded = representation.decode(representation.encode(image))
    assert isinstance(decoded, mi.TensorXf) and decoded.shape == image.shape
    assert np.isfinite(decoded.numpy()).all() and (decoded.numpy() >= 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shift", [-1e3, -5.0, 5.0, 1e3])
def test_decoded_map_stays_finite_wherever_the_parameters_go(kind, shift, rng):
    representation = make(kind)
    params = representation.encode(sky(rng))
    last = list(params)[-1]
    moved = params | {last: mi.TensorXf(params[last].numpy() + np.float32(shift))}
    decoded = representation.decode(moved).numpy()
    assert np.isfinite(decoded).all() and (decoded >= 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [0.0, 1e-30, 1e6])
def test_flat_maps_are_no_special_case(kind, value):
    representation = make(kind)
    decoded = representation.decode(representation.encode(np.full((4, 8, 3), value, np.float32))).numpy()
    assert np.isfinite(decoded).all() and (decoded >= 0).all()


@pytest.mark.parametrize("kind", ["pixels", "log-pixels"])
def test_gradient_is_the_finite_difference(kind, rng):
    representation, image = make(kind), sky(rng) + np.float32(0.1)
    ((name, start),) = representation.encode(image).items()
    weight = rng.normal(size=image.shape)
    leaf = double(start.numpy())
    dr.enable_grad(leaf)
    dr.backward(dr.sum((representation.decode({name: leaf}) * double(weight)).array))

    def loss(step):
        return np.sum(weight * representation.decode({name: double(start.numpy() + step * weight)}).numpy())

    slope = (loss(1e-5) - loss(-1e-5)) / 2e-5
    np.testing.assert_allclose(np.sum(np.array(dr.grad(leaf)) * weight), slope, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_reaches_every_parameter(kind, rng):
    representation = make(kind)
    params = representation.encode(sky(rng) + np.float32(0.1))
    leaves = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(leaves)
    dr.backward(dr.sum(representation.decode(leaves).array))
    for leaf in leaves.values():
        gradient = np.array(dr.grad(leaf))
        assert np.isfinite(gradient).all() and np.count_nonzero(gradient) > 0.9 * gradient.size


@pytest.mark.parametrize("kind", ["pixels", "log-pixels"])
@pytest.mark.parametrize("below", [0.0, 0.5])
def test_black_texels_can_be_lit(kind, below):
    """A slope of 0 at black, or below it where a step may have led, would keep a texel dark for good."""
    representation = make(kind)
    ((name, start),) = representation.encode(np.zeros((2, 3, 3), np.float32)).items()
    leaf = dr.opaque(start - below)
    dr.enable_grad(leaf)
    decoded = representation.decode({name: leaf})
    assert (decoded.numpy() >= 0).all()
    dr.backward(dr.sum(decoded.array))
    assert (np.array(dr.grad(leaf)) > 0).all()


def test_siren_gradient_is_the_finite_difference(rng):
    representation = make("siren")
    params, weight = representation.encode(sky(rng)), rng.normal(size=(8, 16, 3))
    leaves = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(leaves)
    dr.backward(dr.sum((representation.decode(leaves) * mi.TensorXf(weight.astype(np.float32))).array))
    gradient = {name: np.array(dr.grad(leaf), np.float64) for name, leaf in leaves.items()}
    x, normalisation = fit.siren.coordinates(8, 16).numpy(), representation.fitted.normalisation

    def loss(step):
        moved = {name: params[name].numpy() + step * gradient[name] for name in params}
        values = numpy_forward(moved, x, 30.0).T.reshape(8, 16, 3)
        return np.sum(weight * np.exp(values * normalisation.span + normalisation.low))

    h = 1e-7
    slope = (loss(h) - loss(-h)) / (2 * h)
    np.testing.assert_allclose(sum(np.sum(g * g) for g in gradient.values()), slope, rtol=1e-3)


def test_pixels_below_zero_are_black_and_log_pixels_are_never_below():
    params = {"radiance": mi.TensorXf(np.full((1, 2, 3), -0.5, np.float32))}
    assert not envmap.Pixels().decode(params).numpy().any()
    params = {"log_radiance": mi.TensorXf(np.full((1, 2, 3), -100, np.float32))}
    assert not envmap.LogPixels().decode(params).numpy().any()


def test_configuration_names_the_representation():
    found = [make(kind) for kind in KINDS]
    assert [type(r) for r in found] == [envmap.Pixels, envmap.LogPixels, envmap.Siren]
    assert all(r.lr > 0 for r in found)


def test_siren_keeps_its_fits_in_the_folder(tmp_path, rng):
    image = sky(rng)
    a, b = make("siren", tmp_path), make("siren", tmp_path)
    first, second = a.encode(image), b.encode(image)
    assert not a.fitted.cached and b.fitted.cached
    assert dataclasses.asdict(a.fitted.normalisation) == dataclasses.asdict(b.fitted.normalisation)
    np.testing.assert_array_equal(a.decode(first).numpy(), b.decode(second).numpy())
