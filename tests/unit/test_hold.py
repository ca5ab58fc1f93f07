"""The weight of what was not painted, where the program chooses it."""

import numpy as np
import pytest

from envedit import config
from envedit.solve import hold


def further(weight, changed, **target):
    """Ask for the next weight where what was not painted has changed by so much of a display value."""
    return hold.further(config.Target(**({"rest": "keep"} | target)), weight, changed)


def test_only_pixels_without_paint_that_count_have_changed():
    aim = np.zeros((1, 4, 3))
    rendering = np.array([0.0, 0.5, 0.5, 1.0]).reshape(1, 4, 1) ** 2.2 * np.ones(3)
    coverage, counts = np.array([0, 0, 0.01, 0]), np.array([1, 1, 1, 0])
    shaped = (part.reshape(1, 4, 1) for part in (coverage, counts))
    assert hold.change(rendering, aim, *shaped) == pytest.approx(0.25)
    assert hold.change(rendering, aim, np.ones((1, 4, 1)), np.ones((1, 4, 1))) == 0
    assert hold.said(4.0, 0.01) != hold.said(hold.LARGEST_HOLD, 0.05)


@pytest.mark.parametrize(("before", "changed", "target", "after"), [
    (1, 0.0199, {}, None), (1, 0.0201, {}, 2), (8, 1.0, {}, 16), (200, 1.0, {}, 256),
    (hold.LARGEST_HOLD, 1.0, {}, None), (1, 0.04, {"hold": 3.0}, None), (1, 0.04, {"paint": 0.0}, None),
    (1, 0.04, {"rest": "follow"}, None),
])  # fmt: skip
def test_a_weight_that_was_left_open_grows_where_the_change_is_visible(before, changed, target, after):
    found = further(before, changed, **target)
    assert found is None if after is None else found == pytest.approx(after)
