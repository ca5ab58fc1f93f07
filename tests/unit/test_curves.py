"""The drawing of a history: parsed as XML and read back in page coordinates."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envedit.report import curves


def points_of(svg, name):
    """Pen moves (M or L, x, y) of a curve, found by the colour that the legend gives its name."""
    children = list(ElementTree.fromstring(svg))
    legend = {
        text.text.rsplit(" ", 1)[0]: mark.get("fill")
        for mark, text in zip(children, children[1:], strict=False)
        if mark.tag == "rect"
    }
    path = next(e.get("d") for e in children if e.tag == "path" and e.get("stroke") == legend[name])
    pen = path.replace("h0", "").replace("L", " L").replace("M", " M").split()
    return [(p[0], float(p[1:]), float(y)) for p, y in zip(pen[::2], pen[1::2], strict=True)]


def test_curve_is_straight_for_a_geometric_series():
    rows = [{"iteration": 10 * i, "loss": 0.5**i, "ssim": 0.25 * 0.5**i, "lr": 1e-4} for i in range(9)]
    points = points_of(curves.curves_svg(rows), "loss")
    steps = np.diff([(x, y) for _, x, y in points], axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps.mean(axis=0), steps.shape), atol=0.11)
    assert (steps > 0).all(), "to the right, and down the page"
    lower = points_of(curves.curves_svg(rows), "ssim")
    assert lower[0][2] == pytest.approx(points[2][2], abs=0.11), "0.25 stands where 0.5^2 does"
    assert "lr" not in curves.curves_svg(rows)


def test_curve_is_interrupted_where_there_is_no_value():
    values = [1.0, 0.5, np.nan, 0.25, None, 0.0, -1.0, 0.2, np.inf, "text", 0.1]
    svg = curves.curves_svg([{"iteration": i, "loss": v} for i, v in enumerate(values)])
    assert [move for move, _, _ in points_of(svg, "loss")] == ["M", "L", "M", "M", "M"]


@pytest.mark.parametrize("row", [{}, {"loss": None}, {"loss": np.nan}, {"loss": 0.0}, {"lr": 1.0}])
def test_nothing_to_draw_is_an_empty_string(row):
    assert curves.curves_svg([row]) == "" == curves.curves_svg([])


def test_long_history_stays_small_and_keeps_its_spike():
    rows = [{"iteration": i, "loss": 1.0} for i in range(100_000)]
    rows[54_321]["loss"] = 100.0
    svg = curves.curves_svg(rows)
    assert len(svg) < 60_000
    points = points_of(svg, "loss")
    assert min(y for _, _, y in points) < points[0][2] - 200


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.dictionaries(
            st.sampled_from(["loss", "a<b>&\"'", "\0\x1b", "long" * 9, "lr"]),
            st.one_of(st.none(), st.floats(), st.integers(), st.text(max_size=3), st.booleans()),
        ),
        max_size=8,
    )
)
def test_any_history_makes_a_well_formed_drawing(rows):
    svg = curves.curves_svg(rows)
    if svg:
        root = ElementTree.fromstring(svg)
        drawn = " ".join(" ".join(element.attrib.values()) for element in root.iter())
        assert not re.search(r"\d?(nan|inf)\b", drawn)


@pytest.mark.parametrize(
    "low, high, labels",
    [
        (-3, 0, ["0.001", "0.01", "0.1", "1"]),
        (-5.2, -3.9, ["1e-5", "1e-4"]),
        (np.log10(0.39), np.log10(0.41), ["0.39", "0.395", "0.4", "0.405", "0.41"]),
        (-30.0, -18.0, [f"1e{d}" for d in range(-30, -17, 2)]),
    ],
)
def test_log_axis_has_readable_ticks(low, high, labels):
    ticks = curves._log_ticks(low, high)
    assert [label for _, label in ticks] == labels
    positions = [position for position, _ in ticks]
    np.testing.assert_allclose(positions, np.log10([float(label) for label in labels]), atol=1e-9)


@pytest.mark.parametrize("value, rounded", [(0.01, 0.01), (0.011, 0.02), (3, 5), (5.1, 10), (1e-20, 1e-20)])
def test_scales_are_round(value, rounded):
    assert curves.round_up(value) == pytest.approx(rounded, rel=1e-12)


def test_losses_in_units_of_a_changing_noise_are_not_drawn():
    rows = [
        {"iteration": i, "loss": 9 + i, "data": 8 + i, "sigma": 1 / (1 + i), "residual": 0.1 / (1 + i)}
        for i in range(3)
    ]
    svg = curves.curves_svg(rows)
    assert "residual 0.0333" in svg and "loss 1" not in svg and "data" not in svg
