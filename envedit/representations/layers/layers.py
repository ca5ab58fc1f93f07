"""Layers: a representation of the edit instead of the map.

    E = sat_k(E_0' * prod((1 + G_l) / (1 + G_l^0)) * exp(w r)) * exp(g) + sum(C_l)

E_0' is the original without the cores of its lights, G_l and C_l are glow and core of light l
(``separation.py``, ``lights.py``), with index 0 before they moved; w and r are what is seen where a glow has
gone (``behind_glow.py``), k is the saturation of the sky's colours (``saturation.py``), g is its smooth gain
(``gain.py``), and s_l, the factor of a light's flux, is in G_l. Rows below the horizon follow those above
(``below_horizon.py``), or are edited like them. Where f = exp(g) is above 1, E f is read as
E + (f - 1) ((1 - VEIL) E + VEIL lum(E)), :func:`.brightened`. Unmoved lights, no gain and k = 1 give the
original back, bit for bit outside the cores: the sky's own detail is kept, and the map has any resolution.

Longer than 400 lines: the terms of one formula, and what each is at other resolutions.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.representations.layers import behind_glow
from envedit.representations.layers.below_horizon import Below, Horizon, sky_rows
from envedit.representations.layers.gain import CYCLES, GridGain, Octave, brightened
from envedit.representations.layers.ground_light import GroundLight
from envedit.representations.layers.lights import DARK, SPARE, Lights
from envedit.representations.layers.saturation import by_saturation, saturated
from envedit.representations.layers.separation import MOVABLE, Separation, separate

SCALES = {"turn": 0.1, "flux": 1.0, "size": 0.5, "saturation": 1.0}
"""What a unit of each parameter is, in radians and logarithms: one learning rate then suits all."""

GROUND = 0.3
"""What a unit of the log factor of lit ground is: by so much the colour of daylight changes. With 1, Adam,
which has no prior, made ground pink under a mirror (three edits of the analytic sky: maps 34.3, 27.1 and
22.1 dB; with 0.3 36.5, 33.4 and 28.9)."""


class Layers:
    """Lights that move, a background under a smooth gain.

    Parameters may hold ``saturation`` (1, 1), the logarithm of k of ``saturation.py``; without it, k is 1.

    Parameters
    ----------
    rows : (int, int)
        First row of the images in their map, and the rows of that map.
    cycles : int
        Cycles of the gain around the horizon, before :meth:`refine`.
    horizon : str
        What rows below the horizon do where the image is a whole map: "mirror" or "keep", as of
        ``below_horizon.py``, or "free": edited as those above.

    aureoles : bool
        Lights that are added have the glow of the map's strongest, as for :class:`.Lights`.

    Attributes
    ----------
    separation : Separation
        What :meth:`encode` found in the image.
    lights : Lights
        Its lights and spare ones.
    gain : GridGain
        The gain's grids.
    rows, shape : (int, int)
        As given, and rows and columns that lights and gain act on: of the image, or of its sky where the
        rows below the horizon follow.
    whole : (int, int)
        Rows and columns of the image.
    below : Below or None
        The rows that follow.
    behind : BehindGlow or None
        What is seen where a glow has gone; None without glows.
    free : ndarray of bool (rows, W) or None
        As given to :meth:`keep`.
    scales : dict
        What a unit of each parameter is.
    """

    lr = 0.03
    models_edit, fitted = True, None
    Gain = GridGain

    def __init__(
        self,
        rows: tuple[int, int] | None = None,
        cycles: int = CYCLES,
        horizon: Horizon = "free",
        aureoles: bool = True,
    ):
        self.rows, self._cycles, self._horizon, self._aureoles = rows, cycles, horizon, aureoles
        self.below: Below | None = None
        self.separation: Separation | None = None
        self.free: np.ndarray | None = None

    def encode(self, image: np.ndarray, seed: int = 0) -> dict:
        """Separate the image; ``seed`` is not used.

        Raises
        ------
        InputError
            If a texel is not finite, negative, or brighter than :data:`.radiance.BRIGHTEST`.
        """
        self.rows = self.rows or (0, image.shape[0])
        require_radiance(image, "layers", self.rows[0], BRIGHTEST)
        image = np.ascontiguousarray(image, np.float32)
        self.whole, low = image.shape[:2], None
        if self._horizon != "free" and self.rows == (0, len(image)):
            up = sky_rows(len(image))
            image, low = np.ascontiguousarray(image[:up]), image[up:]
        self.separation = separate(image, self.rows, MOVABLE)
        self.lights = Lights(self.separation.lights, self.rows, image.shape[1], self._aureoles)
        self.shape = image.shape[:2]
        core = self.separation.core
        base = np.where((core > 0).any(axis=2, keepdims=True), image - core, image)
        self.base = np.maximum(base, 0).astype(np.float32)
        self.behind = None
        if self.lights.glowing:
            self._away = behind_glow.degrees_to_cores(self.separation.lights, self.shape, self.rows)
            self.behind = behind_glow.behind_glow(
                self.separation.background, self.separation.glow, self._away, self.rows
            )
        self.gain = self.Gain(self._cycles, self.shape[0] / self.rows[1], self.rows[0] == 0)
        self._prepared: dict = {}
        n = self.lights.count
        flux = np.zeros((n, 3), np.float32)
        flux[n - SPARE :] = DARK / SCALES["flux"]
        given = {"turn": np.zeros((n, 3), np.float32), "flux": flux, "size": np.zeros((n, 1), np.float32)}
        params = {name: tensor(value) for name, value in given.items()}
        self.below = self._below(low, params) if low is not None and len(low) else None
        if self.ground_light:
            params["ground"] = tensor(np.zeros((1, 3), np.float32))
        self.scales = self._units()
        return params | {name: tensor(value) for name, value in self.gain.init().items()}

    def _below(self, low, params):
        """Rows that follow, and what they show where the reflection of a glow has gone."""
        above = self._unmoved(params) if self._horizon == "keep" else None
        below = Below(low, self.base, self._horizon, above)
        if self.behind is None or self._horizon != "mirror":
            return below
        background, glow = self.separation.background, self.separation.glow
        gone = 1 - 1 / (glow @ LUMINANCE)[..., None]
        dark = background * np.exp(gone * self.behind.log_change(background))
        unlit = low * np.exp(np.float64(below.log_factor(tensor(dark)).numpy()))
        glow, gone, away = (one[below.mirrored] for one in (glow, gone, self._away))
        behind = behind_glow.behind_glow(unlit, glow, away, (self.shape[0], self.rows[1]))
        below.reveal(behind.log_change(unlit), gone, behind_glow.near_core(away)[..., None])
        return below

    def refine(self, params: dict, octaves: list[Octave]) -> dict:
        """Give the gain finer grids and ``params``, of :meth:`encode`, what these start from: zero."""
        self.gain.refine(octaves)
        self.scales = {
            name: unit if np.ndim(unit) == 0 else tensor(unit) for name, unit in self._units().items()
        }
        self._prepared = {}
        new = {k: tensor(v) for k, v in self.gain.init().items() if k not in params}
        return params | new

    def keep(self, free: np.ndarray | None) -> None:
        """Say which texels (rows, W) may change other than by a light's moving; None: all."""
        self.free = None if free is None else free[: self.shape[0]]
        self._prepared = {}

    def decode(self, params: dict, shape: tuple[int, int] | None = None) -> mi.TensorXf:
        """Compose the map at the resolution of the image, or at any other ``shape`` (rows, W).

        Rows that follow have the resolution of the image. Without parameters of the gain it is 1.
        """
        sky, core = self.parts(params, shape)
        return sky + core

    def parts(self, params: dict, shape: tuple[int, int] | None = None) -> tuple[mi.TensorXf, mi.TensorXf]:
        """Compose the map as :meth:`decode` does, its lights' cores apart: the sky, and cores."""
        shape = shape or self.shape
        if self.below is not None and shape != self.shape:
            raise ValueError(f"rows below the horizon follow at {self.whole} texels only, asked for {shape}")
        rows = self._at(shape)[0]
        real = self._real(params)
        lit, gone = self._lit(real, shape)
        sky = self._under_gain(real, lit, shape)
        if self.below is None:
            return sky, self._core(real, shape, rows)
        core = self._core(real, self.whole, rows)
        by_lights, further = self._log_below(real, lit, gone, sky, core)
        low = self._low(real, by_lights)
        low = dr.ravel(brightened(low, dr.unravel(mi.Color3f, dr.exp(further).array)))
        return mi.TensorXf(dr.concat((sky.array, low)), (*self.whole, 3)), core

    def _real(self, params):
        """Return parameters as logarithms and radians."""
        return {name: value * self.scales[name] for name, value in params.items()}

    def _units(self):
        """Return what a unit of each parameter is; the factor of lit ground is a logarithm, as the gain."""
        return SCALES | self.gain.scales() | ({"ground": GROUND} if self.ground_light else {})

    def _unmoved(self, params):
        """Rows above the horizon as :meth:`decode` composes them where nothing has changed."""
        real = {name: value * SCALES[name] for name, value in params.items()}
        return self.base + self._core(real, self.shape, self.rows).numpy()

    def _core(self, real, shape, rows):
        return self.lights.core(real["turn"], real["flux"], real["size"], shape, rows)

    def _lit(self, real, shape):
        """Return the sky under its lights, and which share of a texel's light was a glow's and is gone."""
        _, d, base, before, _, _, behind = self._at(shape)
        if not self.lights.glowing:
            return base, None
        ratio = self.lights.glow_ratio(real["turn"], real["flux"], d, before)
        gone = behind_glow.gone_of(ratio)
        return base * ratio * dr.exp(gone * behind), gone

    def _under_gain(self, real, lit, shape):
        """Return the sky with its saturation and its gain."""
        *_, gain, free, _ = self._at(shape)
        sky = _coloured(real, lit)
        if "gain.0" in real:
            sky = brightened(sky, dr.exp(self.gain.evaluate(real, gain)))
        sky = sky if free is None else dr.select(free, sky, lit)
        return mi.TensorXf(dr.ravel(sky), (*shape, 3))

    def log_below(self, params: dict) -> tuple[np.ndarray, np.ndarray]:
        """Return log factors (rows, W, 3) of rows that follow: by lights, before saturation; and further."""
        if self.below is None:
            return (np.zeros((0, self.shape[1], 3), np.float32),) * 2
        real = self._real(params)
        lit, gone = self._lit(real, self.shape)
        sky, core = self._under_gain(real, lit, self.shape), self._core(real, self.whole, self.rows)
        by_lights, further = self._log_below(real, lit, gone, sky, core)
        return np.broadcast_to(by_lights.numpy(), further.shape), further.numpy()

    def _log_below(self, real, lit, gone, sky, core):
        """Log factors of the rows that follow: by what lights do, and by what else the sky does."""
        before = None
        by_lights = mi.TensorXf(np.zeros((1, 1, 1), np.float32))
        if self.lights.glowing:
            before = self.below.averaged(self._image(lit))
            by_lights = self.below.log_factor(before, gone)
        ground = self.below.log_lit(sky, core, real.get("ground"))
        if "gain.0" not in real and "saturation" not in real:  # the sky is as lights have made it
            return by_lights, self.below.reshaped(ground)
        if self.mirrored and "saturation" in real:
            before = self._image(_coloured(real, lit))
        return by_lights, self.below.log_factor(sky, None, ground, before)

    def _low(self, real, by_lights):
        """Rows that follow, before the gain."""
        low = self.below.radiance
        if self.lights.glowing:
            low = low * dr.unravel(mi.Color3f, dr.exp(by_lights).array)
        return _coloured(real, low) if self.mirrored else low

    @property
    def active(self) -> slice:
        """Rows of the map that :meth:`decode` composes."""
        return slice(self.rows[0], self.rows[0] + self.whole[0])

    @property
    def mirrored(self) -> bool:
        """Whether rows below the horizon mirror the sky."""
        return self.below is not None and self.below.kind == "mirror"

    @property
    def followed(self) -> np.ndarray:
        """Row of lights and gain that each row of the image goes by, (rows,)."""
        own = np.arange(self.shape[0])
        return own if self.below is None else np.concatenate([own, self.below.mirrored])

    @property
    def follows(self) -> np.ndarray:
        """How far each row of the image goes by lights and gain, (rows,): 1, less where ground is kept."""
        own = np.ones(self.shape[0])
        return own if self.below is None else np.concatenate([own, self.below.fade])

    @property
    def ground_light(self) -> GroundLight | None:
        """What falls on ground that goes by it; None where no row does."""
        return None if self.below is None else self.below.light

    @property
    def lit(self) -> np.ndarray:
        """How far each row of the image follows the light that falls on ground, (rows,)."""
        own = np.zeros(self.shape[0])
        return own if self.below is None else np.concatenate([own, self.below.lit])

    def lighting(self, level: int) -> np.ndarray:
        """Return the share of the ground's irradiance that comes from the sky around each node, (nodes,).

        Of a map with a :attr:`ground_light`.
        """
        rows, columns = self.gain.sizes[level]
        falls = self.ground_light
        light = (self.base @ LUMINANCE * falls.cosine / float(falls.initial @ LUMINANCE)).ravel()
        part = np.zeros(rows * columns)
        for node, share in self.gain.hats(level, self.shape):
            part += np.bincount(node, share * light, rows * columns)
        return part

    def background(self) -> np.ndarray:
        """Return the image without its lights and their glow, (rows, W, 3)."""
        own = self.separation.background
        if self.below is None:
            return own
        glow = self.separation.glow[self.below.mirrored] ** self.below.fade[:, None, None]
        return np.concatenate([own, self.below.image / glow])

    def hats(self, level: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """List what :meth:`.GridGain.hats` does, of all texels of the image, those that follow included."""
        rows, taps = self.followed, []
        for node, share in self.gain.hats(level, self.shape):
            node, share = node.reshape(self.shape)[rows], share.reshape(self.shape)[rows]
            taps.append((node.ravel(), (share * self.follows[:, None]).ravel()))
        return taps

    def before_gain(self, params: dict) -> np.ndarray:
        """Return what the gain multiplies, (rows, W, 3): the sky under its lights, with its saturation."""
        real = self._real(params)
        return self._image(_coloured(real, self._lit(real, self.shape)[0])).numpy()

    def by_saturation(self, params: dict) -> tuple[np.ndarray, np.ndarray]:
        """Return the image before the gain, without cores, and its derivative by the log saturation."""
        real = self._real(params)
        lit, gone = self._lit(real, self.shape)
        parts, image = [(slice(self.shape[0]), lit)], np.empty((*self.whole, 3), np.float32)
        if self.below is not None:
            unsaturated = {name: value for name, value in real.items() if name != "saturation"}
            by_lights = self.below.log_factor(self._image(lit), gone)
            low = self._low(unsaturated, by_lights)
            image[self.shape[0] :] = dr.ravel(low).numpy().reshape(*self.below.shape, 3)
            parts += [(slice(self.shape[0], None), low)] * self.mirrored
        return by_saturation(image, parts, real["saturation"].array)

    def log_gain(self, params: dict) -> np.ndarray:
        """Return the logarithm of the gain (rows, W, 3) float32, at the resolution of the image.

        Of all texels that the gain acts on itself, also of those that :meth:`keep` excepts from it.
        """
        real = self._real(params)
        field = self.gain.evaluate(real, self.gain.prepare(self.shape, self.rows))
        return self._image(field).numpy()

    def log_glow_of(self, i: int, turn: np.ndarray, log_flux: np.ndarray) -> np.ndarray | None:
        """Return log(1 + s_i G_i) (rows, W, 3) of light ``i`` where it is placed; None if it has no glow.

        ``turn`` and ``log_flux`` are as for :meth:`.Lights.glow`, of all lights.
        """
        if self.lights.glows[i] is None:
            return None
        factor = self.lights.glow_of(i, tensor(turn), tensor(log_flux), self._at(self.shape)[1])
        found = self._image(dr.log(factor)).numpy()
        if self.below is None:
            return found
        return np.concatenate([found, found[self.below.mirrored] * self.below.fade[:, None, None]])

    def _image(self, colours):
        return mi.TensorXf(dr.ravel(colours), (*self.shape, 3))

    def _at(self, shape):
        if shape not in self._prepared:
            self._prepared[shape] = self._prepare(shape)
        return self._prepared[shape]

    def _prepare(self, shape):
        first, total = self.rows
        height, width = self.shape
        finer = shape[0] / height
        rows = (0, shape[0])
        if (first, total) != (0, height):
            rows = round(first * finer), round(total * finer)
        d = latlong.directions(rows[1], shape[1])[rows[0] : rows[0] + shape[0]]
        base, behind = self._finer(self.base, shape, d), None
        if self.behind is not None:
            glow = self._finer(self.separation.glow, shape, d)
            smooth = [self._finer(field, shape, d) for field in (self.behind.offset, self.behind.slope)]
            change = behind_glow.BehindGlow(smooth[0], smooth[1], self.behind.faint).log_change(base / glow)
            behind = dr.opaque(mi.Color3f(np.ascontiguousarray(change.reshape(-1, 3).T, np.float32)))
        d = dr.opaque(mi.Vector3f(np.ascontiguousarray(d.reshape(-1, 3).T, np.float32)))
        before = dr.opaque(self.lights.glow_before(d)) if self.lights.glowing else mi.Color3f(1)
        base = dr.opaque(mi.Color3f(np.ascontiguousarray(base.reshape(-1, 3).T)))
        free = None
        if self.free is not None:
            row = np.arange(shape[0]) * height // shape[0]
            column = np.arange(shape[1]) * width // shape[1]
            free = dr.opaque(mi.Bool(self.free[row][:, column].ravel()))
        return rows, d, base, before, self.gain.prepare(shape, rows), free, behind

    def _finer(self, image, shape, d):
        """Interpolate an image (rows, W, 3) at the directions of another resolution."""
        if shape == self.shape:
            return image
        first, total = self.rows
        whole = np.repeat(image[-1:], total, axis=0)
        whole[first : first + len(image)] = image
        whole[:first] = image[:1]
        return latlong.lookup(whole, d).astype(np.float32)


def _coloured(real, radiance):
    """Return radiance with the saturation of its colours, where that is a parameter."""
    return saturated(radiance, dr.exp(real["saturation"].array)) if "saturation" in real else radiance
