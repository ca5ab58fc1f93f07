"""The light transport between blocks of pixels and cells of texels.

It is small enough to evaluate every place of a light.

Samples that are too few for a texel are many for a cell of some degrees: the overview shows, for a light
anywhere on the sphere, roughly what it does to the picture.
"""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.core.types import Views
from envedit.transport.sparse_matrix import ColourMatrix

CELLS = 64
"""Cells around the horizon: 5.6 degrees each."""
BLOCKS = 32
"""Blocks along the longer side of a view."""


class Overview:
    """T between blocks of a picture and cells of a map.

    ``shape`` and ``grid`` are height and width of the picture and of the map, ``views`` the rows of each
    view, where the picture is of several: no block is of two.

    Attributes
    ----------
    block_of, cell_of : ndarray (h * w,), (H * W,)
        Block of every pixel, and cell of every texel.
    blocks, cells : int
        How many there are.
    directions, omega : ndarray (cells, 3), (cells,)
        Unit vectors to the cells' centres, and the solid angle of each cell, as a rendering receives it.
    matrix : ndarray (3, blocks, cells)
        Mean over the pixels of a block, for a radiance of 1 in all texels of a cell: what :meth:`summed`
        returns.
    """

    matrix: np.ndarray

    def __init__(self, shape: tuple[int, int], grid: tuple[int, int], views: Views = ()):
        self.block_of, self.blocks = _blocks(shape, views)
        height, width = grid
        self.cell_of, self.cells = sky_cells(height, width)
        omega = np.repeat(latlong.lookup_solid_angles(height, width), width)
        toward = _means(latlong.directions(height, width).reshape(-1, 3), self.cell_of, omega)
        self.directions = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30)
        self.omega = np.bincount(self.cell_of, omega, self.cells)

    def summed(self, transport: ColourMatrix) -> np.ndarray:
        """Sum up the entries of a transport, pixels by texels, to a :attr:`matrix`, float32."""
        rows, columns, weights = transport.coordinates()
        key = self.block_of[rows] * self.cells + self.cell_of[columns]
        count = np.bincount(self.block_of, minlength=self.blocks)[:, None]
        sums = [np.bincount(key, w, self.blocks * self.cells) for w in weights.T]
        return np.stack([one.reshape(self.blocks, self.cells) / count for one in sums]).astype(np.float32)

    def to_blocks(self, picture: np.ndarray) -> np.ndarray:
        """Average a picture (h, w, c) over blocks: (blocks, c)."""
        return _means(picture.reshape(-1, picture.shape[2]), self.block_of, np.ones(len(self.block_of)))


def _blocks(shape, views):
    """Return the block of every pixel, and their number; the longest side of a view has BLOCKS of them."""
    heights = [rows.stop - rows.start for rows in views] or [shape[0]]
    size = max(1, -(-max(*heights, shape[1]) // BLOCKS))
    parts = []
    count = 0
    for height in heights:
        block_of, blocks = tiles(height, shape[1], size)
        parts.append(block_of + count)
        count += blocks
    return np.concatenate(parts), count


def sky_cells(height: int, width: int) -> tuple[np.ndarray, int]:
    """Return the cell of every texel of a map, flat, and the count of cells."""
    return tiles(height, width, max(1, -(-width // CELLS)))


def tiles(height: int, width: int, size: int) -> tuple[np.ndarray, int]:
    """Return the number of every pixel's square tile, flat, and the count of tiles."""
    across = -(-width // size)
    tile = (np.arange(height) // size)[:, None] * across + np.arange(width) // size
    return tile.ravel(), -(-height // size) * across


def _means(values, group, weight):
    total = np.bincount(group, weight)
    sums = [np.bincount(group, v * weight, len(total)) for v in values.T]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-30)[:, None]
