"""What is said of strokes that little is reached of: which, why, and what is offered."""

from types import SimpleNamespace

import numpy as np
import pytest

from envedit.cli.paint import advice
from envedit.cli.paint.protocol import document
from envedit.cli.paint.solution import Request
from envedit.core.color import tonemap

SHAPE = 8, 8, 3
SQUARE = {"type": "shadow", "rectangle": [0.0, 0.0, 0.5, 0.5], "amount": 0.5, "softness": 0.0}
HELD = {"type": "hold", "rectangle": [0.0, 0.0, 0.5, 0.5]}


def told(feasible, target=0.2, white=1.0, lamps=0.0, **chosen):
    """Say what is said where a square of 0.5 is to become ``target``, and what of it is ``feasible``."""
    base, cover = np.full(SHAPE, 0.5), np.zeros((8, 8, 1))
    cover[:4, :4] = 1
    wanted = np.where(cover > 0, target, base)
    closest = base + feasible * (wanted - base)
    lit = np.where(cover > 0, white, 1.0) * np.ones(SHAPE)
    share = feasible if np.isscalar(feasible) else 0.3
    residual = tonemap(wanted) - tonemap(closest)
    reach = SimpleNamespace(picture=closest, residual=residual, share=share)
    made = document({"strokes": [SQUARE, HELD], **chosen})
    painted = Request(base, wanted, cover)
    return advice.said(made, painted, base, reach, [cover, cover], lit, np.full(SHAPE, lamps))


@pytest.mark.parametrize(("arguments", "why", "change"), [
    ({"feasible": 0.9, "rest": "keep"}, "the rest, which stays", {"rest": "follow"}),
    ({"feasible": 0.9, "freedom": 0.0}, "may change so little", {"freedom": 1.0}),
    ({"feasible": 0.9, "freedom": 0.8}, "unlikely for a sky", None),
    ({"feasible": 0.0, "target": 0.8, "white": 0.01}, "hardly any light of the map", None),
    ({"feasible": 0.1, "lamps": 0.4}, "of lamps of the scene", None),
    ({"feasible": 0.3}, "makes the rest darker too", "opacity"),
    ({"feasible": 0.01}, "makes the rest darker too", None),
])  # fmt: skip
def test_why_and_what_is_offered(arguments, why, change):
    text, actions = told(**arguments)
    assert text.startswith("stroke 1 (shadow) stays too") and why in text
    if change == "opacity":
        (action,) = actions
        strokes = document(action.change).strokes
        assert 0 < strokes[0]["opacity"] < 0.5 and strokes[1]["type"] == "hold"
        assert action.label.startswith("Paint ") and action.label.endswith(" % of stroke 1")
    else:
        assert [action.change for action in actions] == ([] if change is None else [change])


def test_a_pattern_that_is_too_fine_is_told_from_a_level():
    feasible = np.where(np.indices(SHAPE).sum(axis=0) % 2, 1.6, -0.6)  # right in the mean, not in detail
    assert "a pattern so fine" in told(feasible)[0]
