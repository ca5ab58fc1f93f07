"""The smooth gain of the sky: a field of log factors that starts at zero.

A sum of grids of quadratic B-splines over the active rows, periodic in azimuth, each twice as fine as the
one before; a pole is a single node. The three coarse ones, up to a stated number of cycles around the
horizon, are each half as strong per step of their nodes: what a coarse grid can represent is left to it.
Finer ones are added where they are identifiable from the picture.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor

MOST = 12.0
"""Largest log factor. Derived: e^12 is more than any sky needs, and leaves float32 room."""
LEVELS = 3
"""Coarse grids, which any picture may move. Not measured."""
CYCLES = 12
"""Cycles around the horizon that are free with any picture; finer detail must be identifiable from it.
Measured beside networks of 5 to 16 cycles, not beside other grids (``docs/decisions/gain_of_the_sky.md``)."""
DETAIL = 1.0
"""Unit of the nodes of finer grids where they are well known, a logarithm. Not measured."""
VEIL = 0.2
"""Share of luminance in what a gain above 1 adds: a channel that is black cannot be scaled up. Measured
against none: a cyan and orange sky came out in patches of green (36.5 dB, with it 41.0 dB;
``docs/decisions/gain_of_the_sky.md``)."""


def brightened(base: mi.Color3f, factor: mi.Color3f) -> mi.Color3f:
    """Scale radiance; what is brightened is so in part by its luminance: a black channel stays in step."""
    grey = base * (1 - VEIL) + mi.luminance(base) * VEIL
    return dr.select(factor > 1, base + (factor - 1) * grey, base * factor)


def grid_size(cycles: float, share: float) -> tuple[int, int]:
    """Return rows and columns of the grid that holds so many cycles; ``share`` as for :class:`GridGain`."""
    columns = max(2, 2 * round(cycles))
    return max(2, round(columns / 2 * share) + 1), columns


def splines(size: tuple[int, int], shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of a grid's rows (height, rows) and columns (width, columns) at texel centres.

    Quadratic B-splines: a field has no kinks. Beyond the first and the last row nodes go on along a straight
    line, so that a field has their values there.
    """
    (rows, columns), (height, width) = size, shape
    y = (np.arange(height) + 0.5) / height * (rows - 1)
    x = (np.arange(width) + 0.5) / width * columns
    ends = _spline(y[:, None] - np.array([-1, rows]))
    down = _spline(y[:, None] - np.arange(rows))
    for beyond, last, inner in zip(ends.T, (0, rows - 1), (1, rows - 2), strict=True):
        down[:, last] += 2 * beyond
        down[:, inner] -= beyond
    across = sum(_spline(x[:, None] - np.arange(columns) - turn * columns) for turn in (-1, 0, 1))
    return np.maximum(down, 0), across


def _spline(t):
    """Quadratic B-spline: 3/4 at 0, 1/8 at distance 1, 0 from 3/2 on."""
    t = np.abs(t)
    return np.where(t < 0.5, 0.75 - t**2, 0.5 * np.maximum(1.5 - t, 0) ** 2)


@dataclass(frozen=True)
class Octave:
    """One grid of detail."""

    size: tuple[int, int]  # its rows and columns of nodes
    known: np.ndarray  # (rows, columns), how well the picture determines it at each node, in [0, 1)
    share: float  # share of the active rows' solid angle in which it is identifiable, in [0, 1]

    @property
    def cycles(self) -> int:
        """Cycles around the horizon that it can hold."""
        return self.size[1] // 2


class GridGain:
    """Log gain per channel on grids of quadratic B-splines.

    The finest grid can hold ``cycles`` around the horizon: it has twice as many columns. ``share`` is rows of
    the image over rows of its map: the grids are as fine in elevation as in azimuth. With ``top`` the image
    begins at the zenith.
    """

    def __init__(self, cycles: int, share: float, top: bool = True):
        self._share, self._top = share, top
        self.poles = [row for row, at_pole in ((0, top), (-1, top and share == 1)) if at_pole]
        """Rows of nodes that lie at a pole: the first of each counts for all."""
        self.sizes = [grid_size(cycles / 2 ** (LEVELS - 1 - level), share) for level in range(LEVELS)]
        self._units: list[Any] = [0.5**level for level in range(LEVELS)]

    def refined(self, octaves: Sequence[Octave]) -> GridGain:
        """Return this gain with finer grids; a step of a node of theirs counts as far as it is known."""
        finer = copy.copy(self)
        finer.sizes = [*self.sizes, *(octave.size for octave in octaves)]
        units = [DETAIL * np.repeat(octave.known[..., None], 3, axis=2) for octave in octaves]
        finer._units = [*self._units, *(unit.astype(np.float32) for unit in units)]
        return finer

    def init(self) -> dict:
        """Return its parameters: all zero."""
        return {f"gain.{i}": np.zeros((*size, 3), np.float32) for i, size in enumerate(self.sizes)}

    def scales(self) -> dict:
        """Return what a unit of each parameter is: a number, or an array (rows, columns, 3)."""
        return {f"gain.{i}": unit for i, unit in enumerate(self._units)}

    def directions(self, level: int) -> np.ndarray:
        """Return the directions of a grid's nodes, (rows * columns, 3)."""
        rows, columns = self.sizes[level]
        low, high = (0.0, np.pi * self._share) if self._top else (np.pi * (1 - self._share), np.pi)
        theta = low + (high - low) * np.arange(rows) / (rows - 1)
        phi = 2 * np.pi * np.arange(columns) / columns
        theta, phi = np.meshgrid(theta, phi, indexing="ij")
        return latlong.on_sphere(theta.ravel(), phi.ravel())

    def hats(self, level: int, shape: tuple[int, int]) -> list[tuple[np.ndarray, np.ndarray]]:
        """List the nodes around every texel of an image (rows, W), nine at most: (index of the node, weight).

        Each is an array (rows * W,); the same map as :meth:`prepare` has as matrices.
        """
        (rows, columns), (height, width) = self.sizes[level], shape
        down, across = splines((rows, columns), shape)
        tall, wide = min(3, rows), min(3, columns)
        y = np.round((np.arange(height) + 0.5) / height * (rows - 1)).astype(int)
        x = np.round((np.arange(width) + 0.5) / width * columns).astype(int)
        first = np.clip(y - 1, 0, rows - tall)
        left = x - 1
        poles = [row % rows for row in self.poles]
        taps = []
        for a in range(tall):
            for b in range(wide):
                row, column = first + a, (left + b) % columns
                at_pole = np.isin(row, poles)[:, None]
                node = row[:, None] * columns + np.where(at_pole, 0, column)
                weight = down[np.arange(height), row][:, None] * across[np.arange(width), column]
                taps.append((node.ravel(), weight.ravel()))
        return taps

    def prepare(self, shape: tuple[int, int]) -> list:
        """Make the matrices of :meth:`evaluate` for an image (rows, W)."""
        matrices = []
        for size in self.sizes:
            down, across = splines(size, shape)
            at_pole = np.zeros_like(down)
            at_pole[:, self.poles], down[:, self.poles] = down[:, self.poles], 0
            around = np.zeros_like(across)
            around[:, 0] = 1
            channels = np.eye(3)  # one apart from the other
            wide = [np.kron(m.T, channels) for m in (across, around)]
            matrices.append([tensor(m) for m in (down, wide[0], at_pole, wide[1])])
        return matrices

    def evaluate(self, params: dict, prepared: Sequence) -> mi.Color3f:
        """Return the log gain at every texel.

        Products of matrices and not gathers, whose adjoint adds in the order in which threads come.
        """
        g: Any = 0
        for level, (down, across, at_pole, around) in enumerate(prepared):
            rows, columns = self.sizes[level]
            nodes = dr.reshape(params[f"gain.{level}"], (rows, 3 * columns))
            g = g + dr.matmul(dr.matmul(down, nodes), across)
            if self.poles:
                g = g + dr.matmul(dr.matmul(at_pole, nodes), around)
        return dr.clip(dr.unravel(mi.Color3f, g.array), -MOST, MOST)
