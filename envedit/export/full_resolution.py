"""An edit that was found on a small working map, carried to the map's own resolution.

What a working map gives of an edit is smooth (a gain, a glow) or few (lights that have moved). It is applied
to the texels of the source, whose detail the working map never had: clouds, the horizon, a sun's disc of a
tenth of a degree. Work goes in bands of rows of one size: memory stays bounded, kernels are compiled once.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat
from envedit.core.errors import NumericalError, place_of
from envedit.core.rows import Rows
from envedit.export.moved_lights import MovedLights
from envedit.export.ratio_transfer import Ratio
from envedit.export.source_cores import SourceCores
from envedit.export.texel_maps import Places, as_colours, as_image
from envedit.representations.base import Representation
from envedit.representations.layers import lights
from envedit.representations.layers.behind_glow import gone_of
from envedit.representations.layers.gain import brightened
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.saturation import saturated
from envedit.representations.layers.unseen import unseen_kept


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
        The working map before and after; the first is the source resized. Of layers only
        their shape is used.
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
                f"the edit at full resolution is not finite at {place_of(bad, start)}; lower "
                "[optimizer] lr if you have raised it, else scale the map down"
            )
        result[fresh : start + size] = made[fresh - start :]
    return result


# ------------------------------------------------------------------------------------------------------------
# Layers


class _LayersAt:
    """Layers at the resolution of a source, band by band.

    Attributes
    ----------
    gain : ndarray (rows, W, 3)
        Log gain of the working map; of rows that follow those above the horizon, all that they are multiplied
        by.
    edge : int or None
        Working row from which rows follow.
    relit : bool
        The glow has changed; then ``behind`` and ``faint`` are what it had hidden, and ``by_lights`` is the
        log factor of rows that follow.
    exponent : Float or None
        k of ``saturation.py``, where the sky's colours change by it.
    strength : Float
        Of lights that stay, what their cores are multiplied by; of those that move, nothing is left.
    """

    def __init__(self, layers: Layers, params: dict, grid: Places):
        self.layers, self.grid = layers, grid
        self.placed = {name: params[name] * layers.scales[name] for name in ("turn", "flux", "size")}
        turn, flux, size = (value.numpy() for value in self.placed.values())
        self.exponent = None
        if "saturation" in params:
            self.exponent = dr.opaque(mi.Float, float(np.exp(params["saturation"].numpy()[0, 0])))
        by_lights, further = layers.log_below(params)
        self.gain = np.concatenate([layers.log_gain(params), further])
        self.edge = None if layers.below is None else layers.shape[0]
        self.free = layers.free
        if self.edge is not None and self.free is not None:
            self.free = np.concatenate([self.free, np.ones(layers.below.shape, bool)])
        own = layers.lights.own
        self._lit = (flux > lights.DARK).any(axis=1)
        self.relit = layers.lights.glowing and bool(
            turn[self._lit].any() or flux[:own].any() or self._lit[own:].any()
        )
        if self.relit:
            none = np.zeros_like(further)
            self.behind = [np.concatenate([f, none]) for f in (layers.behind.offset, layers.behind.slope)]
            self.by_lights = np.concatenate([np.zeros_like(layers.behind.offset), by_lights])
            self.faint = dr.opaque(mi.Float, layers.behind.faint)
        moved = (turn != 0).any(axis=1) | (size != 0).any(axis=1)
        strength = np.where(moved[:own, None], 0, lights.flux_factor(flux[:own]))
        self.strength = flat(mi.Float, np.concatenate([strength, np.ones((1, 3))]).astype(np.float32))
        self.cores = SourceCores(layers, grid, self.edge)
        self.moved = MovedLights(layers, grid.shape, turn, flux, size)
        self._leaving = np.flatnonzero(moved[:own])

    def collect(self, source):
        """Gather the texels of lights that move, and place them."""
        found: dict[int, list] = {int(i): [] for i in self._leaving}
        for start, fresh, size in self.grid.bands() if found else ():
            if not self.cores.any(start, size):
                continue
            row, column = self.grid.texels(size)
            d, image = self.cores.directions(start, row, column), as_colours(source[start : start + size])
            light, share, core = self.cores.of(image, row, column, d, start, size)
            light, share = (v.numpy().reshape(size, self.grid.shape[1]) for v in (light, share))
            core = as_image(core, size, self.grid.shape[1]).numpy()
            light[: fresh - start] = -1
            for i, parts in found.items():
                r, c = np.nonzero(light == i)
                parts.append((r + start, c, core[r, c], share[r, c]))
        for i, parts in found.items():
            if any(part[2].any() for part in parts):
                self.moved.place_texels(i, *(np.concatenate(p) for p in zip(*parts, strict=True)))
        own = self.layers.lights.own
        for spare in range(own, self.layers.lights.count):
            if self._lit[spare]:
                self.moved.place_lobe(spare)
        self.moved.level(self.grid)

    def band(self, source, start):
        """Compose the rows of a source that begin at ``start``."""
        size = len(source)
        image = as_colours(source)
        row, column = self.grid.texels(size)
        gain = flat(mi.Float, self.grid.smooth_rows(self.gain, start, size, self.edge))
        log = self.grid.smooth_across(mi.Color3f, gain, row, column)
        if self.free is not None:
            inner = flat(mi.Float, self.grid.inner(self.free, start, size))
            log *= self.grid.across(mi.Float, inner, row, column, corners=True)
        factor = dr.exp(log)
        same = factor == 1
        base, core, d = image, None, self.cores.directions(start, row, column)
        if self.cores.any(start, size):
            light, _, core = self.cores.of(image, row, column, d, start, size)
            base = image - core
        colours = base
        if self.relit:
            offset, slope, by_lights = (
                self.grid.smooth_across(mi.Color3f, flat(mi.Float, field), row, column)
                for field in (
                    self.grid.smooth_rows(f, start, size, self.edge) for f in (*self.behind, self.by_lights)
                )
            )
            before, follow = self.layers.lights.glow_before(d), self.cores.follow(start, row)
            ratio = self.layers.lights.glow_ratio(self.placed["turn"], self.placed["flux"], d, before)
            revealed = dr.exp(gone_of(ratio) * (offset + slope * dr.log(base / before + self.faint)))
            ratio = dr.select(follow, dr.exp(by_lights), ratio * revealed)
            colours = base * ratio
            same &= ratio == 1
        if self.exponent is not None:
            kept = self.cores.follow(start, row) & (not self.layers.mirrored)
            colours, same = dr.select(kept, colours, saturated(colours, self.exponent)), same & kept
        sky = brightened(colours, factor)
        if core is not None:
            # The last is 1, for texels of no light.
            which = dr.select(light < 0, dr.opaque(mi.Int32, self.layers.lights.own), light)
            strength = dr.gather(mi.Color3f, self.strength, mi.UInt32(which))
            sky += core * strength
            same &= (strength == 1) | (core == 0)
        sky = dr.select(same, image, sky)
        for light in self.moved.lobes_at(d):
            sky += light
        made = as_image(sky, size, self.grid.shape[1])
        for light in self.moved.radiance(start, size):
            made += light
        return made.numpy()
