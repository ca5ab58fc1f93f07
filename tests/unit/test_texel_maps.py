"""What is interpolated between the texels of a coarser map."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.rows import Rows
from envedit.export.texel_maps import Places

ROWS, COLUMNS = 24, 48


def interpolated(values, finer, edge=None, smooth=True):
    """Values (rows, w, 3) at the texels of a map that is finer by a factor."""
    shape = values.shape[0] * finer, values.shape[1] * finer
    grid = Places(shape, Rows(0, len(values), len(values)), values.shape[1])
    band = next(grid.bands())
    found = grid.smooth(band, values, edge) if smooth else grid.linear(mi.Color3f, band, values)
    return band.image(found).numpy(), grid


def reflection(row, column, turns=0.0):
    """Log factor of a reflection, 25 at its centre and five texels wide, that is taken away."""
    apart = (column[None] - 20.3 - turns + COLUMNS / 2) % COLUMNS - COLUMNS / 2
    one = 24 * np.exp(-np.log(2) * (apart / 2.5) ** 2 - ((row[:, None] - 11.4) / 6) ** 2)
    return -np.repeat(np.log1p(one)[..., None], 3, axis=2)


@pytest.mark.parametrize("turns", [0.0, COLUMNS / 2 + 3.7])  # also across the seam
def test_a_reflection_that_is_taken_away_leaves_no_bars(turns):
    known = reflection(np.arange(ROWS), np.arange(COLUMNS) + 0.5, turns)
    smooth, grid = interpolated(known, 8)
    linear, _ = interpolated(known, 8, smooth=False)
    width = COLUMNS * 8
    true = reflection(grid.place, (np.arange(width) + 0.5) * COLUMNS / width, turns)
    inner = slice(12, -12)  # rows with neighbours on both sides
    errors = [np.abs(np.exp(found - true) - 1)[inner].max() for found in (smooth, linear)]
    assert errors[0] < 0.01 < 0.03 < errors[1]


def test_what_is_constant_and_what_lies_on_texels_keeps_its_bits(rng):
    constant = np.broadcast_to(np.float32([0.1, -0.3, 1 / 3]), (ROWS, COLUMNS, 3))
    found, _ = interpolated(constant, 5)
    assert found.tobytes() == np.ascontiguousarray(np.broadcast_to(constant[0, 0], found.shape)).tobytes()
    values = rng.normal(size=(ROWS, COLUMNS, 3)).astype(np.float32)
    found, _ = interpolated(values, 1)
    assert found.tobytes() == values.tobytes()


def test_nothing_crosses_the_edge(rng):
    values = rng.normal(size=(ROWS, COLUMNS, 3)).astype(np.float32)
    other = values.copy()
    other[10:] += 5
    (a, grid), (b, _) = interpolated(values, 4, edge=10), interpolated(other, 4, edge=10)
    above = grid.place < 9.5
    assert above.any() and (a[above] == b[above]).all()
    np.testing.assert_allclose(b[~above] - a[~above], 5, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (2, 2)])
def test_maps_of_few_texels(shape):
    values = np.arange(np.prod(shape) * 3, dtype=np.float32).reshape(*shape, 3)
    found, _ = interpolated(values, 3)
    assert np.isfinite(found).all() and found.shape == (3 * shape[0], 3 * shape[1], 3)
    dr.eval()
