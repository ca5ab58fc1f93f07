"""Counting and mending bad texels."""

import numpy as np
import pytest

from envedit.core import radiance
from envedit.core.errors import InputError


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
