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
from envedit.export.ratio_transfer import Ratio
from envedit.export.source_lights import MovedLights, SourceCores
from envedit.export.texel_maps import Places
from envedit.representations.base import Representation
from envedit.representations.layers import lights
from envedit.representations.layers.composition import Fields, Glows, compose
from envedit.representations.layers.layers import Layers
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
    """Apply an edit to the source of a working map; NumericalError names a texel that comes out non-finite.

    Layers are evaluated at the source's resolution (``docs/method.md``): its own texels without the cores of
    the lights, times gain and glow; the cores, of the source's own texels, where the lights have gone. A
    core's border falls off over one working texel and keeps its flux. Of any other representation only what
    it did to the working map is known (:mod:`.ratio_transfer`).

    ``representation`` and ``params`` are of the working map's active rows, ``rows_working``, as edited.
    ``original_working`` and ``edited_working`` (h, w, 3) are the working map before and after; the first is
    the source resized. Of layers only their shape is used. ``source`` (H, W, 3) float32 is linear radiance,
    finite and not negative. ``free`` (rows, w) says which active working texels may change at all; None: all.
    Layers know which keep their gain (:meth:`.layers.Layers.keeping`): a light may move across those.

    Returns (H, W, 3) float32. Texels of inactive rows, of working texels that are not free, and wherever the
    edit is the factor 1 have the bits of ``source``.
    """
    # ---- The edit, as layers or as a ratio of the working maps
    width = np.shape(edited_working)[1]
    grid = Places(source.shape[:2], rows_working, width)
    work: _LayersAt | Ratio
    if isinstance(representation, Layers):
        work = _LayersAt(representation, params, grid)
        work.collect(source)
    else:
        work = Ratio(original_working, edited_working, free, grid)
        work.correct(source)

    # ---- Apply it to bands of rows
    def changed(band, original):
        composed = work.band(band, original)
        if representation.models_edit:
            composed = unseen_kept(original, composed)
        if free is not None:
            composed = np.where(free[grid.row[band.rows]][:, grid.column][..., None], composed, original)
        if (bad := ~np.isfinite(composed)).any():
            raise NumericalError(
                f"the edit at full resolution is not finite at {place_of(bad, band.start)}; lower "
                "[optimizer] lr if you have raised it, else scale the map down"
            )
        return composed

    return grid.composed(source, changed)


# ---- Layers ------------------------------------------------------------------------------------------------


class _LayersAt:
    """Layers at the resolution of a source, band by band: :func:`.compose` of interpolated fields."""

    def __init__(self, layers: Layers, params: dict, grid: Places):
        self.layers = layers
        self.grid = grid
        self.fields = layers.texel_fields(params)
        self.placed = {name: params[name] * layers.scales[name] for name in ("turn", "flux", "size")}
        self.log_saturation = None
        if "saturation" in params:
            log_saturation = params["saturation"].numpy()[0, 0] * layers.scales["saturation"]
            self.log_saturation = dr.opaque(mi.Float, float(log_saturation))

        # ---- Working row from which rows follow those above the horizon; texels that are free; None: all
        self.edge = None
        self.free = layers.free
        if layers.below is not None:
            self.edge = layers.shape[0]
            if self.free is not None:
                self.free = np.concatenate([self.free, np.ones(layers.below.shape, bool)])

        # ---- Lights: whether a glow has changed, which have moved, and what the others' cores are times
        turn, flux, size = (value.numpy() for value in self.placed.values())
        own = layers.lights.own
        self._present = (flux > lights.DARK).any(axis=1)
        changed = turn[self._present].any() or flux[:own].any() or self._present[own:].any()
        self.relit = layers.lights.glowing and bool(changed)
        strength = lights.staying(turn[:own], flux[:own], size[:own])
        # The last is 1, for texels of no light.
        self.strength = flat(mi.Float, np.concatenate([strength, np.ones((1, 3))]).astype(np.float32))
        self.cores = SourceCores(layers, grid, self.edge)
        self.moved = MovedLights(layers, grid.shape, turn, flux, size)
        self._leaving = np.flatnonzero(lights.moved(turn[:own], size[:own]))

    def collect(self, source):
        """Gather the texels of lights that move, and place them."""
        texels: dict[int, list] = {int(i): [] for i in self._leaving}
        for band in self.grid.bands() if texels else ():
            if not self.cores.any(band):
                continue
            directions = self.cores.directions(band)
            light, share, core, _ = self.cores.of(band, band.colours(source[band.rows]), directions)
            light, share = (v.numpy().reshape(band.shape) for v in (light, share))
            core = band.image(core).numpy()
            light[: band.fresh - band.start] = -1
            for i, parts in texels.items():
                r, c = np.nonzero(light == i)
                parts.append((r + band.start, c, core[r, c], share[r, c]))
        for i, parts in texels.items():
            if any(part[2].any() for part in parts):
                self.moved.place_texels(i, *(np.concatenate(p) for p in zip(*parts, strict=True)))
        own = self.layers.lights.own
        for spare in range(own, self.layers.lights.count):
            if self._present[spare]:
                self.moved.place_lobe(spare)
        self.moved.level(self.grid)

    def band(self, band, source):
        """Compose the rows of a band, which are ``source``."""
        image = band.colours(source)
        directions = self.cores.directions(band)

        # ---- The source without its cores, and those of lights that stay
        base = image
        core = None
        if self.cores.any(band):
            light, _, own_core, hidden = self.cores.of(band, image, directions)
            which = dr.select(light < 0, dr.opaque(mi.Int32, self.layers.lights.own), light)
            strength = dr.gather(mi.Color3f, self.strength, mi.UInt32(which))
            uncovered = hidden * dr.maximum(1 - mi.luminance(strength), 0)
            base = image - own_core + uncovered
            core = own_core * strength

        # ---- The sky
        sky = compose(base, directions, self._fields_at(band, directions)).sky
        same = sky == base
        if core is not None:
            sky += core
            same &= ((strength == 1) | (own_core == 0)) & (uncovered == 0)
        sky = dr.select(same, image, sky)

        # ---- Lights that have moved or were added: none shines from rows that follow
        shines = ~self.cores.follow(band)
        for lobe in self.moved.lobes_at(directions):
            sky += dr.select(shines, lobe, 0)
        for radiance in self.moved.radiance(band):
            sky += dr.select(shines, dr.unravel(mi.Color3f, radiance.array), 0)
        return band.image(sky).numpy()

    def _fields_at(self, band, directions):
        """Interpolate what the edit does at the texels of a band."""

        def smooth(field):
            return self.grid.smooth(band, field, self.edge)

        follows = self.cores.follow(band)
        share = None if self.free is None else self.grid.inside(band, self.free)
        log_saturation = self.log_saturation
        if log_saturation is not None and not self.layers.mirrored:
            log_saturation = dr.select(follows, 0, log_saturation)
        glows, log_followed = None, None
        if self.relit:
            log_followed = smooth(self.fields.log_followed)
            glows = Glows(
                self.layers.lights,
                self.placed["turn"],
                self.placed["flux"],
                self.layers.lights.glow_before(directions),
                smooth(self.fields.offset),
                smooth(self.fields.slope),
                dr.opaque(mi.Float, self.layers.behind.faint),
            )
        return Fields(
            glows=glows,
            log_followed=log_followed,
            follows=follows,
            log_saturation=log_saturation,
            log_gain=smooth(self.fields.log_gain),
            share=share,
        )
