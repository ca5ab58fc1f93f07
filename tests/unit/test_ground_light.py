"""Ground goes by the light that falls on it, where its albedo says that it is lit from above."""

import drjit as dr
import numpy as np
import pytest

from envedit.core.arrays import tensor
from envedit.images import analytic_sky, images
from envedit.representations.layers import ground_light
from envedit.representations.layers.below_horizon import Below, sky_rows
from envedit.representations.layers.ground_light import GroundLight
from envedit.representations.layers.layers import Layers
from tests.oracles.devices import on_cpu
from tests.oracles.plain import gradient


def halves(image):
    up = sky_rows(len(image))
    return np.float32(image[:up]), np.float32(image[up:])


def whole(above):
    return tensor(np.zeros_like(above))


@pytest.mark.slow
@pytest.mark.parametrize("elevation", [5, 20, 50, 65, 80])
def test_the_analytic_ground_goes_by_its_irradiance(elevation):
    """``analytic_sky`` lays a ground of one albedo under every sky, from an irradiance of its own making."""
    above, ground = halves(analytic_sky.sunsky(256, 90.0, 35.0))
    other, lit = halves(analytic_sky.sunsky(256, 90.0, float(elevation)))
    change = GroundLight(above, ground).log_change(tensor(other), whole(other)).numpy()[0]
    truth = np.log(lit[8:].mean(axis=(0, 1)) / ground[8:].mean(axis=(0, 1)))
    np.testing.assert_allclose(change, truth, atol=0.03)
    assert abs(truth).min() > 0.2


def test_irradiance_of_a_uniform_sky_is_pi_times_its_radiance():
    above = np.full((64, 256, 3), 2.0, np.float32)
    light = GroundLight(above, np.full((64, 256, 3), 0.5, np.float32))
    np.testing.assert_allclose(light.initial, 2 * np.pi, rtol=2e-3)
    assert light.albedo == pytest.approx(0.25, rel=2e-3) and light.plausible


@on_cpu
def test_light_of_cores_counts_and_that_below_the_horizon_does_not(rng):
    above, ground = halves(rng.uniform(0.5, 1, (32, 64, 3)))
    light = GroundLight(above, ground)
    core = np.zeros((32, 64, 3), np.float32)
    core[20] = 1e4
    assert not light.log_change(tensor(above), tensor(core)).numpy().any()
    core[3, 5] = [1e3, 0, 0]
    with_core = above.copy()
    with_core[3, 5] += core[3, 5]
    change = light.log_change(tensor(above), tensor(core)).numpy()
    np.testing.assert_array_equal(change, light.log_change(tensor(with_core), whole(above)).numpy())
    assert change[0, 0] > 2 * change[0, 1] > 0  # green and blue by the veil alone


@pytest.mark.parametrize("value", [0.0, 1e-30, 65504.0, 1e6, 1e30])
def test_extremes_stay_finite(value):
    above, ground = halves(np.full((16, 32, 3), 0.7))
    light = GroundLight(above, ground)
    assert np.isfinite(light.log_change(tensor(np.full(above.shape, value)), whole(above)).numpy()).all()
    black = GroundLight(np.zeros_like(above), ground)
    assert not black.plausible and black.albedo == 0
    assert np.isfinite(black.log_change(tensor(np.full(above.shape, value)), whole(above)).numpy()).all()


@pytest.mark.parametrize(("factor", "lit"), [(1.0, True), (20.0, False), (0.0, False), (1e-3, False)])
def test_ground_that_shines_itself_or_is_black_keeps_its_brightness(factor, lit, rng):
    above, ground = halves(rng.uniform(0.2, 0.4, (32, 64, 3)))
    below = Below(ground * factor, above, "keep", above)
    assert (below.light is not None) == lit and bool(below.lit.any()) == lit
    change = below.log_factor(tensor(2 * above), None, below.log_lit(tensor(2 * above), whole(above))).numpy()
    assert np.allclose(change[-1], np.log(2) if lit else 0, atol=2e-3)


def test_a_mirror_is_not_lit():
    above, ground = halves(np.full((32, 64, 3), 0.5))
    below = Below(ground, above, "mirror", above)
    assert below.light is None and not below.lit.any()


def test_gradient_is_that_of_finite_differences(rng):
    above, ground = halves(rng.uniform(0.5, 1, (8, 16, 3)))
    light, at = GroundLight(above, ground), np.float32(above * rng.uniform(0.5, 2, above.shape))
    _, slope = gradient(lambda x: dr.sum(light.log_change(x, whole(above)).array), tensor(at))
    way = rng.normal(size=at.shape) * at
    ends = [light.log_change(tensor(at + s * 1e-2 * way), whole(above)).numpy().sum() for s in (1, -1)]
    assert (ends[0] - ends[1]) / 2e-2 == pytest.approx((slope * way).sum(), rel=1e-2, abs=1e-3)


def test_layers_darken_the_ground_with_their_light():
    image = np.float32(analytic_sky.sunsky(128, 90.0, 35.0))
    made = Layers.of(image, horizon="keep")
    params = made.start()
    assert np.array_equal(made.decode(params).numpy()[32:], image[32:])  # unmoved: the original's bits
    flux = params["flux"].numpy().copy()
    flux[0] = -30.0  # out
    dark = made.decode(params | {"flux": tensor(flux)}).numpy()
    light = made.below.light
    share = light.irradiance(dark[:32]) / light.initial
    assert share.max() < 0.8
    np.testing.assert_allclose((dark[-1] / image[-1]).mean(axis=0), share, rtol=0.2)
    # It shows nothing of the sky's pattern, so it changes as one.
    change = np.log(dark[32:] / image[32:]).mean(axis=(1, 2))
    np.testing.assert_allclose(change, change[-1], rtol=1e-3)


def test_the_own_factor_of_ground_grows_from_nothing_at_the_horizon(rng):
    above, ground = halves(rng.uniform(0.2, 0.4, (64, 128, 3)))
    below = Below(0.3 * ground, above, "keep", above)
    factors = None, tensor(np.ones((1, 3)))
    plain, own = (below.log_lit(tensor(above), whole(above), factor).numpy()[:, 0] for factor in factors)
    share = own - plain
    assert share[0] < 0.2 and share[-1] > 0.99 and (np.diff(share) > 0).all()


def test_maps_with_ground_have_an_albedo_that_there_is(data):
    for file in sorted((data / "hdri").glob("*.hdr")):
        above, ground = halves(images.load_envmap(file, 256)[0])
        light = GroundLight(above, ground)
        assert light.plausible and 0.03 < light.albedo < 0.5, file.name
        assert light.albedo > ground_light.ALBEDO[0]
