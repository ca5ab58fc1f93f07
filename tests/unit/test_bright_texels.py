"""Texels too bright for even sampling: the predicted error is the one that samples have."""

import numpy as np
import pytest

from envedit.transport import bright_texels


def test_error_is_that_of_samples_in_proportion_to_solid_angle(rng):
    radiance, omega = rng.random(50) ** 4 * 30, rng.random(50) + 0.1
    rest = rng.random(50) < 0.8
    share = omega / omega.sum()
    drawn = rng.choice(50, (20000, 16), p=share)
    exact = (radiance * omega)[~rest].sum()
    estimate = exact + (radiance * rest)[drawn].mean(axis=1) * omega.sum()
    found = estimate.std() / (radiance * omega).sum()
    # The texels that are taken out count as samples of the rest's mean, not of 0: a little less noise.
    assert 0.75 * found < bright_texels.error(radiance, omega, 16, rest) <= 1.02 * found


@pytest.mark.parametrize("tolerance", [0.3, 0.03, 0.003, 0.0])
def test_as_few_texels_as_it_takes_brightest_first(tolerance, rng):
    radiance, omega = np.exp(3 * rng.normal(size=200)), rng.random(200) + 0.1
    found = bright_texels.brightest(radiance, omega, 64, tolerance)
    assert (np.diff(radiance[found]) <= 0).all() and len(found) > 0
    for count, enough in ((len(found), True), (len(found) - 1, False)):
        rest = np.full(200, True)
        rest[found[:count]] = False
        assert (bright_texels.error(radiance, omega, 64, rest) <= tolerance + 1e-9) == enough


def test_black_needs_nothing():
    black, omega = np.zeros(8), np.ones(8)
    assert len(bright_texels.brightest(black, omega, 4, 0.0)) == 0
    assert bright_texels.error(black, omega, 4, np.full(8, True)) == 0
    assert bright_texels.error(np.ones(8), omega, 4, np.full(8, False)) == 0
