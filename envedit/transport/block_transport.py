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
    """T between blocks and cells."""

    # (3, blocks, cells) float32, mean over the pixels of a block, for a radiance of 1 in all texels of a cell
    matrix: np.ndarray
    block_of: np.ndarray  # (h * w,), block of every pixel
    cell_of: np.ndarray  # (H * W,), cell of every texel
    directions: np.ndarray  # (cells, 3), unit vectors to the cells' centres
    omega: np.ndarray  # (cells,), solid angle of each cell, as a rendering receives it

    def to_blocks(self, picture: np.ndarray) -> np.ndarray:
        """Average a picture (h, w, c) over blocks: (blocks, c)."""
        return _means(picture.reshape(-1, picture.shape[2]), self.block_of, np.ones(len(self.block_of)))


def make(matrix: ColourMatrix, shape: tuple[int, int], grid: tuple[int, int], views: Views = ()) -> Overview:
    """Sum up the entries of a transport, pixels by texels.

    ``shape`` and ``grid`` are height and width of the picture and of the map, ``views`` the rows of each
    view, where the picture is of several: no block is of two.
    """
    block_of, blocks = _blocks(shape, views)
    cell_of, cells = tiles(*grid, max(1, -(-grid[1] // CELLS)))
    rows, columns, weights = matrix.coordinates()
    key = block_of[rows] * cells + cell_of[columns]
    count = np.bincount(block_of, minlength=blocks)
    dense = np.stack(
        [np.bincount(key, w, blocks * cells).reshape(blocks, cells) / count[:, None] for w in weights.T]
    )
    omega = np.repeat(latlong.lookup_solid_angles(*grid), grid[1])
    toward = _means(latlong.directions(*grid).reshape(-1, 3), cell_of, omega)
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30)
    size = np.bincount(cell_of, omega, cells)
    return Overview(dense.astype(np.float32), block_of, cell_of, toward, size)


def whole(
    arrays: dict[str, np.ndarray], shape: tuple[int, int], grid: tuple[int, int], views: Views = ()
) -> bool:
    """Return whether arrays from disk are an overview of such a picture and map: no index leaves it."""
    block_of, blocks = _blocks(shape, views)
    cell_of, cells = tiles(*grid, max(1, -(-grid[1] // CELLS)))
    expected = {
        "matrix": ("f4", (3, blocks, cells)),
        "block_of": ("i8", block_of.shape),
        "cell_of": ("i8", cell_of.shape),
        "directions": ("f8", (cells, 3)),
        "omega": ("f8", (cells,)),
    }
    same = holds(arrays, expected) and (arrays["block_of"] == block_of).all()
    return bool(same and (arrays["cell_of"] == cell_of).all())


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


def tiles(height: int, width: int, size: int) -> tuple[np.ndarray, int]:
    """Return the number of every pixel's square tile, flat, and the count of tiles."""
    across = -(-width // size)
    tile = (np.arange(height) // size)[:, None] * across + np.arange(width) // size
    return tile.ravel(), -(-height // size) * across


def _means(values, group, weight):
    total = np.bincount(group, weight)
    sums = [np.bincount(group, v * weight, len(total)) for v in values.T]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-30)[:, None]
