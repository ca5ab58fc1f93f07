"""Counting and mending bad texels."""

import numpy as np
import pytest

from envedit.core import radiance
from envedit.core.errors import InputError


def test_health():
    values = np.ones((4, 8, 3), np.float32)
    values[1, 2, 0] = values[3, 0, 1] = np.nan
    values[2, 3] = np.inf
    values[0, 7, 2] = -0.5
    values[3, 7] = 65504
    h = radiance.health(values)
    assert (h.texels, h.nan, h.inf, h.negative, h.saturated) == (32, 2, 1, 1, 1)
    first = (h.first_nan, h.first_inf, h.first_negative, h.first_saturated)
    assert first == ((1, 2), (2, 3), (0, 7), (3, 7))
    assert (h.minimum, h.maximum, h.median) == (-0.5, 65504, pytest.approx(1))
    assert h.dynamic_range == pytest.approx(65504 / (1 - 1.5 * 0.0722)) and not h.ok
    assert "2 NaN (first at row 1, column 2)" in h.summary() and "\n" not in h.summary()


def test_a_texel_that_is_repaired_does_not_count_as_negative():
    values = np.ones((4, 8, 3), np.float32)
    values[1, 2] = -np.inf
    values[2, 3] = (np.nan, -1, 2)
    values[3, 4] = (1, -1, 2)
    h = radiance.health(values)
    assert (h.inf, h.nan, h.negative, h.first_negative) == (1, 1, 1, (3, 4))


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e6, 3e38, np.nan, -np.inf])
def test_health_is_finite(value):
    h = radiance.health(np.full((1, 1, 3), value, np.float32))
    assert np.isfinite([h.minimum, h.maximum, h.median, h.dynamic_range]).all()
    assert h.ok == np.isfinite(value) and h.summary()


def test_repair(rng):
    values = rng.random((6, 8, 3)).astype(np.float32)
    broken = values.copy()
    broken[2, 0, 1] = np.nan  # on the seam: its neighbours are in columns 7, 0 and 1
    mended, overflowed, replaced = radiance.repair(broken)
    around = np.delete(np.concatenate([values[1:4, 7:], values[1:4, :2]], 1).reshape(9, 3), 4, axis=0)
    assert replaced.sum() == 1 and not overflowed.any() and np.isnan(broken[2, 0, 1])
    np.testing.assert_allclose(mended[2, 0], around.mean(0), rtol=1e-6)
    keep = np.ones((6, 8), bool)
    keep[2, 0] = False
    np.testing.assert_array_equal(mended[keep], values[keep])

    broken[:] = -np.inf
    broken[5, 3] = [1, 2, 3]
    mended, overflowed, replaced = radiance.repair(broken)
    assert replaced.sum() == 47 and not overflowed.any()
    np.testing.assert_allclose(mended, np.broadcast_to([1, 2, 3], (6, 8, 3)), rtol=1e-6)
    assert not any(mask.any() for mask in radiance.repair(values)[1:])
    with pytest.raises(InputError, match="all 48 texels of the image are NaN or infinite"):
        radiance.repair(np.full((6, 8, 3), np.nan))


@pytest.mark.parametrize(("brightest", "expected"), [(3.0, 65504), (1e6, 1e6)])
def test_an_infinite_sun_becomes_the_brightest_light(brightest, expected, rng):
    values = rng.random((6, 8, 3)).astype(np.float32)
    values[0, 0] = brightest
    broken = values.copy()
    broken[2, 3] = np.inf
    broken[2, 4, 0] = np.inf  # a channel of it; the others are as they were
    broken[4, 4] = np.inf, np.nan, 1
    mended, overflowed, replaced = radiance.repair(broken)
    np.testing.assert_array_equal(np.argwhere(overflowed), [[2, 3], [2, 4]])
    np.testing.assert_array_equal(np.argwhere(replaced), [[4, 4]])
    np.testing.assert_array_equal(mended[2, 3], [expected] * 3)
    np.testing.assert_array_equal(mended[2, 4], [expected, *values[2, 4, 1:]])
    assert (mended[4, 4] < 2).all()
