"""By which factor the whole sky has changed, a channel at a time."""

import copy

import mitsuba as mi
import numpy as np
import pytest

from envedit.core.radiance import BRIGHTEST
from envedit.solve import sky_factor

HEIGHT, WIDTH, PIXELS = 4, 8, 6
ALL = np.ones((HEIGHT, WIDTH), bool)
EVEN = np.ones((PIXELS, PIXELS, 1), np.float32)


class Linear:
    """A transport of random weights, which add up to one in each pixel; of a resolved map alone."""

    def __init__(self, rng):
        weights = rng.uniform(size=(PIXELS * PIXELS, HEIGHT * WIDTH))
        self.weights = weights / weights.sum(axis=1, keepdims=True)
        self.is_resolved = False

    def resolved(self, envmap):
        other = copy.copy(self)
        other.is_resolved = True
        return other

    def apply(self, envmap):
        assert self.is_resolved
        return mi.TensorXf(self.exact(envmap.numpy()))

    def exact(self, envmap):
        values = self.weights @ envmap.reshape(-1, 3)
        return values.reshape(PIXELS, PIXELS, 3).astype(np.float32)


@pytest.fixture
def transport(rng):
    return Linear(rng)


@pytest.fixture
def envmap(rng):
    return rng.uniform(0.05, 0.15, (HEIGHT, WIDTH, 3)).astype(np.float32)


def test_each_channel_has_its_own_factor(transport, envmap):
    """To half a step, 4 %."""
    wanted = np.array([3.0, 0.4, 1.0])
    found = sky_factor.find(transport, envmap, ALL, transport.exact(envmap * wanted), EVEN)
    np.testing.assert_allclose(found, wanted, rtol=0.045)


@pytest.mark.parametrize("noise", [0, 1e-3, 0.03])
def test_noise_alone_changes_nothing(noise, transport, envmap, rng):
    picture = transport.exact(envmap)
    picture = np.maximum(picture + noise * rng.normal(size=picture.shape), 0).astype(np.float32)
    np.testing.assert_array_equal(sky_factor.find(transport, envmap, ALL, picture, EVEN), 1)


def test_texels_that_stay_and_pixels_that_do_not_count_have_no_say(transport, envmap):
    active = ALL.copy()
    active[:, : WIDTH // 2] = False
    picture = transport.exact(np.where(active[..., None], 4 * envmap, envmap))
    np.testing.assert_allclose(sky_factor.find(transport, envmap, active, picture, EVEN), 4, rtol=0.045)
    picture = transport.exact(2 * envmap)
    picture[: PIXELS // 2] = 0.9
    weight = np.ones((PIXELS, PIXELS, 1), np.float32)
    weight[: PIXELS // 2] = 0
    np.testing.assert_allclose(sky_factor.find(transport, envmap, ALL, picture, weight), 2, rtol=0.045)


@pytest.mark.parametrize("level", [0, 1e-30, 65504, 1e6, BRIGHTEST])
def test_at_the_extremes_of_radiance_factors_are_finite(level, transport):
    """A black map stays as it is; none becomes brighter than a map may be."""
    envmap = np.full((HEIGHT, WIDTH, 3), level, np.float32)
    for value in (0, 0.5, 1e6):
        picture = np.full((PIXELS, PIXELS, 3), value, np.float32)
        found = sky_factor.find(transport, envmap, ALL, picture, EVEN)
        assert np.isfinite(found).all() and (found > 0).all()
        assert (level * found <= BRIGHTEST * (1 + 1e-6)).all()
        if level == 0:
            np.testing.assert_array_equal(found, 1)


def test_a_black_picture_makes_the_sky_dark(transport, envmap):
    picture = np.zeros((PIXELS, PIXELS, 3), np.float32)
    found = sky_factor.find(transport, envmap, ALL, picture, EVEN)
    np.testing.assert_array_equal(found, 2.0 ** sky_factor.STOPS[0])
