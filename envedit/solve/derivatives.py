"""Derivatives of a rendering by the unknowns of an edit, at a point.

By the gain they are those of the block transport (``block_jacobian.py``). A light's core is seen through T,
by finite differences of its place and size, its glow and the saturation through the blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from envedit.core.rotations import rotated, rotation_vector
from envedit.solve.block_jacobian import BlockJacobian
from envedit.solve.unknowns import Point, Unknowns
from envedit.transport.light_transport import COLUMNS_A_LOOK, LightTransport

ANGLE, WIDE = np.radians(0.7), np.radians(2.1)
"""Rotations of the finite difference by a light's direction: half a texel of a map of 256, and, where that
leads no further, as much as the noise of single columns of T does not hide."""


@dataclass(frozen=True)
class Linearisation:
    """Derivatives of a rendering.

    Attributes
    ----------
    pictures : ndarray (k, h, w, 3)
        By the unknowns of lights, and by the saturation.
    named : list of (str, int, int or ndarray)
        Which these are: name, light, and channel or axis.
    profile : ndarray (h, w, 3)
        Of the sky's light within blocks.
    jacobian : list of ndarray (blocks, nodes)
        By the log gain, per channel.
    """

    pictures: np.ndarray
    named: list
    profile: np.ndarray
    jacobian: list[np.ndarray]


class Derivatives:
    """Derivatives of the renderings of some unknowns; those of the last point are kept.

    Parameters
    ----------
    unknowns : Unknowns
        Of the layers.
    transport : LightTransport
        T; gets columns, with the fewest paths, for texels that a light covers.
    blocks : BlockJacobian
        T of blocks of pixels.

    Attributes
    ----------
    angle : float
        Rotation of the finite difference by a light's direction.
    """

    def __init__(self, unknowns: Unknowns, transport: LightTransport, blocks: BlockJacobian):
        self.unknowns, self.transport, self.blocks = unknowns, transport, blocks
        self.layers = unknowns.layers
        self.rows, self.shape = self.layers.active, transport.shape
        self.angle = ANGLE
        self._last: tuple[np.ndarray, float, Linearisation] | None = None

    def at(self, point: Point) -> Linearisation:
        """Return the derivatives at a point, which must be finite; they depend on no target and no weight."""
        if self._last is None or self._last[0] is not point.rendering or self._last[1] != self.angle:
            pictures, named, profile = self._lights(point)
            jacobian = self.blocks.jacobian(self._slopes(point))
            made = Linearisation(pictures, named, profile, jacobian)
            self._last = point.rendering, self.angle, made
        return self._last[2]

    def _slopes(self, point):
        """Return the derivative of the sky by the log gain of a texel, (rows * W, 3)."""
        slopes = point.sky.astype(np.float64)
        slopes[: self.layers.shape[0]] = self.layers.gain_slope(self.unknowns.params(point.state))
        return slopes.reshape(-1, 3)

    def _profile(self, point, cores):
        """Return the sky's light on every pixel over the mean of its block, (h, w, 3).

        What a node changes is taken to spread so over a block: by texture, shading and outlines. ``cores``
        are pictures, (pixels, 3) each, of what in the point's rendering is light of cores.
        """
        sky = point.rendering - self.transport.other_light()
        for one in cores:
            sky -= one.reshape(sky.shape)
        return self.blocks.profile(np.maximum(sky, 0))

    def _lights(self, point):
        """Return derivatives by lights and saturation, what these are, and the profile."""
        state, layers, sky, found, unknowns = point.state, self.layers, point.sky, [], []
        # Columns of one light must not take the place of another's.
        lit = self.unknowns.lit(state)
        most = min(COLUMNS_A_LOOK, self.transport.capacity // (4 * max(len(lit), 1)))
        for i in lit:
            turn, flux, size = state["turn"][i], state["flux"][i], float(state["size"][i, 0])
            axes, turns = self._tangents(state, i), [turn]
            for axis in axes:
                for sign in (1, -1):
                    there = rotated(self.unknowns.direction(state, i), sign * self.angle * axis)
                    turns.append(rotation_vector(layers.lights.centres[i], there))
            ways = [(one, flux, size) for one in turns] + [(turn, flux, size + 0.1)]
            now, *ends, larger = layers.lights.cores_of(i, ways, layers.whole)
            cores = np.stack([now, *self._differences(ends), (larger - now) / 0.1])
            seen = self.transport.pictures(cores, self.rows, most).reshape(4, -1, 3)
            found.append((i, turns, cores, seen))
            unknowns += [*(("turn", i, axis) for axis in axes), ("size", i, 0)]
            unknowns += [("flux", i, c) for c in range(3)]
        profile = self._profile(point, [seen[0] for *_, seen in found])
        for i, turns, cores, seen in found:
            glow, *ends = (self._log_glow(state, i, one) for one in turns)
            shone = None
            if glow is not None:
                shone = np.stack([sky * -np.expm1(-glow), *(sky * d for d in self._differences(ends))])
            shone = self._with_lit_ground(point, cores[:3], shone)
            if shone is not None:
                seen[:3] += self.blocks.pictures(shone) * profile.reshape(-1, 3)
        whole = []
        if self.unknowns.saturates:
            unknowns.append(("saturation", 0, 0))
            whole.append(self._by_saturation(point, profile))
        return self._apart([seen for *_, seen in found], whole), unknowns, profile

    def _by_saturation(self, point, profile):
        """Return the derivative of the rendering by the log saturation, (h * w, 3), through the blocks."""
        change = self.layers.saturation_slope(self.unknowns.params(point.state))
        change = self._with_lit_ground(point, np.zeros_like(change[None]), change[None])
        return (self.blocks.pictures(change) * profile.reshape(-1, 3))[0]

    def _with_lit_ground(
        self, point: Point, cores: np.ndarray, shone: np.ndarray | None
    ) -> np.ndarray | None:
        """Add to changes of the sky (k, rows, W, 3), None for none, those of the ground that it lights."""
        falls, lit, up = self.layers.ground_light, self.layers.lit, self.layers.shape[0]
        if falls is None:
            return shone
        whole = np.zeros_like(cores) if shone is None else shone
        light = np.maximum(falls.irradiance(point.edited[self.rows][:up]), 1e-30)
        for k, core in enumerate(cores):
            more = falls.irradiance(whole[k, :up] + core[:up]) / light
            whole[k, up:] += point.sky[up:] * np.float32(lit[up:, None, None] * more)
        return whole

    def _log_glow(self, state, i, turn):
        turns = state["turn"].copy()
        turns[i] = turn
        return self.layers.log_glow_of(i, turns, state["flux"])

    def _apart(self, pictures, whole):
        """Take pictures by flux, two angles and size, (4, pixels, 3), of every light apart: (k, h, w, 3).

        By direction, size, and flux per channel; in memory channel by channel. Pictures (h * w, 3) of
        unknowns that are no light's come last.
        """
        lights = 6 * len(pictures)
        found = np.zeros((3, lights + len(whole), math.prod(self.shape)), np.float32)
        for k, seen in enumerate(pictures):
            for c in range(3):
                found[c, 6 * k : 6 * k + 3] = seen[1:, :, c]
                found[c, 6 * k + 3 + c] = seen[0, :, c]
        for k, one in enumerate(whole, lights):
            found[:, k] = one.reshape(-1, 3).T
        return found.reshape(3, -1, *self.shape).transpose(1, 2, 3, 0)

    def _tangents(self, state, i):
        """Two directions in which a light can move, (3,) each: axes of rotation."""
        centre = self.unknowns.direction(state, i)
        across = np.cross(centre, [0.0, 1.0, 0.0])
        length = np.linalg.norm(across)
        across = across / length if length > 1e-6 else np.array([1.0, 0, 0])
        return across, np.cross(across, centre)

    def _differences(self, ends):
        """Return derivatives by two angles of what is given ahead and back along each."""
        return [(ends[k] - ends[k + 1]) / (2 * self.angle) for k in (0, 2)]
