"""Every representation gives back what it was given, stays finite and lets gradients through."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit import config, representations
from envedit.core import latlong
from envedit.representations.siren import fit
from envedit.representations.siren import network as siren
from tests.oracles.plain import double, gradient, numpy_forward

EXTREMES = np.array([0, 1e-30, 1e-4, 0.01, 0.5, 65504, 1e6, 123456.789, 1.0] * 2, np.float32).reshape(2, 3, 3)
QUICK = config.Fit(polish="always", epochs=5, awp_gamma=0.0)


def sky(rng, shape=(8, 16)):
    return (rng.random((*shape, 3)) ** 4 * 20).astype(np.float32)


def make(kind, folder=None, rows=None, **network):
    network = config.Representation(**{"kind": kind, "hidden": 10, "depth": 1} | network)
    return representations.make(config.Config(representation=network, fit=QUICK), folder, rows=rows)


KINDS = ("pixels", "log-pixels", "siren")


def test_pixels_give_back_every_bit_and_their_logarithms_the_map():
    image = EXTREMES.copy()
    image[0, 0, 0] = 3e38
    decoded = make("pixels").decode(make("pixels").encode(image)).numpy()
    assert decoded.tobytes() == image.tobytes()
    log_pixels = make("log-pixels")
    decoded = log_pixels.decode(log_pixels.encode(EXTREMES)).numpy()
    # A logarithm of 14 rounds at 5e-7; next to black what is left is the rounding of 0.01.
    np.testing.assert_allclose(decoded, EXTREMES, rtol=1e-5, atol=1e-8)
    assert (decoded >= 0).all()


def test_siren_holds_what_was_fitted(rng):
    image, representation = sky(rng), make("siren")
    params = representation.encode(image, seed=4)
    fitted = fit.fit(image, representation.network, QUICK, seed=4)
    assert representation.fitted.log_psnr == fitted.log_psnr
    assert all(np.array_equal(params[name].numpy(), fitted.params[name]) for name in fitted.params)


def plane_points(height, width, rows):
    y, x = (2 * np.arange(height) + 1) / height - 1, (2 * np.arange(width) + 1) / width - 1
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


def sphere_points(height, width, rows):
    first, total = rows
    return siren.SPHERE_SCALE * latlong.directions(total, width)[first : first + height].reshape(-1, 3)


POINTS = {"plane": plane_points, "sphere": sphere_points}


@pytest.mark.parametrize("coordinates", POINTS)
@pytest.mark.parametrize("shape, rows", [
    ((8, 16), None), ((5, 7), None), ((1, 1), None), ((8, 16), (0, 16)), ((8, 20), (6, 16)),
])  # fmt: skip
def test_siren_is_decoded_at_the_texels_of_its_rows(coordinates, shape, rows, rng):
    """The network in float64 at the texel centres, and Eq. 2-3."""
    representation = make("siren", rows=rows, coordinates=coordinates)
    params = representation.encode(sky(rng, shape))
    x = POINTS[coordinates](*shape, rows or (0, shape[0]))
    values = numpy_forward({name: value.numpy() for name, value in params.items()}, x, 30.0)
    normalisation = representation.fitted.normalisation
    expected = np.exp(values.reshape(*shape, 3) * normalisation.span + normalisation.low) - 0.01
    decoded = representation.decode(params).numpy()
    np.testing.assert_allclose(decoded, expected, rtol=1e-3, atol=1e-5)
    assert representation.decode(params).numpy().tobytes() == decoded.tobytes()


@pytest.mark.parametrize("kind", ["layers", "pixels"])
def test_an_image_is_encoded_as_the_configuration_asks_for(kind, rng):
    image, settings = sky(rng), config.Config(representation=config.Representation(kind=kind))
    representation, params = representations.encoded(image, settings)
    assert representation.models_edit == (kind == "layers")
    np.testing.assert_allclose(representation.decode(params).numpy(), image, rtol=1e-6)


def test_layers_are_not_made_without_an_image():
    with pytest.raises(ValueError, match="kind 'layers' of envedit.representations"):
        representations.make(config.Config(representation=config.Representation(kind="layers")))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shift", [-1e3, -5.0, 5.0, 1e3])
def test_decoded_map_stays_finite_wherever_the_parameters_go(kind, shift, rng):
    representation = make(kind)
    params = representation.encode(sky(rng))
    last = list(params)[-1]
    moved = params | {last: mi.TensorXf(params[last].numpy() + np.float32(shift))}
    decoded = representation.decode(moved).numpy()
    assert np.isfinite(decoded).all() and (decoded >= 0).all()


@pytest.mark.parametrize("kind", ["pixels", "log-pixels"])
def test_gradient_is_the_finite_difference(kind, rng):
    representation, image = make(kind), sky(rng) + np.float32(0.1)
    ((name, start),) = representation.encode(image).items()
    weight = rng.normal(size=image.shape)

    def loss(x):
        return dr.sum((representation.decode({name: x}) * double(weight)).array)

    _, found = gradient(loss, double(start.numpy()))
    ends = [loss(double(start.numpy() + step * weight))[0] for step in (1e-5, -1e-5)]
    np.testing.assert_allclose(np.sum(found * weight), (ends[0] - ends[1]) / 2e-5, rtol=1e-6)


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


def test_siren_of_another_image_forgets_the_points_of_the_first(rng):
    used, images = make("siren", rows=(0, 16)), [sky(rng, (8, 16)), sky(rng, (4, 16))]
    for image in images:
        fresh = make("siren", rows=(0, 16))
        decoded = used.decode(used.encode(image)).numpy()
        np.testing.assert_array_equal(decoded, fresh.decode(fresh.encode(image)).numpy())
        assert used.decode(used.encode(image)).shape == image.shape


def test_a_fit_that_is_edited_is_not_polished_unless_asked_for():
    settings = config.Config(representation=config.Representation(kind="siren", hidden=8, depth=1))
    recipe = representations.make(settings).settings
    assert (recipe.awp_until, recipe.light) == (1.0, 0.0) and recipe == fit.unpolished(settings.fit)
    asked = dataclasses.replace(settings, fit=dataclasses.replace(settings.fit, polish="always"))
    assert representations.make(asked).settings == asked.fit
