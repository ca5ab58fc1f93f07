"""Layers: a representation of the edit instead of the map.

The formula is that of ``composition.py``, at the texels of a working map: lights that move
(``separation.py``, ``lights.py``) over a background under a smooth gain (``gain.py``). Rows below the horizon
follow those above (``below_horizon.py``), or are edited like them. Where exp(g) is above 1, what it adds is
in part luminance (:func:`.brightened`). Unmoved lights, no gain and k = 1 give the original back, bit for bit
outside the cores: the sky's own detail is kept.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat, tensor, vectors
from envedit.core.color import LUMINANCE
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.rotations import rotated
from envedit.representations.layers import behind_glow
from envedit.representations.layers.behind_glow import BehindGlow
from envedit.representations.layers.below_horizon import Below, Horizon, sky_rows
from envedit.representations.layers.composition import Fields, Glows, compose
from envedit.representations.layers.gain import CYCLES, GridGain, Octave
from envedit.representations.layers.ground_light import GroundLight
from envedit.representations.layers.lights import DARK, SPARE, Lights, flux_factor, staying
from envedit.representations.layers.saturation import saturated
from envedit.representations.layers.separation import MOVABLE, Separation, separate

SCALES = {"turn": 0.1, "flux": 1.0, "size": 0.5, "saturation": 1.0}
"""Unit of each parameter, in radians and logarithms: one learning rate then suits all. Not measured."""

GROUND = 0.3
"""Unit of the log factor of ground, a logarithm: by so much the colour of daylight changes. With a larger one
Adam, which has no prior, colours ground under a mirror (``docs/decisions/gain_of_the_sky.md``)."""

SATURATION_STEP = 0.05
"""Step of the difference by the log saturation, towards grey. Not measured beside other steps; why it is no
tangent: ``docs/decisions/slope_of_the_saturation.md``."""


@dataclass(frozen=True)
class TexelFields:
    """What parameters do to every texel of a working map, (rows, W, 3) float32 each."""

    # Log gain, also of texels that :meth:`Layers.keeping` excepts from it; of rows that follow, the log
    # factor that is beside :attr:`log_followed`
    log_gain: np.ndarray
    log_followed: np.ndarray  # log factor, by what lights do, of rows that follow; 0 of others
    # offset, slope: of :class:`.BehindGlow`; 0 of rows that follow, and without glows
    offset: np.ndarray
    slope: np.ndarray


class _Texels(NamedTuple):
    """The texels above the horizon on the device, and the fields of no edit there."""

    directions: mi.Vector3f
    base: mi.Color3f
    # What the lights hide, :attr:`.Light.hidden`, None: nothing; and which light, an index, a texel is of
    hidden: mi.Color3f | None
    light: mi.UInt32
    fields: Fields


@dataclass(frozen=True, eq=False)
class Layers:
    """Lights that move, a background under a smooth gain; made by :meth:`of`, and never changed.

    Parameters may hold ``saturation`` (1, 1), the logarithm of k of ``saturation.py``; without it, k is 1.
    """

    rows: tuple[int, int]  # first row of the image in its map, and the rows of that map
    whole: tuple[int, int]  # rows and columns of the image
    separation: Separation  # lights and background of the rows above the horizon, or of all where none follow
    lights: Lights  # its lights and spare ones
    gain: GridGain  # the gain's grids
    base: np.ndarray  # (rows, W, 3) float32, E_0', of the rows of the separation
    behind: BehindGlow | None = None  # what is seen where a glow has gone; None without glows
    below: Below | None = None  # the rows that follow
    free: np.ndarray | None = None  # bool (rows, W), texels that gain and saturation act on; None: all
    # (rows, W, 3), radiance of locked lights, added to the cores whatever the parameters are; None: 0
    fixed: np.ndarray | None = None
    kept: np.ndarray | None = None  # (rows, W), how far a texel stays as it is, 0 to 1; None: nowhere

    lr = 0.03
    models_edit = True
    fitted = None

    # ---- making --------------------------------------------------------------------------------------------

    @classmethod
    def of(
        cls,
        image: np.ndarray,
        rows: tuple[int, int] | None = None,
        cycles: int = CYCLES,
        horizon: Horizon = "free",
        aureoles: bool | np.ndarray = True,
        fixed: np.ndarray | None = None,
        kept: np.ndarray | None = None,
    ) -> Layers:
        """Separate an image (rows, W, 3) of linear radiance.

        ``rows`` are its first row in its map, and the rows of that map; None: it is a whole map. ``cycles``
        are those of the gain around the horizon, before :meth:`refined`. ``horizon`` is what rows below the
        horizon of a whole map do: "mirror" or "keep", as of ``below_horizon.py``, or "free": edited as those
        above. With ``aureoles`` lights that are added have a glow, as for :class:`.Lights`: of the map's
        strongest, or of a sun in a clear sky, or of a table. ``fixed`` (rows, W, 3) is what of the image is
        of locked lights: it is left out of the separation, and never changes. ``kept`` (rows, W) is how far a
        texel stays as it is, 0 to 1: that share of the original is in every decoded map.

        InputError if a texel is not finite, negative, or brighter than :data:`.radiance.BRIGHTEST`.
        """
        rows = rows or (0, len(image))
        require_radiance(image, "layers", rows[0], BRIGHTEST)
        image = np.ascontiguousarray(image, np.float32)
        if fixed is not None:
            fixed = np.minimum(fixed, image)
            image = image - fixed

        # ---- Rows above the horizon, and rows below that follow them
        above, low = image, image[:0]
        if horizon != "free" and rows == (0, len(image)):
            up = sky_rows(len(image))
            above, low = image[:up], image[up:]

        # ---- Lights, and the map without their cores
        separation = separate(above, rows, MOVABLE)
        core = separation.core
        lights = Lights(separation.lights, rows, image.shape[1], aureoles, separation.background)
        base = np.where((core > 0).any(axis=2, keepdims=True), above - core, above)
        base = np.maximum(base, 0).astype(np.float32)

        # ---- What is seen where a glow has gone
        behind, away = None, None
        if lights.glowing:
            away = behind_glow.degrees_to_cores(separation.lights, above.shape[:2], rows)
            behind = behind_glow.behind_glow(separation.background, separation.glow, away, rows)

        gain = GridGain(cycles, len(above) / rows[1], rows[0] == 0)
        layers = cls(rows, image.shape[:2], separation, lights, gain, base, behind, fixed=fixed, kept=kept)
        return replace(layers, below=layers._below(low, horizon, away)) if len(low) else layers

    def _below(self, low, horizon, away):
        """Rows that follow, and what they show where the reflection of a glow has gone."""
        lit_by = self.base + self._core(self._real(self.start())).numpy()[: len(self.base)]
        below = Below(low, self.base, horizon, lit_by if horizon == "keep" else None)
        if self.behind is None or horizon != "mirror":
            return below
        background, glow = self.separation.background, self.separation.glow
        gone = 1 - 1 / (glow @ LUMINANCE)[..., None]
        dark = background * np.exp(gone * self.behind.log_change(background))
        unlit = low * np.exp(np.float64(below.log_factor(tensor(dark)).numpy()))
        glow, gone, away = (field[below.mirrored] for field in (glow, gone, away))
        behind = behind_glow.behind_glow(unlit, glow, away, (self.shape[0], self.rows[1]))
        below.reveal(behind.log_change(unlit), gone, behind_glow.near_core(away)[..., None])
        return below

    def refined(self, octaves: Sequence[Octave]) -> Layers:
        """Return these layers with finer grids of the gain; :meth:`start` has zeros for them."""
        return replace(self, gain=self.gain.refined(octaves))

    def keeping(self, free: np.ndarray | None) -> Layers:
        """Return these layers with other texels (rows, W) that gain and saturation act on; None: all."""
        return replace(self, free=None if free is None else free[: self.shape[0]])

    # ---- parameters ----------------------------------------------------------------------------------------

    def start(self) -> dict[str, mi.TensorXf]:
        """Return the parameters of no edit, in units of :attr:`scales`: zeros, and spare lights dark."""
        n = self.lights.count
        flux = np.zeros((n, 3), np.float32)
        flux[n - SPARE :] = DARK / SCALES["flux"]
        start = {"turn": np.zeros((n, 3)), "flux": flux, "size": np.zeros((n, 1))}
        if self.ground_light:
            start["ground"] = np.zeros((1, 3))
        return {name: tensor(value) for name, value in (start | self.gain.init()).items()}

    @functools.cached_property
    def scales(self) -> dict[str, Any]:
        """Unit of each parameter, a number or an array of its shape."""
        return SCALES | self.gain.scales() | ({"ground": GROUND} if self.ground_light else {})

    @functools.cached_property
    def _scales(self):
        """The same on the device."""
        return {name: unit if np.ndim(unit) == 0 else tensor(unit) for name, unit in self.scales.items()}

    def _real(self, params):
        """Return parameters as logarithms and radians."""
        return {name: value * self._scales[name] for name, value in params.items()}

    def light_moves(self, params: dict) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """List where each light of the map was and is, unit vectors (3,), and the mean factor of its flux."""
        real = self._real({name: params[name] for name in ("turn", "flux")})
        turn, log_flux = (real[name].numpy().astype(np.float64) for name in ("turn", "flux"))
        return [
            (centre, rotated(centre, turn[k]), float(flux_factor(log_flux[k]).mean()))
            for k, centre in enumerate(self.lights.centres[: self.lights.own])
        ]

    # ---- composing -----------------------------------------------------------------------------------------

    def decode(self, params: dict) -> mi.TensorXf:
        """Compose the map, (rows, W, 3); without parameters of the gain that is 1."""
        sky, core = self.parts(params)
        return sky + core

    def parts(self, params: dict) -> tuple[mi.TensorXf, mi.TensorXf]:
        """Compose the map as :meth:`decode` does, its lights' cores apart: the sky, and cores."""
        real = self._real(params)
        above, core = self._above(real), self._core(real)
        sky = dr.ravel(above.sky)
        if self.below is not None:
            log_followed, log_gain = self._log_below(real, above, core)
            low = self._low(_log_saturation(real), log_followed, log_gain)
            sky = dr.concat((sky, dr.ravel(low.sky)))
        return mi.TensorXf(sky, (*self.whole, 3)), core

    def _core(self, real):
        core = self._unkept_core(real)
        if self.kept is not None:
            share, own_core = self._kept_core
            core = share * own_core + (1 - share) * core
        return core if self.fixed is None else core + tensor(self.fixed)

    def _unkept_core(self, real):
        """Render the cores, (rows, W, 3): rows that follow have none, as a light that sets is behind them."""
        core = self.lights.core(real["turn"], real["flux"], real["size"], self.shape)
        low = 3 * (self.whole[0] - self.shape[0]) * self.whole[1]
        if not low:
            return core
        return mi.TensorXf(dr.concat((dr.ravel(core), dr.zeros(mi.Float, low))), (*self.whole, 3))

    @functools.cached_property
    def _kept_core(self):
        """How far cores are kept, (rows, W, 3), and what they are of unmoved lights."""
        core = self._unkept_core(self._real(self.start()))
        return tensor(np.repeat(self.kept[..., None], 3, axis=2)), tensor(core.numpy())

    def _above(self, real, fields=None):
        """Compose the rows above the horizon, by default with the fields of the parameters."""
        texels = self._texels
        base = texels.base
        if texels.hidden is not None:
            own = slice(self.lights.own)
            left = staying(*(dr.detach(real[name]).numpy()[own] for name in ("turn", "flux", "size")))
            uncovered = flat(mi.Float, np.maximum(1 - left @ LUMINANCE, 0).astype(np.float32))
            base = base + texels.hidden * dr.gather(mi.Float, uncovered, texels.light)
        return compose(base, texels.directions, fields or self._fields(real))

    def _fields(self, real):
        """Return what parameters do to the rows above the horizon."""
        glows = self._texels.fields.glows
        if glows is not None:
            glows = replace(glows, turn=real["turn"], log_flux=real["flux"])
        log_gain = self.gain.evaluate(real, self._grids) if "gain.0" in real else None
        log_saturation = _log_saturation(real)
        return replace(self._texels.fields, glows=glows, log_saturation=log_saturation, log_gain=log_gain)

    def _log_below(self, real, above, core):
        """Log factors (rows, W, 3) of the rows that follow: by lights, or None; by what else the sky does."""
        before, log_followed = None, None
        if above.gone is not None:
            before = self.below.averaged(self._image(above.relit))
            log_followed = self.below.log_factor(before, above.gone)
        # A mirror has the sky's saturation itself.
        if self.mirrored and "saturation" in real:
            before = self._image(saturated(above.relit, dr.exp(_log_saturation(real))))
        sky = self._image(above.sky)
        ground = self.below.log_lit(sky, core, real.get("ground"))
        return log_followed, self.below.log_factor(sky, None, ground, before)

    def _low(self, log_saturation, log_followed, log_gain):
        """Compose the rows that follow."""
        fields = Fields(
            log_followed=None if log_followed is None else dr.unravel(mi.Color3f, log_followed.array),
            log_saturation=log_saturation if self.mirrored else None,
            log_gain=dr.unravel(mi.Color3f, log_gain.array),
            kept=None if self.kept is None else dr.opaque(mi.Float(self.kept[self.shape[0] :].ravel())),
        )
        return compose(self.below.radiance, None, fields)

    def _image(self, colours):
        return mi.TensorXf(dr.ravel(colours), (*self.shape, 3))

    @functools.cached_property
    def _texels(self) -> _Texels:
        (first, total), (height, width) = self.rows, self.shape
        directions = vectors(mi.Vector3f, latlong.directions(total, width, slice(first, first + height)))
        glows = None
        if self.behind is not None:
            start = self._real(self.start())
            glows = Glows(
                lights=self.lights,
                turn=start["turn"],
                log_flux=start["flux"],
                before=dr.opaque(self.lights.glow_before(directions)),
                offset=vectors(mi.Color3f, self.behind.offset),
                slope=vectors(mi.Color3f, self.behind.slope),
                faint=dr.opaque(mi.Float, self.behind.faint),
            )
        free = None if self.free is None else dr.opaque(mi.Float(np.float32(self.free.ravel())))
        kept = None if self.kept is None else dr.opaque(mi.Float(self.kept[:height].ravel()))
        hidden = np.zeros((height * width, 3))
        light = np.zeros(height * width, np.uint32)
        for i, one in enumerate(self.separation.lights):
            hidden[one.texels] = one.hidden
            light[one.texels] = i
        if self.kept is not None:
            hidden *= 1 - self.kept[:height].reshape(-1, 1)
        return _Texels(
            directions=directions,
            base=vectors(mi.Color3f, self.base),
            hidden=vectors(mi.Color3f, hidden) if hidden.any() else None,
            light=dr.opaque(mi.UInt32(light)),
            fields=Fields(glows=glows, share=free, kept=kept),
        )

    @functools.cached_property
    def _grids(self):
        return self.gain.prepare(self.shape)

    # ---- fields and derivatives ----------------------------------------------------------------------------

    def log_gain(self, params: dict) -> np.ndarray:
        """Return the log gain (rows, W, 3) of the rows above the horizon, also of kept texels."""
        return self._image(self.gain.evaluate(self._real(params), self._grids)).numpy()

    def texel_fields(self, params: dict) -> TexelFields:
        """Return what parameters do to every texel, as images that hold at any resolution."""
        nothing = np.zeros((*self.shape, 3), np.float32)
        log_gain = self.log_gain(params) if "gain.0" in params else nothing
        log_followed, offset, slope = nothing, nothing, nothing
        if self.behind is not None:
            offset, slope = self.behind.offset, self.behind.slope
        if self.below is not None:
            real = self._real(params)
            below = np.zeros((*self.below.shape, 3), np.float32)
            by_lights, further = self._log_below(real, self._above(real), self._core(real))
            log_gain = np.concatenate([log_gain, further.numpy()])
            log_followed = np.concatenate([nothing, below if by_lights is None else by_lights.numpy()])
            offset, slope = (np.concatenate([field, below]) for field in (offset, slope))
        return TexelFields(log_gain, log_followed, offset, slope)

    def gain_slope(self, params: dict) -> np.ndarray:
        """Return the derivative of the sky by the log gain of a texel, (rows, W, 3), above the horizon."""
        return self._slope_by("log_gain", self._real(params))

    def _slope_by(self, name, real):
        """Return the derivative of the sky by a field of :class:`.Fields`, 0 where it is None."""
        with dr.isolate_grad():
            fields = self._fields(real)
            value = getattr(fields, name)
            value = dr.zeros(mi.Color3f, math.prod(self.shape)) if value is None else mi.Color3f(value)
            dr.enable_grad(value)
            dr.set_grad(value, 1)
            sky = self._above(real, replace(fields, **{name: value})).sky
            dr.forward_to(sky)
            return self._image(dr.grad(sky)).numpy()

    def glow_slope(self, params: dict, sky: np.ndarray) -> np.ndarray:
        """Return the derivative of the map without cores by the log factor 1 + f G of a glow, (rows, W, 3).

        ``sky`` is that map; there are glows. Rows that follow change by as much, relatively, as what they
        mirror, fading.
        """
        slope = self._slope_by("log_glow", self._real(params))
        if self.below is None:
            return slope
        up = len(slope)
        share = np.divide(slope, sky[:up], out=np.zeros_like(slope), where=sky[:up] > 0)
        low = sky[up:] * share[self.below.mirrored] * self.below.fade[:, None, None]
        if self.kept is not None:
            low *= 1 - self.kept[up:, :, None]
        return np.concatenate([slope, low])

    def saturation_slope(self, params: dict) -> np.ndarray:
        """Return the derivative of the map without cores by the log saturation, (rows, W, 3): a difference.

        Of the saturation itself, in all rows that have it: what rows below the horizon follow is held.
        """
        real = self._real(params)
        fields = self._fields(real)
        log_followed, log_gain = None, None
        if self.mirrored:
            log_followed, log_gain = self._log_below(real, self._above(real), None)

        def sky_at(log_saturation):
            sky = dr.ravel(self._above(real, replace(fields, log_saturation=log_saturation)).sky)
            if self.mirrored:
                low = self._low(log_saturation, log_followed, log_gain)
                sky = dr.concat((sky, dr.ravel(low.sky)))
            return sky.numpy().reshape(-1, self.whole[1], 3)

        log_saturation = real["saturation"].array
        here = sky_at(log_saturation)
        slopes = np.zeros((*self.whole, 3), np.float32)
        slopes[: len(here)] = (here - sky_at(log_saturation - SATURATION_STEP)) / np.float32(SATURATION_STEP)
        return slopes

    def log_glow_of(self, i: int, turn: np.ndarray, log_flux: np.ndarray) -> np.ndarray | None:
        """Return log(1 + f_i G_i) (rows, W, 3) of light ``i`` where it is placed; None if it has no glow.

        Of rows that follow, at the texels that they mirror.
        ``turn`` and ``log_flux`` are as for :meth:`.Lights.glow`, of all lights.
        """
        if self.lights.glows[i] is None:
            return None
        factor = self.lights.glow_of(i, tensor(turn), tensor(log_flux), self._texels.directions)
        log_glow = self._image(dr.log(factor)).numpy()
        return log_glow if self.below is None else np.concatenate([log_glow, log_glow[self.below.mirrored]])

    def cores_of(
        self, i: int, placements: Sequence[tuple[np.ndarray, np.ndarray, float]], half_row: float = 1.0
    ) -> np.ndarray:
        """Return what :meth:`.Lights.cores_of` does of light ``i``, (k, rows, W, 3), without what is kept."""
        above = self.lights.cores_of(i, placements, self.shape, half_row)
        low = self.whole[0] - self.shape[0]
        cores = np.pad(above, ((0, 0), (0, low), (0, 0), (0, 0)))
        return cores if self.kept is None else cores * self.changeable

    # ---- rows ----------------------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that lights and gain act on: of the image, or of its sky where rows follow it."""
        height, width, _ = self.base.shape
        return height, width

    @property
    def changeable(self) -> np.ndarray | float:
        """How far each texel may change, (rows, W, 1); 1 where nothing is kept."""
        return 1.0 if self.kept is None else 1 - self.kept[..., None]

    @property
    def active(self) -> slice:
        """Rows of the map that :meth:`decode` composes."""
        return slice(self.rows[0], self.rows[0] + self.whole[0])

    @property
    def mirrored(self) -> bool:
        """Whether rows below the horizon mirror the sky."""
        return self.below is not None and self.below.kind == "mirror"

    @property
    def ground_light(self) -> GroundLight | None:
        """What falls on ground that goes by it; None where no row does."""
        return None if self.below is None else self.below.light

    @property
    def lit(self) -> np.ndarray:
        """How far each row of the image follows the light that falls on ground, (rows,)."""
        own = np.zeros(self.shape[0])
        return own if self.below is None else np.concatenate([own, self.below.lit])

    @property
    def own_ground(self) -> np.ndarray:
        """How far each row of the image has the ground's own factor, (rows,)."""
        own = np.zeros(self.shape[0])
        return own if self.below is None else np.concatenate([own, self.below.own_ground])

    def lighting(self, level: int) -> np.ndarray:
        """Return the share of the ground's irradiance that comes from the sky around each node, (nodes,).

        Of a map with a :attr:`ground_light`.
        """
        rows, columns = self.gain.sizes[level]
        ground = self.ground_light
        light = (self.base @ LUMINANCE * ground.cosine / float(ground.initial @ LUMINANCE)).ravel()
        total = np.zeros(rows * columns)
        for node, weight in self.gain.hats(level, self.shape):
            total += np.bincount(node, weight * light, rows * columns)
        return total

    def background(self) -> np.ndarray:
        """Return the image without its lights and their glow, (rows, W, 3)."""
        own = self.separation.background
        if self.below is None:
            return own
        glow = self.separation.glow[self.below.mirrored] ** self.below.fade[:, None, None]
        return np.concatenate([own, self.below.image / glow])

    def hats(self, level: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """List what :meth:`.GridGain.hats` does, of all texels of the image, those that follow included."""
        own = self.gain.hats(level, self.shape)
        if self.below is None:
            return own
        followed = np.concatenate([np.arange(self.shape[0]), self.below.mirrored])
        follows = np.concatenate([np.ones(self.shape[0]), self.below.fade])
        taps = []
        for node, weight in own:
            node = node.reshape(self.shape)[followed]
            weight = weight.reshape(self.shape)[followed] * follows[:, None]
            taps.append((node.ravel(), weight.ravel()))
        return taps


def _log_saturation(real):
    return real["saturation"].array if "saturation" in real else None
