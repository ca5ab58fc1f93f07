"""Lights at the resolution of a source: cores where they were, points and lobes where they have gone.

A light that has moved is the points of its core, shared out among the source's texels; one that was added is
a lobe.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat, vectors
from envedit.core.rotations import rotated
from envedit.core.rows import Rows
from envedit.export.texel_maps import Band, Places
from envedit.representations.layers import lights
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.separation import grown

NARROWEST = 0.6
"""Least radius of an added light in texels: one that is narrower would vanish between them."""
LEAST_LUMINANCE = 1e-30
"""Least luminance of a texel that its core's is divided by. Derived: finite where both are 0."""
REACH = 6.0
"""Radii at which an added light ends, at 1e-8 of its peak."""


class SourceCores:
    """Cores in the texels of a source, band by band, by the survey of the layers of its working map.

    ``grid`` has the source's texels in the working map; rows from ``edge`` on, if any, follow those above the
    horizon, and have no lights.
    """

    def __init__(self, layers: Layers, grid: Places, edge: int | None):
        self.lights: lights.Lights = layers.lights
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

    def of(
        self, band: Band, image: mi.Color3f, d: mi.Vector3f
    ) -> tuple[mi.Int32, mi.Float, mi.Color3f, mi.Color3f]:
        """Return of texels of a band at directions ``d``: light or -1, share in it, core, what it hides."""
        at = self.surveyed
        label = self.label[at.row[band.rows]].astype(np.int32)
        light = at.nearest(mi.Int32, band, flat(mi.Int32, label))
        inside, outside = (at.inside(band, mask) for mask in (self.labelled, ~self.labelled))
        below = at.linear(mi.Color3f, band, self.survey.below)
        if self.lights.glowing:
            below *= self.lights.glow_before(d)
        light = dr.select(self.follow(band), -1, light)
        above_sky = dr.select(light >= 0, (image - below) * (1 - outside), 0)
        core = dr.maximum(above_sky, 0)
        of_core = mi.luminance(core) / dr.maximum(mi.luminance(image), LEAST_LUMINANCE)
        return light, inside, core, of_core * dr.maximum(-above_sky, 0)


# ---- Lights that have moved or were added ------------------------------------------------------------------


@dataclass(frozen=True)
class _Points:
    """The points of a light, placed; ``omega`` is the solid angle of each, ``rows`` are those they reach."""

    places: tuple[mi.Float, mi.Float, mi.Float]
    flux: mi.Color3f
    omega: mi.Color3f
    half_row: float
    rows: tuple[int, int]


class MovedLights:
    """The points of lights, of the layers of a working map, that have moved or were added, in its source.

    ``turn`` and ``flux`` (lights, 3) and ``size`` (lights, 1) are where and how large the lights are, as of
    :class:`.Lights`: rotation vectors, logarithms.
    """

    def __init__(
        self, layers: Layers, shape: tuple[int, int], turn: np.ndarray, flux: np.ndarray, size: np.ndarray
    ):
        self.layers, (self.height, self.width) = layers, shape
        self.turn, self.flux, self.size = turn, flux, size
        self.points: dict[int, _Points] = {}
        self.lobes: list[tuple[mi.Vector3f, float, mi.Color3f]] = []
        self._level: dict[int, np.ndarray] = {}

    def place_texels(
        self, light: int, row: np.ndarray, column: np.ndarray, radiance: np.ndarray, share: np.ndarray
    ) -> None:
        """Place texels (n,) of the source with the radiance (n, 3) of a light's core in them.

        ``share`` (n,) in [0, 1] falls off at the border of the core, which keeps its flux.
        """
        # ---- Flux and solid angle of each point
        omega = latlong.lookup_solid_angles(self.height, self.width)[row]
        flux = np.float64(radiance) * omega[:, None]
        soft = flux * share[:, None]
        kept = soft.sum(axis=0)
        flux = soft * np.divide(flux.sum(axis=0), kept, out=np.ones(3), where=kept > 0)
        if len(row) == 1:  # a single one would be a scalar, and another kernel
            row, column, flux, omega = (np.repeat(v, 2, axis=0) for v in (row, column, flux / 2, omega / 2))

        # ---- Where they go
        factor = float(lights.size_factor(self.size[light, 0]))
        point = vectors(mi.Vector3f, lights.points(row, column, self.height, self.width))
        size = dr.opaque(mi.Float, factor)
        centre = vectors(mi.Vector3f, self.layers.lights.centres[light])
        turn = vectors(mi.Vector3f, self.turn[light])
        sine = flat(mi.Float, np.sin(np.pi * row / (self.height - 1)).astype(np.float32)) * size
        places = lights.placed(point, centre, turn, size, sine, (self.height, self.width))
        dr.eval(places)
        half_row = max(1.0, factor)
        reach = places[0].numpy()
        self.points[light] = _Points(
            places,
            vectors(mi.Color3f, flux * lights.flux_factor(self.flux[light])),
            mi.Color3f(flat(mi.Float, (omega * factor**2).astype(np.float32))),
            half_row,
            (int(np.floor(reach.min() - half_row)), int(np.ceil(reach.max() + half_row))),
        )

    def place_lobe(self, light: int) -> None:
        """Place a light that was added: radiance that falls off as a Gaussian of the angle."""
        own = self.layers.lights
        centre = rotated(own.centres[light], self.turn[light])
        radius = float(lights.size_factor(self.size[light, 0])) * math.radians(lights.LOBE_DEGREES)
        radius = math.hypot(radius, NARROWEST * np.pi / (self.height - 1))

        # ---- Its sum over the texels
        omega = latlong.lookup_solid_angles(self.height, self.width)
        middle, _ = latlong.texel_position(centre, self.height, self.width)
        reach = REACH * radius / np.pi * self.height
        total = 0.0
        for row in range(max(int(middle - reach), 0), min(int(middle + reach) + 2, self.height)):
            d = latlong.directions(self.height, self.width, slice(row, row + 1))
            angle = np.linalg.norm(d - centre, axis=-1) / radius
            total += omega[row] * float(_lobe(angle, np).sum())

        flux = own.flux[light] * lights.flux_factor(self.flux[light])
        self.lobes.append((vectors(mi.Vector3f, centre), radius, vectors(mi.Color3f, flux / total)))

    def lobes_at(self, d: mi.Vector3f) -> Iterator[mi.Color3f]:
        """Yield the radiance of each light that was added, at directions."""
        for centre, radius, peak in self.lobes:
            yield peak * _lobe(dr.norm(d - centre) * dr.opaque(mi.Float, 1 / radius), dr)

    def level(self, grid: Places) -> None:
        """Find what makes up for the flux that dividing by the density takes or gives."""
        flux = {light: np.zeros((2, 3)) for light in self.points}
        omega = latlong.lookup_solid_angles(self.height, self.width)
        for band in grid.bands():
            for light, total, density in self._shared_out(band):
                for k, image in enumerate((total, total / density)):
                    rows = image.numpy()[band.fresh - band.start :].sum(axis=1, dtype=np.float64)
                    flux[light][k] += omega[band.fresh : band.stop] @ rows
        for light, (target, got) in flux.items():
            self._level[light] = np.where(got > 0, target / np.maximum(got, 1e-300), 1).astype(np.float32)

    def radiance(self, band: Band) -> Iterator[mi.TensorXf]:
        """Yield the radiance (size, W, 3) of each light that reaches a band."""
        for light, total, density in self._shared_out(band):
            # Points on a turned grid lie closer here and farther there: a pattern of fine stripes, otherwise.
            level = flat(mi.Float, self._level[light])
            yield total / density * dr.reshape(mi.TensorXf(level), (1, 1, 3))

    def _shared_out(self, band):
        """Yield of each light that reaches a band its radiance there, and its density, which should be 1."""
        rows = band.start, self.height
        for light, p in sorted(self.points.items()):
            if p.rows[0] < band.stop and p.rows[1] >= band.start:
                total, density = (
                    lights.shared_out(*p.places, v, p.half_row, band.shape, rows) for v in (p.flux, p.omega)
                )
                yield light, total, dr.clip(density, 0.5, 2)


def _lobe(angle, library):
    """Return a Gaussian of an angle in radii, in numpy or in Dr.Jit."""
    where = np.where if library is np else dr.select
    return where(angle < REACH, library.exp(-0.5 * library.square(angle)), 0)
