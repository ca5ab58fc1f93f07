"""Lights that move on the sphere: their texels are rotated, differentiably.

A light is a set of points, each a direction with a flux. A rotation, a size and a flux per channel place it;
then every point is shared out among the texels around it. A point's share of a texel is the tent of
Mitsuba's own interpolation: in rows one row wide to either side, in columns one column, or as wide as the
texel that the point came from where columns lie closer. A point that has not moved falls into its own texel,
all of it: no blur; turned about the vertical, a light is interpolated as any turned map is; and flux
(radiance times :func:`.latlong.lookup_solid_angles`) is kept wherever it goes.

The shares are piecewise linear in the place, so their derivatives are exact everywhere but on the lines
through texel centres, where they jump. Sums run in integers: the order in which threads add does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor, vectors
from envedit.core.color import LUMINANCE
from envedit.core.types import ArrayLike
from envedit.representations.layers.aureoles import CLEAR_FLUX, Aureole, Sky, clear_glow
from envedit.representations.layers.separation import Light

SPARE = 2
"""Lights beside the map's own, dark until one is needed: lobes. Not measured: each costs as much as a light
of the map."""
DARK = -30.0
"""Log flux of a light that is not there: such a flux is taken for 0. Derived: e^-30 is 1e-13."""
FAINTEST = 1e-3
"""Least flux of a spare light in a channel, as a share of its strongest channel: factors can give it any
colour. Not measured."""
LOBE_POINTS = 1024
"""Points of a lobe. Not measured: more cost time, with fewer a large lobe shows its points."""
SPACINGS = math.sqrt(LOBE_POINTS) / 8
"""Distances between points in the radius of a lobe. Derived from the lobe's area in points, to a factor."""
LOBE_DEGREES = 0.5
"""Radius (standard deviation) of a lobe of size 1: a sun, a little blurred. Not measured."""
LOBE_REACH = 2.5
"""Radii at which a lobe ends: points farther out would lie singly. Not measured."""
NARROWEST = 0.4
"""Radius in texels from which a lobe is round. With the tents of its points, of variance 1/6, it makes 0.57:
where its centre lies between texels changes its second moments by less than 2 % (derived;
``tests/oracle/test_lights.py`` measures it). A narrower one is interpolated as a single texel is."""
LEAST_IRRADIANCE = 1e-25
"""Least irradiance of a sky beside which spare lights are measured: fluxes stay within float32. Derived."""
LOG_SIZES = (-6.0, 3.0)
"""Log sizes are cut to these: from a texel's fraction to twenty times the light. Not measured."""
MOST_LOG_FLUX = 30.0
"""Log fluxes are cut there: e^30 is 1e13, and products stay within float32. Derived."""
LEAST_SINE = 1e-8
"""Least sine of a polar angle, where a column is not defined: keeps quotients finite. Derived."""
SNAP_TEXELS = 2e-4
"""A place within this of a whole row or column is taken for it: 1e-5 of a sun is bright. Derived: float32
rounds the azimuths of a map 512 texels wide by so much."""
SNAP_SHARE = 4e-7
"""The same as a share of a map's width, where that is more. Derived from float32's rounding."""
OFF_POLE_TEXELS = 1e-4
"""Texels of a pole's row are taken to lie so far from it, so that each has its azimuth. Not measured."""
MOST_HALF_WIDTH = 2.0
"""Most half-width of a tent, in widths of the map: there it is even all around. Derived."""
SUM_BITS = 40
"""Bits that the largest radiance has in the integer sums. Derived: of 63, 23 are left for how many points
may fall into one texel."""


class Lights:
    """The lights of a map at one resolution, as points.

    ``lights`` are of a :class:`.separation.Separation`. Their texels refer to an image of ``width`` columns;
    ``rows`` are its first row in its map, and the rows of that map. With ``aureoles`` spare lights have a
    glow, or that of a table (len(GLOW_DEGREES), 3); without, what surrounds a light that is added is left to
    the gain. ``background`` (rows, W, 3) is the map without its lights; by default glows are as bright
    wherever their lights are.

    Of ``count`` lights, spare ones included, the map's ``own`` come first:

    - ``centres`` (count, 3) are directions of unmoved lights; spare ones are at the zenith.
    - ``flux`` (count, 3) is that of unmoved lights, radiance times steradian; spare ones have the mean of the
      others, at least :data:`FAINTEST` of it in every channel, or 1; in a sky where no light has a glow,
      scaled to :data:`.CLEAR_FLUX` of its irradiance.
    - ``glows`` are tables as of :class:`.separation.Light`, or None. Spare lights have that of ``aureoles``
      or of the strongest light with a glow, in proportion to flux, or of a sun in a clear sky where none has
      one.
    """

    def __init__(
        self,
        lights: list[Light],
        rows: tuple[int, int],
        width: int,
        aureoles: bool | np.ndarray = True,
        background: np.ndarray | None = None,
    ):
        self.own = len(lights)
        self.count = len(lights) + SPARE
        self.width = width
        self.total = rows[1]
        self._rows = rows

        # ---- Points of each light: directions, fluxes, and widths as the sine of a polar angle
        directions, fluxes, sines = _points_of(lights, rows, width)
        own = np.array([flux.sum(axis=0) for flux in fluxes]).reshape(-1, 3)

        # ---- Those of spare ones
        sky = None if background is None else Sky.of(background, rows)
        strongest = _strongest([light.glow for light in lights], own)
        sky_irradiance = 0.0 if sky is None else sky.irradiance @ LUMINANCE
        clear = strongest is None and sky_irradiance > LEAST_IRRADIANCE
        spare = own.mean(axis=0) if len(own) else np.ones(3)
        spare = np.maximum(spare, FAINTEST * spare.max())
        if clear:
            spare *= CLEAR_FLUX * sky_irradiance / (spare @ LUMINANCE)
        d, weight, spacing = lobe()
        directions += [d] * SPARE
        fluxes += [weight[:, None] * spare] * SPARE
        sines += [np.full(len(d), spacing / (2 * math.pi / width))] * SPARE

        # ---- Which light each point is of
        counts = [len(d) for d in directions]
        which = np.repeat(np.arange(self.count), counts)
        self._points_of = list(zip(np.cumsum([0, *counts[:-1]]).tolist(), counts, strict=True))
        # Products with it, and not gathers, whose adjoint adds in the order in which threads come.
        self._owner = tensor(which[:, None] == np.arange(self.count))
        self._which = dr.opaque(mi.UInt32(which.astype(np.uint32)))
        self._added = dr.opaque(mi.Bool(which >= self.own))

        # ---- The same on the device
        self.centres = np.array([light.direction for light in lights] + [[0.0, 1.0, 0.0]] * SPARE)
        self.flux = np.concatenate([own, np.repeat(spare[None], SPARE, axis=0)])
        self._point = vectors(mi.Vector3f, np.concatenate(directions))
        self._flux = vectors(mi.Color3f, np.concatenate(fluxes))
        self._sine = dr.opaque(mi.Float(np.concatenate(sines).astype(np.float32)))
        self._centre = vectors(mi.Vector3f, self.centres)

        # ---- Glows
        of_spare = aureoles if isinstance(aureoles, np.ndarray) else None
        if aureoles is True and strongest is not None:
            own_flux = np.maximum(own[strongest], FAINTEST * own[strongest].max())
            of_spare = lights[strongest].glow * (spare / own_flux)
        elif aureoles is True and clear:
            of_spare = clear_glow()
        own_glows = [light.glow for light in lights]
        self.glows = own_glows + [of_spare] * SPARE
        self._aureoles = [
            None if glow is None else Aureole(glow, centre, sky)
            for glow, centre in zip(own_glows, self.centres, strict=False)
        ]
        home = None if strongest is None else self.centres[strongest]
        self._aureoles += [None if of_spare is None else Aureole(of_spare, home, sky)] * SPARE

    @property
    def glowing(self) -> bool:
        """Whether any light has a glow."""
        return any(aureole is not None for aureole in self._aureoles)

    def log_size(self, degrees: float) -> float:
        """Return the log size of a spare light of a radius, at least that from which it is round."""
        return math.log(max(degrees, NARROWEST * 360 / self.width) / LOBE_DEGREES)

    def core(
        self,
        turn: mi.TensorXf,
        log_flux: mi.TensorXf,
        log_size: mi.TensorXf,
        shape: tuple[int, int],
    ) -> mi.TensorXf:
        """Render the cores: linear radiance (rows, W, 3); what falls on rows that are not wanted is lost.

        ``turn`` (count, 3) are rotation vectors, axis times angle in radians, from where the light was;
        ``log_flux`` (count, 3) and ``log_size`` (count, 1) are logarithms of flux and size over what they
        were. ``shape`` has the rows and columns wanted, from the first row that the lights were given for.
        """
        centre = dr.gather(mi.Vector3f, self._centre, self._which)
        size = dr.exp(dr.clip(dr.matmul(self._owner, log_size).array, *LOG_SIZES))
        turn = dr.unravel(mi.Vector3f, dr.matmul(self._owner, turn).array)
        flux = self._flux * _exp(dr.unravel(mi.Color3f, dr.matmul(self._owner, log_flux).array))
        wide = _widths(self._sine * size, self._added)
        row, column, half = placed(self._point, centre, turn, size, wide, (self.total, self.width))
        return shared_out(row, column, half, flux, 1.0, shape, self._rows)

    def cores_of(
        self,
        i: int,
        placements: Sequence[tuple[np.ndarray, np.ndarray, float]],
        shape: tuple[int, int],
        half_row: float = 1.0,
    ) -> np.ndarray:
        """Render the core of light ``i`` alone as it is placed in one way and another, (k, rows, W, 3).

        ``placements`` are turn, log flux and log size, as of :meth:`core`, as is ``shape``; ``half_row`` is
        as of :func:`shared_out`. Linear radiance; not differentiable.
        """
        # ---- Every point of the light once for each placement
        first, count = self._points_of[i]
        pages = len(placements)
        lane = dr.arange(mi.UInt32, count * pages)
        page = lane // dr.opaque(mi.UInt32, count)
        point = lane - page * dr.opaque(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
        position = dr.gather(mi.Vector3f, self._point, point)
        centre = dr.gather(mi.Vector3f, self._centre, dr.opaque(mi.UInt32, i))

        # ---- Its turn, flux and size there
        turns, log_fluxes, log_sizes = (tensor(values).array for values in zip(*placements, strict=True))
        turn = dr.gather(mi.Vector3f, turns, page)
        log_flux = mi.Color3f(dr.gather(mi.Vector3f, log_fluxes, page))
        flux = dr.gather(mi.Color3f, self._flux, point) * _exp(log_flux)
        size = dr.exp(dr.clip(dr.gather(mi.Float, log_sizes, page), *LOG_SIZES))
        wide = dr.gather(mi.Float, self._sine, point) * size
        wide = _widths(wide, dr.gather(mi.Bool, self._added, point))

        # ---- One image for each placement
        row, column, half = placed(position, centre, turn, size, wide, (self.total, self.width))
        cores = shared_out(row, column, half, flux, half_row, shape, self._rows, mi.Int32(page), pages)
        return cores.numpy().reshape(-1, *shape, 3)

    def glow(self, turn: mi.TensorXf, log_flux: mi.TensorXf, d: mi.Vector3f) -> mi.Color3f:
        """Evaluate the product over all lights, as they are placed, of what :meth:`glow_of` returns."""
        factor = mi.Color3f(1)
        for i in range(self.count):
            factor *= self.glow_of(i, turn, log_flux, d)
        return factor

    def glow_before(self, d: mi.Vector3f) -> mi.Color3f:
        """Evaluate that product where the map has its lights, without spare ones."""
        log_flux = np.zeros((self.count, 3), np.float32)
        log_flux[self.own :] = DARK
        return self.glow(tensor(np.zeros_like(log_flux)), tensor(log_flux), d)

    def glow_of(self, i: int, turn: mi.TensorXf, log_flux: mi.TensorXf, d: mi.Vector3f) -> mi.Color3f:
        """Evaluate 1 + f c G of light ``i`` alone at directions ``d`` (``aureoles.py``); 1 without a glow."""
        aureole = self._aureoles[i]
        if aureole is None:
            return mi.Color3f(1)
        index = dr.opaque(mi.UInt32, i)
        turned_by = dr.gather(mi.Vector3f, turn.array, index)
        centre = rotate(turned_by, dr.gather(mi.Vector3f, self._centre, index))
        factor = _exp(dr.gather(mi.Color3f, log_flux.array, index))
        return 1 + aureole.at(d, centre, factor)

    def glow_around(self, i: int, d: mi.Vector3f, centre: mi.Vector3f) -> mi.Color3f:
        """Evaluate c G of light ``i`` of its own flux, which has a glow, at ``d`` if it is at ``centre``."""
        return self._aureoles[i].at(d, centre, mi.Color3f(1))


def placed(
    point: mi.Vector3f,
    centre: mi.Vector3f,
    turn: mi.Vector3f,
    size: mi.Float,
    wide: mi.Float,
    grid: tuple[int, int],
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return where points of lights come to lie: row, column and half-width in columns, each Float (n,).

    Of each point (n,) there are its direction, the centre and the rotation vector of its light, the light's
    size over what it was, and the width that it is to have, ``wide``, in columns at the equator: size times
    the sine of the polar angle of the texel that it came from. ``grid`` are rows and columns of the whole
    map.
    """
    total, width = grid
    along = dr.dot(point, centre)
    scaled = dr.normalize(point + (point - centre * along) * (size - 1))
    d = rotate(turn, scaled)
    # As in latlong.texel_position; the horizontal part is held off 0, where a column is not defined.
    across = dr.sqrt(dr.maximum(d.x * d.x + d.z * d.z, LEAST_SINE**2))
    row = dr.atan2(across, d.y) * dr.opaque(mi.Float, (total - 1) / math.pi)
    column = dr.atan2(d.x, -d.z) * dr.opaque(mi.Float, width / (2 * math.pi)) - 0.5
    snap = max(SNAP_TEXELS, SNAP_SHARE * width)
    row, column = _snapped(row, snap), _snapped(column, snap)
    half = dr.clip(wide / across, 1, MOST_HALF_WIDTH * width)
    half = dr.select(half < 1 + 1e-5, 1, half)  # a tent that is wider by rounding would reach neighbours
    return row, column, half


def shared_out(
    row: mi.Float,
    column: mi.Float,
    half: mi.Float,
    flux: mi.Color3f,
    half_row: float,
    shape: tuple[int, int],
    rows: tuple[int, int],
    page: mi.Int32 | int = 0,
    pages: int = 1,
) -> mi.TensorXf:
    """Share points (n,) out among the texels around them: linear radiance (rows, W, 3).

    ``row``, ``column`` and ``half`` are as :func:`placed` returns them, ``flux`` is radiance times steradian,
    ``half_row`` the half-width of a tent in rows, at least 1. ``shape`` and ``rows`` are as in
    :meth:`Lights.core`; what falls on other rows is lost. With several ``pages``, the result is (pages, rows,
    W, 3), and ``page`` is the image that each point is of.
    """
    page = dr.opaque(mi.Int32, 0) if pages == 1 else page
    return dr.custom(_Share, row, column, half, flux, half_row, shape, rows, page, pages)


def points(row: np.ndarray, column: np.ndarray, total: int, width: int) -> np.ndarray:
    """Return the directions (n, 3) of texels; those of the poles' rows each keep their azimuth."""
    theta = np.pi * np.clip(row, OFF_POLE_TEXELS, total - 1 - OFF_POLE_TEXELS) / max(total - 1, 1)
    phi = 2 * np.pi * (column + 0.5) / width
    return latlong.on_sphere(theta, phi)


def rotate(v: mi.Vector3f, d: mi.Vector3f) -> mi.Vector3f:
    """Rotate ``d`` by the rotation vector ``v`` (Rodrigues), smooth at v = 0."""
    angle = dr.sqrt(dr.squared_norm(v) + 1e-14)
    sinc, half = dr.sin(angle) / angle, dr.sin(0.5 * angle) / (0.5 * angle)
    return d * dr.cos(angle) + dr.cross(v, d) * sinc + v * (dr.dot(v, d) * (0.5 * half * half))


def lobe() -> tuple[np.ndarray, np.ndarray, float]:
    """Return the points of a cut Gaussian lobe: directions around the zenith, weights, spacing in radians."""
    k = np.arange(LOBE_POINTS) + 0.5
    radius = math.radians(LOBE_DEGREES)
    inside = 1 - math.exp(-0.5 * LOBE_REACH**2)
    angle = radius * np.sqrt(-2 * np.log(1 - inside * k / LOBE_POINTS))
    turn = k * math.pi * (3 - math.sqrt(5))
    d = np.stack([np.sin(angle) * np.cos(turn), np.cos(angle), np.sin(angle) * np.sin(turn)], axis=1)
    # As far as points lie apart where they are fewest: near a pole single ones would be seen.
    return d, np.full(LOBE_POINTS, 1 / LOBE_POINTS), radius / SPACINGS


def _widths(wide, added):
    """Return widths of points in columns at the equator: those of a round lobe are a texel wide at least."""
    return dr.select(added, dr.maximum(wide, dr.minimum(wide * (SPACINGS / NARROWEST), 1)), wide)


def _points_of(lights, rows, width):
    """List directions (n, 3), fluxes (n, 3) and sines of polar angles (n,) of the texels of each light."""
    first, total = rows
    directions, fluxes, sines = [], [], []
    omega = latlong.lookup_solid_angles(total, width)
    for light in lights:
        row, column = first + light.texels // width, light.texels % width
        directions.append(points(row, column, total, width))
        fluxes.append(light.radiance * omega[row][:, None])
        sines.append(np.sin(np.pi * row / max(total - 1, 1)))
    return directions, fluxes, sines


def _strongest(glows, fluxes):
    """Return which light is the strongest of those that have a glow; None where none has one."""
    strength = [0.0 if glow is None else f @ LUMINANCE for glow, f in zip(glows, fluxes, strict=True)]
    return int(np.argmax(strength)) if strength and max(strength) > 0 else None


def _exp(x):
    return dr.select(x <= DARK, 0, dr.exp(dr.minimum(x, MOST_LOG_FLUX)))


def flux_factor(log_flux: np.ndarray) -> np.ndarray:
    """Return what a flux is multiplied by; the same on the host as :meth:`Lights.core` has it."""
    return np.where(log_flux <= DARK, 0, np.exp(np.minimum(log_flux, MOST_LOG_FLUX)))


def moved(turn: np.ndarray, log_size: np.ndarray) -> np.ndarray:
    """Say which lights are elsewhere or of another size, bool (n,); parameters as of :func:`staying`."""
    return (turn != 0).any(axis=1) | (log_size != 0).any(axis=1)


def staying(turn: np.ndarray, log_flux: np.ndarray, log_size: np.ndarray) -> np.ndarray:
    """Return what of lights is where they were, (n, 3), a factor of their flux: 0 of those that have moved.

    ``turn``, ``log_flux`` (n, 3) and ``log_size`` (n, 1) are as for :meth:`Lights.core`.
    """
    return np.where(moved(turn, log_size)[:, None], 0, flux_factor(log_flux))


def log_flux_of(factor: ArrayLike) -> np.ndarray:
    """Return the log flux of a factor, the inverse of :func:`flux_factor`; DARK of 0."""
    return np.log(np.maximum(factor, np.exp(DARK)))


def size_factor(log_size: ArrayLike) -> np.ndarray:
    """Return what a size is multiplied by; likewise."""
    return np.exp(np.clip(log_size, *LOG_SIZES))


def _sign(x):
    # Not dr.sign, which is 1 at 0: on a texel's centre the mean of both sides' derivatives.
    return dr.select(x > 0, 1, dr.select(x < 0, -1, mi.Float(0)))


def _snapped(place, snap):
    """Move a place that is a whole number but for rounding onto it: 1e-5 of a sun is bright."""
    whole = dr.round(place)
    return dr.replace_grad(dr.select(dr.abs(place - whole) < snap, whole, place), place)


class _Grid(NamedTuple):
    """Texels that points are shared out among; a point falls on one of several pages of them."""

    per_omega: mi.Float
    half_row: mi.Float
    width: mi.Int32
    first: mi.Int32
    height: mi.Int32
    total: mi.Int32
    page: mi.Int32


class _Share(dr.CustomOp):
    """Share points out among texels; see the module's docstring."""

    def eval(self, row, column, half, flux, half_row, shape, rows, page, pages):
        first, total = rows
        self.args = row, column, half, flux
        omega = latlong.lookup_solid_angles(total, shape[1]).astype(np.float32)
        self.grid = _Grid(
            per_omega=dr.opaque(mi.Float(1 / omega)),
            half_row=dr.opaque(mi.Float, half_row),
            width=dr.opaque(mi.Int32, shape[1]),
            first=dr.opaque(mi.Int32, first),
            height=dr.opaque(mi.Int32, shape[0]),
            total=dr.opaque(mi.Int32, total),
            page=page,
        )
        texels = pages * shape[0] * shape[1]
        # Of the largest radiance that can come about, so many bits are kept.
        most = dr.max(dr.maximum(dr.maximum(flux.x, flux.y), flux.z)) * float(1 / omega.min())
        most = dr.minimum(most, dr.largest(mi.Float))  # infinite, it would put all lights out
        scale = dr.select(most > 0, 2.0**SUM_BITS / dr.maximum(most, 1e-25), 0)
        sums = dr.zeros(mi.Int64, texels * 3)
        _scatter(sums, row, column, half, flux, scale, self.grid)
        dr.eval(sums)
        radiance = mi.Float(mi.Float64(sums) * dr.select(scale > 0, 1 / mi.Float64(scale), 0))
        # Summed in double precision: many bright points are no infinity.
        bad = ~dr.isfinite(dr.sum(mi.Float64(flux.x) + flux.y + flux.z + row + column + half))
        return mi.TensorXf(dr.select(bad, dr.nan, radiance), (*((pages,) if pages > 1 else ()), *shape, 3))

    def backward(self):
        row, column, half, flux = _pull(self.grad_out().array, *self.args, self.grid)
        self.set_grad_in("row", row)
        self.set_grad_in("column", column)
        self.set_grad_in("half", half)
        self.set_grad_in("flux", flux)

    def name(self):
        return "share points out"


# Flux F at (row, column), texels apart, spreads over a tent of half-widths h and half (in columns):
#
#     L[r, c] += F t_r t_c / (R C omega_r),   t_r = 1 - |r - row| / h,   t_c = 1 - |c - column| / half,
#     R = sum of t_r,   C = sum of t_c
#
# dt_r/drow = sign(r - row) / h and dt_c/dhalf = |c - column| / half^2; the quotient rule adds -t R'/R and
# -t C'/C.


@dr.syntax
def _total(place, half, low, high):
    """Sum of the tent around ``place`` over whole numbers within [low, high], and of its derivatives."""
    k = dr.maximum(mi.Int32(dr.ceil(place - half)), low)
    stop = dr.minimum(mi.Int32(dr.floor(place + half)), high)
    total, slope, widening = mi.Float(0), mi.Float(0), mi.Float(0)
    while k <= stop:
        x = mi.Float(k) - place
        total += 1 - dr.abs(x) / half
        slope += _sign(x) / half
        widening += dr.abs(x) / (half * half)
        k += 1
    return total, slope, widening


@dr.syntax
def _scatter(sums, row, column, half, flux, scale, grid):
    per_omega, half_row, width, first, height, total, page = grid
    rows, _, _ = _total(row, half_row, mi.Int32(0), total - 1)
    columns, _, _ = _total(column, half, mi.Int32(-1 << 20), mi.Int32(1 << 20))
    r = dr.maximum(mi.Int32(dr.ceil(row - half_row)), first)
    last = dr.minimum(mi.Int32(dr.floor(row + half_row)), first + height - 1)
    while r <= last:
        share = (1 - dr.abs(mi.Float(r) - row) / half_row) / rows * dr.gather(mi.Float, per_omega, r)
        c = mi.Int32(dr.ceil(column - half))
        stop = mi.Int32(dr.floor(column + half))
        while c <= stop:
            # The scale first: of a light of 1e-30 it is larger than a share leaves room for.
            value = flux * scale * (share * (1 - dr.abs(mi.Float(c) - column) / half) / columns)
            place = ((page * height + r - first) * width + (c % width + width) % width) * 3
            for channel in range(3):
                v = value[channel]
                dr.scatter_add(sums, mi.Int64(v), mi.UInt32(place + channel), v != 0)
            c += 1
        r += 1


@dr.syntax
def _pull(grad, row, column, half, flux, grid):
    per_omega, half_row, width, first, height, total, page = grid
    rows, rows_slope, _ = _total(row, half_row, mi.Int32(0), total - 1)
    columns, columns_slope, columns_widening = _total(column, half, mi.Int32(-1 << 20), mi.Int32(1 << 20))
    all_, d_row, d_column, d_half = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0)
    d_flux = mi.Color3f(0)
    r = dr.maximum(mi.Int32(dr.ceil(row - half_row)), first)
    last = dr.minimum(mi.Int32(dr.floor(row + half_row)), first + height - 1)
    while r <= last:
        y = mi.Float(r) - row
        per = dr.gather(mi.Float, per_omega, r)
        share = (1 - dr.abs(y) / half_row) / rows
        within, slope, widening = mi.Float(0), mi.Float(0), mi.Float(0)
        c = mi.Int32(dr.ceil(column - half))
        stop = mi.Int32(dr.floor(column + half))
        while c <= stop:
            x = mi.Float(c) - column
            place = mi.UInt32((page * height + r - first) * width + (c % width + width) % width)
            pulled = dr.gather(mi.Color3f, grad, place) * per
            part = (1 - dr.abs(x) / half) / columns
            d_flux += pulled * (share * part)
            g = pulled.x * flux.x + pulled.y * flux.y + pulled.z * flux.z
            within += g * part
            slope += g * _sign(x)
            widening += g * dr.abs(x)
            c += 1
        all_ += share * within
        d_column += share * slope / (half * columns)
        d_half += share * widening / (half * half * columns)
        d_row += within * _sign(y) / (half_row * rows)
        r += 1
    d_row -= all_ * rows_slope / rows
    d_column -= all_ * columns_slope / columns
    d_half -= all_ * columns_widening / columns
    return d_row, d_column, d_half, d_flux
