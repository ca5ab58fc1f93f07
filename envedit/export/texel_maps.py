"""Where the texels of a large map lie among those of a coarser one, and the bands in which it is worked on.

A band is some rows of the large map. What is known at the coarser map's texels is interpolated along the rows
on the host, where it is small, and across the columns on the device. What is smooth is interpolated by cubic
convolution (Keys 1981, a = -1/2): linearly, the log factor of a reflection that is taken away, 25 at its
centre and five texels wide, errs by 5 %, and texels of the coarser map show as bars.
"""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat
from envedit.core.rows import Rows
from envedit.core.types import DrArray

BAND_TEXELS = 1 << 21
"""Texels of the source that are worked on at a time."""


class Places:
    """Where the texels of a source lie among rows of a coarser map.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the source.
    rows : Rows
        Which rows of its map the coarser image is.
    columns : int
        Its columns.

    Attributes
    ----------
    row, column : ndarray of int64 (H,), (W,)
        The nearest texel of the coarser image.
    place : ndarray (H,)
        Row of the coarser image, with its fraction.
    start, stop : int
        Rows of the source whose nearest row is in the coarser image.
    """

    def __init__(self, shape: tuple[int, int], rows: Rows, columns: int):
        self.shape = shape
        self.rows = rows
        self.count = rows.count
        self.columns = columns
        height, width = shape
        place = np.arange(height) * ((rows.total - 1) / max(height - 1, 1)) - rows.first
        nearest = np.rint(place)
        inside = np.flatnonzero((nearest >= 0) & (nearest < self.count))
        self.start, self.stop = (int(inside[0]), int(inside[-1]) + 1) if len(inside) else (0, 0)
        self.row = np.clip(nearest, 0, self.count - 1).astype(np.int64)
        across = (np.arange(width) + 0.5) * (self.columns / width)
        self.column = np.minimum(across.astype(np.int64), self.columns - 1)
        self.place = place
        left = np.floor(across - 0.5)
        around = [(left + step) % self.columns for step in (0, 1, -1, 2)]
        index = np.stack([*around, self.column, self.column + 1], axis=1).astype(np.uint32)
        part = np.stack([across - 0.5 - left, across - self.column], axis=1).astype(np.float32)
        self._index = [dr.opaque(mi.UInt32(np.ascontiguousarray(i))) for i in index.T]
        self._part = [dr.opaque(mi.Float(np.ascontiguousarray(p))) for p in part.T]

    def bands(self) -> Iterator[tuple[int, int, int]]:
        """Yield (first row, first row not in an earlier band, rows): bands of one size over start to stop."""
        height = self.stop - self.start
        size = min(max(BAND_TEXELS // self.shape[1], 1), height)
        for fresh in range(self.start, self.stop, max(size, 1)):
            yield min(fresh, self.stop - size), fresh, size

    def along_rows(self, values: np.ndarray, start: int, size: int) -> np.ndarray:
        """Interpolate values (rows, w, C) linearly at rows of the source; float32 (size, w, C)."""
        return _between(values, np.clip(self.place[start : start + size], 0, self.count - 1))

    def smooth_rows(self, values: np.ndarray, start: int, size: int, edge: int | None = None) -> np.ndarray:
        """Interpolate values (rows, w, C) by cubic convolution at rows of the source; float32 (size, w, C).

        Nothing is interpolated across the edge before row ``edge`` of the values.
        """
        place = self.place[start : start + size]
        first, last = np.zeros(size, np.int64), np.full(size, self.count - 1)
        if edge is not None:
            above = place < edge - 0.5
            first, last = np.where(above, 0, edge), np.where(above, edge - 1, last)
        place = np.clip(place, first, last)
        top = np.floor(place).astype(np.int64)
        a, b, before, after = (values[np.clip(top + step, first, last)] for step in (0, 1, -1, 2))
        part = (place - top)[:, None, None]
        return _keys(a, b, before, after, part).astype(np.float32)

    def inner(self, mask: np.ndarray, start: int, size: int) -> np.ndarray:
        """Interpolate a mask (rows, w) by its corners, 0 wherever a texel is not in it; (size, w + 1)."""
        around = np.pad(mask, ((1, 1), (0, 0)), mode="edge")
        across = around & np.roll(around, 1, axis=1)
        corners = across[:-1] & across[1:]
        corners = np.concatenate([corners, corners[:, :1]], axis=1).astype(np.float64)
        place = np.clip(self.place[start : start + size] + 0.5, 0, self.count)
        return _between(corners[..., None], place)[..., 0]

    def across(
        self, kind: type[DrArray], table: DrArray, row: mi.UInt32, column: mi.UInt32, corners: bool = False
    ) -> DrArray:
        """Interpolate a table of :meth:`along_rows`, or of :meth:`inner`, at texels of a band."""
        left, right = self._index[4:6] if corners else self._index[:2]
        part = dr.gather(mi.Float, self._part[1 if corners else 0], column)
        first = row * dr.opaque(mi.UInt32, self.columns + (1 if corners else 0))
        a = dr.gather(kind, table, first + dr.gather(mi.UInt32, left, column))
        b = dr.gather(kind, table, first + dr.gather(mi.UInt32, right, column))
        return a + (b - a) * part

    def smooth_across(
        self, kind: type[DrArray], table: DrArray, row: mi.UInt32, column: mi.UInt32
    ) -> DrArray:
        """Interpolate a table of :meth:`smooth_rows` by cubic convolution at texels of a band."""
        first = row * dr.opaque(mi.UInt32, self.columns)
        around = [dr.gather(mi.UInt32, index, column) for index in self._index[:4]]
        a, b, before, after = (dr.gather(kind, table, first + offset) for offset in around)
        return _keys(a, b, before, after, dr.gather(mi.Float, self._part[0], column))

    def nearest(self, kind: type[DrArray], table: DrArray, row: mi.UInt32, column: mi.UInt32) -> DrArray:
        """Look up a table (size, w) at texels of a band."""
        place = row * dr.opaque(mi.UInt32, self.columns) + dr.gather(mi.UInt32, self._index[4], column)
        return dr.gather(kind, table, place)

    def beside(self, column: mi.UInt32) -> mi.Float:
        """Columns from the nearest, -1/2 to 1/2."""
        return dr.gather(mi.Float, self._part[1], column) - 0.5

    def texels(self, size: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Row and column in the band of all its texels."""
        index = dr.arange(mi.UInt32, size * self.shape[1])
        row = index // dr.opaque(mi.UInt32, self.shape[1])
        return row, index - row * dr.opaque(mi.UInt32, self.shape[1])


def _keys(a, b, before, after, part):
    """Cubic convolution (Keys 1981, a = -1/2) between a and b, from the four values around.

    By differences from a, so that what is constant keeps its bits.
    """
    square, cube = part * part, part * part * part
    near, far = (4 * square - 3 * cube + part) / 2, (cube - square) / 2
    return a + (b - a) * near + (before - a) * (square - (cube + part) / 2) + (after - a) * far


def _between(values, place):
    top = np.minimum(place.astype(np.int64), max(len(values) - 2, 0))
    part = (place - top)[:, None, None]
    bottom = np.minimum(top + 1, len(values) - 1)
    return (values[top] + (values[bottom] - values[top]) * part).astype(np.float32)


def as_colours(rows: np.ndarray) -> mi.Color3f:
    """Return the texels of rows (n, W, 3), flat, as colours."""
    return dr.unravel(mi.Color3f, flat(mi.Float, rows))


def as_image(colour: mi.Color3f, size: int, width: int) -> mi.TensorXf:
    """Arrange the texels of a band as a tensor (size, width, 3)."""
    return mi.TensorXf(dr.ravel(colour), (size, width, 3))
