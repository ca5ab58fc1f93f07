"""Lights at the resolution of a source.

Those that have moved are points, shared out among its texels; those that were added are lobes.
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
from envedit.export.texel_maps import Band, Places
from envedit.representations.layers import lights
from envedit.representations.layers.layers import Layers

POINTS_AT_ONCE = 1 << 20
"""Texels of a light that are moved at a time."""
NARROWEST = 0.6
"""Least radius of an added light in texels: one that is narrower would vanish between them."""
REACH = 6.0
"""Radii at which an added light ends, at 1e-8 of its peak."""


@dataclass(frozen=True)
class _Points:
    """Points of one light, placed; ``omega`` is the solid angle of each."""

    light: int
    places: tuple[mi.Float, mi.Float, mi.Float]
    flux: mi.Color3f
    omega: mi.Color3f
    half_row: float
    first: int
    last: int


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
        self.points: list[_Points] = []
        self.lobes: list[tuple[mi.Vector3f, float, mi.Color3f]] = []
        self._level: dict[int, np.ndarray] = {}

    def place_texels(
        self, light: int, row: np.ndarray, column: np.ndarray, radiance: np.ndarray, share: np.ndarray
    ) -> None:
        """Place texels (n,) of the source with the radiance (n, 3) of a light's core in them.

        ``share`` (n,) in [0, 1] falls off at the border of the core, which keeps its flux.
        """
        omega = latlong.lookup_solid_angles(self.height, self.width)
        flux = np.float64(radiance) * omega[row][:, None]
        soft = flux * share[:, None]
        kept = soft.sum(axis=0)
        flux = soft * np.divide(flux.sum(axis=0), kept, out=np.ones(3), where=kept > 0)
        for k in range(0, len(row), POINTS_AT_ONCE):
            part = slice(k, k + POINTS_AT_ONCE)
            self._place(light, row[part], column[part], flux[part], omega[row[part]])

    def _place(self, light, row, column, flux, omega):
        if len(row) == 1:  # a single one would be a scalar, and another kernel
            row, column, flux, omega = (np.repeat(v, 2, axis=0) for v in (row, column, flux / 2, omega / 2))
        factor = float(lights.size_factor(self.size[light, 0]))
        half_row = max(1.0, factor)
        flux = flux * lights.flux_factor(self.flux[light])
        point = vectors(mi.Vector3f, lights.points(row, column, self.height, self.width))
        size = dr.opaque(mi.Float, factor)
        centre = vectors(mi.Vector3f, self.layers.lights.centres[light])
        turn = vectors(mi.Vector3f, self.turn[light])
        sine = flat(mi.Float, np.sin(np.pi * row / (self.height - 1)).astype(np.float32)) * size
        places = lights.placed(point, centre, turn, size, sine, (self.height, self.width))
        dr.eval(places)
        reach = places[0].numpy()
        first, last = int(np.floor(reach.min() - half_row)), int(np.ceil(reach.max() + half_row))
        omega = mi.Color3f(flat(mi.Float, (omega * factor**2).astype(np.float32)))
        flux = vectors(mi.Color3f, flux)
        self.points.append(_Points(int(light), places, flux, omega, half_row, first, last))

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
        flux = {p.light: np.zeros((2, 3)) for p in self.points}
        omega = latlong.lookup_solid_angles(self.height, self.width)
        for band in grid.bands():
            for light in self._reaching(band):
                total, density = self._shared_out(light, band)
                for k, image in enumerate((total, total / density)):
                    rows = image.numpy()[band.fresh - band.start :].sum(axis=1, dtype=np.float64)
                    flux[light][k] += omega[band.fresh : band.stop] @ rows
        for light, (target, got) in flux.items():
            self._level[light] = np.where(got > 0, target / np.maximum(got, 1e-300), 1).astype(np.float32)

    def radiance(self, band: Band) -> Iterator[mi.TensorXf]:
        """Yield the radiance (size, W, 3) of each light that reaches a band."""
        for light in self._reaching(band):
            # Points on a turned grid lie closer here and farther there: a pattern of fine stripes, otherwise.
            total, density = self._shared_out(light, band)
            level = flat(mi.Float, self._level[light])
            yield total / density * dr.reshape(mi.TensorXf(level), (1, 1, 3))

    def _reaching(self, band):
        return sorted({p.light for p in self.points if p.first < band.stop and p.last >= band.start})

    def _shared_out(self, light, band):
        """Share out the points of a light in a band: radiance, and its density, which should be 1."""
        total, density = 0, 0
        rows = band.start, self.height
        for p in self.points:
            if p.light == light and p.first < band.stop and p.last >= band.start:
                total += lights.shared_out(*p.places, p.flux, p.half_row, band.shape, rows)
                density += lights.shared_out(*p.places, p.omega, p.half_row, band.shape, rows)
        return total, dr.clip(density, 0.5, 2)


def _lobe(angle, library):
    """Return a Gaussian of an angle in radii, in numpy or in Dr.Jit."""
    where = np.where if library is np else dr.select
    return where(angle < REACH, library.exp(-0.5 * library.square(angle)), 0)
