"""Layers: a representation of the edit instead of the map.

    E = E_0' * prod((1 + G_l) / (1 + G_l^0)) * exp(g) + sum(C_l)

E_0' is the original without the cores of its lights, G_l and C_l are glow and core of light l
(``separation.py``, ``lights.py``), with index 0 before they moved, and g is the smooth gain of the sky
(``gain.py``); s_l, the factor of a light's flux, is in G_l. Where f = exp(g) is above 1, E f is read as
E + (f - 1) ((1 - VEIL) E + VEIL lum(E)), :func:`brightened`. Unmoved lights and no gain give the original
back, bit for bit outside the cores: there is nothing to fit, the sky's own detail is kept, and the map has
any resolution.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.representations.layers.gain import CYCLES, GridGain, Octave
from envedit.representations.layers.lights import DARK, SPARE, Lights
from envedit.representations.layers.separation import Separation, separate

VEIL = 0.2
"""Share of luminance in what a gain above 1 adds: a channel that is black cannot be scaled up."""
SCALES = {"turn": 0.1, "flux": 1.0, "size": 0.5}
"""What a unit of each parameter is, in radians and logarithms: one learning rate then suits all."""


def brightened(base: mi.Color3f, factor: mi.Color3f) -> mi.Color3f:
    """Scale radiance; what is brightened is so in part by its luminance: a black channel stays in step."""
    grey = base * (1 - VEIL) + mi.luminance(base) * VEIL
    return dr.select(factor > 1, base + (factor - 1) * grey, base * factor)


class Layers:
    """Lights that move, a background under a smooth gain.

    Parameters
    ----------
    rows : (int, int)
        First row of the images in their map, and the rows of that map.
    cycles : int
        Cycles of the gain around the horizon, before :meth:`refine`.

    Attributes
    ----------
    separation : Separation
        What :meth:`encode` found in the image.
    lights : Lights
        Its lights and spare ones.
    gain : GridGain
        The gain's grids.
    rows, shape : (int, int)
        As given, and rows and columns of the image.
    free : ndarray of bool (rows, W) or None
        As :meth:`keep` was told.
    scales : dict
        What a unit of each parameter is.
    """

    lr = 0.03
    models_edit, fitted = True, None
    Gain = GridGain

    def __init__(self, rows: tuple[int, int] | None = None, cycles: int = CYCLES):
        self.rows, self._cycles = rows, cycles
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
        self.separation = separate(image, self.rows)
        self.lights = Lights(self.separation.lights, self.rows, image.shape[1])
        self.shape = image.shape[:2]
        core = self.separation.core
        base = np.where((core > 0).any(axis=2, keepdims=True), image - core, image)
        self.base = np.maximum(base, 0).astype(np.float32)
        self.gain = self.Gain(self._cycles, self.shape[0] / self.rows[1])
        self.scales = SCALES | self.gain.scales()
        self._prepared = {}
        n = self.lights.count
        flux = np.zeros((n, 3), np.float32)
        flux[n - SPARE :] = DARK / SCALES["flux"]
        params = {"turn": np.zeros((n, 3), np.float32), "flux": flux, "size": np.zeros((n, 1), np.float32)}
        params |= self.gain.init()
        return {name: tensor(value) for name, value in params.items()}

    def refine(self, params: dict, octaves: list[Octave]) -> dict:
        """Give the gain finer grids and ``params``, of :meth:`encode`, what these start from: zero."""
        self.gain.refine(octaves)
        self.scales = {
            name: unit if np.ndim(unit) == 0 else tensor(unit)
            for name, unit in (SCALES | self.gain.scales()).items()
        }
        self._prepared = {}
        new = {k: tensor(v) for k, v in self.gain.init().items() if k not in params}
        return params | new

    def keep(self, free: np.ndarray | None) -> None:
        """Say which texels (rows, W) may change other than by a light's moving; None: all."""
        self.free = free
        self._prepared = {}

    def decode(self, params: dict, shape: tuple[int, int] | None = None) -> mi.TensorXf:
        """Compose the map at the resolution of the image, or at any other ``shape`` (rows, W)."""
        shape = tuple(shape or self.shape)
        if shape not in self._prepared:
            self._prepared[shape] = self._prepare(shape)
        rows, d, base, before, gain, free = self._prepared[shape]
        real = {name: value * self.scales[name] for name, value in params.items()}
        factor = dr.exp(self.gain.evaluate(real, gain))
        factor = dr.select(free, factor, 1) if free is not None else factor
        sky = brightened(base, factor)
        if self.lights.glowing:
            sky *= self.lights.glow(real["turn"], real["flux"], d) / before
        sky = mi.TensorXf(dr.ravel(sky), (*shape, 3))
        return sky + self.lights.core(real["turn"], real["flux"], real["size"], shape, rows)

    def log_gain(self, params: dict) -> np.ndarray:
        """Return the logarithm of the gain (rows, W, 3) float32, at the resolution of the image.

        Of all texels, also of those that :meth:`keep` excepts from it.
        """
        real = {name: value * self.scales[name] for name, value in params.items()}
        field = self.gain.evaluate(real, self.gain.prepare(self.shape, self.rows))
        return mi.TensorXf(dr.ravel(field), (*self.shape, 3)).numpy()

    def _prepare(self, shape):
        first, total = self.rows
        height, width = self.shape
        finer = shape[0] / height
        rows = (0, shape[0])
        if (first, total) != (0, height):
            rows = round(first * finer), round(total * finer)
        d = latlong.directions(rows[1], shape[1])[rows[0] : rows[0] + shape[0]]
        base = self.base
        if shape != self.shape:
            whole = np.repeat(base[-1:], total, axis=0)
            whole[first : first + height] = base
            whole[:first] = base[:1]
            base = latlong.lookup(whole, d).astype(np.float32)
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
        return rows, d, base, before, self.gain.prepare(shape, rows), free
