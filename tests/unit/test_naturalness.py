"""Whether an edited sky still looks like a photograph: white and patches, against closed forms."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.losses import naturalness
from tests.oracles.maps import angle

GRID = (64, 128)
DIRECTIONS = latlong.directions(*GRID)
HALF = GRID[0] // 2
OMEGA = np.repeat(latlong.solid_angles(*GRID)[:HALF, None], GRID[1], axis=1)


def grey(log, level=30.0):
    """Return a map whose log radiance over a level, far above the logarithm's floor, is this."""
    return level * np.exp(np.broadcast_to(log, GRID))[..., None].repeat(3, axis=2).astype(np.float32)


def degrees_from(place):
    return angle(DIRECTIONS, DIRECTIONS[place])


def by_texels(log):
    """The measure over all texels in place of cells, as an integral over the upper half."""
    d, omega, g = DIRECTIONS[:HALF].reshape(-1, 3), OMEGA.ravel(), log[:HALF].ravel()
    some = slice(None, None, 3)
    kernel = np.exp(-0.5 * (angle(d[some], d.T) / 60) ** 2) * omega
    off = g[some] - kernel @ g / kernel.sum(axis=1)
    return np.sqrt((omega[some] * off**2).sum() / omega[some].sum())


@pytest.mark.parametrize("factor", [1.0, 0.25, 3.0])
def test_no_change_and_a_factor_for_the_whole_sky_are_no_patches(factor, rng):
    image = grey(rng.normal(0, 0.3, GRID))
    coloured = factor * image * np.array([1.2, 1, 0.8], np.float32)
    assert naturalness.patches(factor * image, image) == pytest.approx(0, abs=1e-4)
    assert naturalness.patches(coloured, image) < 0.02
    assert naturalness.natural(image, image)["white"] == 0


@pytest.mark.parametrize("width", [15.0, 25.0])
def test_a_dark_bump_is_a_patch_of_its_size(width, rng):
    """Against the integral over texels, whatever the sky below it."""
    bump = -0.5 * np.exp(-0.5 * (degrees_from((16, 40)) / width) ** 2)
    expected = by_texels(bump)
    assert expected > 0.05
    for sky in (np.zeros(GRID), rng.normal(0, 0.1, GRID)):
        found = naturalness.patches(grey(sky + bump), grey(sky))
        assert found == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("clouds", [0.0, 0.2])
def test_the_sun_elsewhere_is_no_patch(clouds, rng):
    """Its texels are cut, where it was and where it is; a bright patch that is no sun is not."""
    sky = grey(rng.normal(0, clouds, GRID) if clouds else np.zeros(GRID))
    with_sun = []
    for row, column in ((14, 30), (9, 90)):
        image = sky.copy()
        image[row : row + 2, column : column + 2] = 1e5
        with_sun.append(image)
    assert naturalness.patches(*with_sun) < 0.03
    bright = sky.copy()
    bright[14:22, 30:50] *= 3
    assert naturalness.patches(bright, sky) > 0.1


@pytest.mark.parametrize("degrees", [20.0, 45.0])
def test_white_is_the_share_of_the_skys_solid_angle(degrees, rng):
    """Of a cap around the zenith 1 - cos; what is white below the horizon, or in one channel, is not."""
    sky = grey(rng.normal(0, 0.2, GRID), 0.2)
    capped = sky.copy()
    capped[degrees_from((0, 0)) < degrees] = 1.0
    capped[HALF:] = 5
    capped[10:20, :, 0] = np.maximum(capped[10:20, :, 0], 2)
    assert naturalness.white(sky) == 0
    assert naturalness.white(capped) == pytest.approx(1 - np.cos(np.radians(degrees)), rel=0.15)
    assert naturalness.natural(capped, sky)["white"] == naturalness.white(capped)
    assert naturalness.natural(sky, capped)["white"] == -naturalness.white(capped)


@pytest.mark.parametrize("shape", [(2, 4), (4, 8), (15, 30)])
def test_small_maps_have_as_many_cells_as_rows(shape, rng):
    image = rng.random((*shape, 3)).astype(np.float32)
    logs, directions, omega = naturalness.cells(image)
    half = max(1, shape[0] // 2)
    assert omega.sum() == pytest.approx(latlong.solid_angles(*shape)[:half].sum() * shape[1], rel=1e-6)
    assert len(logs) <= half * shape[1] and np.isfinite(logs).all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert naturalness.patches(image, image) == 0
    assert np.isfinite(naturalness.patches(0 * image, image))


def test_a_user_is_warned_of_much_white_and_of_patches():
    fine = {"white": 0.05, "patches": 1.0}
    assert naturalness.warning(fine) == ""
    white = naturalness.warning(fine | {"white": 0.08})
    assert "8 % more of it is white" in white and "patches" not in white and "solve.freedom" in white
    both = naturalness.warning({"white": 0.08, "patches": 1.9})
    assert "white and its patches are 1.9 times" in both
