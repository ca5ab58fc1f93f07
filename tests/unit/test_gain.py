"""The smooth gain: interpolation between nodes, periodic, bounded, and no finer than it says."""

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.representations.layers import gain
from envedit.representations.layers.gain import Octave

SHAPES = [(1, 2), (3, 7), (5, 8), (17, 33), (32, 64)]
GAINS = [(8, 1.0), (8, 0.5), (6, 0.3), (1, 1.0), (5, 0.1)]


def tensors(params):
    return {name: mi.TensorXf(value) for name, value in params.items()}


def random(g, rng, size=1.0):
    scales = g.scales()
    drawn = {n: rng.standard_normal(v.shape).astype(np.float32) for n, v in g.init().items()}
    return {n: size * scales[n] * value for n, value in drawn.items()}


def field(g, params, shape):
    return np.array(g.evaluate(tensors(params), g.prepare(shape))).T.reshape(*shape, 3)


def interpolated(grid, shape, poles=(0,)):
    """Evaluate one grid in float64, segment by segment: a parabola around every node.

    Nodes of a row from u = 0 on, rows from the top to the bottom edge, beyond which they go on evenly.
    """
    (rows, columns, channels), (height, width) = grid.shape, shape
    grid = np.array(grid, np.float64)
    for row in poles:
        grid[row] = grid[row, 0]
    grid = np.concatenate([2 * grid[:1] - grid[1:2], grid, 2 * grid[-1:] - grid[-2:-1]])
    result = np.empty((height, width, channels))
    for i, y in enumerate((np.arange(height) + 0.5) / height * (rows - 1)):
        for k, x in enumerate((np.arange(width) + 0.5) / width * columns):
            r, c = round(y), round(x)
            column = [grid[:, (c + s) % columns] for s in (-1, 0, 1)]
            line = sum(w * v for w, v in zip(parabolas(x - c), column, strict=True))
            result[i, k] = sum(w * line[r + 1 + s] for w, s in zip(parabolas(y - r), (-1, 0, 1), strict=True))
    return result


def parabolas(f):
    return 0.5 * (0.5 - f) ** 2, 0.75 - f * f, 0.5 * (0.5 + f) ** 2


def poles(share):
    return (0, -1) if share == 1 else (0,)


@pytest.mark.parametrize("cycles, share", [(8, 1.0), (16, 0.5), (32, 0.25)])
def test_grids_double_and_are_as_fine_in_elevation_as_in_azimuth(cycles, share):
    g = gain.GridGain(cycles, share)
    columns = [c for _, c in g.sizes]
    assert columns == [cycles // 2, cycles, 2 * cycles]
    assert [180 * share / (rows - 1) for rows, _ in g.sizes] == [360 / c for c in columns]
    assert set(g.init()) == set(g.scales()) == {"gain.0", "gain.1", "gain.2"}
    assert list(g.scales().values()) == [1, 0.5, 0.25]


@pytest.mark.parametrize("cycles, share", GAINS)
@pytest.mark.parametrize("shape", SHAPES)
def test_hats_are_a_partition_of_unity_and_the_field_is_their_interpolation(cycles, share, shape, rng):
    g = gain.GridGain(cycles, share)
    for level in range(len(g.sizes)):
        taps = g.hats(level, shape)
        rows, columns = g.sizes[level]
        assert len(taps) == min(3, rows) * min(3, columns)
        for node, weight in taps:
            assert node.shape == weight.shape == (shape[0] * shape[1],)
            assert node.min() >= 0 and node.max() < np.prod(g.sizes[level])
            assert weight.min() >= 0
        np.testing.assert_allclose(sum(weight for _, weight in taps), 1, rtol=1e-12)
        ones = {n: np.full_like(v, n == f"gain.{level}") for n, v in g.init().items()}
        np.testing.assert_allclose(field(g, ones, shape), 1, rtol=1e-6)
    params = random(g, rng)
    expected = sum(interpolated(grid, shape, poles(share)) for grid in params.values())
    # Twelve products of numbers of order 1, rounded to float32.
    np.testing.assert_allclose(field(g, params, shape), expected, atol=2e-6)
    by_hats = 0
    for level, grid in enumerate(params.values()):
        nodes = grid.reshape(-1, 3).astype(np.float64)
        by_hats = by_hats + sum(nodes[node] * weight[:, None] for node, weight in g.hats(level, shape))
    np.testing.assert_allclose(by_hats.reshape(*shape, 3), expected, atol=1e-12)


def test_gain_is_bounded_and_only_at_its_bounds(rng):
    g = gain.GridGain(4, 1.0)
    shape = (9, 40)
    for sign in (1, -1):
        far = {n: np.full_like(v, sign * 1e6) for n, v in g.init().items()}
        np.testing.assert_array_equal(field(g, far, shape), sign * gain.MOST)
    params = random(g, rng, size=15)
    free = sum(interpolated(grid, shape, poles(1)) for grid in params.values())
    assert (np.abs(free) > gain.MOST).any() and (np.abs(free) < gain.MOST).any()
    np.testing.assert_allclose(field(g, params, shape), np.clip(free, -12, 12), atol=3e-5)


def test_finer_grids_start_at_nothing_and_move_as_far_as_they_are_known(rng):
    coarse, fine = gain.GridGain(6, 0.5), gain.GridGain(6, 0.5)
    size = gain.grid_size(12, 0.5)
    known = np.linspace(0, 1, size[0] * size[1]).reshape(size)
    fine = fine.refined([Octave(size, known, 0.5)])
    assert fine.sizes == [*coarse.sizes, size] and fine.init().keys() - coarse.init().keys() == {"gain.3"}
    assert not fine.init()["gain.3"].any()
    unit = fine.scales()["gain.3"]
    assert unit.shape == (*size, 3) and np.allclose(unit, gain.DETAIL * known[..., None])
    params = {k: rng.normal(size=v.shape).astype(np.float32) for k, v in coarse.init().items()}
    assert np.array_equal(*(field(g, g.init() | params, (16, 64)) for g in (coarse, fine)))


@pytest.mark.parametrize(("share", "top"), [(1.0, True), (0.5, True), (0.5, False)])
def test_directions_of_nodes_are_where_a_field_has_their_values(share, top):
    """Splines make a linear field exactly: of nodes with their own colatitude, that of every texel.

    To half a texel, as the first and last row of a map lie on the poles. Around the horizon a field of one
    cycle keeps its phase.
    """
    g, width = gain.GridGain(12, share, top), 96
    height = round(width / 2 * share)
    first = 0 if top else width // 2 - height
    d = latlong.directions(width // 2, width)[first : first + height]
    rows, columns = g.sizes[2]
    nodes = g.directions(2)
    np.testing.assert_allclose(np.linalg.norm(nodes, axis=1), 1)
    down, across = gain.splines((rows, columns), (height, width))
    colatitude = np.arccos(np.clip(nodes[:, 1], -1, 1)).reshape(rows, columns)
    off = down @ colatitude @ across.T - np.arccos(np.clip(d[..., 1], -1, 1))
    assert np.abs(off).max() < 1.001 * np.pi / width
    middle = rows // 2  # no pole
    around = nodes.reshape(rows, columns, 3)[middle][:, [0, 2]] / np.sin(colatitude[middle, 0])
    found = across @ around
    texel = d[height // 2][:, [0, 2]] / np.sqrt(1 - d[height // 2, :1, 1] ** 2)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    assert np.degrees(np.arccos((found * texel).sum(axis=1).clip(-1, 1))).max() < 0.1
