"""Lights that have moved, at the resolution of a source: their points, shared out among its texels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat
from envedit.export.texel_maps import Places
from envedit.representations.layers import lights
from envedit.representations.layers.layers import Layers

POINTS_AT_ONCE = 1 << 20
"""Texels of a light that are moved at a time."""


@dataclass(frozen=True)
class _Points:
    """Points of one light, placed; ``omega`` is the solid angle of each, None of an added light's."""

    light: int
    places: tuple
    flux: mi.Color3f
    omega: mi.Color3f | None
    half_row: float
    first: int
    last: int


class MovedLights:
    """The points of lights that have moved or were added.

    Parameters
    ----------
    layers : Layers
        Of the working map.
    shape : (int, int)
        Rows and columns of the source.
    turn, flux, size : ndarray (lights, 3), (lights, 3), (lights, 1)
        Where and how large the lights are, as of :class:`.Lights`: rotation vectors, logarithms.
    """

    def __init__(
        self, layers: Layers, shape: tuple[int, int], turn: np.ndarray, flux: np.ndarray, size: np.ndarray
    ):
        self.layers, (self.height, self.width) = layers, shape
        self.turn, self.flux, self.size = turn, flux, size
        self.points: list[_Points] = []
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
            self._place_some(light, row[part], column[part], flux[part], omega[row[part]])

    def _place_some(self, light, row, column, flux, omega):
        if len(row) == 1:  # a single one would be a scalar, and another kernel
            row, column, flux, omega = (np.repeat(v, 2, axis=0) for v in (row, column, flux / 2, omega / 2))
        d = lights.points(row, column, self.height, self.width)
        sine = np.sin(np.pi * row / max(self.height - 1, 1))
        size = float(lights.size_factor(self.size[light, 0]))
        self._place(light, d, flux, sine, 1.0, max(1.0, size), omega * size**2)

    def place_lobe(self, light: int) -> None:
        """Place the points of a light that was added."""
        d, weight, spacing = lights.lobe()
        total, width = self.layers.rows[1], self.layers.shape[1]
        sine = np.full(len(d), spacing / (2 * np.pi / width))
        half_row = max(1.0, (self.height - 1) / max(total - 1, 1))
        flux = weight[:, None] * self.layers.lights.flux[light]
        self._place(light, d, flux, sine, self.width / width, half_row)

    def _place(self, light, d, flux, sine, finer, half_row, omega=None):
        def vector(v):
            return dr.opaque(mi.Vector3f(*(float(x) for x in v)))

        scale = lights.flux_factor(self.flux[light])
        point = mi.Vector3f(*(flat(mi.Float, v) for v in d.T.astype(np.float32)))
        flux = mi.Color3f(*(flat(mi.Float, v) for v in (flux * scale).T.astype(np.float32)))
        size = dr.opaque(mi.Float, float(lights.size_factor(self.size[light, 0])))
        centre, turn = vector(self.layers.lights.centres[light]), vector(self.turn[light])
        sine = flat(mi.Float, sine.astype(np.float32))
        places = lights.placed(point, centre, turn, size, sine, finer, (self.height, self.width))
        dr.eval(places)
        row = places[0].numpy()
        first, last = int(np.floor(row.min() - half_row)), int(np.ceil(row.max() + half_row))
        if omega is not None:
            omega = mi.Color3f(flat(mi.Float, omega.astype(np.float32)))
        self.points.append(_Points(int(light), places, flux, omega, half_row, first, last))

    def level(self, grid: Places) -> None:
        """Find what makes up for the flux that dividing by the density takes or gives."""
        flux = {p.light: np.zeros((2, 3)) for p in self.points}
        omega = latlong.lookup_solid_angles(self.height, self.width)
        for start, fresh, size in grid.bands():
            for light in self._reaching(start, size):
                total, density = self._shared_out(light, start, size)
                for k, image in enumerate((total, total / density)):
                    rows = image.numpy()[fresh - start :].sum(axis=1, dtype=np.float64)
                    flux[light][k] += omega[fresh : start + size] @ rows
        for light, (wanted, got) in flux.items():
            self._level[light] = np.where(got > 0, wanted / np.maximum(got, 1e-300), 1).astype(np.float32)

    def radiance(self, start: int, size: int) -> Iterator[mi.TensorXf]:
        """Yield the radiance (size, W, 3) of each light that reaches the band of rows from ``start``."""
        for light in self._reaching(start, size):
            # Points on a turned grid lie closer here and farther there: a pattern of fine stripes, otherwise.
            total, density = self._shared_out(light, start, size)
            level = flat(mi.Float, self._level[light])
            yield total / density * dr.reshape(mi.TensorXf(level), (1, 1, 3))

    def _reaching(self, start, size):
        return sorted({p.light for p in self.points if p.first < start + size and p.last >= start})

    def _shared_out(self, light, start, size):
        """Share out the points of a light in a band: radiance, and its density, which should be 1."""
        total, density = 0, None
        for p in self.points:
            if p.light == light and p.first < start + size and p.last >= start:
                (row, column, half), shape, rows = p.places, (size, self.width), (start, self.height)
                total += lights.shared_out(row, column, half, p.flux, p.half_row, shape, rows)
                if p.omega is not None:
                    part = lights.shared_out(row, column, half, p.omega, p.half_row, shape, rows)
                    density = part if density is None else density + part
        return total, 1 if density is None else dr.clip(density, 0.5, 2)
