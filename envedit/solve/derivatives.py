"""Derivatives of a rendering, and of the map, by the unknowns of an edit, at a point.

What the map does is asked of the layers: by the gain in forward mode (:meth:`.Layers.gain_slope`), by the
saturation, and by place and size of a light as differences. What that does to the rendering goes through the
block transport (``block_jacobian.py``) for the sky, through T itself for the core of a light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from envedit.core.rotations import rotated, rotation_vector
from envedit.representations.layers.aureoles import log_strength_slope
from envedit.representations.layers.lights import flux_factor
from envedit.solve.block_jacobian import BlockJacobian
from envedit.solve.unknowns import Point, Unknowns
from envedit.transport.light_transport import COLUMNS_A_LOOK

NARROW_ANGLE, WIDE_ANGLE = np.radians(0.7), np.radians(2.1)
"""Rotations of the finite difference by a light's direction: half a texel of a map of 256, and, where that
leads no further, as much as the noise of single columns of T does not hide."""

SIZE_STEP = 0.1
"""Step of the difference by a light's log size. Not measured."""


@dataclass(frozen=True)
class Linearisation:
    """Derivatives of a rendering and of the map."""

    # (k, h, w, 3), by the unknowns of lights, by a camera's factors, and by the saturation
    pictures: np.ndarray
    named: list  # which these are, as of :meth:`.Unknowns.named`
    profile: np.ndarray  # (h, w, 3), of the sky's light within blocks
    jacobian: list[np.ndarray]  # (blocks, nodes), by the log gain, per channel
    # Of each light (4, rows, W, 3), of the map: by log flux, each channel by its own, two angles and log size
    maps: list[np.ndarray]

    def by_lights(self, weights: np.ndarray) -> list[float]:
        """Return the derivatives of the sum of weights (rows, W, 3) times the map by lights, as ``named``."""
        values = []
        for change in self.maps:
            by_flux, *others = np.einsum("khwc,hwc->kc", change, weights, dtype=np.float64)
            values += [*(one.sum() for one in others), *by_flux]
        return values


class Derivatives:
    """Derivatives of the renderings of some unknowns; those of the last point are kept.

    ``blocks`` is T of blocks of pixels.
    """

    def __init__(self, unknowns: Unknowns, blocks: BlockJacobian):
        self.unknowns, self.blocks = unknowns, blocks
        self.layers = unknowns.layers
        self.rows = self.layers.active
        self._last: tuple[np.ndarray, float, Linearisation] | None = None

    def at(self, point: Point, angle: float = NARROW_ANGLE) -> Linearisation:
        """Return the derivatives at a point, which must be finite; they depend on no target and no weight.

        ``angle`` is the rotation of the finite difference by a light's direction, radians.
        """
        if self._last is None or self._last[0] is not point.rendering or self._last[1] != angle:
            pictures, profile, maps = self._lights(point, angle)
            by_gain = point.sky * np.float64(self.layers.changeable)
            by_gain[: self.layers.shape[0]] = self.layers.gain_slope(self.unknowns.params(point.state))
            jacobian = self.blocks.jacobian(by_gain.reshape(-1, 3))
            named = self.unknowns.named(point.state)
            made = Linearisation(pictures, named, profile, jacobian, maps)
            self._last = point.rendering, angle, made
        return self._last[2]

    def _profile(self, point, cores):
        """Return the sky's light on every pixel over the mean of its block, (h, w, 3).

        What a node changes is taken to spread so over a block: by texture, shading and outlines. ``cores``
        are pictures, (pixels, 3) each, of what in the point's rendering is light of cores.
        """
        sky = point.rendering - point.transport.other_light()
        for one in cores:
            sky -= one.reshape(sky.shape)
        return self.blocks.profile(np.maximum(sky, 0))

    def _lights(self, point, angle):
        """Return derivatives by lights and saturation, the profile, and those of the map."""
        # ---- Cores through T: rendered, and by two angles and by size
        state, layers = point.state, self.layers
        lights: list = []
        # Columns of one light must not take the place of another's.
        lights_shining = self.unknowns.shining(state)
        most = min(COLUMNS_A_LOOK, point.transport.capacity // (4 * max(len(lights_shining), 1)))
        for i in lights_shining:
            turn, flux, size = state["turn"][i], state["flux"][i], float(state["size"][i, 0])
            turns = [turn]
            for axis in self.unknowns.tangents(state, i):
                for sign in (1, -1):
                    end = rotated(self.unknowns.direction(state, i), sign * angle * axis)
                    turns.append(rotation_vector(layers.lights.centres[i], end))
            placements = [(one, flux, size) for one in turns]
            placements.append((turn, flux, size + SIZE_STEP))
            core, *ends, larger = layers.cores_of(i, placements)
            cores = np.stack([core, *_differences(ends, angle), (larger - core) / SIZE_STEP])
            pictures = point.transport.pictures(cores, self.rows, most).reshape(4, -1, 3)
            lights.append((i, turns, cores, pictures))

        # ---- Glows, and the ground that lights shine on, through the blocks
        profile = self._profile(point, [pictures[0] for *_, pictures in lights])
        params = self.unknowns.params(state)
        slope = layers.glow_slope(params, point.sky) if layers.lights.glowing else None
        for i, turns, cores, pictures in lights:
            log_glow, *ends = (self._log_glow(state, i, one) for one in turns)
            change = None
            if log_glow is not None:
                # d log(1 + f G) / d log f is f G / (1 + f G), which is 1 - 1 / (1 + f G)
                by_flux = -np.expm1(-log_glow) * log_strength_slope(flux_factor(state["flux"][i]))
                by_turn = (slope * one for one in _differences(ends, angle))
                change = np.stack([slope * by_flux, *by_turn])
            change = self._with_lit_ground(point, cores[:3], change)
            if change is not None:
                pictures[:3] += self.blocks.pictures(change) * profile.reshape(-1, 3)
                cores[:3] += change

        # ---- A camera's factor of every channel, and the saturation, through the blocks
        of_sky = []
        if self.unknowns.photographed:
            of_sky += [point.rendering * np.eye(3, dtype=np.float32)[c] for c in range(3)]
        if self.unknowns.saturates:
            of_sky.append(self._by_saturation(point, profile))
        pictures = self._apart([pictures for *_, pictures in lights], of_sky, point.transport.shape)
        return pictures, profile, [cores for _, _, cores, _ in lights]

    def _by_saturation(self, point, profile):
        """Return the derivative of the rendering by the log saturation, (h * w, 3), through the blocks."""
        change = self.layers.saturation_slope(self.unknowns.params(point.state))
        change = self._with_lit_ground(point, np.zeros_like(change[None]), change[None])
        return (self.blocks.pictures(change) * profile.reshape(-1, 3))[0]

    def _with_lit_ground(
        self, point: Point, cores: np.ndarray, change: np.ndarray | None
    ) -> np.ndarray | None:
        """Add to changes of the sky (k, rows, W, 3), None for none, those of the ground that it lights."""
        ground = self.layers.ground_light
        if ground is None:
            return change
        up = self.layers.shape[0]
        share = self.layers.lit[up:, None, None]
        change = np.zeros_like(cores) if change is None else change
        light = np.maximum(ground.irradiance(point.edited[self.rows][:up]), 1e-30)
        for k, core in enumerate(cores):
            more = ground.irradiance(change[k, :up] + core[:up]) / light
            change[k, up:] += point.sky[up:] * np.float32(share * more)
        return change

    def _log_glow(self, state, i, turn):
        turns = state["turn"].copy()
        turns[i] = turn
        return self.layers.log_glow_of(i, turns, state["flux"])

    def _apart(self, of_lights, of_sky, shape):
        """Take pictures by flux, two angles and size, (4, pixels, 3), of every light apart: (k, h, w, 3).

        By direction, size, and flux per channel; in memory channel by channel. Pictures (h * w, 3) of
        unknowns that are no light's come last.
        """
        first = 6 * len(of_lights)
        columns = np.zeros((3, first + len(of_sky), math.prod(shape)), np.float32)
        for k, pictures in enumerate(of_lights):
            for c in range(3):
                columns[c, 6 * k : 6 * k + 3] = pictures[1:, :, c]
                columns[c, 6 * k + 3 + c] = pictures[0, :, c]
        for k, picture in enumerate(of_sky, first):
            columns[:, k] = picture.reshape(-1, 3).T
        return columns.reshape(3, -1, *shape).transpose(1, 2, 3, 0)


def _differences(ends, angle):
    """Return derivatives by two angles of what is given ahead and back along each."""
    return [(ends[k] - ends[k + 1]) / (2 * angle) for k in (0, 2)]
