"""The derivative of a picture by the gain of the sky, in blocks of pixels and cells of texels."""

from __future__ import annotations

import drjit as dr
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE
from envedit.representations.layers.layers import Layers
from envedit.transport.light_transport import LightTransport


class BlockJacobian:
    """The block transport with the gain's hats in its cells."""

    def __init__(self, layers: Layers, transport: LightTransport, shape: tuple[int, int]):
        overview = transport.overview()
        self.block_of, self.count = overview.block_of, len(overview.matrix[0])
        active = slice(layers.active.start * shape[1], layers.active.stop * shape[1])
        self._shape = layers.whole
        cells, omega = len(overview.omega), np.repeat(latlong.lookup_solid_angles(*shape), shape[1])
        self._directions = overview.directions
        self._total = np.bincount(overview.cell_of, omega, cells)
        self._cell, self._omega, self._cells = overview.cell_of[active], omega[active], cells
        # Hats are weighed by the sky's luminance: what is bright in a cell determines its gain.
        sky = np.maximum(layers.background().reshape(-1, 3) @ LUMINANCE, 1e-12) * self._omega
        light = np.maximum(np.bincount(self._cell, sky, cells), 1e-30)
        hats = []
        for level, (rows, columns) in enumerate(layers.gain.sizes):
            nodes, one = rows * columns, np.zeros(())
            for node, share in layers.hats(level):
                one = one + np.bincount(self._cell * nodes + node, share * sky, cells * nodes)
            hats.append(one.reshape(cells, nodes) / light[:, None])
        used = np.bincount(self._cell, minlength=cells) > 0
        self._used = np.flatnonzero(used)
        self._hats = np.concatenate(hats, axis=1)[used].astype(np.float32)
        self._matrix = [np.ascontiguousarray(m[:, used]) for m in overview.matrix]
        self._tensors = [tensor(m) for m in self._matrix]

    def jacobian(self, slopes: np.ndarray) -> list[np.ndarray]:
        """Return the change of a block's radiance by each node, (blocks, n), per channel."""
        found = []
        for c in range(3):
            sky = np.bincount(self._cell, self._omega * slopes[:, c], self._cells) / np.maximum(
                self._total, 1e-30
            )
            hats = tensor(sky[self._used, None].astype(np.float32) * self._hats)
            found.append(dr.matmul(self._tensors[c], hats).numpy())
        return found

    def pictures(self, changes: np.ndarray) -> np.ndarray:
        """Return what changes of the active rows, (k, rows, W, 3), do to every pixel: (k, pixels, 3)."""
        found = np.empty((len(changes), len(self.block_of), 3), np.float32)
        for c, matrix in enumerate(self._matrix):
            sums = np.stack(
                [np.bincount(self._cell, self._omega * one[..., c].ravel(), self._cells) for one in changes]
            )
            cells = (sums / np.maximum(self._total, 1e-30))[:, self._used]
            found[..., c] = (cells.astype(np.float32) @ matrix.T)[:, self.block_of]
        return found

    def profile(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture (h, w, 3) over its mean in every block; 1 where that is 0."""
        flat = np.float64(picture).reshape(-1, 3)
        size = np.bincount(self.block_of, minlength=self.count)
        mean = (self.summed(flat.reshape(picture.shape)) / np.maximum(size, 1)[:, None])[self.block_of]
        profile = np.divide(flat, mean, out=np.ones_like(flat), where=mean > 0)
        return profile.astype(np.float32).reshape(picture.shape)

    def sky_cells(self, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """List the cells that lie in rows of the sky: their numbers in use, and directions (n, 3)."""
        inside = np.zeros(self._cells)
        own = self._cell[: shape[0] * shape[1]]
        np.add.at(inside, own, self._omega[: len(own)])
        cells = np.flatnonzero(inside[self._used] > 0.5 * self._total[self._used])
        return cells, self._directions[self._used[cells]]

    def lit(self, cells: np.ndarray) -> list[np.ndarray]:
        """Return pictures of unit flux in each of some cells, (blocks, n), per channel."""
        size = self._total[self._used[cells]]
        return [m[:, cells] / np.float32(np.maximum(size, 1e-30)) for m in self._matrix]

    def spread(self, covariance: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the sum of all grids in every texel, (rows, W)."""
        variance = np.einsum("kn,nm,km->k", self._hats, covariance, self._hats, optimize=True)
        cells = np.zeros(self._cells)
        cells[self._used] = np.sqrt(np.maximum(variance, 0))
        return cells[self._cell].reshape(self._shape).astype(np.float32)

    def summed(self, picture: np.ndarray) -> np.ndarray:
        """Sum a picture (h, w, k) over blocks: (blocks, k)."""
        flat = picture.reshape(-1, picture.shape[2])
        return np.stack([np.bincount(self.block_of, v, self.count) for v in flat.T], axis=1)
