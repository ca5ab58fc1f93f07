"""Where the texels of a large map lie among those of a coarser one, and the bands in which it is worked on.

A band is some rows of the large map. What is known at the coarser map's texels is interpolated along the rows
on the host, where it is small, and across the columns on the device; what is smooth by cubic convolution
(Keys 1981, a = -1/2), as texels of the coarser map would show as bars with linear interpolation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat
from envedit.core.rows import Rows
from envedit.core.types import DrArray

BAND_TEXELS = 1 << 21
"""Texels of the source that are worked on at a time."""


class Band:
    """Some rows of a source, which are worked on at a time."""

    def __init__(self, start: int, stop: int, fresh: int, width: int):
        self.start = start
        self.stop = stop
        self.fresh = fresh  # the first row that is not in an earlier band
        self.rows = slice(start, stop)
        self.shape = stop - start, width
        # Of every texel, row after row; rows count from ``start``.
        index = dr.arange(mi.UInt32, self.shape[0] * width)
        self.row = index // dr.opaque(mi.UInt32, width)
        self.column = index - self.row * dr.opaque(mi.UInt32, width)

    def colours(self, source: np.ndarray) -> mi.Color3f:
        """Return the texels of the band's rows (size, W, 3), flat, as colours."""
        return dr.unravel(mi.Color3f, flat(mi.Float, source))

    def image(self, colour: mi.Color3f) -> mi.TensorXf:
        """Arrange the texels of the band as a tensor (size, W, 3)."""
        return mi.TensorXf(dr.ravel(colour), (*self.shape, 3))


class Places:
    """Where the texels of a source of a ``shape`` lie among ``rows`` of a coarser map of so many columns."""

    def __init__(self, shape: tuple[int, int], rows: Rows, columns: int):
        self.shape = shape
        self.rows = rows
        self.count = rows.count
        self.columns = columns
        height, width = shape

        # ---- Row of the coarser image with its fraction, the nearest, and the source's rows that have one
        self.place = np.arange(height) * ((rows.total - 1) / (height - 1)) - rows.first
        nearest = np.rint(self.place)
        self.row = np.clip(nearest, 0, self.count - 1).astype(np.int64)
        inside = np.flatnonzero((nearest >= 0) & (nearest < self.count))
        self.start, self.stop = (int(inside[0]), int(inside[-1]) + 1) if len(inside) else (0, 0)

        # ---- The nearest column, its two borders, the four around, and the parts of a column beyond the left
        across = (np.arange(width) + 0.5) * (columns / width)
        self.column = np.minimum(across.astype(np.int64), columns - 1)
        self._borders = [flat(mi.UInt32, (self.column + step).astype(np.uint32)) for step in (0, 1)]
        self._beyond_border = flat(mi.Float, (across - self.column).astype(np.float32))
        left = np.floor(across - 0.5)
        around = [(left + step) % columns for step in (0, 1, -1, 2)]
        self._around = [flat(mi.UInt32, column.astype(np.uint32)) for column in around]
        self._beyond_left = flat(mi.Float, (across - 0.5 - left).astype(np.float32))

    def bands(self) -> Iterator[Band]:
        """Yield bands of one size over start to stop."""
        height = self.stop - self.start
        size = min(max(BAND_TEXELS // self.shape[1], 1), height)
        for fresh in range(self.start, self.stop, max(size, 1)):
            start = min(fresh, self.stop - size)
            yield Band(start, start + size, fresh, self.shape[1])

    def composed(self, source: np.ndarray, of_band: Callable[[Band, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return a source (H, W, 3) with each band (size, W, 3) as a function makes it of the band."""
        result = source.copy()
        for band in self.bands():
            changed = of_band(band, source[band.rows])
            result[band.fresh : band.stop] = changed[band.fresh - band.start :]
        return result

    def linear(self, kind: type[DrArray], band: Band, values: np.ndarray) -> DrArray:
        """Interpolate values (rows, w, C) linearly at the texels of a band; ``kind`` has C components."""
        place = np.clip(self.place[band.rows], 0, self.count - 1)
        return self._across(kind, band, _between(values, place), self._around[:2], self._beyond_left)

    def inside(self, band: Band, mask: np.ndarray) -> mi.Float:
        """Interpolate a mask (rows, w) by its corners: 0 wherever a texel is not in it."""
        around = np.pad(mask, ((1, 1), (0, 0)), mode="edge")
        across = around & np.roll(around, 1, axis=1)
        corners = across[:-1] & across[1:]
        corners = np.concatenate([corners, corners[:, :1]], axis=1).astype(np.float64)
        place = np.clip(self.place[band.rows] + 0.5, 0, self.count)
        rows = _between(corners[..., None], place)
        return self._across(mi.Float, band, rows, self._borders, self._beyond_border)

    def _across(self, kind, band, rows, index, part):
        """Interpolate along the columns values (size, columns, C) that are those of the band's rows."""
        table = flat(mi.Float, rows)
        first = band.row * dr.opaque(mi.UInt32, rows.shape[1])
        a, b = (dr.gather(kind, table, first + dr.gather(mi.UInt32, side, band.column)) for side in index)
        return a + (b - a) * dr.gather(mi.Float, part, band.column)

    def smooth(self, band: Band, values: np.ndarray, edge: int | None = None) -> mi.Color3f:
        """Interpolate values (rows, w, 3) by cubic convolution at the texels of a band.

        Nothing is interpolated across the edge before row ``edge`` of the values.
        """
        # ---- Along the rows
        place = self.place[band.rows]
        first, last = np.zeros(len(place), np.int64), np.full(len(place), self.count - 1)
        if edge is not None:
            above = place < edge - 0.5
            first, last = np.where(above, 0, edge), np.where(above, edge - 1, last)
        place = np.clip(place, first, last)
        top = np.floor(place).astype(np.int64)
        a, b, before, after = (values[np.clip(top + step, first, last)] for step in (0, 1, -1, 2))
        rows = _keys(a, b, before, after, (place - top)[:, None, None]).astype(np.float32)

        # ---- Along the columns
        table = flat(mi.Float, rows)
        begin = band.row * dr.opaque(mi.UInt32, self.columns)
        offsets = (dr.gather(mi.UInt32, index, band.column) for index in self._around)
        a, b, before, after = (dr.gather(mi.Color3f, table, begin + offset) for offset in offsets)
        return _keys(a, b, before, after, dr.gather(mi.Float, self._beyond_left, band.column))

    def nearest(self, kind: type[DrArray], band: Band, table: DrArray) -> DrArray:
        """Look up a table (size, w), of the band's rows, at its texels."""
        place = band.row * dr.opaque(mi.UInt32, self.columns)
        return dr.gather(kind, table, place + dr.gather(mi.UInt32, self._borders[0], band.column))

    def beside(self, band: Band) -> mi.Float:
        """Columns from the nearest, -1/2 to 1/2."""
        return dr.gather(mi.Float, self._beyond_border, band.column) - 0.5


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
