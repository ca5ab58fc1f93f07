"""Which texels a view determines: thresholds, poles, and noise that must not take a texel that matters."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.transport.influence import LEAST_RADIUS, determined, per_solid_angle

HEIGHT, WIDTH = 32, 64
PLENTY = np.full(HEIGHT, 1e6)
EVERY = slice(0, HEIGHT)


def even(density):
    """T' 1 of a view to which each steradian of a texel matters as given, (H, W) or a number."""
    sphere = np.outer(latlong.solid_angles(HEIGHT, WIDTH), np.ones(WIDTH))
    return (density * sphere).astype(np.float32)


def test_texels_count_by_solid_angle_and_below_a_share_of_the_mean_are_not_determined():
    np.testing.assert_allclose(per_solid_angle(even(3.0)), 3.0, rtol=1e-6)
    assert determined(even(1.0), PLENTY, EVERY, 0.9).all()
    density = np.ones((HEIGHT, WIDTH))
    density[16:] = 0.01
    found = determined(even(density), PLENTY, EVERY, 0.05)
    # The neighbourhood of a row reaches LEAST_RADIUS rows into the dark half.
    assert found[: 16 + LEAST_RADIUS].all() and not found[16 + LEAST_RADIUS :].any()
    assert determined(even(density), PLENTY, EVERY, 0.01).all()
    density[16:] = 1e-4
    assert determined(even(density), PLENTY, slice(20, 32), 1e-3)[20:].all()
    assert not determined(even(density), PLENTY, EVERY, 1e-3)[20:].any()
    density = np.ones((HEIGHT, WIDTH))
    density[20:] = 0
    assert not determined(even(density), PLENTY, slice(24, 32), 1e-3)[24:].any()
    assert not determined(even(0.0), PLENTY, EVERY, 1e-3).any()
    assert determined(np.zeros((HEIGHT, WIDTH), np.float32), PLENTY, EVERY, 0).all()


def test_neighbours_are_as_far_in_angle_across_as_up_and_down():
    """One texel of influence: at the equator it is a square that frees its neighbours, above a wider one."""
    for row in (16, 4):
        density = np.zeros((HEIGHT, WIDTH))
        density[row, 0] = 1
        found = determined(even(density), PLENTY, EVERY, 1e-3)
        columns = int(found[row].sum())
        sine = np.sin(np.pi * row / (HEIGHT - 1))
        assert columns == 2 * int(np.ceil(LEAST_RADIUS / sine)) + 1
        assert found[row, -1] and found[row, 1]  # across the seam
        assert np.flatnonzero(found.any(axis=1)).tolist() == list(range(row - LEAST_RADIUS, row + 3))


def test_the_fewer_samples_the_wider_the_neighbourhood():
    density = np.ones((HEIGHT, WIDTH))
    density[:, 8:] = 0
    shares = []
    for samples in (1e6, 100, 10, 1e-6):
        shares.append(determined(even(density), np.full(HEIGHT, samples), EVERY, 1e-2).mean())
    assert shares == sorted(shares) and shares[0] < 0.4 and shares[1] < shares[2] and shares[-1] == 1


@pytest.mark.parametrize("samples", [2, 20, 200])
def test_noise_does_not_take_texels_above_the_threshold(samples, rng):
    """Texels of the right half have six times the threshold, but many of them have met no sample."""
    threshold = 0.02
    density = np.ones((HEIGHT, WIDTH))
    density[:, WIDTH // 2 :] = 6 * threshold * 0.5
    for _ in range(20):
        met = rng.poisson(samples * density) / samples
        found = determined(even(met), np.full(HEIGHT, float(samples)), EVERY, threshold)
        assert found.all()
        assert samples > 20 or (met[:, WIDTH // 2 :] == 0).mean() > 0.2  # each by itself would be taken
