"""The texels of a map as sampling targets: directions drawn from a texel, and the texels around a direction.

Mitsuba interpolates the map bilinearly, so "texel j" is the tent function around its centre: a texel is
sampled by drawing from that tent, and a direction counts for the four texels whose tents cover it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong


class Grid:
    """The texels of a map of ``height`` x ``width`` as sampling targets, in the world frame of one emitter.

    ``to_world`` (3, 3) rotates the emitter's frame to the world. A texel is chosen with probability mass[row]
    / W, ``mass`` (H,) up to a factor, then a direction in its tent. Densities over the (u, v) square turn
    into densities over solid angle by the jacobian 2 pi^2 sin(theta).
    """

    def __init__(self, height: int, width: int, to_world: np.ndarray, mass: np.ndarray):
        self.shape = height, width
        self.height, self.width = height, width
        self.texels = height * width
        self.to_world = mi.Matrix3f(np.asarray(to_world, dtype=np.float32))
        mass = np.asarray(mass, np.float64) / np.sum(mass)
        area = np.diff(latlong.row_edges(height)) / width  # of a texel in the (u, v) square
        self.mass, self.area = (dr.opaque(mi.Float(x.astype(np.float32))) for x in (mass, area))
        self.cdf = dr.opaque(mi.Float(np.concatenate([[0], np.cumsum(mass)]).astype(np.float32)))
        self.density = dr.opaque(mi.Float((mass / width / area).astype(np.float32)))

    def choose(self, u: mi.Point2f) -> tuple[mi.UInt32, mi.Vector3f, mi.Float, mi.Float, mi.Float]:
        """Choose a texel and a direction in its tent.

        ``u``, uniform in [0, 1)^2, chooses row and column, and what is left of it places the direction.
        Returned are the texel, row * W + column; the direction, a unit vector in the world; the texel's
        probability, and its area in the (u, v) square; and d(solid angle) / d(u, v) at the direction.
        """
        row = dr.binary_search(0, self.height, lambda i: dr.gather(mi.Float, self.cdf, i + 1) <= u.x)
        row = dr.minimum(row, self.height - 1)
        low, mass = dr.gather(mi.Float, self.cdf, row), dr.gather(mi.Float, self.mass, row)
        x = u.y * self.width
        column = dr.minimum(mi.UInt32(x), self.width - 1)
        rest = mi.Point2f(x - column, dr.clip((u.x - low) / mass, 0, 1))
        direction, jacobian = self.direction(row, column, rest)
        area = dr.gather(mi.Float, self.area, row)
        return row * self.width + column, direction, mass / self.width, area, jacobian

    def direction(self, row: mi.UInt32, column: mi.UInt32, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """Return a world direction drawn from the tent of a texel, and d(solid angle) / d(u, v) there."""
        tent_x, tent_y = _tent(u.x), _tent(u.y)
        # The tents of the poles' rows are one-sided.
        north, south = dr.abs(tent_y), -dr.abs(tent_y)
        tent_y = dr.select(row == 0, north, dr.select(row == self.height - 1, south, tent_y))
        phi = dr.two_pi * (mi.Float(column) + 0.5 + tent_x) / self.width
        theta = dr.pi * (mi.Float(row) + tent_y) / max(self.height - 1, 1)
        sin_theta, cos_theta = dr.sincos(theta)
        sin_phi, cos_phi = dr.sincos(phi)
        local = mi.Vector3f(sin_theta * sin_phi, cos_theta, -sin_theta * cos_phi)
        return self.to_world @ local, 2 * dr.pi * dr.pi * dr.maximum(sin_theta, 0)

    def locate(self, direction: mi.Vector3f) -> tuple[list[tuple[mi.UInt32, mi.Float]], mi.Float, mi.Float]:
        """Find the four texels around a world direction, a unit vector, and the weights of Mitsuba's lookup.

        Returned are the texels with their bilinear weights, which add up to 1; the fractional row, 0 ... H -
        1; and d(solid angle) / d(u, v) at the direction.
        """
        d = self.to_world.T @ direction
        x = dr.atan2(d.x, -d.z) * dr.inv_two_pi * self.width - 0.5
        y = self._row(d)
        column = dr.floor(x)
        row = dr.clip(dr.floor(y), 0, max(self.height - 2, 0))
        fx, fy = x - column, y - row
        column = mi.Int32(column)
        left = mi.UInt32(dr.select(column < 0, column + self.width, column)) % self.width
        right = (left + 1) % self.width
        top = mi.UInt32(row) * self.width
        bottom = dr.minimum(mi.UInt32(row) + 1, self.height - 1) * self.width
        taps = [
            (top + left, (1 - fx) * (1 - fy)),
            (top + right, fx * (1 - fy)),
            (bottom + left, (1 - fx) * fy),
            (bottom + right, fx * fy),
        ]
        jacobian = 2 * dr.pi * dr.pi * dr.safe_sqrt(1 - d.y * d.y)
        return taps, y, jacobian

    def _row(self, d):
        return dr.safe_acos(d.y) * dr.inv_pi * (self.height - 1)

    def row_of(self, direction: mi.Vector3f) -> mi.Float:
        """Return the fractional row, 0 ... H - 1, of a world direction."""
        return self._row(self.to_world.T @ direction)

    def locate_one(self, direction: mi.Vector3f, u: mi.Point2f) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Draw one of the four texels around a direction by its weight; returns texel, position, jacobian."""
        taps, position, jacobian = self.locate(direction)
        (top_left, w00), (top_right, w10), (bottom_left, w01), (bottom_right, _) = taps
        top = w00 + w10
        right = u.x < dr.select(top > 0, w10 / top, 0)
        is_top = u.y < top
        # The horizontal share is the same in both rows.
        right = dr.select(top > 0, right, u.x > w01)
        above = dr.select(right, top_right, top_left)
        below = dr.select(right, bottom_right, bottom_left)
        return dr.select(is_top, above, below), position, jacobian

    def density_at(self, position: mi.Float) -> mi.Float:
        """Interpolate the density of sampled directions over (u, v) at a fractional row."""
        row = dr.minimum(mi.UInt32(position), max(self.height - 2, 0))
        below = dr.minimum(row + 1, self.height - 1)
        at_row, at_below = dr.gather(mi.Float, self.density, row), dr.gather(mi.Float, self.density, below)
        return dr.lerp(at_row, at_below, dr.clip(position - row, 0, 1))


def _tent(u):
    """Map a uniform number to an offset in (-1, 1) with the density 1 - |offset|."""
    return dr.select(u < 0.5, dr.sqrt(2 * u) - 1, 1 - dr.safe_sqrt(2 - 2 * u))
