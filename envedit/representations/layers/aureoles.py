"""The glow of a light, wherever the light is placed and however bright it is made.

A glow G is measured as a factor of the sky around a light (``separation.py``). Of a light at direction d,
with s times its flux, it is f(s) c(d) G, with f(s) = 2 s / (1 + s) and c(d) = min(1, M(d_0) / M(d)): d_0 is
where the light was, M(d) the mean radiance of the background under G around d, per channel. A glow is light
of the sun that air has scattered. Before bright clouds or at a bright horizon it is therefore no brighter in
itself, c, nor of another colour. It is gone with its light, but of a brighter sun it is hardly brighter: on
eight PureSky maps, whose suns have 0.06 to 25 times the irradiance of their skies, the glow at 10 degrees
goes with the flux to the power of 0.12 (``python -m experiments natural.aureoles run``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.representations.layers.separation import GLOW_DEGREES, coarse

CLEAR_FLUX, CLEAR_GLOW, CLEAR_GLOW_DEGREES = 40.0, 26.0, 15.0
"""A sun in a clear sky: its flux over the irradiance of the ground by the sky, and its glow, CLEAR_GLOW
exp(-angle / CLEAR_GLOW_DEGREES). Measured on three PureSky maps with clear suns
(``tests/oracle/test_lights.py`` compares them)."""
NODES = 11
"""Nodes of M along each side of a cube around the sphere: 11 degrees apart, less than a glow is wide.
Derived."""


def glow_strength(factor: Any) -> Any:
    """Return f, what a glow is multiplied by where the flux of its light is; of NumPy and Dr.Jit."""
    return 2 * factor / (1 + factor)


def log_strength_slope(factor: np.ndarray) -> np.ndarray:
    """Return d log f / d log s, 1 / (1 + s)."""
    return 1 / (1 + factor)


def clear_glow() -> np.ndarray:
    """Return the glow (len(GLOW_DEGREES), 3) of a sun in a clear sky, of :data:`CLEAR_FLUX`."""
    table = CLEAR_GLOW * np.exp(-GLOW_DEGREES / CLEAR_GLOW_DEGREES)[:, None] * np.ones(3)
    table[-1] = 0
    return table


def ground_irradiance(sky: np.ndarray, rows: tuple[int, int]) -> np.ndarray:
    """Return the irradiance (3,) of level ground by a sky (n, W, 3) without lights.

    ``rows`` are its first row in the map, and the rows of the map; those below the horizon light nothing.
    """
    first, total = rows
    weight = latlong.level_weights(total, sky.shape[1])[first : first + len(sky)]
    return weight @ sky.sum(axis=1, dtype=np.float64)


@dataclass(frozen=True)
class Sky:
    """A background in means over some degrees."""

    # directions, radiance: (n, 3); omega: (n,), solid angle
    directions: np.ndarray
    radiance: np.ndarray
    omega: np.ndarray
    irradiance: np.ndarray  # of the ground, (3,)

    @classmethod
    def of(cls, background: np.ndarray, rows: tuple[int, int]) -> Sky:
        """Average a background (rows, W, 3); ``rows`` are its first row, and the rows of the map."""
        shape, known, radiance, omega = coarse(background, *rows)
        return cls(
            directions=latlong.directions(*shape).reshape(-1, 3)[known],
            radiance=radiance,
            omega=omega,
            irradiance=ground_irradiance(background, rows),
        )

    def mean(self, glow: np.ndarray, toward: np.ndarray) -> np.ndarray:
        """Return M (k, 3), the mean radiance under a glow (len(GLOW_DEGREES), 3) around directions (k, 3)."""
        angle = np.degrees(np.arccos(np.clip(toward @ self.directions.T, -1, 1)))
        means = []
        for of_channel, radiance in zip(glow.T, self.radiance.T, strict=True):
            weight = np.interp(angle, GLOW_DEGREES, of_channel) * self.omega
            means.append(weight @ radiance / np.maximum(weight.sum(axis=1), 1e-30))
        return np.stack(means, axis=1)


class Aureole:
    """The glow of one light on the device.

    ``glow`` (len(GLOW_DEGREES), 3) is as of :class:`.separation.Light`. At ``home`` (3,) it has this glow;
    None: in a sky that is the same all around. ``sky`` is the background that it brightens; None: c is 1.
    """

    def __init__(self, glow: np.ndarray, home: np.ndarray | None, sky: Sky | None):
        self._table = dr.opaque(mi.Float(glow.astype(np.float32).ravel()))
        self._log_level: mi.Texture3f | None = None
        if sky is None or not sky.radiance.any():
            return
        at_home = sky.irradiance / math.pi if home is None else sky.mean(glow, home[None])[0]
        if not (at_home > 0).any():
            return
        side = np.linspace(-1, 1, NODES)
        nodes = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1)[..., ::-1].reshape(-1, 3)
        nodes = nodes / np.maximum(np.linalg.norm(nodes, axis=1, keepdims=True), 1e-30)
        log_level = np.log(np.maximum(sky.mean(glow, nodes) / np.maximum(at_home, 1e-30), 1))
        table = tensor(log_level.astype(np.float32).reshape(NODES, NODES, NODES, 3))
        self._log_level = mi.Texture3f(table, use_accel=False)
        # At home c is 1, whatever is interpolated there between nodes.
        self._log_at_home = dr.opaque(mi.Color3f, 0.0)
        if home is not None:
            self._log_at_home = dr.opaque(self._interpolated(mi.Vector3f(*home.tolist())))

    def at(self, d: mi.Vector3f, centre: mi.Vector3f, factor: mi.Color3f) -> mi.Color3f:
        """Return f c G at directions ``d`` of the light at ``centre``, ``factor`` times its flux."""
        strength = glow_strength(factor)
        if self._log_level is not None:
            strength *= dr.exp(dr.minimum(self._log_at_home - self._interpolated(centre), 0))
        return _interpolated_glow(self._table, dr.dot(d, centre)) * strength

    def _interpolated(self, toward):
        """Return log M at a direction, per channel, linearly between nodes."""
        place = mi.Point3f(toward) * (0.5 * (NODES - 1) / NODES) + 0.5
        return mi.Color3f(*self._log_level.eval(place))


def _interpolated_glow(table, cosine):
    """Interpolate a glow, flat, at angles given by their cosines.

    Level within the first of GLOW_DEGREES, 0 beyond the last.
    """
    step = float(GLOW_DEGREES[1])
    last = len(GLOW_DEGREES) - 1
    # The derivative of acos is infinite at 1: held off by less than the level part.
    angle = dr.acos(dr.clip(cosine, -1 + 1e-6, 1 - 1e-6)) * (180 / math.pi / step)
    node = dr.clip(mi.UInt32(angle), 0, last - 1)
    part = angle - node
    low, high = (dr.gather(mi.Color3f, table, node + k) for k in (0, 1))
    return dr.select(angle < last, low + (high - low) * part, 0)
