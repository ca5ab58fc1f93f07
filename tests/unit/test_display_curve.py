"""The curve through which losses see a picture: by formula, and its slope everywhere."""

import math

import numpy as np
import pytest

from envedit.losses import display_curve
from tests.oracles.plain import plain_display, single


def shown(x, white=math.inf):
    return display_curve.to_display(single(np.reshape(x, (1, 1, -1))), white).numpy().ravel()


def slope(x, white=math.inf):
    return display_curve.slope(np.reshape(x, (1, 1, -1)), white).ravel()


def test_display_values_are_by_formula_and_rise_everywhere_without_a_jump():
    x = np.float32([-1, 0, 1e-30, 5e-4, 1e-3, 0.18, 1, 2, 65504, 1e6, 1e30, 3e38])
    found = shown(x)
    np.testing.assert_allclose(found, plain_display(np.float64(x)), rtol=2e-6)
    assert found[6] == 1
    x = [np.linspace(-1e-3, 3e-3, 400), np.linspace(0.99, 1.01, 400), np.geomspace(1.1, 1e30, 400)]
    assert (np.diff(shown(np.concatenate(x))) > 0).all()
    for joint in (1e-3, 1.0):
        below, above = shown(joint * np.array([1 - 1e-5, 1 + 1e-5]))
        assert 0 < above - below < 2.1e-5 * above


def test_display_slope_is_the_finite_difference_and_positive_and_finite_everywhere():
    x = np.array([-0.5, 0.0, 5e-4, 2e-3, 0.18, 0.9, 1.1, 4.0, 1e4])
    h = 1e-6 * np.maximum(np.abs(x), 1e-3)
    wanted = (plain_display(x + h) - plain_display(x - h)) / (2 * h)
    np.testing.assert_allclose(slope(x), wanted, rtol=1e-4)
    np.testing.assert_allclose(slope([0.999999, 1.0, 1.000001]), 1 / 2.2, rtol=1e-5)
    for white in (1.0, math.inf):
        found = slope([0, 1e-38, 1e-30, 1e-3, 65504, 1e6, 1e30], white)
        assert np.isfinite(found).all() and (found > 0).all()


@pytest.mark.parametrize("white", [1.0, 3.0, 1e6])
def test_differences_above_white_count_for_a_share_and_others_as_before(white):
    x = np.array([1e-3, 0.18, 1.0, 1.5, 4.0, 65504.0, 1e30])
    joint, whole = plain_display(white), plain_display(x)
    above = joint + display_curve.ABOVE_WHITE * (whole - joint)
    np.testing.assert_allclose(shown(x, white), np.where(x > white, above, whole), rtol=2e-6)
    factor = np.where(x > white, display_curve.ABOVE_WHITE, 1)
    np.testing.assert_allclose(slope(x[x != white], white), (factor * slope(x))[x != white], rtol=1e-5)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_shown_as_not_finite(value):
    """Otherwise the loop would take a broken rendering for a grey one."""
    assert list(np.isfinite(shown([0.5, value, 0.5]))) == [True, False, True]
