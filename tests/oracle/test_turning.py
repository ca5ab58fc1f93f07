"""The turn of a sky is found from any angle, to a small part of a texel, and told from no turn at all."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.scene import scene
from envedit.solve import turning
from envedit.transport.light_transport import LightTransport
from tests.oracles.dense_transport import DenseTransport

FILM, GRID = (12, 16), (32, 64)


def sky(rng):
    d = latlong.directions(*GRID)
    image = 0.3 + 0.2 * np.exp(np.sin(3 * d[..., :1]) + np.sin(2 * d[..., 2:])) + 0.1 * rng.random((*GRID, 3))
    return image.astype(np.float32)


@pytest.fixture(scope="module")
def traced():
    return DenseTransport.random(np.random.default_rng(0), FILM, GRID, even=0.6)


def rendered(transport, image):
    return transport.apply(tensor(image)).numpy()


def found_of(transport, image, picture, **more):
    """Find a turn where T is exact, so that it renders turned maps too."""
    even = np.ones_like(picture[..., :1])
    return turning.find(
        transport, lambda envmap, _: rendered(transport, envmap), image, picture, even, **more
    )


@pytest.mark.parametrize("texels", [0.0, 0.5, 7.0, 21.3, 32.0, 63.9])
def test_the_turn_is_found(texels, traced, rng):
    image = sky(rng)
    degrees = 360 * texels / GRID[1]
    found = found_of(traced, image, rendered(traced, latlong.rotate(image, degrees)))
    off = abs(found.degrees - degrees) % 360
    assert min(off, 360 - off) <= 1.01 * 360 / GRID[1] * turning.FINEST_TEXELS
    assert found.error < 0.003 and (found.left < 0.2 or texels in (0.0, 63.9))


def test_a_glance_shows_what_t_does_where_blocks_are_pixels_and_cells_texels(traced, rng):
    """Against every turn rendered through T itself."""
    image, picture = sky(rng), rendered(traced, sky(np.random.default_rng(5)))
    count = 0.5 + rng.random((*FILM, 1))
    own = rendered(traced, image)
    glance, least = turning._at_a_glance(traced, image, picture, count, own)
    shown = np.float64(turning.display_curve.to_display(tensor(picture)).numpy())
    plain = []
    for k in range(GRID[1]):
        made = rendered(traced, np.roll(image, -k, axis=1))
        made = np.float64(turning.display_curve.to_display(tensor(made)).numpy())
        plain.append((count * (made - shown) ** 2).sum() / (3 * count.sum()))
    np.testing.assert_allclose(glance, plain, rtol=1e-3)
    assert least < 1e-6 * min(plain)


def test_a_sky_that_is_not_there_under_any_turn(traced, rng):
    image = sky(rng)
    found = found_of(traced, image, rendered(traced, 4 * sky(np.random.default_rng(7))))
    assert found.left > 0.5


@pytest.mark.parametrize("periods", [1, 2, 4])
def test_as_many_turns_are_alike_as_a_sky_has_periods(periods, traced, rng):
    image = np.tile(sky(rng)[:, : GRID[1] // periods], (1, periods, 1))
    found = found_of(traced, image, rendered(traced, np.roll(image, 5, axis=1)))
    np.testing.assert_allclose(found.alike, periods, rtol=1e-3)


@pytest.mark.parametrize("still", [0.0, np.inf])
def test_a_turn_explains_nothing_where_there_is_no_residual_or_none_that_is_finite(still):
    assert turning.Turn(90.0, error=still, still=still).left == np.inf


@pytest.mark.slow
def test_what_noise_hides_in_pixels_is_seen_in_blocks(rng, tmp_path):
    image = sky(rng)
    lit = scene.load("sphere", 32, 32)
    transport = LightTransport.build(lit, *GRID, max_depth=3, few=True, folder=tmp_path)
    picture = rendered(transport, latlong.rotate(image, 90.0))
    noisy = picture * np.exp(rng.normal(0, 0.1, picture.shape)).astype(np.float32)
    found = found_of(transport, image, noisy)
    assert found.degrees == pytest.approx(90, abs=3)
    assert found.error > 0.5 * found.still and found.blocks < 0.5
    assert found.left == found.blocks


def test_a_turn_that_explains_nothing_is_not_looked_for(traced, rng):
    """What the block transport shows decides; a turn that is there is found all the same."""
    image = sky(rng)
    found = found_of(traced, image, rendered(traced, 4 * image), thorough=False)
    assert found.degrees == 0 and found.error == found.still
    picture = rendered(traced, np.roll(image, -9, axis=1))
    assert found_of(traced, image, picture, thorough=False) == found_of(traced, image, picture)


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 1e-30, 65504.0, 1e30])
def test_any_radiance(value, traced, rng):
    image = sky(rng)
    image[5, 9] = value
    found = found_of(traced, image, rendered(traced, latlong.rotate(image, 45)))
    assert np.isfinite(found.degrees) and 0 <= found.degrees < 360
    black = found_of(traced, np.zeros_like(image), rendered(traced, image))
    assert black.degrees == 0


@pytest.mark.parametrize(("texels", "noise", "whole"), [(9.0, 0.03, True), (9.4, 0.003, False)])
def test_a_whole_turn_is_preferred_within_the_noise(texels, noise, whole, traced, rng):
    """Every rendering with noise of its own, as where other samples find the sun."""
    image, degrees = sky(rng), 360 * texels / GRID[1]

    def render(envmap, _):
        picture = rendered(traced, envmap)
        return np.float32(picture * np.exp(noise * rng.standard_normal((*FILM, 1))))

    picture = render(latlong.rotate(image, degrees), 2)
    found = turning.find(traced, render, image, picture, np.ones_like(picture[..., :1]))
    assert found.degrees % (360 / GRID[1]) == 0 if whole else abs(found.degrees - degrees) < 0.5
