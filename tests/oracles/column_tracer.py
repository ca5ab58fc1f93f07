"""Columns of the light transport, traced one after the other from all paths at once: slow and plain."""

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.scene import camera_paths
from envedit.transport.recording import bsdf_weight, connect

OFFSET = 7919  # between the seeds of a column's rays and of its paths


def columns(scene, grid, texels, count, bounces, seed):
    """Trace columns of T: (n, pixels, 3) float64, and how many contributions were not finite.

    Every path vertex sends one ray into the tent of the texel; a path that leaves the scene counts for the
    four texels around its direction. Both are weighed by the balance heuristic, one ray a texel against the
    BSDF. Values are those of the same float32 functions, but summed in float64 on the host.
    """
    pixels = scene.width * scene.height
    total, lost = np.zeros((len(texels), pixels * count, 3)), 0
    lane = dr.arange(mi.UInt32, pixels * count)
    path, pixel = lane % count, lane // count
    areas = np.diff(latlong.row_edges(grid.height)) / grid.width
    uniform = grid.width * (grid.height - 1)
    every = np.arange(pixels, dtype=np.uint32)
    for event in camera_paths.trace(scene.mi, every, count, bounces, seed + OFFSET):
        if isinstance(event, camera_paths.Escape):
            taps, _, jacobian = grid.locate(event.direction)
            value = event.throughput * (bsdf_weight(event.pdf, uniform / jacobian) / count)
            value, active = np.float64(value).T, np.array(event.active)
            parts = []
            for texel in texels:
                share = sum(np.array(s, np.float64) * (np.array(t) == texel) for t, s in taps)
                parts.append(np.where((active & (share > 0))[:, None], value * share[:, None], 0))
        else:
            parts = []
            for texel in texels:
                row, column = divmod(int(texel), grid.width)
                key = mi.UInt32((int(texel) + seed * 31 + event.bounce) & 0xFFFFFFFF)
                u = camera_paths.lattice(path, mi.sample_tea_32(pixel, key)[0])
                direction, jacobian = grid.direction(mi.UInt32(row), mi.UInt32(column), u)
                value = connect(scene.mi, event, direction, jacobian, uniform / jacobian)
                parts.append(np.float64(value * (float(areas[row]) * jacobian / count)).T)
        for one, part in zip(total, parts, strict=True):
            finite = np.isfinite(part).all(axis=1)
            lost += int((~finite).sum())
            one += np.where(finite[:, None], part, 0)
    return total.reshape(len(texels), pixels, count, 3).sum(axis=2), lost
