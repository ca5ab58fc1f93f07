"""The overview against dense numpy: a transport written out in full, and averaged tile by tile."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.transport.block_transport import Overview
from envedit.transport.sparse_matrix import ColourMatrix

# (picture, map): tiles of one and of several pixels or texels, that divide the sides and that do not.
SIZES = [((5, 33), (4, 65)), ((40, 7), (5, 130)), ((4, 6), (3, 10)), ((2, 64), (3, 192)), ((1, 1), (3, 2))]


def tiles(height, width, side):
    """Yield the slices of square tiles, row by row; those at the lower and right edge may be smaller."""
    for top in range(0, height, side):
        for left in range(0, width, side):
            yield slice(top, top + side), slice(left, left + side)


def sides(shape, grid):
    """Return pixels and texels along a side of a tile: the fewest that leave 32 blocks and 64 cells."""
    return int(np.ceil(max(shape) / 32)), int(np.ceil(grid[1] / 64))


def transport(rng, shape, grid):
    """Return a random transport, a tenth of it not zero: as a matrix and dense."""
    size = shape[0] * shape[1], grid[0] * grid[1]
    full = rng.random((*size, 3)).astype(np.float32) * (rng.random((*size, 1)) < 0.1)
    rows, columns = np.nonzero(full.any(axis=2))
    matrix = ColourMatrix(rows.astype(np.uint32), columns.astype(np.uint32), full[rows, columns], size)
    return matrix, full.astype(np.float64).reshape(*shape, *grid, 3)


def overview(matrix, shape, grid, views=()):
    overview = Overview(shape, grid, views)
    overview.matrix = overview.summed(matrix)
    return overview


@pytest.mark.parametrize("shape, grid", SIZES)
def test_the_overview_is_the_transport_averaged_tile_by_tile_over_the_sphere(shape, grid, rng):
    matrix, full = transport(rng, shape, grid)
    result = overview(matrix, shape, grid)
    pixels, texels = sides(shape, grid)
    blocks, cells = list(tiles(*shape, pixels)), list(tiles(*grid, texels))
    assert result.matrix.shape == (3, len(blocks), len(cells)) and result.matrix.dtype == np.float32
    expected = [[full[b][:, :, c[0], c[1]].mean(axis=(0, 1)).sum(axis=(0, 1)) for c in cells] for b in blocks]
    np.testing.assert_allclose(result.matrix, np.moveaxis(expected, 2, 0), rtol=1e-6)
    light = rng.random((result.matrix.shape[2], 3))
    picture = np.einsum("hwrtc,rtc->hwc", full, light[result.cell_of].reshape(*grid, 3))
    seen = np.einsum("cbl,lc->bc", result.matrix.astype(np.float64), light)
    np.testing.assert_allclose(seen, result.to_blocks(picture), rtol=1e-6)
    assert result.omega.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    texel = np.repeat(latlong.lookup_solid_angles(*grid), grid[1]).reshape(grid)

    np.testing.assert_allclose(result.omega, [texel[c].sum() for c in cells], rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(result.directions, axis=1), 1, rtol=1e-12)
    toward = latlong.directions(*grid)
    for direction, c in zip(result.directions, cells, strict=True):
        mean = (toward[c] * texel[c][..., None]).sum(axis=(0, 1))
        assert direction @ mean == pytest.approx(np.linalg.norm(mean), rel=1e-9)


def test_no_more_tiles_than_stated():
    empty = np.zeros(0, np.uint32)
    matrix = ColourMatrix(empty, empty, np.zeros((0, 3), np.float32), (97 * 31, 12 * 200))
    result = overview(matrix, (97, 31), (12, 200))
    assert result.matrix.shape == (3, 25 * 8, 3 * 50) and not result.matrix.any()


def test_no_block_is_of_two_views(rng):
    """Two views of one size have the blocks that each has alone."""
    views, grid = (slice(0, 33), slice(33, 66)), (4, 65)
    matrix, full = transport(rng, (66, 20), grid)
    result = overview(matrix, (66, 20), grid, views)
    half = np.split(result.matrix, 2, axis=1)
    for rows, one in zip(views, half, strict=True):
        part = full[rows].reshape(33 * 20, -1, 3)
        pixels, texels = np.nonzero(part.any(axis=2))
        weights = part[pixels, texels].astype(np.float32)
        indices = pixels.astype(np.uint32), texels.astype(np.uint32)
        alone = overview(ColourMatrix(*indices, weights, part.shape[:2]), (33, 20), grid)
        np.testing.assert_array_equal(one, alone.matrix)
