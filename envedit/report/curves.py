"""Curves of a run's history as inline SVG, without a plotting library."""

from __future__ import annotations

import html
import math
from typing import Any

import numpy as np

from envedit.losses.optimizer import ramp
from envedit.report.plain_files import columns

PALETTE = ("#22223b", "#c8553d", "#2a7f9e", "#588157", "#b5838d", "#8d6a9f", "#d4a017", "#6c757d")
DECADES = 12
"""Of the axis, at most, below the largest value."""
LABEL_CHARACTERS = 16
"""Characters of a name beside its curve, at most."""
WIDTH, HEIGHT = 860, 340
"""Of the drawing, in its own units."""
_NOT_LOSSES = ("iteration", "lr", "step_ms")


def curves_svg(rows: list[dict]) -> str:
    """Draw every loss column of a history on a logarithmic axis against the iteration, as an SVG element.

    Values that are missing, not finite, zero or negative are left out. An empty string where there is nothing
    to draw. Losses that are in units of a ``sigma`` which changes from row to row cannot be compared:
    ``residual`` is drawn in their place.
    """
    series = _series(rows)
    if not series:
        return ""

    # ---- Axes: iterations across, decimal logarithms up
    steps = [x for points in series.values() for x, _ in points]
    values = [y for points in series.values() for _, y in points]
    start = min(steps)
    end = max(steps)
    high = max(values)
    low = max(min(values), high - DECADES)
    margin = max(0.04 * (high - low), 0.01)
    left, right, top, bottom = 64, WIDTH - 190, 12, HEIGHT - 28

    def across(x):
        return left + (x - start) / max(end - start, 1) * (right - left)

    def down(y):
        return bottom - (max(y, low) - low + margin) / (high - low + 2 * margin) * (bottom - top)

    decades = range(math.ceil(low + 2 * margin), math.floor(high - 2 * margin) + 1)
    drawn = [
        f'<svg class="curves" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="losses by iteration">'
    ]
    for y in sorted({low, *decades, high}):
        drawn.append(f'<path class="grid" d="M{left} {down(y):.1f}H{right}"/>')
        drawn.append(f'<text x="{left - 8}" y="{down(y) + 4:.1f}" text-anchor="end">{_value(y)}</text>')
    drawn.append(f'<path class="grid" d="M{left} {top}V{bottom}H{right}"/>')
    for x in sorted({start, end}):
        drawn.append(f'<text x="{across(x):.1f}" y="{bottom + 19}" text-anchor="middle">{x:g}</text>')
    drawn.append(f'<text x="{(left + right) / 2:.0f}" y="{bottom + 19}">iteration</text>')

    # ---- Curves, and beside them their names and last values; the total, named first, lies on top
    for i, (name, points) in reversed(list(enumerate(series.items()))):
        colour = PALETTE[i % len(PALETTE)]
        line = " ".join(f"{across(x):.1f},{down(y):.1f}" for x, y in points)
        total = ' class="total"' if name in ("loss", "residual") else ""
        drawn.append(f'<polyline{total} stroke="{colour}" points="{line}"/>')
        label = f"{escape(name[:LABEL_CHARACTERS])} {_value(points[-1][1])}"
        drawn.append(f'<text x="{right + 16}" y="{top + 10 + 21 * i}" fill="{colour}">{label}</text>')
    return "\n".join([*drawn, "</svg>"])


def _series(rows):
    """Return the (iteration, decimal logarithm) of each positive value of each loss, by its name."""
    names = [name for name in columns(rows) if name not in _NOT_LOSSES]
    if {"sigma", "residual"} <= set(names):
        names = ["residual"]
    series = {}
    for name in names:
        values = [(row["iteration"], number(row.get(name))) for row in rows]
        points = [(step, math.log10(value)) for step, value in values if value and value > 0]
        if points:
            series[name] = points
    return series


def _value(logarithm):
    """Print 10 to a power; the logarithm of the largest float is rounded up, which would overflow."""
    return f"{10.0 ** min(logarithm, 308.25):.3g}"


def normalised(rows: list[dict], ramps: dict, iterations: int) -> tuple[list[dict], str]:
    """Return a history whose losses have their last weights throughout, and a line that explains the curves.

    A weight that rises during a run lets the loss rise while the rendering improves: values of different
    iterations can be compared only under the same weights.

    Each row has ``iteration``, ``loss``, and the weighted terms that it is the sum of; ``ramps`` has the
    first and last weight of each, which change over so many ``iterations``.
    """
    names = columns(rows)
    if {"sigma", "residual"} <= set(names):
        return rows, (
            "Residual: root mean square, over pixels and channels, of the difference between rendering and "
            "target in display values. The objective itself is in units of a noise level that is estimated "
            "anew in every iteration, so its values cannot be compared."
        )
    about = "Losses, times their weights, and their sum." if "loss" in names else ""
    changing = {name: ends for name, ends in ramps.items() if name in names and ends[0] != ends[1]}
    if not changing:
        return rows, about

    scaled = []
    for row in rows:
        terms = {name: row[name] for name in ramps if name in names}
        for name, (start, end) in changing.items():
            terms[name] *= end / ramp(start, end, row["iteration"], iterations)
        scaled.append(row | terms | {"loss": sum(terms.values())})
    which = ", ".join(f"{name} (from {start:g} to {end:g})" for name, (start, end) in changing.items())
    return scaled, f"{about} Weights change during the run: {which}. All are drawn with the last ones."


def number(value: Any) -> float | None:
    """Return a finite number as float; None for whatever else a cell may hold."""
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(value) else None


def escape(text: object) -> str:
    """Escape text for HTML and SVG."""
    return html.escape(str(text))
