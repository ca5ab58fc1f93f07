"""Pixels that are mostly noise count less, and only they."""

import numpy as np
import pytest

from envedit.solve import pixel_confidence

SHAPE = (24, 32, 3)


def pictures(rng, noise=0.003):
    base = np.full(SHAPE, 0.4) + 0.2 * rng.random(SHAPE)
    return [base + noise * rng.normal(size=SHAPE) for _ in range(2)], base


def test_equal_pictures_and_noise_alone_are_trusted(rng):
    (_, _), base = pictures(rng)
    assert pixel_confidence.weights(base, base, 1 / 8, base) is None
    assert pixel_confidence.weights(base, base, 1 / 8, base, np.zeros(SHAPE[:2])) is None
    base = np.full(SHAPE, 0.5)
    both = [base + rng.random(SHAPE) for _ in range(2)]
    assert pixel_confidence.weights(*both, 1 / 8, base) is None


@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_even_noise_is_nothing_special(rng, noise):
    both, base = pictures(rng, noise)
    assert pixel_confidence.weights(*both, 1 / 8, base) is None


def test_a_caustic_counts_less_and_the_rest_as_before(rng):
    (first, second), base = pictures(rng)
    first[10:13, 20:23] += 3
    found = pixel_confidence.weights(first, second, 1 / 8, base)
    assert found.shape == (24, 32, 1) and found.dtype == np.float32
    assert found[11, 21] < 0.01 and found[9, 19] < 0.05, "and around it, where others are hit"
    assert found[:, :16].min() > 0.99


def test_more_samples_leave_more_noise_to_the_first_and_the_target_s_own_counts(rng):
    (first, second), base = pictures(rng)
    first[10:13, 20:23] += 0.1
    few, many = (pixel_confidence.weights(first, second, share, base) for share in (1 / 2, 2))
    assert many[11, 21] < few[11, 21] < 0.5
    (first, second), base = pictures(rng)
    noise = np.full(SHAPE[:2], 0.002)
    noise[4, 5] = 0.5
    found = pixel_confidence.weights(first, second, 1 / 8, base, noise)
    assert found[4, 5] < 0.05 and found[20, 28] > 0.99


def test_pixels_that_show_the_light_itself_tell_nothing(rng):
    (first, second), base = pictures(rng)
    first[10, 20] += 3
    base[3, 3], first[3, 3], second[3, 3] = 100, 120, 80
    found = pixel_confidence.weights(first, second, 1 / 8, base)
    assert not found[2:5, 2:5].any() and found[6, 6] > 0.99


def test_a_coloured_picture_shows_no_light_all_over(rng):
    """Brightness is of the brightest channel, in a pixel and in the picture's median alike."""
    (first, second), base = (list(p) if isinstance(p, list) else p for p in pictures(rng))
    orange = np.array([1.0, 0.3, 0.05])
    first, second, base = first * orange, second * orange, base * orange
    first[10:13, 20:23] += 0.1
    found = pixel_confidence.weights(first, second, 1 / 8, base)
    assert 0 < found[11, 21] < 0.5 and found.min() > 0


def test_what_is_bright_and_no_noise_counts_beside_what_is(rng):
    """A mirror in front of a dark wall."""
    (first, second), base = pictures(rng)
    for picture in (first, second, base):
        picture[12:, :] *= 8
    first[2, 2] += 3
    found = pixel_confidence.weights(first, second, 1 / 8, base)
    assert found[2, 2] < 0.05 and np.median(found[16:]) > 0.5


@pytest.mark.parametrize("backdrop", [0, 1e-30, 1e-4])
def test_a_mirror_ball_in_the_dark_is_judged_by_its_own_pixels(rng, backdrop):
    (first, second), base = pictures(rng)
    for picture in (first, second, base):
        picture[:, 12:] = backdrop
    first[2, 2] += 3
    found = pixel_confidence.weights(first, second, 1 / 8, base)
    assert found[2, 2] < 0.05 and np.median(found[:, :12]) > 0.9
    assert pixel_confidence.weights(*pictures(rng)[0], 1 / 8, np.zeros(SHAPE)) is None


def test_radiance_at_the_extremes_is_finite(rng):
    (first, second), base = pictures(rng)
    first[5, 5], second[6, 6], first[8, 8] = 3e38, 0, 1e-30
    found = pixel_confidence.weights(first, second, 1 / 8, base)
    assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1


def test_noise_at_the_edge_of_a_view_says_nothing_of_the_next(rng):
    (first, second), base = pictures(rng)
    first[10:12, 20:23] += 3
    views = slice(0, 12), slice(12, 24)
    apart, joined = (pixel_confidence.weights(first, second, 1 / 8, base, None, v) for v in (views, ()))
    assert apart[11, 21] < 0.01 and apart[12:].min() > 0.99 and joined[12, 21] < 0.05
