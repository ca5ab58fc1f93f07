"""Regions of a map, on the sphere: ``[[input.regions]]``.

A region has a weight in every texel: 1 inside, and with d the angle outwards from its border

    w = 3 t^2 - 2 t^3,    t = clip(1 - d / max(softness, texel), 0, 1),

so that a region that is smaller than a texel still is in the nearest one.

A brush covers all directions within a radius of its middle line, of arcs of great circles. A polygon is that
of the lat-long image: on a border that is crossed, d is the distance in the tangent plane of the texel. The
texels of a map at any resolution have the weights of their own directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from envedit.core import latlong
from envedit.core.errors import ConfigError
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.resampling import smooth_step
from envedit.core.rows import bands
from envedit.images import inpainting

ROWS = 128
"""Rows of a map that are worked on at a time: some 50 MB of a map 8192 texels wide."""
KEPT_SHARE = 0.5
"""How far a texel is kept from which on it counts as one that stays, where it cannot count in part."""
Region = dict[str, Any]


def changed(envmap: np.ndarray, regions: Sequence[Region]) -> np.ndarray:
    """Return a map (H, W, 3), linear radiance, in which regions are scaled and filled, in their order.

    Radiance becomes 1 + w (factor - 1) times itself, or (1 - w) times itself and w times what is filled in
    (:func:`.inpainting.filled`). ConfigError if a region that is to be filled covers the whole map,
    InputError if a texel becomes brighter than :data:`.radiance.BRIGHTEST`, MachineError if one is to be
    filled and OpenCV is not installed.
    """
    height, width, _ = envmap.shape
    for i, region in enumerate(regions):
        if region["action"] == "keep":
            continue
        weight = _weight(region, height, width)
        if region["action"] == "fill":
            try:
                envmap = inpainting.filled(envmap, weight)
            except inpainting.NothingAroundError:
                raise ConfigError(
                    f"input.regions[{i}]: covers the whole map, which leaves nothing to fill it from: "
                    "make it smaller"
                ) from None
            continue
        envmap = envmap.copy()
        for row in np.flatnonzero(weight.any(axis=1)):
            with np.errstate(over="ignore"):
                envmap[row] *= 1 + weight[row][:, None] * np.float32(np.array(region["factor"]) - 1)
        require_radiance(envmap, f"input.regions[{i}]", brightest=BRIGHTEST)
    return envmap


def kept(regions: Sequence[Region], height: int, width: int) -> np.ndarray | None:
    """Return how far every texel is kept, (H, W) float32 in [0, 1]; None where no region keeps any."""
    keeping = [region for region in regions if region["action"] == "keep"]
    if not keeping:
        return None
    free = np.ones((height, width), np.float32)
    for region in keeping:
        free *= 1 - _weight(region, height, width)
    return 1 - free


def blended(edited: np.ndarray, original: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Return keep * original + (1 - keep) * edited, maps (H, W, 3); the bits of one where keep is 0 or 1."""
    mixed = edited.copy()
    for row in np.flatnonzero(keep.any(axis=1)):
        share = keep[row][:, None]
        mixed[row] = share * original[row] + (1 - share) * edited[row]
    return mixed


def _weight(region: Region, height: int, width: int) -> np.ndarray:
    """Return the weight of a region in every texel, (H, W) float32."""
    weight = np.empty((height, width), np.float32)
    texel = np.degrees(max(np.pi / (height - 1), 2 * np.pi / width))
    fade = max(region["softness"], texel)
    for band in bands(height, ROWS):
        if "points" in region:
            inwards = _within_brush(region["points"], region["radius"], fade, (height, width), band)
        else:
            inwards = _within_polygon(region["polygon"], (height, width), band)
        weight[band] = smooth_step(1 + inwards / fade)
    return weight


# ---- Shapes ------------------------------------------------------------------------------------------------


def _within_brush(points, radius, fade, shape, band):
    """Return the degrees inwards from the border of a brush in a band of rows, (n, W); -inf far outside."""
    height, width = shape
    inwards = np.full((band.stop - band.start, width), -np.inf)
    azimuth, elevation = np.radians(points).T
    ends = latlong.on_sphere(np.pi / 2 - elevation, azimuth)
    polar = np.pi * np.arange(band.start, band.stop) / (height - 1)
    for a, b in zip(ends[: max(len(ends) - 1, 1)], ends[1:] if len(ends) > 1 else ends, strict=True):
        # ---- Texels in a cap around the arc
        middle = a + b if np.linalg.norm(a + b) > 1e-6 else a
        middle = middle / np.linalg.norm(middle)
        reach = min(np.pi, _angle(a, middle) + np.radians(radius + fade))
        rows = np.flatnonzero(np.abs(polar - _angle(np.array([0, 1.0, 0]), middle)) <= reach)
        columns = np.arange(width)
        across = np.hypot(middle[0], middle[2])
        if reach < np.pi / 2 and np.sin(reach) < across:
            half = int(np.ceil(np.arcsin(np.sin(reach) / across) / (2 * np.pi) * width)) + 1
            _, at = latlong.texel_position(middle, height, width)
            columns = np.unique((round(float(at)) + np.arange(-half, half + 1)) % width)
        if not len(rows):
            continue
        # ---- Their angle from the arc
        phi = 2 * np.pi * (columns + 0.5) / width
        toward = latlong.on_sphere(polar[rows][:, None], phi)
        away = np.minimum(_angle(toward, a), _angle(toward, b))
        normal = np.cross(a, b)
        if np.linalg.norm(normal) > 1e-9:
            normal = normal / np.linalg.norm(normal)
            beside = (toward @ np.cross(normal, a) >= 0) & (toward @ np.cross(b, normal) >= 0)
            away = np.where(beside, np.arcsin(np.minimum(np.abs(toward @ normal), 1)), away)
        part = np.ix_(rows, columns)
        inwards[part] = np.maximum(inwards[part], radius - np.degrees(away))
    return inwards


def _within_polygon(corners, shape, band):
    """Return the degrees inwards from the border of a polygon in a band of rows, (n, W)."""
    height, width = shape
    elevation = 90 - 180 * np.arange(band.start, band.stop) / (height - 1)
    elevation = np.clip(elevation, -90 + 1e-9, 90 - 1e-9)[:, None]  # the poles belong to what reaches them
    azimuth = 360 * (np.arange(width) + 0.5) / width
    squeeze = np.cos(np.radians(elevation))
    edges = list(zip(corners, [*corners[1:], corners[0]], strict=True))
    inwards = np.full((len(elevation), width), -np.inf)
    first, last = (pick(corner[0] for corner in corners) for pick in (min, max))
    for turn in (-720, -360, 0, 360):
        if last < turn - 180 or first > turn + 540:
            continue
        x = azimuth[None] + turn
        inside = np.zeros(inwards.shape, bool)
        away = np.full(inwards.shape, np.inf)
        for (x0, y0), (x1, y1) in edges:
            # ---- Even-odd rule along the row
            crosses = (y0 > elevation) != (y1 > elevation)
            at = x0 + (elevation - y0) * ((x1 - x0) / (y1 - y0 if y1 != y0 else 1.0))
            inside ^= crosses & (x < at)
            if _no_border((x0, y0), (x1, y1), edges):
                continue
            # ---- Distance from the edge, in the tangent plane
            dx, dy = (x1 - x0) * squeeze, y1 - y0
            px, py = (x - x0) * squeeze, elevation - y0
            along = np.clip((px * dx + py * dy) / np.maximum(dx**2 + dy**2, 1e-12), 0, 1)
            away = np.minimum(away, np.hypot(px - along * dx, py - along * dy))
        inwards = np.maximum(inwards, np.where(inside, away, -away))
    return inwards


def _no_border(a, b, edges):
    """Whether an edge lies in a pole, or is where a polygon that goes around meets itself."""
    if abs(a[1]) == abs(b[1]) == 90:
        return True
    return any(
        c[1] == b[1] and d[1] == a[1] and abs(c[0] - b[0]) == abs(d[0] - a[0]) == 360 for c, d in edges
    )


def _angle(a, b):
    """Return the angle in radians between unit vectors (..., 3)."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=-1) / 2, 1))
