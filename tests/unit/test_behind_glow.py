"""Where a glow has gone the sky continues from the same elevation."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE, tonemap
from envedit.images.analytic_sky import sunsky
from envedit.losses import metrics
from envedit.representations.layers.behind_glow import behind_glow
from envedit.representations.layers.layers import SCALES, Layers
from envedit.representations.layers.lights import DARK
from tests.oracles.maps import angle
from tests.unit.test_layers import SHAPE, SUN, sent, sky

D = latlong.directions(*SHAPE)
AWAY = angle(D, D[SUN])
ROWS = 0, SHAPE[0]


def changed(background, glow):
    found = behind_glow(background, glow, AWAY, ROWS)
    return background * np.exp(found.log_change(background))


def test_what_a_glow_has_wrong_is_taken_from_the_elevation(rng):
    """A patch that is too dark, tinted and of three times the contrast becomes as the sky around it."""
    glow = 1 + 8 * np.exp(-AWAY / 12)[..., None] * [1.0, 0.9, 0.7]
    level, texture = np.exp(D[..., 1:2]) * [0.4, 0.5, 0.7], 0.1 * rng.normal(size=(*SHAPE, 1))
    share = np.exp(-0.5 * (AWAY / 15) ** 2)[..., None]
    wrong = np.exp(np.log(level) + texture * (1 + 2 * share) - share * [0.7, 0.5, 0.0])
    got = changed(wrong, glow)
    near = AWAY < 12
    for image, least, most in ((wrong, 0.4, 1.0), (got, 0.0, 0.15)):
        off = np.log(image / level)[near].mean(axis=0)
        assert least < np.abs(off).max() < most
    rough = [np.std(np.log(m / level)[(AWAY > 8) & near] @ LUMINANCE) for m in (wrong, got)]
    assert rough[0] > 0.15 and rough[1] < 0.14


def test_a_sky_that_is_the_same_around_the_horizon_stays_and_roofs_are_no_sky():
    level = np.exp(D[..., 1:2]) * [0.4, 0.5, 0.7]
    got = changed(level, 1 + 8 * np.exp(-AWAY / 12)[..., None] * np.ones(3))
    np.testing.assert_allclose(got, level, rtol=0.02)
    roofs = (D @ [D[SUN][0], 0, D[SUN][2]] < 0)[..., None] & (np.abs(D[..., 1:2]) < np.sin(np.radians(40)))
    houses = np.where(roofs, 0.05, level)
    got = changed(houses, 1 + 8 * np.exp(-AWAY / 12)[..., None] * np.ones(3))
    near = AWAY < 12
    assert 0.4 < roofs[SUN[0]].mean() < 0.6 and not roofs[near].any()
    assert np.abs(np.log(got / level)[near].mean(axis=0)).max() < 0.4  # with them 1.5


@pytest.mark.parametrize("level", [0.0, 1e-30, 1e-6, 65504.0])
@pytest.mark.parametrize("shape", [(3, 2), (4, 6), (9, 16)])
def test_extremes_stay_finite(level, shape):
    background = np.full((*shape, 3), level)
    background[shape[0] // 2, 0] = 1e6 if level else 0.0
    found = behind_glow(background, np.full((*shape, 3), 1e4), np.zeros(shape), (0, shape[0]))
    assert np.isfinite(background * np.exp(found.log_change(background))).all()


@pytest.mark.slow
def test_the_old_place_of_a_sun_looks_like_the_elevation_and_an_unmoved_one_keeps_its_bits():
    plain = sky(sun=None)
    image = plain * np.float32(1 + 30 * np.exp(-AWAY / 10))[..., None]
    image[SUN] = 5e4
    mirror = angle(D, D[SUN] * [1, -1, 1])
    image[32:] = (plain * np.float32(1 + 4 * np.exp(-0.5 * (mirror / 6) ** 2))[..., None])[32:]
    made = Layers.of(image, horizon="mirror")
    params = made.start()
    still = made.decode(params).numpy()
    outside = np.ones(SHAPE, bool)
    outside[:32] = ~(made.separation.core > 0).any(axis=2)
    np.testing.assert_array_equal(still[outside], image[outside])
    edited = made.decode(sent(made, params, made.lights.centres[0] * [-1, 1, -1])).numpy()
    for near in (AWAY < 8, mirror < 8):
        assert np.abs(np.log(edited / plain)[near]).max() < 0.5


@pytest.mark.slow
def test_a_low_orange_sun_that_leaves_a_grey_sky_leaves_no_fleck_below_the_horizon():
    """Its reflection goes with its glow, and its colour before the sky's saturation is lowered."""
    low, orange = (29, 20), np.float32([1.0, 0.4, 0.1])
    plain, at = sky(sun=None), D[low]
    away = angle(D, at)
    image = plain * (1 + 8 * np.float32(np.exp(-away / 8))[..., None] * orange)
    image[low] = 5e3 * orange
    mirror = angle(D, at * [1, -1, 1])
    shine = 1 + 20 * np.float32(np.exp(-0.5 * (mirror / 3) ** 2))[..., None] * orange
    image[32:] = (plain * (1 + 8 * np.float32(np.exp(-mirror / 8))[..., None] * orange) * shine)[32:]
    made = Layers.of(image, horizon="mirror")
    params = made.start()
    flux = params["flux"].numpy()
    flux[0] = DARK / SCALES["flux"]
    grey = tensor(np.full((1, 1), np.log(0.05), np.float32))
    edited = made.decode(params | {"flux": tensor(flux), "saturation": grey}).numpy()
    for near in (away < 6, mirror < 6):
        assert np.abs(np.log(edited @ LUMINANCE / (plain @ LUMINANCE)))[near].max() < 0.5
        assert (edited.max(axis=2) / edited.min(axis=2))[near].max() < 1.15


@pytest.fixture(scope="module")
def analytic():
    """The analytic sky at 35 degrees, told apart."""
    made = Layers.of(sunsky(128, 90.0, 35.0), horizon="keep")
    return made, made.start()


@pytest.mark.slow
@pytest.mark.parametrize("elevation", [5, 20, 50, 65, 80])
def test_a_sun_that_rises_or_sets_is_in_its_place_and_tears_nothing(elevation, analytic):
    """The truth is the analytic sky with its sun there; flux and gain, which differ, are the solver's."""
    made, params = analytic
    original, true = made.decode(params).numpy(), sunsky(128, 90.0, float(elevation))
    up, (x, _, z) = np.radians(elevation), made.lights.centres[0]
    end = np.array([np.cos(up) * x, np.sin(up) * np.hypot(x, z), np.cos(up) * z]) / np.hypot(x, z)
    edited = made.decode(sent(made, params, end)).numpy()
    # Near the zenith a texel is less than 2.8 degrees wide: the distance is an angle.
    where = [latlong.directions(64, 128)[metrics.peak_position(m)] for m in (edited, true)]
    assert angle(*where) < 1.5 * 180 / 63
    assert metrics.psnr(tonemap(edited), tonemap(true)) > metrics.psnr(tonemap(original), tonemap(true))
    logs = [np.log(m[:28] @ LUMINANCE + 1e-3) for m in (edited, true)]
    away = angle(latlong.directions(64, 128)[:28], end) > 12
    for apart in (lambda a: np.diff(a, axis=0), lambda a: (a - np.roll(a, 1, axis=1))[1:]):
        steps = [np.abs(apart(one))[away[1:] & away[:-1]].max() for one in logs]
        assert steps[0] < 1.6 * steps[1] + 0.02


@pytest.mark.slow
def test_a_glow_adds_to_a_cloud_what_it_adds_to_the_sky():
    """It is haze before the cloud; a dark outline is brightened in proportion, and stays dark."""
    new = D[SUN] * [-1, 1, -1]
    away = angle(D, new)
    column = np.degrees(np.arctan2(D[..., 0], -D[..., 2])) - np.degrees(np.arctan2(new[0], -new[2]))
    column = (column + 180) % 360 - 180
    plain = sky(sun=None)
    bodies = [(away > 8) & (away < 20) & (sign * column > 4) & (D[..., 1] > 0) for sign in (1, -1)]
    plain[bodies[0]] *= 4  # a cloud
    plain[bodies[1]] *= 0.05  # a tree
    image = plain * np.float32(1 + 8 * np.exp(-AWAY / 10))[..., None]
    image[SUN] = 5e4
    made = Layers.of(image, horizon="keep")
    edited = made.decode(sent(made, made.start(), new)).numpy()
    more = [(edited - plain)[body].mean() for body in bodies]
    factor = [(edited / plain)[body].mean() for body in bodies]
    clear = sky(sun=None)
    expected = [(clear * 8 * np.exp(-away / 10)[..., None])[body].mean() for body in bodies]
    assert 0.7 < more[0] / expected[0] < 1.4  # in proportion to the cloud it would be 4
    assert 1.5 < factor[1] < 9 and more[1] < 0.1 * expected[1]
