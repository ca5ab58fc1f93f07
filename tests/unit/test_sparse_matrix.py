"""The sparse product against dense numpy."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.transport.sparse_matrix import ColourMatrix, merge, scale_packets, to_packets


def dense(rows, columns, weights, shape):
    """Add up entries in float64, one after the other."""
    matrix = np.zeros((*shape, 3))
    for r, c, w in zip(rows, columns, weights, strict=True):
        matrix[int(r), int(c)] += w.astype(np.float64)
    return matrix


def entries(rng, shape, count):
    rows = rng.integers(0, shape[0], count).astype(np.uint32)
    columns = rng.integers(0, shape[1], count).astype(np.uint32)
    return rows, columns, rng.standard_normal((count, 3)).astype(np.float32)


def product(matrix, x):
    packets = np.zeros((len(x), 4), np.float32)
    packets[:, :3] = x
    packets[:, 3] = np.nan  # "unused": must not reach a result
    return np.array(matrix.apply(mi.Float(packets.ravel()))[0]).T


@pytest.mark.parametrize("shape", [(1, 5), (7, 3), (8, 8), (9, 20), (64, 1), (37, 101)])
def test_product_is_the_dense_one(rng, shape):
    rows, columns, weights = entries(rng, shape, 4 * shape[0])
    x = rng.standard_normal((shape[1], 3)).astype(np.float32)
    result = product(ColourMatrix(rows, columns, weights, shape), x)
    full = dense(rows, columns, weights, shape)
    expected = np.einsum("ijc,jc->ic", full, x.astype(np.float64))
    # Each product and each sum rounds once: (entries of the row + 1) * 2^-24 of the sum of magnitudes.
    magnitude = np.zeros((shape[0], 3))
    np.add.at(magnitude, rows.astype(int), np.abs(weights * x[columns.astype(int)]))
    assert result.shape == expected.shape
    bound = (np.bincount(rows, minlength=shape[0])[:, None] + 1) * 2.0**-24 * magnitude
    assert (np.abs(result - expected) <= bound).all()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_several_vectors_give_the_bits_of_each_alone(count, rng):
    shape = (37, 101)
    matrix = ColourMatrix(*entries(rng, shape, 400), shape)
    vectors, scale = np.float32(rng.standard_normal((count, shape[1], 3))), np.float32(rng.random(shape[1]))
    packets = to_packets(mi.Float(vectors.ravel()), shape[1], count)
    packets = scale_packets(packets, mi.Float(scale), shape[1], count)
    found = [np.array(one).T for one in matrix.apply(packets, count)]
    assert len(found) == count
    for one, vector in zip(found, vectors, strict=True):
        np.testing.assert_array_equal(one, product(matrix, vector * scale[:, None]))


@pytest.mark.parametrize("rows", [1, 9])
def test_matrix_without_entries_gives_zero(rows):
    nothing = np.zeros(0, np.uint32)
    matrix = ColourMatrix(nothing, nothing, np.zeros((0, 3), np.float32), (rows, 4))
    np.testing.assert_array_equal(product(matrix, np.ones((4, 3), np.float32)), np.zeros((rows, 3)))
    assert matrix.entries == 0


@pytest.mark.parametrize("shape", [(1, 5), (7, 3), (8, 8), (64, 1), (37, 101)])
@pytest.mark.parametrize("vectors", [1, 3])
def test_transposed_is_the_dense_transpose_of_some_rows(rng, shape, vectors):
    entry = entries(rng, shape, 4 * shape[0])
    matrix, full = ColourMatrix(*entry, shape), dense(*entry, shape)
    for some in (np.arange(shape[0]), rng.permutation(shape[0])[: 1 + shape[0] // 3]):
        values = rng.standard_normal((vectors, len(some), 3)).astype(np.float32)
        got = matrix.transposed(some, values)
        expected = np.einsum("ijc,kic->kjc", full[some], values.astype(np.float64))
        sizes = dense(*entry[:2], np.abs(entry[2]), shape)[some]
        magnitude = np.einsum("ijc,kic->kjc", sizes, np.abs(values))
        assert got.shape == (vectors, shape[1], 3) and got.dtype == np.float32
        # Products and the result are rounded, sums are in float64; entries may share a place.
        assert (np.abs(got - expected) <= 4 * 2.0**-24 * magnitude).all()
    restored = ColourMatrix.from_arrays(matrix.arrays())
    assert restored.transposed(some, values).tobytes() == got.tobytes()


@pytest.mark.parametrize("shape, count", [((37, 101), 200), ((9, 4), 0), ((1, 5), 3)])
def test_a_matrix_of_its_own_arrays_gives_the_same_bits(shape, count, rng):
    first = ColourMatrix(*entries(rng, shape, count), shape)
    arrays = {name: np.array(array) for name, array in first.arrays().items()}
    second = ColourMatrix.from_arrays(arrays)
    dr.sync_thread()  # Dr.Jit copies when its queue comes to it
    for array in arrays.values():  # the matrix has its own copy
        array[...] = 0
    x = rng.standard_normal((shape[1], 3)).astype(np.float32)
    assert product(second, x).tobytes() == product(first, x).tobytes()
    assert (second.shape, second.entries, second.bytes) == (first.shape, first.entries, first.bytes)


def test_one_long_row_does_not_spoil_the_short_ones(rng):
    rows = np.concatenate([np.full(500, 3), np.arange(20)]).astype(np.uint32)
    columns = rng.integers(0, 50, len(rows)).astype(np.uint32)
    weights = rng.random((len(rows), 3), dtype=np.float32)
    matrix = ColourMatrix(rows, columns, weights, (20, 50))
    x = rng.random((50, 3), dtype=np.float32)
    expected = np.einsum("ijc,jc->ic", dense(rows, columns, weights, (20, 50)), x)
    # All is positive: the relative error of a sum of n terms is at most n * 2^-24, and the longest has 501.
    np.testing.assert_allclose(product(matrix, x), expected, rtol=502 * 2.0**-24)


@pytest.mark.slow
def test_column_indices_survive_as_bits_of_a_float():
    # 0x7f80_0001 upwards would be NaNs; real indices are far below, yet beyond 2^24 a float cannot count.
    index = (1 << 24) + 1
    zero, column = np.zeros(1, np.uint32), np.array([index], np.uint32)
    matrix = ColourMatrix(zero, column, np.ones((1, 3), np.float32), (1, index + 1))
    x = dr.zeros(mi.Float, 4 * (index + 1))
    dr.scatter(x, mi.Float(1, 2, 3), mi.UInt32(4 * index, 4 * index + 1, 4 * index + 2))
    np.testing.assert_array_equal(np.array(matrix.apply(x)).ravel(), [1, 2, 3])


@pytest.mark.parametrize(
    "shape, count", [((37, 101), 200), ((9, 4), 0), ((1, 5), 3), ((64, 1), 20), ((300, 7), 900), ((16, 9), 1)]
)
def test_coordinates_are_the_entries(shape, count, rng):
    rows, columns, weights = merge(*entries(rng, shape, count), shape[1])
    emptied = ~np.isin(rows, rng.integers(0, shape[0], shape[0] // 4))
    rows, columns, weights = rows[emptied], columns[emptied], weights[emptied]
    shuffle = rng.permutation(len(rows))
    matrix = ColourMatrix(rows[shuffle], columns[shuffle], weights[shuffle], shape)
    r, c, w = matrix.coordinates()
    assert r.shape == c.shape == (len(rows),) and w.shape == (len(rows), 3)
    order = np.lexsort((c, r))
    np.testing.assert_array_equal(r[order], rows)
    np.testing.assert_array_equal(c[order], columns)
    assert w[order].tobytes() == weights.tobytes()


def test_coordinates_leave_out_what_is_zero(rng):
    rows, columns, weights = merge(*entries(rng, (20, 30), 100), 30)
    weights[::3] = 0
    r, c, w = ColourMatrix(rows, columns, weights, (20, 30)).coordinates()
    assert len(r) == weights.any(axis=1).sum() < len(rows)
    np.testing.assert_array_equal(dense(r, c, w, (20, 30)), dense(rows, columns, weights, (20, 30)))


def test_merge_adds_entries_of_one_place_and_sorts_them(rng):
    rows, columns, weights = entries(rng, (6, 5), 400)
    r, c, w = merge(rows, columns, weights, 5)
    key = r.astype(np.int64) * 5 + c
    assert (np.diff(key) > 0).all()  # distinct, ordered by row, then column
    # One rounding to float32 after a float64 sum.
    expected = dense(rows, columns, weights, (6, 5))[r, c]
    np.testing.assert_allclose(w, expected, rtol=2.0**-23, atol=1e-12)
    assert (r.dtype, c.dtype, w.dtype) == (np.uint32, np.uint32, np.float32)
    # 1e8 + 1 in float32 is 1e8: sums are accumulated in float64.
    zero = np.zeros(4, np.uint32)
    weights = np.array([[1e8], [1.0], [-1e8], [1.0]], np.float32).repeat(3, axis=1)
    np.testing.assert_array_equal(merge(zero, zero, weights, 1)[2], [[2, 2, 2]])
    r, c, w = merge(np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((0, 3), np.float32), 7)
    assert r.shape == c.shape == (0,) and w.shape == (0, 3)
    rows, columns = np.array([200_000, 200_000, 0], np.uint32), np.array([99_999, 99_999, 1], np.uint32)
    r, c, w = merge(rows, columns, np.ones((3, 3), np.float32), 100_000)
    np.testing.assert_array_equal(np.stack([r, c]), [[0, 200_000], [1, 99_999]])
    np.testing.assert_array_equal(w[:, 0], [1, 2])
