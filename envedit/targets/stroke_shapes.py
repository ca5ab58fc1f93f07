"""Where a stroke is: the coverage of each pixel by a shape, from its signed distance.

A brush along points is round at ends and joints, a polygon filled by the even-odd rule, and an ellipse turned
from x towards y, which points down. In fractions x and rx are shares of the picture's width, y and ry of its
height, and width and softness of its width; in pixels the first one's centre is at 0.5, 0.5.
"""

from __future__ import annotations

import math

import numpy as np

from envedit.core.resampling import smooth_step

_SUBSAMPLES = 8  # along a side of a pixel that an edge crosses
_LEAST = 1e-6  # less coverage is none


def coverage(stroke: dict, height: int, width: int) -> np.ndarray:
    """Return how much of each pixel a stroke covers, ``(height, width, 1)`` float64 in [0, 1].

    With d the signed distance to the shape's edge, negative inside, and s its softness, coverage is the
    smooth step u^2 (3 - 2u) of u = clip(1/2 - d / s, 0, 1): the same share of the picture at any resolution.
    Pixels at an edge narrower than eight pixels are the mean over 8 x 8 places. The stroke has every key, as
    :mod:`envedit.config.list_schema` completes it.
    """
    covered = np.zeros((height, width))
    across, down = (width, height) if stroke["units"] == "fraction" else (1, 1)
    shape = _shape(stroke, np.array([across, down], np.float64), across)
    if shape is None:
        return covered[..., None] + 1
    distance, low, high = shape
    soft = stroke["softness"] * across
    margin = soft / 2 + 1
    x0, y0 = (int(v) for v in np.clip(np.floor(low - margin), 0, (width, height)))
    x1, y1 = (int(v) for v in np.clip(np.ceil(high + margin), 0, (width, height)))
    if x0 >= x1 or y0 >= y1:
        return covered[..., None]
    y, x = np.mgrid[y0:y1, x0:x1] + 0.5
    centres = np.stack([x.ravel(), y.ravel()], axis=-1)
    d = distance(centres)
    nearby = smooth_step(0.5 - d / max(soft, 1.0))
    if soft < 8:
        crossed = np.flatnonzero(np.abs(d) < soft / 2 + 0.75)  # a pixel reaches 0.71 from its centre
        offsets = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES - 0.5
        places = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(1, -1, 2)
        for start in range(0, len(crossed), 1 << 14):
            part = crossed[start : start + (1 << 14)]
            d = distance((centres[part, None] + places).reshape(-1, 2)).reshape(len(part), -1)
            nearby[part] = smooth_step(0.5 - d / max(soft, 1 / _SUBSAMPLES)).mean(axis=1)
    nearby[nearby < _LEAST] = 0
    covered[y0:y1, x0:x1] = nearby.reshape(y1 - y0, x1 - x0)
    return covered[..., None]


def _shape(stroke, scale, across):
    """Return a shape's signed distance, points (N, 2) -> (N,), and the corners of its box, all in pixels."""
    if "points" in stroke:
        points, half = np.array(stroke["points"]) * scale, stroke["width"] * across / 2
        ends = np.concatenate([points[1:], points[-1:]])  # a single point is a dot
        return (
            lambda p: _to_segments(p, points, ends) - half,
            points.min(axis=0) - half,
            points.max(axis=0) + half,
        )
    if "polygon" in stroke:
        corners = np.array(stroke["polygon"]) * scale
        return lambda p: _to_polygon(p, corners), corners.min(axis=0), corners.max(axis=0)
    if "rectangle" in stroke:
        low, high = np.array(stroke["rectangle"]).reshape(2, 2) * scale
        return lambda p: _to_rectangle(p, (low + high) / 2, (high - low) / 2), low, high
    if "ellipse" in stroke:
        centre, radii = np.array(stroke["ellipse"][:4]).reshape(2, 2) * scale
        turn = math.radians(stroke["ellipse"][4]) if len(stroke["ellipse"]) == 5 else 0.0
        axes = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        reach = np.sqrt(((axes * radii[:, None]) ** 2).sum(axis=0))
        return lambda p: _to_ellipse((p - centre) @ axes.T, radii), centre - reach, centre + reach
    return None


def _to_segments(p, starts, ends):
    """Distance from points (N, 2) to the nearest of some segments."""
    nearest = np.full(len(p), np.inf)
    for a, b in zip(starts, ends, strict=True):
        along, from_a = b - a, p - a
        length = along @ along
        share = np.clip(from_a @ along / length, 0, 1) if length else np.zeros(len(p))
        nearest = np.minimum(nearest, ((from_a - share[:, None] * along) ** 2).sum(axis=1))
    return np.sqrt(nearest)


def _to_polygon(p, corners):
    """Signed distance to a polygon; a point is inside if a ray from it crosses an odd number of edges."""
    nexts = np.roll(corners, -1, axis=0)
    inside = np.zeros(len(p), bool)
    for (ax, ay), (bx, by) in zip(corners, nexts, strict=True):
        if ay != by:
            between = (ay > p[:, 1]) != (by > p[:, 1])
            inside ^= between & (p[:, 0] < ax + (bx - ax) * (p[:, 1] - ay) / (by - ay))
    return np.where(inside, -1, 1) * _to_segments(p, corners, nexts)


def _to_rectangle(p, centre, half):
    q = np.abs(p - centre) - half
    return np.hypot(*np.maximum(q, 0).T) + np.minimum(q.max(axis=1), 0)


def _to_ellipse(p, radii):
    """Signed distance to an ellipse around the origin.

    With a the larger radius and b the other, the nearest point is (a^2 x / (u + a^2 - b^2), b^2 y / u), u the
    largest root of (a x / (u + a^2 - b^2))^2 + (b y / u)^2 = 1, found by bisection (Eberly, "Distance from a
    Point to an Ellipse").
    """
    major, minor = (0, 1) if radii[0] >= radii[1] else (1, 0)
    a, b = radii[major], radii[minor]
    x = np.abs(p[:, major])
    y = np.maximum(np.abs(p[:, minor]), 1e-6 * b)  # off the axis, where the root would be a limit
    low, high = b * y, np.hypot(a * x, b * y)
    for _ in range(50):
        u = (low + high) / 2
        beyond = (a * x / (u + (a * a - b * b))) ** 2 + (b * y / u) ** 2 > 1
        low, high = np.where(beyond, u, low), np.where(beyond, high, u)
    u = (low + high) / 2
    to = np.hypot(x - a * a * x / (u + (a * a - b * b)), y - b * b * y / u)
    return np.where((x / a) ** 2 + (y / b) ** 2 < 1, -to, to)
