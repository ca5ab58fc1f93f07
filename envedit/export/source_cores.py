"""Cores of a map's lights in the texels of its source: which light a texel belongs to, and how far."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat
from envedit.core.rows import Rows
from envedit.export.texel_maps import Band, Places
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
            self.labelled = self.survey.label >= 0
            self.label = grown(self.survey.label)
        theta = np.pi * np.arange(height) / (height - 1)
        sine = np.sin(theta)
        sine[-1] = 0.0
        phi = 2 * np.pi * (np.arange(width) + 0.5) / width
        self._theta = [flat(mi.Float, t.astype(np.float32)) for t in (sine, np.cos(theta))]
        self._phi = [flat(mi.Float, f(phi).astype(np.float32)) for f in (np.sin, np.cos)]

    def directions(self, band: Band) -> mi.Vector3f:
        """Return the unit vectors through the texels of a band."""
        first = dr.opaque(mi.UInt32, band.start)
        sine, cosine = (dr.gather(mi.Float, t, band.row + first) for t in self._theta)
        x, z = (dr.gather(mi.Float, t, band.column) for t in self._phi)
        return mi.Vector3f(sine * x, cosine, -sine * z)

    def follow(self, band: Band) -> mi.Bool:
        """Say which texels of a band are of rows that follow those above the horizon."""
        return band.row + dr.opaque(mi.UInt32, band.start) >= self._follows

    def any(self, band: Band) -> bool:
        """Say whether a band may have texels of a light."""
        if self.survey is None:
            return False
        near = self.surveyed.row[[band.start, band.stop - 1]]
        return bool((self.label[near[0] : near[1] + 1] >= 0).any())

    def of(self, band: Band, image: mi.Color3f, d: mi.Vector3f) -> tuple[mi.Int32, mi.Float, mi.Color3f]:
        """Return of a band's texels at directions ``d``: light, or -1; how far inside it, 0 to 1; core."""
        at = self.surveyed
        label = self.label[at.row[band.rows]].astype(np.int32)
        light = at.nearest(mi.Int32, band, flat(mi.Int32, label))
        inside, outside = (at.inside(band, mask) for mask in (self.labelled, ~self.labelled))
        below = at.linear(mi.Color3f, band, self.survey.below)
        if self.lights.glowing:
            below *= self.lights.glow_before(d)
        light = dr.select(self.follow(band), -1, light)
        core = dr.select(light >= 0, dr.maximum(image - below, 0) * (1 - outside), 0)
        return light, inside, core
