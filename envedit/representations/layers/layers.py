"""Layers: a representation of the edit instead of the map.

    E = E_0' * prod((1 + G_l) / (1 + G_l^0)) * exp(w r) * exp(g) + sum(C_l)

E_0' is the original without the cores of its lights, G_l and C_l are glow and core of light l
(``separation.py``, ``lights.py``), with index 0 before they moved; w and r are what is seen where a glow has
gone (``behind_glow.py``), g is the smooth gain of the sky (``gain.py``), and s_l, the factor of a light's
flux, is in G_l. Rows below the horizon follow those above (``below_horizon.py``), or are edited like them.
Where f = exp(g) is above 1, E f is read as
E + (f - 1) ((1 - VEIL) E + VEIL lum(E)), :func:`.brightened`. Unmoved lights and no gain give the original
back, bit for bit outside the cores: there is nothing to fit, the sky's own detail is kept, and the map has
any resolution.
"""

from __future__ import annotations

from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.representations.layers.behind_glow import BehindGlow, behind_glow
from envedit.representations.layers.below_horizon import Below, sky_rows
from envedit.representations.layers.gain import CYCLES, GridGain, Octave, brightened
from envedit.representations.layers.ground_light import GroundLight
from envedit.representations.layers.lights import DARK, SPARE, Lights
from envedit.representations.layers.saturation import by_saturation, saturated
from envedit.representations.layers.separation import MOVABLE, Separation, separate

Horizon = Literal["mirror", "keep", "free"]
UNSEEN = 1 / 512
"""Relative change of radiance below a display's resolution: a step of 8 bits is twice as large."""
SCALES = {"turn": 0.1, "flux": 1.0, "size": 0.5, "saturation": 1.0}
"""What a unit of each parameter is, in radians and logarithms: one learning rate then suits all."""

GROUND = 0.3
"""What a unit of the log factor of lit ground is: by so much the colour of daylight changes. With 1, Adam,
which has no prior, made ground pink under a mirror (three edits of the analytic sky: maps 34.3, 27.1 and
22.1 dB; with 0.3 36.5, 33.4 and 28.9)."""


def unseen_kept(original: np.ndarray, edited: np.ndarray) -> np.ndarray:
    """Give texels of an edited image the original's bits where no channel changes by over :data:`UNSEEN`."""
    seen = np.abs(edited - original) > UNSEEN * original
    return np.where(seen.any(axis=2, keepdims=True), edited, original)


def gone_of(ratio: mi.Color3f) -> mi.Float:
    """Return the share of radiance that was a glow's and is gone, where the glow changes by a ratio."""
    return dr.maximum(mi.luminance(1 - ratio), 0)


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

    def __init__(self, rows: tuple[int, int] | None = None, cycles: int = CYCLES, horizon: Horizon = "free"):
        self.rows, self._cycles, self._horizon = rows, cycles, horizon
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
        self.lights = Lights(self.separation.lights, self.rows, image.shape[1])
        self.shape = image.shape[:2]
        core = self.separation.core
        base = np.where((core > 0).any(axis=2, keepdims=True), image - core, image)
        self.base = np.maximum(base, 0).astype(np.float32)
        self.behind = None
        if self.lights.glowing:
            told = self.separation.background, self.separation.glow, self._away()
            self.behind = behind_glow(*told, self.rows)
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

    def _away(self):
        """Degrees from each texel to the nearest light that has a glow, (rows, W); 0 within its core.

        A core is taken to be a disc of the solid angle of its texels.
        """
        first, total = self.rows
        toward = latlong.directions(total, self.shape[1])[first : first + self.shape[0]]
        omega = latlong.lookup_solid_angles(total, self.shape[1])
        glowing = [light for light in self.separation.lights if light.glow is not None]
        radii = [np.sqrt(omega[first + one.texels // self.shape[1]].sum() / np.pi) for one in glowing]
        angles = np.arccos(np.clip(toward @ np.transpose([one.direction for one in glowing]), -1, 1))
        return np.degrees(np.maximum(angles - radii, 0).min(axis=2))

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
        mirrored = glow[below.mirrored], self._away()[below.mirrored]
        behind = behind_glow(unlit, *mirrored, (self.shape[0], self.rows[1]))
        below.reveal(behind.log_change(unlit))
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

        Rows that follow have the resolution of the image.
        """
        sky, core = self.parts(params, shape)
        return sky + core

    def parts(self, params: dict, shape: tuple[int, int] | None = None) -> tuple[mi.TensorXf, mi.TensorXf]:
        """Compose the map as :meth:`decode` does, its lights' cores apart: the sky, and cores."""
        height, width = shape or self.shape
        shape = height, width
        if self.below is not None and shape != self.shape:
            raise ValueError(f"rows below the horizon follow at {self.whole} texels only, asked for {shape}")
        rows = self._at(shape)[0]
        real = {name: value * self.scales[name] for name, value in params.items()}
        sky, gone = self._sky(real, shape)
        if self.below is None:
            return sky, self._core(real, shape, rows)
        core = self._core(real, self.whole, rows)
        factor = dr.unravel(mi.Color3f, dr.exp(self._log_below(real, sky, gone, core)).array)
        low = self.below.radiance
        if self.mirrored and "saturation" in real:
            low = saturated(low, _exponent(real))
        low = dr.ravel(brightened(low, factor))
        return mi.TensorXf(dr.concat((sky.array, low)), (*self.whole, 3)), core

    def _units(self):
        """Return what a unit of each parameter is; the factor of lit ground is a logarithm, as the gain."""
        return SCALES | self.gain.scales() | ({"ground": GROUND} if self.ground_light else {})

    def _unmoved(self, params):
        """Rows above the horizon as :meth:`decode` composes them where nothing has changed."""
        real = {name: value * SCALES[name] for name, value in params.items()}
        return self.base + self._core(real, self.shape, self.rows).numpy()

    def _core(self, real, shape, rows):
        return self.lights.core(real["turn"], real["flux"], real["size"], shape, rows)

    def _sky(self, real, shape):
        """Background and glow (rows, W, 3); share of a texel's radiance that was a glow's and is gone."""
        _, d, base, before, gain, free, behind = self._at(shape)
        base = saturated(base, _exponent(real)) if "saturation" in real else base
        factor = dr.exp(self.gain.evaluate(real, gain))
        factor = dr.select(free, factor, 1) if free is not None else factor
        sky, gone = brightened(base, factor), None
        if self.lights.glowing:
            ratio = self.lights.glow(real["turn"], real["flux"], d) / before
            gone = gone_of(ratio)
            sky *= ratio * dr.exp(gone * behind)
        return mi.TensorXf(dr.ravel(sky), (*shape, 3)), gone

    def log_below(self, params: dict) -> np.ndarray:
        """Return the log factor of the rows that follow, (rows, W, 3); without such rows, none."""
        if self.below is None:
            return np.zeros((0, self.shape[1], 3), np.float32)
        real = {name: value * self.scales[name] for name, value in params.items()}
        sky, gone = self._sky(real, self.shape)
        core = self._core(real, self.whole, self.rows)
        return self._log_below(real, sky, gone, core).numpy()

    def _log_below(self, real, sky, gone, core):
        """Log factor of the rows that follow; of a mirror, beside what the saturation of its own does."""
        before = None
        if self.mirrored and "saturation" in real:
            before = saturated(self._at(self.shape)[2], _exponent(real))
            before = mi.TensorXf(dr.ravel(before), (*self.shape, 3))
        return self.below.log_factor(sky, gone, core, real.get("ground"), before)

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

    def sky_base(self, params: dict) -> np.ndarray:
        """Return what the gain multiplies, (rows, W, 3): the original without cores, with its saturation."""
        if "saturation" not in params:
            return self.base
        real = {"saturation": params["saturation"] * self.scales["saturation"]}
        base = saturated(self._at(self.shape)[2], _exponent(real))
        return mi.TensorXf(dr.ravel(base), (*self.shape, 3)).numpy()

    def base_by_saturation(self, params: dict) -> tuple[np.ndarray, np.ndarray]:
        """Return the image without cores, (rows, W, 3), and its derivative by the log saturation."""
        image = self.base if self.below is None else np.concatenate([self.base, self.below.image])
        parts = [(slice(self.shape[0]), self._at(self.shape)[2])]
        if self.mirrored:
            parts.append((slice(self.shape[0], None), self.below.radiance))
        return by_saturation(image, parts, (params["saturation"] * self.scales["saturation"]).array)

    def log_gain(self, params: dict) -> np.ndarray:
        """Return the logarithm of the gain (rows, W, 3) float32, at the resolution of the image.

        Of all texels that the gain acts on itself, also of those that :meth:`keep` excepts from it.
        """
        real = {name: value * self.scales[name] for name, value in params.items()}
        field = self.gain.evaluate(real, self.gain.prepare(self.shape, self.rows))
        return mi.TensorXf(dr.ravel(field), (*self.shape, 3)).numpy()

    def log_glow_of(self, i: int, turn: np.ndarray, log_flux: np.ndarray) -> np.ndarray | None:
        """Return log(1 + s_i G_i) (rows, W, 3) of light ``i`` where it is placed; None if it has no glow.

        ``turn`` and ``log_flux`` are as for :meth:`.Lights.glow`, of all lights.
        """
        if i >= len(self.separation.lights) or self.separation.lights[i].glow is None:
            return None
        factor = self.lights.glow_of(i, tensor(turn), tensor(log_flux), self._at(self.shape)[1])
        found = mi.TensorXf(dr.ravel(dr.log(factor)), (*self.shape, 3)).numpy()
        if self.below is None:
            return found
        return np.concatenate([found, found[self.below.mirrored] * self.below.fade[:, None, None]])

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
            change = BehindGlow(smooth[0], smooth[1], self.behind.faint).log_change(base / glow)
            behind = dr.opaque(mi.Color3f(np.ascontiguousarray(change.reshape(-1, 3).T, np.float32)))
        d = dr.opaque(mi.Vector3f(np.ascontiguousarray(d.reshape(-1, 3).T, np.float32)))
        n, before = self.lights.count, mi.Color3f(1)
        if self.lights.glowing:
            still = mi.TensorXf(np.zeros((n, 3), np.float32))
            before = dr.opaque(self.lights.glow(still, still, d))
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


def _exponent(real):
    return dr.exp(real["saturation"].array)
