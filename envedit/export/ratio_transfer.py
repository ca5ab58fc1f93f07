"""What was done to a working map, done to its source: for edits of which nothing else is known.

Per channel, with W_0 and W the working map before and after, the source S becomes

* S W / W_0 where the radiance of a texel and its neighbours at least halves and at most doubles,
* S + (W - W_0) where one at least quadruples: a new light,
* W where one falls to a quarter: the source's detail is of a light that is gone, and would be its ghost,

and a mixture between. The ratio is interpolated; the others are linear within each working texel, with its
value as their mean. Then the ratio is corrected until the means agree, at last texel by texel.

Every source texel that overlaps an unchanged working texel has the bits of the source. The mean of every
changed one (:func:`.latlong.resize` of the result) differs from W by at most 1 % of the brightest of it and
its neighbours, if the source is at least four times as wide; one that touches an unchanged texel cannot be
darkened where a source texel lies in both. The source is larger than the working map.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat
from envedit.core.resampling import smooth_step
from envedit.export.texel_maps import Band, Places

MODERATE = 4.0
"""Largest ratio by which a texel of the source is scaled."""
TOLERANCE = 0.005
"""Of the means of working texels, relative to their radiance."""
LEAST = 1e-3
"""Radiance, relative to the mean of the edited map, that the tolerance is relative to at least."""
ROUNDS = 3, 3
"""Most corrections of the means: of what is interpolated, and of working texels one by one."""


class Ratio:
    """What was done to a working map, applied to its source."""

    def __init__(self, original: np.ndarray, edited: np.ndarray, free: np.ndarray | None, grid: Places):
        self.grid = grid
        rows = grid.rows.slice
        self.old, self.want = (np.asarray(e, np.float64)[rows] for e in (original, edited))
        self.changed = (np.asarray(original)[rows] != np.asarray(edited)[rows]).any(axis=2)
        if free is not None:
            self.changed &= free
        self._overlaps(np.shape(edited)[:2])
        with np.errstate(divide="ignore", over="ignore"):
            ratio = np.where(
                self.old > 0, self.want / np.maximum(self.old, 1e-30), 1 + 1e30 * (self.want > 0)
            )
        ratio = np.where(self.changed[..., None], ratio, 1.0)
        self.m = np.minimum(ratio, MODERATE)
        darker = _most_around(-np.log2(np.maximum(ratio.min(axis=2), 1e-30)))
        brighter = _most_around(np.log2(np.maximum(ratio.max(axis=2), 1e-30)))
        replaced, added = smooth_step(darker - 1), smooth_step(brighter - 1)
        self.parts = np.stack([replaced, added * (1 - replaced)], axis=2)
        self.replacement = _Linear(np.where(self.changed[..., None], self.want, self.old))
        self.more = _Linear(np.where(self.changed[..., None], self.want - self.old, 0))
        self.fix = np.ones(self.m.shape), np.zeros(self.m.shape)
        self.fixed = False

    def _overlaps(self, whole):
        """Find the first and the last working row and column that each of the source's overlaps."""
        (height, width), (total, columns) = self.grid.shape, whole
        # As latlong.row_edges has them, in rows of the working map.
        edges = np.clip((np.arange(height + 1) - 0.5) * ((total - 1) / (height - 1)), 0, total - 1)
        edges -= self.grid.rows.first
        few = height < 2 * total
        low, high = np.floor(edges[:-1] + 0.5 + 1e-9), np.ceil(edges[1:] - 0.5 - 1e-9)
        self.rows = [np.asarray(self.grid.row if few else v, np.int64) for v in (low, high)]
        across = np.arange(width + 1) * (columns / width)
        few = width < 2 * columns
        low, high = np.floor(across[:-1] + 1e-9), np.ceil(across[1:] - 1e-9) - 1
        self.columns = [np.asarray(self.grid.column if few else v, np.int64) for v in (low, high)]

    def correct(self, source: np.ndarray) -> None:
        """Correct m and a until the means of the changed working texels are the edited map's."""
        if not self.changed.any():
            return
        least = LEAST * float(self.want.mean())
        for step in range(sum(ROUNDS)):
            composed = self.grid.composed(source, self.band)
            mean = latlong.resize(composed, self.grid.rows.total, self.grid.columns)[self.grid.rows.slice]
            off = np.abs(mean - self.want) > TOLERANCE * np.maximum(self.want, least)
            off &= self.changed[..., None]
            if not off.any():
                return
            ratio = np.where(mean > 0, self.want / np.maximum(mean, 1e-30), np.inf)
            scaled = ratio <= 2
            m = np.where(off & scaled, ratio, 1.0)
            a = np.where(off & ~scaled, self.want - mean, 0.0)
            if step < ROUNDS[0]:
                self.m = self.m * m
            else:
                self.fix = (self.fix[0] * m, self.fix[1] * m + a)
                self.fixed = True

    def band(self, band: Band, source: np.ndarray) -> np.ndarray:
        """Compose the rows of a band, which are ``source``."""
        # ---- Texels of the band whose working texel changes
        low, high = (r[band.rows] for r in self.rows)
        inside = (low >= 0) & (high < len(self.changed))
        low, high = (np.clip(r, 0, len(self.changed) - 1) for r in (low, high))
        changed = self.changed[low] & self.changed[high] & inside[:, None]
        changed = changed[:, self.columns[0]] & changed[:, self.columns[1]]
        if not changed.any():
            return source

        # ---- Texels times m; where that is no moderate factor, replaced or added to
        grid = self.grid
        near = grid.row[band.rows]
        image = band.colours(source)
        composed = image * grid.linear(mi.Color3f, band, self.m)
        if self.parts[max(near[0] - 1, 0) : near[-1] + 2].any():  # rows between which is interpolated
            replaced, added = grid.linear(mi.Vector2f, band, self.parts)

            def linear(field):
                tables = field.along_rows((low, high), grid.place[band.rows])
                mean, slope = (grid.nearest(mi.Color3f, band, flat(mi.Float, table)) for table in tables)
                return mean + slope * grid.beside(band)

            additions = (image + linear(self.more) - composed) * added
            replacements = (linear(self.replacement) - composed) * replaced
            composed = dr.maximum(composed + (additions + replacements), 0)
        if self.fixed:
            tables = (fix[near].astype(np.float32) for fix in self.fix)
            factor, offset = (grid.nearest(mi.Color3f, band, flat(mi.Float, table)) for table in tables)
            composed = composed * factor + offset
        composed = dr.select(flat(mi.Bool, changed), composed, image)
        return band.image(composed).numpy()


def _most_around(values):
    """Most of each texel (rows, w) and its 8 neighbours, columns periodic."""
    padded = np.pad(values, ((1, 1), (0, 0)), mode="edge")
    down = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.maximum(np.maximum(np.roll(down, 1, axis=1), down), np.roll(down, -1, axis=1))


class _Linear:
    """A field that is linear within every texel, with the texel's value as its mean and no new extremes.

    The slope is the mean of the differences to both sides, at most twice the smaller one, 0 at an extreme
    (van Leer 1977): where a texel is a thousand times as bright as the next, nothing leaks.
    """

    def __init__(self, values):
        self.value = values
        padded = np.pad(values, ((1, 1), (0, 0), (0, 0)), mode="edge")
        self.down = self._slope(values - padded[:-2], padded[2:] - values)
        self.over = self._slope(values - np.roll(values, 1, axis=1), np.roll(values, -1, axis=1) - values)
        # In a corner both add up: it keeps a tenth of the mean, or it would be a black dot.
        steep = np.abs(self.down) + np.abs(self.over)
        held = np.minimum(1.8 * np.abs(values) / np.maximum(steep, 1e-30), 1)
        self.down, self.over = self.down * held, self.over * held

    def along_rows(self, rows, place):
        """Mean and slope to the right, (R, w, 3) each, at rows of a finer image.

        ``rows`` are the first and the last row that each overlaps: one that lies in two takes the lesser of
        both, so that the light of a bright one is not counted for a dark one.
        """
        means = [self.value[r] + self.down[r] * np.clip(place - r, -0.5, 0.5)[:, None, None] for r in rows]
        slopes = [self.over[r] for r in rows]
        return [_lesser(*both).astype(np.float32) for both in (means, slopes)]

    @staticmethod
    def _slope(a, b):
        size = np.minimum(np.minimum(np.abs(a), np.abs(b)) * 2, np.abs(a + b) / 2)
        return np.where(a * b > 0, np.sign(a) * size, 0.0)


def _lesser(a, b):
    """Return the one nearer to 0 of two of one sign, else 0."""
    return np.where(a * b > 0, np.where(np.abs(a) < np.abs(b), a, b), 0.0)
