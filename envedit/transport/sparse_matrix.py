"""A sparse matrix with colour weights whose product costs what its memory traffic costs.

Rows are grouped in slices of :data:`SLICE` rows of similar length, padded to the longest of the slice and
stored column by column (sliced ELLPACK, Kreutzer et al. 2014, "SELL-C-sigma"): the lanes of a vector then
read neighbouring memory. An entry is four floats, (r, g, b, bits of the column index), fetched by one packet
load. Each output is summed by one lane in a fixed order: the product has no atomics and gives the same bits
on every run.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

SLICE = 8


class ColourMatrix:
    """Sparse matrix of RGB weights, of ``shape`` (rows, columns): y[i, c] = sum_j w[i, j, c] x[j, c].

    Made of the row and the column (nnz,) and the weights (nnz, 3) of its entries, in any order.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, shape: tuple[int, int]):
        self.shape = shape
        self.entries = len(rows)
        slices = -(-shape[0] // SLICE)
        count = np.bincount(rows, minlength=slices * SLICE)
        by_length = np.argsort(count, kind="stable")[::-1]
        # The work is cut into few blocks of consecutive lanes, one or more a thread: dealing the slices out
        # by length balances them.
        dealt = by_length.reshape(slices, SLICE)
        dealt = np.concatenate([dealt[0::4], dealt[2::4], dealt[1::4], dealt[3::4]])
        lane = np.empty(slices * SLICE, np.int64)
        lane[dealt.ravel()] = np.arange(slices * SLICE)
        longest = count[dealt].max(axis=1)
        slice_start = np.concatenate([[0], np.cumsum(longest * SLICE)])

        # Position of every entry within its row, from a stable sort by row.
        order = np.argsort(rows, kind="stable")
        sorted_rows = rows[order]
        first = np.concatenate([[0], np.cumsum(count)[:-1]])
        within = np.arange(self.entries) - first[sorted_rows]
        lanes = lane[sorted_rows]
        position = slice_start[lanes // SLICE] + within * SLICE + lanes % SLICE

        packed = np.zeros((max(int(slice_start[-1]), 1), 4), np.float32)
        packed[position, :3] = weights[order]
        packed[position, 3] = columns[order].astype(np.uint32).view(np.float32)
        every = np.arange(slices * SLICE)
        start = slice_start[every // SLICE] + every % SLICE
        stop = start + longest[every // SLICE] * SLICE
        self._upload(packed.ravel(), *(x.astype(np.uint32) for x in (start, stop, lane[: shape[0]])))

    def _upload(self, packed, start, stop, lane):
        self.bytes = packed.nbytes
        self._packed = dr.opaque(mi.Float(packed))
        self._start, self._stop, self._lane = (dr.opaque(mi.UInt32(x)) for x in (start, stop, lane))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that the matrix consists of, as it is stored; :meth:`from_arrays` takes it back."""
        return {
            "shape": np.array(self.shape, np.int64),
            "entries": np.array(self.entries, np.int64),
            **{name: getattr(self, f"_{name}").numpy() for name in ("packed", "start", "stop", "lane")},
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> ColourMatrix:
        """Make a matrix of what :meth:`arrays` returned; its products have the same bits."""
        matrix = cls.__new__(cls)
        matrix.shape = tuple(arrays["shape"].tolist())
        matrix.entries = int(arrays["entries"])
        matrix._upload(*(arrays[name] for name in ("packed", "start", "stop", "lane")))
        return matrix

    def coordinates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows (n,), columns (n,) and weights (n, 3) of the entries that are not zero."""
        stored = self.arrays()
        packed = stored["packed"].reshape(-1, 4)
        first = stored["start"][::SLICE].astype(np.int64)
        row_of = np.full(len(stored["start"]), -1, np.int64)
        row_of[stored["lane"]] = np.arange(len(stored["lane"]))
        place = np.arange(len(packed))
        part = np.searchsorted(first, place, side="right") - 1
        rows = row_of[part * SLICE + (place - first[part]) % SLICE]
        real = (rows >= 0) & packed[:, :3].any(axis=1)
        return rows[real], packed[real, 3].copy().view(np.uint32), packed[real, :3]

    def transposed(self, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Multiply the transpose with vectors that are zero but for some distinct rows (n,).

        ``values`` (k, n, 3) are their colours there. Returns (k, columns, 3) float32, in memory channel by
        channel.
        """
        total = np.zeros((3, len(values), self.shape[1]), np.float32).transpose(1, 2, 0)
        if not len(rows):
            return total
        packed = self._packed.numpy().reshape(-1, 4)
        lane = self._lane.numpy()[rows]
        start = self._start.numpy()[lane].astype(np.int64)
        length = (self._stop.numpy()[lane].astype(np.int64) - start) // SLICE
        row = np.repeat(np.arange(len(rows)), length)
        within = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
        entries = packed[start[row] + within * SLICE]
        column = entries[:, 3].copy().view(np.uint32)
        for product, colours in zip(total, values, strict=True):
            for c in range(3):
                product[:, c] = np.bincount(column, entries[:, c] * colours[row, c], self.shape[1])
        return total

    def apply(self, x: mi.Float, count: int = 1) -> list[mi.Color3f]:
        """Multiply with vectors of colours; reading the matrix once is most of what one product costs.

        ``x`` has for each column a packet of each vector, of 4 floats (r, g, b, unused), flat:
        :func:`to_packets`. Returns of each of the ``count`` vectors one colour per row.
        """
        products = _product(self._packed, x, self._start, self._stop, count)
        dr.eval(products)
        return [dr.gather(mi.Color3f, product, self._lane) for product in products]


@dr.syntax
def _product(packed, x, start, stop, count):
    i = mi.UInt32(start)
    total = [mi.Color3f(0) for _ in range(count)]
    while i < stop:
        entry = dr.gather(mi.Vector4f, packed, i)
        total = add_products(total, entry, x, dr.reinterpret_array(mi.UInt32, entry.w))
        i += SLICE
    return total


def add_products(
    total: list[mi.Color3f], weight: mi.Vector4f, packets: mi.Float, column: mi.UInt32
) -> list[mi.Color3f]:
    """Add to the total of each vector a weight times its colour in a column."""
    sums = []
    for k, before in enumerate(total):
        value = dr.gather(mi.Vector4f, packets, column * len(total) + k if len(total) > 1 else column)
        sums.append(before + mi.Color3f(weight.x * value.x, weight.y * value.y, weight.z * value.z))
    return sums


def to_packets(flat: mi.Float, size: int, count: int = 1) -> mi.Float:
    """Interleave ``count`` vectors of ``size`` colours, 3 floats each, for :meth:`ColourMatrix.apply`.

    A colour is padded to the 4 floats that are loaded at once.
    """
    i = dr.arange(mi.UInt32, size * count * 4)
    packet = i >> 2
    if count > 1:
        packet = packet // count + packet % count * size
    return dr.gather(mi.Float, flat, packet * 3 + (i & 3), (i & 3) < 3)


def scale_packets(packets: mi.Float, scale: mi.Float, size: int, count: int = 1) -> mi.Float:
    """Multiply the packets of each of ``size`` columns by its own number."""
    i = dr.arange(mi.UInt32, size * count * 4)
    return packets * dr.gather(mi.Float, scale, (i >> 2) // count)


def merge(
    rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum entries that share row and column of a matrix of so many columns, its ``width``.

    Rows, columns (n,) and RGB weights (n, 3) in any order become distinct places (m,), uint32, ordered by
    row, then column, and sums (m, 3) float32, accumulated in float64.
    """
    key = rows.astype(np.int64) * width + columns
    order = np.argsort(key)
    key = key[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    total = np.add.reduceat(weights[order].astype(np.float64), first, axis=0)
    row, column = np.divmod(key[first], width)
    return row.astype(np.uint32), column.astype(np.uint32), total.astype(np.float32)
