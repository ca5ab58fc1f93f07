"""An edit that was found on a small working map, carried to the map's own resolution.

What a working map gives of an edit is smooth (a gain, a glow) or few (lights that have moved). It is applied
to the texels of the source, whose detail the working map never had: clouds, the horizon, a sun's disc of a
tenth of a degree. Work goes in bands of rows of one size: memory stays bounded, kernels are compiled once.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat
from envedit.core.errors import NumericalError, place_of
from envedit.core.rows import Rows
from envedit.export.ratio_transfer import Ratio
from envedit.export.texel_maps import Places, as_image
from envedit.representations.base import Representation
from envedit.representations.layers import lights
from envedit.representations.layers.gain import brightened
from envedit.representations.layers.layers import Layers, gone_of, unseen_kept
from envedit.representations.layers.separation import grown

POINTS_AT_ONCE = 1 << 20
"""Texels of a light that are moved at a time."""


def carry(
    representation: Representation,
    params: dict,
    original_working: np.ndarray,
    edited_working: np.ndarray,
    source: np.ndarray,
    rows_working: Rows,
    free: np.ndarray | None = None,
) -> np.ndarray:
    """Apply an edit to the source of a working map.

    Layers are evaluated at the source's resolution (``docs/method.md``): its own texels without the cores of
    the lights, times gain and glow; the cores, of the source's own texels, where the lights have gone. A
    core's border falls off over one working texel, so that no outline of its region is seen; it keeps its
    flux.

    Of any other representation only what it did to the working map is known: per channel, with W_0 and W the
    working maps, the source S becomes

    * S W / W_0 where the radiance of a texel and its neighbours at least halves and at most doubles,
    * S + (W - W_0) where one at least quadruples: a new light,
    * W where one falls to a quarter: the source's detail is of a light that is gone, and would be its ghost,

    and a mixture between. The ratio is interpolated; the others are linear within each working texel, with
    its value as their mean. Then the ratio is corrected until the means agree, at last texel by texel.

    Parameters
    ----------
    representation : object
        The representation of the working map's active rows, as it was edited.
    params : dict
        Its parameters.
    original_working, edited_working : ndarray (h, w, 3)
        The working map before and after; the first is the source resized. Layers need neither.
    source : ndarray (H, W, 3) float32
        Linear radiance, finite and not negative.
    rows_working : Rows
        Active rows of the working map.
    free : ndarray of bool (rows, w), optional
        Active working texels that may change at all; None: all. Layers know which keep their gain
        (:meth:`.layers.Layers.keep`): a light may move across those.

    Returns
    -------
    ndarray (H, W, 3) float32
        Texels of inactive rows, of working texels that are not free, and wherever the edit is the factor 1
        have the bits of ``source``. For other representations than layers so has every source texel that
        overlaps an unchanged working texel, and the mean of every changed one (:func:`.latlong.resize` of the
        result) differs from ``edited_working`` by at most 1 % of the brightest of it and its neighbours, if
        the source is at least four times as wide; one that touches an unchanged texel cannot be darkened
        where a source texel lies in both. A source that is not larger than the working map takes
        the edited map's values, resized, where it was changed.

    Raises
    ------
    NumericalError
        If a texel comes out non-finite; names its row and column.
    """
    source = np.asarray(source)
    if source.ndim != 3 or source.shape[2] != 3 or source.dtype != np.float32:
        raise ValueError(f"carry: a source is (H, W, 3) float32, got {source.shape} {source.dtype}")
    width = np.shape(edited_working)[1]
    if np.shape(original_working) != np.shape(edited_working):
        raise ValueError(
            f"carry: the working maps have shapes {np.shape(original_working)} and {np.shape(edited_working)}"
        )
    grid = Places(source.shape[:2], rows_working, width)
    work: _LayersAt | Ratio
    if isinstance(representation, Layers):
        work = _LayersAt(representation, params, grid)
        work.collect(source)
    else:
        work = Ratio(original_working, edited_working, free, grid)
        work.correct(source)
    result = source.copy()
    for start, fresh, size in grid.bands():
        band = slice(start, start + size)
        made = work.band(source[band], start)
        if representation.models_edit:
            made = unseen_kept(source[band], made)
        if free is not None:
            made = np.where(free[grid.row[band]][:, grid.column][..., None], made, source[band])
        if (bad := ~np.isfinite(made)).any():
            raise NumericalError(
                f"the edit at full resolution is not finite at {place_of(bad, start)}; lower [optimizer] lr"
            )
        result[fresh : start + size] = made[fresh - start :]
    return result


# ------------------------------------------------------------------------------------------------------------
# Layers


@dataclass(frozen=True)
class _Points:
    """Points of one light, placed; ``omega`` is the solid angle of each, or None where they are few."""

    light: int
    places: tuple
    flux: mi.Color3f
    omega: mi.Color3f | None
    half_row: float
    first: int
    last: int


class _LayersAt:
    """Layers at the resolution of a source, band by band."""

    def __init__(self, layers: Layers, params: dict, grid: Places):
        self.layers, self.grid = layers, grid
        self.height, self.width = grid.shape
        self.real = {name: params[name] * layers.scales[name] for name in ("turn", "flux", "size")}
        self.turn, self.flux, self.size = (self.real[k].numpy() for k in ("turn", "flux", "size"))
        self.moved = (self.turn != 0).any(axis=1) | (self.size != 0).any(axis=1)
        self.relit = layers.lights.glowing and bool(self.turn.any() or self.flux[: -lights.SPARE].any())
        # Of rows that follow those above the horizon, all that they are multiplied by.
        self.gain = np.concatenate([layers.log_gain(params), layers.log_below(params)])
        self.edge = None if layers.below is None else layers.shape[0]
        self.free = layers.free
        if self.edge is not None and self.free is not None:
            self.free = np.concatenate([self.free, np.ones(layers.below.shape, bool)])
        if self.relit:
            # Rows that follow have it in their factor.
            none = np.zeros_like(self.gain[layers.shape[0] :])
            self.behind = [np.concatenate([f, none]) for f in (layers.behind.offset, layers.behind.slope)]
            self.faint = dr.opaque(mi.Float, layers.behind.faint)
        above = np.full(self.height, True) if self.edge is None else grid.place < self.edge - 0.5
        self.follows = dr.opaque(mi.UInt32, int(above.sum()))
        # Of lights that stay, what their cores are multiplied by; of those that move, nothing is left.
        own = layers.lights.count - lights.SPARE
        strength = lights.flux_factor(self.flux[:own])
        strength = np.where(self.moved[:own, None], 0, strength)
        self.strength = flat(mi.Float, np.concatenate([strength, np.ones((1, 3))]).astype(np.float32))
        self.survey = layers.separation.survey
        if self.survey is not None:
            start, total = self.survey.rows
            rows, columns = self.survey.label.shape
            self.surveyed = Places(grid.shape, Rows(start, rows, total), columns)
            self.inside = self.survey.label >= 0
            self.label = grown(self.survey.label)
        theta = np.pi * np.arange(self.height) / max(self.height - 1, 1)
        sin = np.sin(theta)
        sin[-1] = 0.0 if self.height > 1 else 1.0
        self._theta = sin.astype(np.float32), np.cos(theta).astype(np.float32)
        phi = 2 * np.pi * (np.arange(self.width) + 0.5) / self.width
        self._phi = [flat(mi.Float, f(phi).astype(np.float32)) for f in (np.sin, np.cos)]
        self.points: list[_Points] = []
        self.level: dict[int, np.ndarray] = {}

    def collect(self, source):
        """Gather the texels of lights that move, and place them."""
        own = self.layers.lights.count - lights.SPARE
        found: dict[int, list] = {int(i): [] for i in np.flatnonzero(self.moved[:own])}
        for start, fresh, size in self.grid.bands() if found else ():
            if not self._any_label(start, size):
                continue
            row, column = self.grid.texels(size)
            d, image = self._directions(start, row, column), self._load(source[start : start + size])
            light, share, core = self._core(image, row, column, d, start, size)
            light, share = (v.numpy().reshape(size, self.width) for v in (light, share))
            core = as_image(core, size, self.width).numpy()
            light[: fresh - start] = -1
            for i, parts in found.items():
                r, c = np.nonzero(light == i)
                parts.append((r + start, c, core[r, c], share[r, c]))
        omega = latlong.lookup_solid_angles(self.height, self.width)
        for i, parts in found.items():
            if not any(part[2].any() for part in parts):
                continue
            row, column, radiance, share = (np.concatenate(p) for p in zip(*parts, strict=True))
            flux = np.float64(radiance) * omega[row][:, None]
            soft = flux * share[:, None]
            # Rescaled so that feathering preserves flux.
            kept = soft.sum(axis=0)
            flux = soft * np.divide(flux.sum(axis=0), kept, out=np.ones(3), where=kept > 0)
            for k in range(0, len(row), POINTS_AT_ONCE):
                part = slice(k, k + POINTS_AT_ONCE)
                self._place_texels(i, row[part], column[part], flux[part], omega[row[part]])
        for spare in range(own, self.layers.lights.count):
            if (self.flux[spare] > lights.DARK).any():
                self._place_lobe(spare)
        self._level()

    def band(self, source, start):
        """Compose the rows of a source that begin at ``start``."""
        size = len(source)
        image = self._load(source)
        row, column = self.grid.texels(size)
        gain = flat(mi.Float, self.grid.along_rows(self.gain, start, size, self.edge))
        log = self.grid.across(mi.Color3f, gain, row, column)
        if self.free is not None:
            inner = flat(mi.Float, self.grid.inner(self.free, start, size))
            log *= self.grid.across(mi.Float, inner, row, column, corners=True)
        factor = dr.exp(log)
        same = factor == 1
        base, core, d = image, None, None
        if self.relit or self._any_label(start, size):
            d = self._directions(start, row, column)
        if self._any_label(start, size):
            light, _, core = self._core(image, row, column, d, start, size)
            base = image - core
        sky = brightened(base, factor)
        if self.relit:
            still = dr.zeros(mi.TensorXf, self.turn.shape)
            before = self.layers.lights.glow(still, still, d)
            ratio = self.layers.lights.glow(self.real["turn"], self.real["flux"], d) / before
            ratio = dr.select(self._follow(start, row), 1, ratio)
            offset, slope = (
                self.grid.across(mi.Color3f, flat(mi.Float, field), row, column)
                for field in (self.grid.along_rows(f, start, size, self.edge) for f in self.behind)
            )
            change = offset + slope * dr.log(base / before + self.faint)
            sky *= ratio * dr.exp(gone_of(ratio) * change)
            same &= ratio == 1
        if core is not None:
            # The last is 1, for texels of no light.
            which = dr.select(light < 0, dr.opaque(mi.Int32, self.layers.lights.count - lights.SPARE), light)
            strength = dr.gather(mi.Color3f, self.strength, mi.UInt32(which))
            sky += core * strength
            same &= (strength == 1) | (core == 0)
        made = as_image(dr.select(same, image, sky), size, self.width)
        for light in self._reaching(start, size):
            # Points on a turned grid lie closer here and farther there: a pattern of fine stripes, otherwise.
            total, density = self._moved(light, start, size)
            level = flat(mi.Float, self.level[light])
            made += total / density * dr.reshape(mi.TensorXf(level), (1, 1, 3))
        return made.numpy()

    def _moved(self, light, start, size):
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

    def _reaching(self, start, size):
        """Lights that have moved to a band."""
        return sorted({p.light for p in self.points if p.first < start + size and p.last >= start})

    def _level(self):
        """Find what makes up for the flux that dividing by the density takes or gives."""
        flux = {p.light: np.zeros((2, 3)) for p in self.points}
        omega = latlong.lookup_solid_angles(self.height, self.width)
        for start, fresh, size in self.grid.bands():
            for light in self._reaching(start, size):
                total, density = self._moved(light, start, size)
                for k, image in enumerate((total, total / density)):
                    rows = image.numpy()[fresh - start :].sum(axis=1, dtype=np.float64)
                    flux[light][k] += omega[fresh : start + size] @ rows
        for light, (wanted, got) in flux.items():
            self.level[light] = np.where(got > 0, wanted / np.maximum(got, 1e-300), 1).astype(np.float32)

    def _load(self, source):
        return dr.unravel(mi.Color3f, flat(mi.Float, source))

    def _directions(self, start, row, column):
        first = dr.opaque(mi.UInt32, start)
        if not hasattr(self, "_rows"):
            self._rows = [flat(mi.Float, t) for t in self._theta]
        sin, cos = (dr.gather(mi.Float, t, row + first) for t in self._rows)
        x, z = (dr.gather(mi.Float, t, column) for t in self._phi)
        return mi.Vector3f(sin * x, cos, -sin * z)

    def _follow(self, start, row):
        """Which texels of a band are of rows that follow those above the horizon."""
        return row + dr.opaque(mi.UInt32, start) >= self.follows

    def _any_label(self, start, size):
        if self.survey is None:
            return False
        near = self.surveyed.row[[start, start + size - 1]]
        return bool((self.label[near[0] : near[1] + 1] >= 0).any())

    def _core(self, image, row, column, d, start, size):
        """Light that a texel of a band belongs to, or -1; how far inside it lies, 0 to 1; the core in it."""
        at, survey = self.surveyed, self.survey
        label = self.label[at.row[start : start + size]].astype(np.int32)
        light = at.nearest(mi.Int32, flat(mi.Int32, label), row, column)
        share = [
            at.across(mi.Float, flat(mi.Float, at.inner(mask, start, size)), row, column, corners=True)
            for mask in (self.inside, ~self.inside)
        ]
        table = flat(mi.Float, at.along_rows(survey.below, start, size))
        below = at.across(mi.Color3f, table, row, column)
        if self.layers.lights.glowing:
            still = dr.zeros(mi.TensorXf, self.turn.shape)
            below *= self.layers.lights.glow(still, still, d)
        light = dr.select(self._follow(start, row), -1, light)
        core = dr.select(light >= 0, dr.maximum(image - below, 0) * (1 - share[1]), 0)
        return light, share[0], core

    def _place_texels(self, i, row, column, flux, omega):
        if len(row) == 1:  # a single one would be a scalar, and another kernel
            row, column, flux, omega = (np.repeat(v, 2, axis=0) for v in (row, column, flux / 2, omega / 2))
        d = lights.points(row, column, self.height, self.width)
        sine = np.sin(np.pi * row / max(self.height - 1, 1))
        size = float(lights.size_factor(self.size[i, 0]))
        self._place(i, d, flux, sine, 1.0, max(1.0, size), omega * size**2)

    def _place_lobe(self, i):
        d, weight, spacing = lights.lobe()
        total, width = self.layers.rows[1], self.layers.shape[1]
        sine = np.full(len(d), spacing / (2 * np.pi / width))
        half_row = max(1.0, (self.height - 1) / max(total - 1, 1))
        flux = weight[:, None] * self.layers.lights.flux[i]
        self._place(i, d, flux, sine, self.width / width, half_row)

    def _place(self, i, d, flux, sine, finer, half_row, omega=None):
        def vector(v):
            return dr.opaque(mi.Vector3f(*(float(x) for x in v)))

        scale = lights.flux_factor(self.flux[i])
        point = mi.Vector3f(*(flat(mi.Float, v) for v in d.T.astype(np.float32)))
        flux = mi.Color3f(*(flat(mi.Float, v) for v in (flux * scale).T.astype(np.float32)))
        size = dr.opaque(mi.Float, float(lights.size_factor(self.size[i, 0])))
        centre, turn = vector(self.layers.lights.centres[i]), vector(self.turn[i])
        sine = flat(mi.Float, sine.astype(np.float32))
        places = lights.placed(point, centre, turn, size, sine, finer, self.grid.shape)
        dr.eval(places)
        row = places[0].numpy()
        first, last = int(np.floor(row.min() - half_row)), int(np.ceil(row.max() + half_row))
        if omega is not None:
            omega = mi.Color3f(flat(mi.Float, omega.astype(np.float32)))
        self.points.append(_Points(int(i), places, flux, omega, half_row, first, last))
