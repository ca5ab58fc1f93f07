"""Curves of a run's history as inline SVG, without a plotting library."""

from __future__ import annotations

import html
import math
from typing import Any

from envedit.losses.optimizer import ramp
from envedit.report.manifest import columns

_PALETTE = ("#22223b", "#c8553d", "#2a7f9e", "#588157", "#b5838d", "#8d6a9f", "#d4a017", "#6c757d")
_TIMES = ("_s", "_ms", "time", "seconds")
_NOT_LOSSES = ("iteration", "step", "epoch", "lr", "damping", "sigma", "non_finite", "skipped")


def curves_svg(rows: list[dict], width: int = 860, height: int = 340) -> str:
    """Draw every loss column of a history on a logarithmic axis against the iteration, as an SVG element.

    Columns that are no losses (iteration, learning rates, times) are left out, and so is what a logarithm
    cannot show: a value that is missing, not finite, zero or negative interrupts its line. The axis ends
    twelve decades below the largest value. An empty string where there is nothing to draw.

    Losses that are in units of a ``sigma`` which changes from row to row cannot be compared: ``residual`` is
    drawn in their place.
    """
    series, names = {}, columns(rows)
    for name in ["residual"] if {"sigma", "residual"} <= set(names) else names:
        if name in _NOT_LOSSES or name.startswith(("lr_", "weight")) or name.endswith(_TIMES):
            continue
        points = []
        for i, row in enumerate(rows):
            x, y = number(row.get("iteration", i)), number(row.get(name))
            points.append((float(i) if x is None else x, math.log10(y) if y is not None and y > 0 else None))
        if any(y is not None for _, y in points):
            series[name] = _thin(points)
    if not series:
        return ""
    values = [y for points in series.values() for _, y in points if y is not None]
    low, high = max(min(values), max(values) - 12), max(values)
    margin = max(0.04 * (high - low), 0.01)
    low, high = low - margin, high + margin
    steps = [x for points in series.values() for x, _ in points]
    start, end = min(steps), max(steps)
    end = end if end > start else start + 1

    left, right, top, bottom = 64, width - 190, 12, height - 44

    def across(x):
        return left + (x - start) / (end - start) * (right - left)

    def down(y):
        return bottom - (max(y, low) - low) / (high - low) * (bottom - top)

    out = [f'<svg class="curves" viewBox="0 0 {width} {height}" role="img" aria-label="losses by iteration">']
    for y, label in _log_ticks(low, high):
        out.append(f'<line class="grid" x1="{left}" x2="{right}" y1="{down(y):.1f}" y2="{down(y):.1f}"/>')
        out.append(f'<text x="{left - 8}" y="{down(y) + 4:.1f}" text-anchor="end">{label}</text>')
    for x in _ticks(start, end, 8, least=1):
        out.append(f'<path class="axis" d="M{across(x):.1f} {bottom}v5"/>')
        out.append(f'<text x="{across(x):.1f}" y="{bottom + 19}" text-anchor="middle">{x:g}</text>')
    out.append(f'<path class="axis" d="M{left} {top}V{bottom}H{right}"/>')
    out.append(f'<text x="{(left + right) / 2:.0f}" y="{height - 6}" text-anchor="middle">iteration</text>')
    # The total is drawn last, on top of its terms, and named first.
    for i, (name, points) in reversed(list(enumerate(series.items()))):
        colour, pen, drawing = _PALETTE[i % len(_PALETTE)], [], False
        for x, y in points:
            if y is not None:  # h0 makes a lone point visible
                pen.append(f"{'L' if drawing else 'M'}{across(x):.1f} {down(y):.1f}{'' if drawing else 'h0'}")
            drawing = y is not None
        total = ' class="total"' if name in ("loss", "total", "residual") else ""
        out.append(f'<path{total} stroke="{colour}" d="{"".join(pen)}"/>')
        if i < 14:
            last = next((y for _, y in reversed(points) if y is not None), low)
            label = name if len(name) <= 14 else name[:13] + "…"
            level = top + 10 + 21 * i
            out.append(f'<rect x="{right + 16}" y="{level - 6}" width="16" height="3" fill="{colour}"/>')
            value = 10.0 ** min(last, 308.25)  # the logarithm of the largest float is rounded up
            out.append(f'<text x="{right + 38}" y="{level}">{escape(label)} {value:.3g}</text>')
    return "\n".join([*out, "</svg>"])


def normalised(rows: list[dict], ramps: dict, iterations: int) -> tuple[list[dict], str]:
    """Return a history whose losses have their last weights throughout, and a line that explains the curves.

    A weight that rises during a run lets the loss rise while the rendering improves: values of different
    iterations can be compared only under the same weights.

    Parameters
    ----------
    rows : list of dict
        A row an iteration: ``iteration``, ``loss``, and the weighted terms that it is the sum of.
    ramps : dict of str to (float, float)
        First and last weight of the terms.
    iterations : int
        That the weights take to change.
    """
    names = columns(rows)
    if {"sigma", "residual"} <= set(names):
        return rows, (
            "Residual: root mean square, over pixels and channels, of the difference between rendering and "
            "target in display values. The objective itself is in units of a noise level that is estimated "
            "anew in every iteration, so its values cannot be compared."
        )
    changing = {name: ends for name, ends in ramps.items() if name in names and ends[0] != ends[1]}
    about = "Losses, times their weights, and their sum." if "loss" in names else ""
    if not changing:
        return rows, about
    made = []
    for i, row in enumerate(rows):
        row, at = dict(row), number(row.get("iteration", i)) or 0.0
        for name, (start, end) in changing.items():
            if (value := number(row.get(name))) is not None:
                row[name] = value * end / ramp(start, end, at, iterations)
        terms = [number(row.get(name)) for name in ramps if name in names]
        if number(row.get("loss")) is not None and None not in terms:
            row["loss"] = sum(terms)
        made.append(row)
    which = ", ".join(f"{name} (from {start:g} to {end:g})" for name, (start, end) in changing.items())
    return made, f"{about} Weights change during the run: {which}. All are drawn with the last ones."


def number(value: Any) -> float | None:
    """Read a cell as a finite float, or None for whatever else it may hold."""
    if isinstance(value, (bool, str)) or value is None:
        return None
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return found if math.isfinite(found) else None


def _ticks(low, high, count, least=0.0):
    step = max(round_up((high - low) / count), least)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low, high):
    """List (log10 position, label) pairs: whole decades, or round numbers where there are not two of them."""
    first, last = math.ceil(low - 1e-9), math.floor(high + 1e-9)
    if last > first:
        decades = range(first, last + 1, -(-(last - first) // 8))
        return [(d, f"1e{d}" if abs(d) > 3 else f"{10.0**d:g}") for d in decades]
    decade = math.floor(low)  # taken out, so that 1e-320 and 1e300 are as good as 1
    plain = abs(decade) < 300
    return [
        (decade + math.log10(v), f"{v * 10.0**decade:.4g}" if plain else f"{v:.4g}e{decade}")
        for v in _ticks(10 ** (low - decade), 10 ** (high - decade), 5)
        if v > 0
    ]


def _thin(points, most=600):
    """Keep lowest and highest of every stretch so that a long run stays a small file and no spike is lost."""
    size = -(-len(points) // most)
    if size < 3:
        return points
    kept = []
    for start in range(0, len(points), size):
        chunk = [p for p in points[start : start + size] if p[1] is not None]
        ends = {min(chunk, key=lambda p: p[1]), max(chunk, key=lambda p: p[1])} if chunk else {points[start]}
        kept += sorted(ends, key=lambda p: p[0])
    return kept


def round_up(value: float) -> float:
    """Smallest of 1, 2, 5 times a power of ten that is not below ``value`` > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * (1 - 1e-9))


def escape(text: object) -> str:
    """Escape text for HTML and SVG, control characters included."""
    return html.escape("".join(c if c >= " " or c in "\n\t" else "\ufffd" for c in str(text)))
