"""The drawing of a history: parsed as XML and read back in page coordinates."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from envedit.report import curves


def points_of(svg, name):
    """Points of a curve, found by the colour of its name."""
    elements = list(ElementTree.fromstring(svg))
    texts = [element for element in elements if element.tag == "text"]
    colour = next(text.get("fill") for text in texts if text.text.rsplit(" ", 1)[0] == name)
    line = next(e.get("points") for e in elements if e.get("stroke") == colour)
    return [tuple(map(float, point.split(","))) for point in line.split()]


def test_curve_is_straight_for_a_geometric_series_and_leaves_out_what_is_no_value():
    rows = [{"iteration": 10 * i, "loss": 0.5**i, "ssim": 0.25 * 0.5**i, "lr": 1e-4} for i in range(9)]
    points = points_of(curves.curves_svg(rows), "loss")
    steps = np.diff(points, axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps.mean(axis=0), steps.shape), atol=0.11)
    assert (steps > 0).all(), "to the right, and down the page"
    lower = points_of(curves.curves_svg(rows), "ssim")
    assert lower[0][1] == pytest.approx(points[2][1], abs=0.11), "0.25 stands where 0.5^2 does"
    assert "lr" not in curves.curves_svg(rows)
    values = [1.0, 0.5, np.nan, 0.25, None, 0.0, -1.0, 0.2, np.inf, "text", 0.1]
    svg = curves.curves_svg([{"iteration": i, "loss": v} for i, v in enumerate(values)])
    assert len(points_of(svg, "loss")) == 5


@pytest.mark.parametrize("row", [{}, {"loss": None}, {"loss": np.nan}, {"loss": 0.0}, {"lr": 1.0}])
def test_nothing_to_draw_is_an_empty_string(row):
    assert curves.curves_svg([{"iteration": 0} | row]) == "" == curves.curves_svg([])


@pytest.mark.parametrize("values, labels", [
    ([1.0, 0.1, 0.002], ["0.002", "0.01", "0.1", "1"]),
    ([0.41, 0.39], ["0.39", "0.41"]),
    ([3e-5], ["3e-05"]),
    ([1e300, 1e-300], ["1e+288", *(f"1e+{d}" for d in range(289, 301))]),
])  # fmt: skip
def test_axis_has_its_ends_and_the_powers_of_ten_between(values, labels):
    svg = curves.curves_svg([{"iteration": i, "loss": value} for i, value in enumerate(values)])
    texts = [e for e in ElementTree.fromstring(svg) if e.get("text-anchor") == "end"]
    assert [text.text for text in texts] == labels
    heights = [float(text.get("y")) for text in texts]
    steps = np.diff(np.log10([float(label) for label in labels])) / np.diff(heights)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[:1], steps.shape), rtol=0.02)


def test_losses_in_units_of_a_changing_noise_are_not_drawn():
    rows = [{"iteration": i, "loss": 9 + i, "data": 8 + i, "sigma": 1 / (1 + i)} for i in range(3)]
    svg = curves.curves_svg([row | {"residual": 0.1 * row["sigma"]} for row in rows])
    assert "residual 0.0333" in svg and "loss 1" not in svg and "data" not in svg
