"""The light transport between blocks of pixels and cells of texels.

It is small enough to evaluate every place of a light.

Samples that are too few for a texel are many for a cell of some degrees: the overview shows, for a light
anywhere on the sphere, roughly what it does to the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.array_cache import holds
from envedit.core.types import Views
from envedit.transport.sparse_matrix import ColourMatrix

CELLS = 64
"""Cells around the horizon: 5.6 degrees each."""
BLOCKS = 32
"""Blocks along the longer side of a view."""


@dataclass(frozen=True)
class Overview:
    """T between blocks and cells; made by :meth:`of`."""

    # (3, blocks, cells) float32, mean over the pixels of a block, for a radiance of 1 in all texels of a cell
    matrix: np.ndarray
    block_of: np.ndarray  # (h * w,), block of every pixel
    cell_of: np.ndarray  # (H * W,), cell of every texel
    directions: np.ndarray  # (cells, 3), unit vectors to the cells' centres
    omega: np.ndarray  # (cells,), solid angle of each cell, as a rendering receives it

    @classmethod
    def of(
        cls, matrix: np.ndarray, shape: tuple[int, int], grid: tuple[int, int], views: Views = ()
    ) -> Overview:
        """Say of which pixels and texels a matrix of :func:`summed`, with the same arguments, is."""
        block_of, _ = _blocks(shape, views)
        cell_of, cells = _cells(grid)
        omega = np.repeat(latlong.lookup_solid_angles(*grid), grid[1])
        toward = _means(latlong.directions(*grid).reshape(-1, 3), cell_of, omega)
        toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30)
        return cls(matrix, block_of, cell_of, toward, np.bincount(cell_of, omega, cells))

    def to_blocks(self, picture: np.ndarray) -> np.ndarray:
        """Average a picture (h, w, c) over blocks: (blocks, c)."""
        return _means(picture.reshape(-1, picture.shape[2]), self.block_of, np.ones(len(self.block_of)))


def summed(
    matrix: ColourMatrix, shape: tuple[int, int], grid: tuple[int, int], views: Views = ()
) -> np.ndarray:
    """Sum up the entries of a transport, pixels by texels, to :attr:`Overview.matrix`.

    ``shape`` and ``grid`` are height and width of the picture and of the map, ``views`` the rows of each
    view, where the picture is of several: no block is of two.
    """
    block_of, blocks = _blocks(shape, views)
    cell_of, cells = _cells(grid)
    rows, columns, weights = matrix.coordinates()
    key = block_of[rows] * cells + cell_of[columns]
    count = np.bincount(block_of, minlength=blocks)
    dense = np.stack(
        [np.bincount(key, w, blocks * cells).reshape(blocks, cells) / count[:, None] for w in weights.T]
    )
    return dense.astype(np.float32)


def whole(
    arrays: dict[str, np.ndarray], shape: tuple[int, int], grid: tuple[int, int], views: Views = ()
) -> bool:
    """Return whether arrays from disk are the matrix of such a picture and map."""
    return holds(arrays, {"matrix": ("f4", (3, _blocks(shape, views)[1], _cells(grid)[1]))})


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


def _cells(grid):
    """Return the cell of every texel, and their number."""
    height, width = grid
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
