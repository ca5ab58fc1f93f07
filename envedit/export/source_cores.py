"""Cores of a map's lights in the texels of its source: which light a texel belongs to, and how far."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat
from envedit.core.rows import Rows
from envedit.export.texel_maps import Places
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import Lights
from envedit.representations.layers.separation import grown


class SourceCores:
    """Cores in the texels of a source, band by band, by the survey of the layers of its working map.

    ``grid`` has the source's texels in the working map; rows from ``edge`` on, if any, follow those above the
    horizon, and have no lights.
    """

    def __init__(self, layers: Layers, grid: Places, edge: int | None):
        self.lights: Lights = layers.lights
        height, width = grid.shape
        above = np.full(height, True) if edge is None else grid.place < edge - 0.5
        self._follows = dr.opaque(mi.UInt32, int(above.sum()))
        self.survey = layers.separation.survey
        if self.survey is not None:
            start, total = self.survey.rows
            rows, columns = self.survey.label.shape
            self.surveyed = Places(grid.shape, Rows(start, rows, total), columns)
            self.inside = self.survey.label >= 0
            self.label = grown(self.survey.label)
        theta = np.pi * np.arange(height) / max(height - 1, 1)
        sine = np.sin(theta)
        sine[-1] = 0.0 if height > 1 else 1.0
        phi = 2 * np.pi * (np.arange(width) + 0.5) / width
        self._theta = [flat(mi.Float, t.astype(np.float32)) for t in (sine, np.cos(theta))]
        self._phi = [flat(mi.Float, f(phi).astype(np.float32)) for f in (np.sin, np.cos)]

    def directions(self, start: int, row: mi.UInt32, column: mi.UInt32) -> mi.Vector3f:
        """Return the unit vectors through the texels of a band that begins at row ``start``."""
        first = dr.opaque(mi.UInt32, start)
        sine, cosine = (dr.gather(mi.Float, t, row + first) for t in self._theta)
        x, z = (dr.gather(mi.Float, t, column) for t in self._phi)
        return mi.Vector3f(sine * x, cosine, -sine * z)

    def follow(self, start: int, row: mi.UInt32) -> mi.Bool:
        """Say which texels of a band are of rows that follow those above the horizon."""
        return row + dr.opaque(mi.UInt32, start) >= self._follows

    def any(self, start: int, size: int) -> bool:
        """Say whether a band may have texels of a light."""
        if self.survey is None:
            return False
        near = self.surveyed.row[[start, start + size - 1]]
        return bool((self.label[near[0] : near[1] + 1] >= 0).any())

    def of(
        self, image: mi.Color3f, row: mi.UInt32, column: mi.UInt32, d: mi.Vector3f, start: int, size: int
    ) -> tuple[mi.Int32, mi.Float, mi.Color3f]:
        """Return of texels at directions ``d``: light, or -1; how far inside it, 0 to 1; core in them."""
        at = self.surveyed
        survey = self.survey
        label = self.label[at.row[start : start + size]].astype(np.int32)
        light = at.nearest(mi.Int32, flat(mi.Int32, label), row, column)
        share = [
            at.across(mi.Float, flat(mi.Float, at.inner(mask, start, size)), row, column, corners=True)
            for mask in (self.inside, ~self.inside)
        ]
        table = flat(mi.Float, at.along_rows(survey.below, start, size))
        below = at.across(mi.Color3f, table, row, column)
        if self.lights.glowing:
            below *= self.lights.glow_before(d)
        light = dr.select(self.follow(start, row), -1, light)
        core = dr.select(light >= 0, dr.maximum(image - below, 0) * (1 - share[1]), 0)
        return light, share[0], core
