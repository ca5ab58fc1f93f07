"""Losses, metrics and reductions in single precision against float64, within the bounds that are stated."""

import extremes_precision
import pytest
from extremes_precision import CHECKS

from envedit.losses import losses


@pytest.mark.parametrize("name", CHECKS)
def test_error_is_within_its_bound(name):
    one = CHECKS[name]
    assert one.measure() <= one.bound


def test_every_loss_has_a_bound():
    assert set(extremes_precision._VALUES) == set(losses.LOSSES)
