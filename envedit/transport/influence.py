"""Which texels of a map a view can determine: those that it sees with enough influence.

The influence of a texel is T' 1: what a unit of radiance in it adds to the picture. It is known from
samples, and a texel with little of it may have met none: whether a texel is determined is therefore asked of
its neighbourhood.
"""

from __future__ import annotations

import math

import numpy as np

from envedit.core import latlong

WANTED_SAMPLES = 5
"""Samples that a neighbourhood at the threshold should meet: it meets none once in 150 times."""
LEAST_RADIUS = 2
"""Rows to either side that always belong to a texel's neighbourhood."""


def per_solid_angle(influence: np.ndarray) -> np.ndarray:
    """Return influence per steradian, (H, W) float64: the texels of a pole are small, not unseen."""
    height, width = influence.shape
    return influence.astype(np.float64) / latlong.solid_angles(height, width)[:, None]


def determined(influence: np.ndarray, samples: np.ndarray, rows: slice, threshold: float) -> np.ndarray:
    """Say which texels a view determines: bool (H, W).

    A texel is determined if it or a neighbour has more than ``threshold`` of the mean influence (H, W), T' 1,
    per solid angle of the active ``rows``; with 0 all are. The neighbourhood is so wide that, by the
    ``samples`` (H,) that a texel of each row has received, :data:`WANTED_SAMPLES` of them would have met it:
    noise may keep a texel that hardly matters, but does not take one that does.
    """
    height, width = influence.shape
    if threshold <= 0:
        return np.ones((height, width), bool)
    sphere, density = latlong.solid_angles(height, width), per_solid_angle(influence)
    mean = influence[rows].sum(dtype=np.float64) / (sphere[rows].sum() * width)
    is_determined = np.empty((height, width), bool)
    for row in range(height):
        # At the threshold, threshold * samples / sphere samples fall on a steradian: on this many steradians,
        # WANTED_SAMPLES.
        area = WANTED_SAMPLES / max(threshold * samples[row] / sphere[row], 1e-30)
        across_rows = math.sqrt(area) * (height - 1) / math.pi
        radius = min(max(math.ceil((across_rows - 1) / 2), LEAST_RADIUS), height)
        band = density[max(row - radius, 0) : row + radius + 1].max(axis=0)
        sine = math.sin(math.pi * row / max(height - 1, 1))
        across = math.ceil(radius / max(sine, 1e-6))  # as far in angle as up and down
        is_determined[row] = _largest_around(band, across) > threshold * mean
    return is_determined


def _largest_around(values, radius):
    """Return the maximum over ``radius`` places to either side, periodically."""
    if 2 * radius + 1 >= len(values):
        return np.full_like(values, values.max())
    wide = np.concatenate([values[-radius:], values, values[:radius]])
    return np.lib.stride_tricks.sliding_window_view(wide, 2 * radius + 1).max(axis=1)
