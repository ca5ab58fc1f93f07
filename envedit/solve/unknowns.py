"""The unknowns of an edit with layers, as they are solved for: logarithms and radians.

A state is a dict of float64 arrays: ``gain`` (nodes, 3), ``turn`` and ``flux`` (lights, 3), ``size``
(lights, 1) and ``saturation`` (1, 1); of a photograph also ``camera`` (1, 3), the log factor of each channel
between a rendering and the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.core.arrays import tensor
from envedit.core.rotations import rotated, rotation_vector
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK
from envedit.transport.light_transport import LightTransport

OWN_LOG_SIZES, LOBE_LOG_SIZES = (-3.0, 1.5), (-3.0, 2.1)
"""Logarithms of sizes that a light of the map may take on, and an added one: points that are too few for a
larger lobe would be seen."""
LOG_SATURATIONS = (-3.0, 0.0)
"""Logarithms of the sky's saturation that are looked for, from 5 % to the original's own: more would amplify
what its colours have of noise."""


@dataclass(frozen=True)
class Point:
    """A state with its map, rendering and residual of display values; the last two None if not finite.

    ``sky`` is the map's active rows without the cores of its lights, (rows, W, 3); ``transport`` is T with
    the columns through which the map was rendered.
    """

    state: dict
    edited: np.ndarray
    sky: np.ndarray
    transport: LightTransport
    rendering: np.ndarray | None
    residual: np.ndarray | None


class Unknowns:
    """The unknowns of some layers.

    ``saturates``: the saturation of the sky's colours is one; ``photographed``: the factor of a camera is.

    Attributes
    ----------
    sizes : list of (int, int)
        Rows and columns of the gain's grids.
    nodes : int
        Of all grids, and one more where ground goes by the light that falls on it.
    """

    def __init__(self, layers: Layers, saturates: bool = False, photographed: bool = False):
        self.layers, self.saturates, self.photographed = layers, saturates, photographed
        self.sizes = layers.gain.sizes
        self.ground = layers.ground_light is not None
        self.nodes = sum(rows * columns for rows, columns in self.sizes) + self.ground

    @property
    def grids(self) -> list[str]:
        """Names of the parameters that are nodes of the gain."""
        return [f"gain.{i}" for i in range(len(self.sizes))] + ["ground"] * self.ground

    def state(self, params: dict) -> dict[str, np.ndarray]:
        """Return the parameters in their own units: logarithms and radians, float64.

        The factor of ground, where there is one, is the last of the gain's nodes.
        """
        real = {k: np.float64(v.numpy()) * self.layers.scales[k] for k, v in params.items()}
        grids = [real.pop(name).reshape(-1, 3) for name in self.grids]
        camera = {"camera": np.zeros((1, 3))} if self.photographed else {}
        return {"saturation": np.zeros((1, 1))} | camera | real | {"gain": np.concatenate(grids)}

    def params(self, state: dict) -> dict:
        """Return the layers' parameters of a state; where it is an unknown, with the saturation."""
        params, start = {}, 0
        shapes = [(*size, 3) for size in self.sizes] + [(1, 3)] * self.ground
        for name, shape in zip(self.grids, shapes, strict=True):
            stop = start + int(np.prod(shape[:-1]))
            grid = state["gain"][start:stop].reshape(shape)
            unit = self.layers.scales[name]
            params[name] = tensor(np.divide(grid, unit, out=np.zeros_like(grid), where=unit > 0))
            start = stop
        names = ["turn", "flux", "size"]
        if self.saturates or state["saturation"].any():
            names.append("saturation")
        for name in names:
            params[name] = tensor(state[name] / self.layers.scales[name])
        return params

    def solution_params(self, state: dict) -> dict:
        """Return the layers' parameters of a state that is a solution: colours that stay keep their bits."""
        params = self.params(state)
        if not state["saturation"].any():
            params.pop("saturation", None)
        return params

    def named(self, state: dict) -> list[tuple[str, int, Any]]:
        """List the unknowns of a state beside the gain: name, light, and channel or axis (3,) of its turn."""
        names: list[tuple[str, int, Any]] = []
        for i in self.shining(state):
            names += [("turn", i, axis) for axis in self.tangents(state, i)]
            names += [("size", i, 0), ("flux", i, 0), ("flux", i, 1), ("flux", i, 2)]
        names += [("camera", 0, c) for c in range(3)] * self.photographed
        names += [("saturation", 0, 0)] * self.saturates
        return names

    def moved(
        self, state: dict, step: np.ndarray, names: list, largest: dict[str, float] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the state after a step (3 nodes + len(names),).

        It is of the gain's nodes channel by channel, then of what is named as of :meth:`named`; ``largest``
        bounds the step of each, by default not at all.
        """
        kinds = "gain", "turn", "flux", "size", "saturation", "camera"
        bound = dict.fromkeys(kinds, np.inf) | (largest or {})
        n = self.nodes
        changed = {name: value.copy() for name, value in state.items()}
        changed["gain"] += np.clip(step[: 3 * n], -bound["gain"], bound["gain"]).reshape(3, n).T

        # ---- Lights, and the saturation
        turns: dict[int, np.ndarray] = {}
        for value, (name, i, axis) in zip(step[3 * n :], names, strict=True):
            if name == "turn":
                turns[i] = turns.get(i, 0.0) + value * axis
            else:
                changed[name][i, axis] += np.clip(value, -bound[name], bound[name])
        own = self.layers.lights.own
        changed["saturation"] = np.clip(changed["saturation"], *LOG_SATURATIONS)
        changed["size"][:own] = np.clip(changed["size"][:own], *OWN_LOG_SIZES)
        changed["size"][own:] = np.clip(changed["size"][own:], *LOBE_LOG_SIZES)
        for i, turn in turns.items():
            turn = turn * min(1.0, bound["turn"] / max(float(np.linalg.norm(turn)), 1e-12))
            there = self._in_sky(rotated(self.direction(state, i), turn), self.direction(state, i))
            changed["turn"][i] = rotation_vector(self.layers.lights.centres[i], there)
        return changed

    def _in_sky(self, there, here):
        """Return a direction, raised to the horizon where a light would leave the sky by it."""
        first, total = self.layers.rows
        edge = np.cos(np.pi * (first + self.layers.shape[0]) / total)
        lowest = min(edge, here[1])
        if there[1] >= lowest:
            return there
        along = there[[0, 2]] * np.sqrt(max(0.0, 1 - lowest**2)) / max(np.hypot(there[0], there[2]), 1e-12)
        return np.array([along[0], lowest, along[1]])

    def added(self, state: dict) -> list[int]:
        """List the added lights that shine: spare ones whose flux is not 0."""
        return [i for i in self.shining(state) if i >= self.layers.lights.own]

    def spare(self, state: dict) -> int | None:
        """Return the first light that is not the map's and does not shine; None where all do."""
        lights, added = self.layers.lights, self.added(state)
        return next((i for i in range(lights.own, lights.count) if i not in added), None)

    def shining(self, state: dict) -> list[int]:
        """List the lights whose flux is not 0."""
        return [i for i, flux in enumerate(state["flux"]) if flux.max() > DARK + 1]

    def direction(self, state: dict, i: int) -> np.ndarray:
        """Return where light ``i`` is, (3,)."""
        return rotated(self.layers.lights.centres[i], state["turn"][i])

    def tangents(self, state: dict, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return two directions in which light ``i`` can move, (3,) each: axes of rotation."""
        centre = self.direction(state, i)
        across = np.cross(centre, [0.0, 1.0, 0.0])
        length = np.linalg.norm(across)
        across = across / length if length > 1e-6 else np.array([1.0, 0, 0])
        return across, np.cross(across, centre)


def with_light(state: dict, k: int, **values: Any) -> dict:
    """Return a state with other values of one light, by the names of its unknowns."""
    state = {name: value.copy() for name, value in state.items()}
    for name, value in values.items():
        state[name][k] = value
    return state
