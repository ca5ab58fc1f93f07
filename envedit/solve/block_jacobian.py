"""The derivative of a picture by the gain of the sky, in blocks of pixels and cells of texels."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat, tensor, vectors
from envedit.core.color import LUMINANCE
from envedit.representations.layers.layers import Layers
from envedit.transport.light_transport import LightTransport


class BlockJacobian:
    """The block transport with the gain's hats in its cells.

    ``sky`` are the cells of the sky that may change: their numbers in use, and directions (n, 3).
    """

    def __init__(self, layers: Layers, transport: LightTransport, shape: tuple[int, int]):
        overview = transport.overview()
        self.block_of, self.count = overview.block_of, overview.blocks
        active = slice(layers.active.start * shape[1], layers.active.stop * shape[1])
        self._shape = layers.whole
        cells, omega = overview.cells, np.repeat(latlong.lookup_solid_angles(*shape), shape[1])
        # Pixels in the order of their blocks, where each block begins, and which these are.
        self._order = np.argsort(self.block_of, kind="stable")
        ordered = self.block_of[self._order]
        self._starts = np.flatnonzero(np.diff(ordered, prepend=-1))
        self._present = ordered[self._starts]
        self._total = overview.omega
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
        if layers.ground_light:  # what the sky does to it, and its own factor
            lit, own = (
                np.bincount(self._cell, np.repeat(rows, shape[1]) * sky, cells) / light
                for rows in (layers.lit, layers.own_ground)
            )
            hats = [one + np.outer(lit, layers.lighting(level)) for level, one in enumerate(hats)]
            hats.append(own[:, None])
        used = np.bincount(self._cell, minlength=cells) > 0
        self._used = np.flatnonzero(used)
        self._hats = np.concatenate(hats, axis=1)[used].astype(np.float32)
        # Products leave out cells whose light does not reach the picture: half of them above a floor.
        self._reaching = np.flatnonzero(used & overview.matrix.any(axis=(0, 1)))
        self._reaching_hats = self._hats[np.searchsorted(self._used, self._reaching)]
        self._overview = overview.matrix
        self._matrix = [np.ascontiguousarray(m[:, self._reaching]) for m in overview.matrix]
        self._tensors = [tensor(m) for m in self._matrix]
        # Where in the sky is what the texels of a cell follow.
        toward = latlong.directions(*shape)[layers.active]
        if layers.below is not None:
            toward[layers.shape[0] :] = toward[layers.below.mirrored]
        toward = np.stack([self._means(one.ravel()) for one in np.moveaxis(toward, 2, 0)], axis=1)
        self._toward = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30)
        # Cells that are more than half full of texels above the horizon that may change.
        texels = slice(layers.shape[0] * shape[1])
        changeable = (self._omega.reshape(*self._shape, 1) * layers.changeable).ravel()
        inside = np.bincount(self._cell[texels], changeable[texels], cells)
        in_sky = np.flatnonzero(inside[used] > 0.5 * self._total[used])
        self.sky = in_sky, overview.directions[self._used[in_sky]]

    def jacobian(self, slopes: np.ndarray) -> list[np.ndarray]:
        """Return the change of a block's radiance by each node, (blocks, n), per channel."""
        channels = []
        for c, matrix in enumerate(self._tensors):
            hats = tensor(self._means(slopes[:, c])[:, None] * self._reaching_hats)
            channels.append(dr.matmul(matrix, hats).numpy())
        return channels

    def pictures(self, changes: np.ndarray) -> np.ndarray:
        """Return what changes of the active rows, (k, rows, W, 3), do to every pixel: (k, pixels, 3)."""
        of_pixels = np.empty((3, len(changes), len(self.block_of)), np.float32)
        for c, matrix in enumerate(self._matrix):
            cells = np.stack([self._means(one[..., c].ravel()) for one in changes], axis=1)
            np.take(cells.T @ matrix.T, self.block_of, axis=1, out=of_pixels[c])
        return of_pixels.transpose(1, 2, 0)

    def _means(self, values):
        """Return the means over the cells of :attr:`_matrix` of values of texels, (rows * W,), float32."""
        sums = np.bincount(self._cell, self._omega * values, self._cells)
        return (sums / np.maximum(self._total, 1e-30))[self._reaching].astype(np.float32)

    def profile(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture (h, w, 3) over its mean in every block; 1 where that is 0."""
        flat = np.float64(picture).reshape(-1, 3)
        size = np.bincount(self.block_of, minlength=self.count)
        mean = (self.summed(flat.reshape(picture.shape)) / np.maximum(size, 1)[:, None])[self.block_of]
        profile = np.divide(flat, mean, out=np.ones_like(flat), where=mean > 0)
        return profile.astype(np.float32).reshape(picture.shape)

    @functools.cached_property
    def _lit(self):
        """Pictures of unit flux in each cell of the sky, (blocks, n), per channel."""
        cells, _ = self.sky
        cells = self._used[cells]
        size = np.maximum(self._total[cells], 1e-30)
        return [tensor(m[:, cells] / np.float32(size)) for m in self._overview]

    def cells(self, ground: np.ndarray | None = None) -> CellLights:
        """Return pictures of light in each cell of :attr:`sky`.

        ``ground`` (h, w, 3) is the picture of ground on which light of an irradiance of 1 falls; None: none.
        """
        if ground is None:
            return CellLights(self._lit)
        _, directions = self.sky
        upward = np.maximum(directions[:, 1], 0)
        size = np.maximum(np.bincount(self.block_of, minlength=self.count), 1)[:, None]
        by_blocks = [tensor(np.outer(of_channel, upward)) for of_channel in (self.summed(ground) / size).T]
        return CellLights([lit + lit_ground for lit, lit_ground in zip(self._lit, by_blocks, strict=True)])

    def glows(self, slope: np.ndarray, glow: Callable[[mi.Vector3f, mi.Vector3f], mi.Color3f]) -> list:
        """Return pictures of a glow around each cell of :attr:`sky`, tensors (blocks, n), per channel.

        ``glow`` returns what it adds to the factor of the sky at directions (m,), around centres (m,);
        ``slope`` (rows, W, 3) is the derivative of the map by that factor.
        """
        _, centres = self.sky
        count = len(centres)
        centres = centres[::2]  # two that are side by side, 6 degrees apart, have one glow
        shape = len(self._toward), len(centres)
        cell, centre = np.divmod(np.arange(math.prod(shape), dtype=np.uint32), np.uint32(max(shape[1], 1)))
        around = glow(
            dr.gather(mi.Vector3f, vectors(mi.Vector3f, self._toward), mi.UInt32(cell)),
            dr.gather(mi.Vector3f, vectors(mi.Vector3f, centres), mi.UInt32(centre)),
        )
        pictures = []
        for c, matrix in enumerate(self._tensors):
            change = self._means(slope[..., c].ravel())[:, None] * around[c].numpy().reshape(shape)
            of_centres = dr.matmul(matrix, tensor(change)).numpy()
            pictures.append(tensor(np.repeat(of_centres, 2, axis=1)[:, :count]))
        return pictures

    def spread(self, covariance: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the sum of all grids in every texel, (rows, W)."""
        variance = np.einsum("kn,nm,km->k", self._hats, covariance, self._hats, optimize=True)
        cells = np.zeros(self._cells)
        cells[self._used] = np.sqrt(np.maximum(variance, 0))
        return cells[self._cell].reshape(self._shape).astype(np.float32)

    def summed(self, picture: np.ndarray) -> np.ndarray:
        """Sum a picture (h, w, k) over blocks: (blocks, k)."""
        return self.sums(picture.reshape(-1, picture.shape[2]).T).T

    def sums(self, pictures: np.ndarray) -> np.ndarray:
        """Sum pictures (k, pixels) over blocks: (k, blocks)."""
        in_blocks = np.zeros((len(pictures), self.count), pictures.dtype)
        in_blocks[:, self._present] = np.add.reduceat(pictures[:, self._order], self._starts, axis=1)
        return in_blocks


class CellLights:
    """Pictures in blocks, (blocks, n) per channel, of a flux of 1 in each cell of the sky."""

    def __init__(self, lit: list[mi.TensorXf]):
        self._lit = lit

    def of(self, flux: np.ndarray) -> list[mi.TensorXf]:
        """Return those of a flux (3,)."""
        return [m * flat(mi.Float, np.float32(f)) for m, f in zip(self._lit, flux, strict=True)]

    def products(self, pictures: list[np.ndarray]) -> list[np.ndarray]:
        """Return, per channel, products of pictures (blocks, k) with them: (k, n)."""
        return [dr.matmul(tensor(p), m, At=True).numpy() for m, p in zip(self._lit, pictures, strict=True)]

    def power(self, weights: np.ndarray) -> np.ndarray:
        """Return sums of weights (blocks, 3) times their squares, (3, n)."""
        squares = zip(self._lit, weights.T, strict=True)
        return np.stack([dr.matmul(tensor(w[None]), dr.square(m)).numpy()[0] for m, w in squares])
