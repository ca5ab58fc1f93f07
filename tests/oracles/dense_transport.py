"""A light transport that is a dense matrix, for what only asks to render and for the block transport."""

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.transport.block_transport import Overview
from envedit.transport.exact_columns import Columns
from envedit.transport.sparse_matrix import ColourMatrix


class DenseTransport:
    """Multiply maps with a matrix of pixels by texels, the same or another one in every channel.

    Parameters
    ----------
    weights : ndarray (h * w, H * W) or (3, h * w, H * W)
        T.
    shape, grid : (int, int)
        Height and width of the picture and of the map.
    """

    capacity = 256

    def __init__(self, weights, shape, grid):
        self.shape, self.grid, self.exact = shape, grid, Columns.none()
        self.weights = np.broadcast_to(
            np.asarray(weights, np.float32), (3, shape[0] * shape[1], grid[0] * grid[1])
        )
        self._tensors = [mi.TensorXf(np.ascontiguousarray(w)) for w in self.weights]

    @classmethod
    def random(cls, rng, shape, grid, even=0.3):
        """Make a transport whose pixels each see a few texels well and all of them a little."""
        pixels, texels = shape[0] * shape[1], grid[0] * grid[1]
        weights = np.full((pixels, texels), even / texels)
        for row in weights:
            row[rng.integers(0, texels, 4)] += (1 - even) / 4
        return cls(weights, shape, grid)

    def resolved(self, envmap, **options):
        """Every texel is exact."""
        return self

    def main(self, maps, rows):
        return np.zeros(0, np.int64)

    def with_probed(self, texels):
        return self

    def with_columns(self, exact):
        return self

    def restored(self, exact):
        return self

    def apply(self, envmap):
        flat = dr.reshape(mi.TensorXf(envmap), (self.grid[0] * self.grid[1], 3))
        rgb = [dr.matmul(w, flat[:, c : c + 1]).array for c, w in enumerate(self._tensors)]
        return mi.TensorXf(dr.ravel(mi.Color3f(*rgb)), (*self.shape, 3))

    def linear(self, maps):
        if maps.ndim == 3:
            return self.apply(maps)
        return mi.TensorXf(np.stack([self.apply(mi.TensorXf(one)).numpy() for one in maps.numpy()]))

    def other_light(self):
        return np.zeros((*self.shape, 3), np.float32)

    def adjoint(self, image):
        flat = np.asarray(image, np.float32).reshape(-1, 3)
        rgb = [w.T @ flat[:, c] for c, w in enumerate(self.weights)]
        return mi.TensorXf(np.ascontiguousarray(np.stack(rgb, axis=1).reshape(*self.grid, 3)))

    def pictures(self, maps, rows, most=0):
        whole = np.zeros((len(maps), *self.grid, 3))
        whole[:, rows] = maps
        found = np.einsum("cpt,ktc->kpc", self.weights, whole.reshape(len(maps), -1, 3), optimize=True)
        return found.reshape(len(maps), *self.shape, 3).astype(np.float32)

    def probe(self, texels):
        return self.weights[:, :, texels].transpose(2, 1, 0)

    def overview(self):
        some, texel = np.nonzero(self.weights.any(axis=0))
        entries = some.astype(np.uint32), texel.astype(np.uint32), self.weights[:, some, texel].T
        matrix = ColourMatrix(*entries, self.weights.shape[1:])
        overview = Overview(self.shape, self.grid)
        overview.matrix = overview.summed(matrix)
        return overview


def node_shares(problem):
    """Return every node's share of every texel of a problem, by levels: (texels, nodes) each."""
    height, width = problem.transport.grid
    found = []
    for level, size in enumerate(problem.sizes):
        share = np.zeros((height * width, np.prod(size)))
        for node, weight in problem.layers.gain.hats(level, (height, width)):
            np.add.at(share, (np.arange(len(node)), node), weight)
        found.append(share)
    return found
