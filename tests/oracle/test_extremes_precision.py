"""Losses, metrics and reductions in single precision against float64, within the bounds that are stated."""

import pytest

from envedit.losses import losses
from tests.oracles import extremes_precision
from tests.oracles.extremes_precision import CHECKS


@pytest.mark.parametrize("name", CHECKS)
def test_error_is_within_its_bound(name):
    one = CHECKS[name]
    assert one.measure() <= one.bound


def test_every_loss_has_a_bound():
    assert set(losses.LOSSES) <= set(extremes_precision._VALUES)
