"""The smooth gain of the sky: a field of log factors that starts at zero.

A sum of bilinear grids over the active rows, periodic in azimuth, each twice as fine as the one before and
half as strong per step of its nodes: what a coarse grid can say is said by it. The finest has a stated number
of cycles around the horizon; detail of the sky is scaled, never made.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

MOST = 12.0
"""Largest log factor: e^12 is more than any sky needs, and leaves float32 room."""
LEVELS = 3


class GridGain:
    """Log gain per channel on bilinear grids.

    Parameters
    ----------
    cycles : int
        Cycles around the horizon that the finest grid can hold: it has twice as many columns.
    share : float
        Rows of the image over rows of its map: the grids are as fine in elevation as in azimuth.
    """

    def __init__(self, cycles: int, share: float):
        self.sizes = []
        for level in range(LEVELS):
            columns = max(2, 2 * round(cycles / 2 ** (LEVELS - 1 - level)))
            self.sizes.append((max(2, round(columns / 2 * share) + 1), columns))

    def init(self) -> dict:
        """Return its parameters: all zero."""
        return {f"gain.{i}": np.zeros((*size, 3), np.float32) for i, size in enumerate(self.sizes)}

    def scales(self) -> dict:
        """Return what a unit of each parameter is."""
        return {f"gain.{i}": 0.5**i for i in range(LEVELS)}

    def hats(self, level: int, shape) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (node, weight) of every texel of an image (rows, W) in one of the grids, four of them."""
        (rows, columns), (height, width) = self.sizes[level], shape
        y = (np.arange(height) + 0.5) / height * (rows - 1)
        x = (np.arange(width) + 0.5) / width * columns
        top = np.minimum(y.astype(int), rows - 2)
        left = x.astype(int) % columns
        fy, fx = (y - top)[:, None], (x - np.floor(x))[None]
        taps = []
        for a in (0, 1):
            for b in (0, 1):
                node = np.add.outer((top + a) * columns, (left + b) % columns)
                weight = (fy if a else 1 - fy) * (fx if b else 1 - fx)
                taps.append((node.ravel(), weight.ravel()))
        return taps

    def prepare(self, shape, rows=None) -> list:
        """Bring nodes and weights of the texels of an image (rows, W) to the device; ``rows`` is not used."""
        return [
            [
                (dr.opaque(mi.UInt32(i.astype(np.uint32))), dr.opaque(mi.Float(w.astype(np.float32))))
                for i, w in self.hats(level, shape)
            ]
            for level in range(LEVELS)
        ]

    def evaluate(self, params: dict, prepared) -> mi.Color3f:
        """Return the log gain at every texel."""
        g = mi.Color3f(0)
        for level, taps in enumerate(prepared):
            values = params[f"gain.{level}"].array
            for index, weight in taps:
                g += dr.gather(mi.Color3f, values, index) * weight
        return dr.clip(g, -MOST, MOST)
