"""Where a light that the map does not have would lower F most, and by how much.

With a the picture of a light in display values, r the residual, W its weights, H and g those of the normal
equations and c the mixed part of the larger Hessian, F falls by

    (a' W r - c' H^-1 g)^2 / (a' W a - c' H^-1 c)

for the best strength of the light, beside all other unknowns.
"""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.representations.layers.lights import SPARE, rotation_vector
from envedit.solve.map_problem import Normal, Point, Problem

SPACINGS, REACH = (2, 1), (2, 1)
"""Distances in texels of the exact columns around the best cell, and how many of them to each side."""


def best(
    problem: Problem, point: Point, normal: Normal, light: int | None = None
) -> tuple[dict, float] | None:
    """Light a spare light where F falls most; ``light`` if given, or else the first that is dark.

    Candidates are the cells of the block transport, then texels around the best one, through exact columns.

    Returns
    -------
    state : dict
        The point's, with the light.
    fall : float
        By how much F falls.
        None in place of both where no light lowers F, or none is spare.
    """
    layers, transport = problem.layers, problem.transport
    spare = range(layers.lights.count - SPARE, layers.lights.count)
    dark = [i for i in spare if i not in problem.added(point.state)] if light is None else [light]
    if not dark:
        return None
    try:
        model = _Model(problem, normal)
    except np.linalg.LinAlgError:
        return None
    i, flux = dark[0], layers.lights.flux[dark[0]]
    cells, directions = problem.blocks.sky_cells(layers.shape)
    strength, fall = model.of_cells([m * f for m, f in zip(problem.blocks.lit(cells), flux, strict=True)])
    found = int(np.argmax(fall))
    if not fall[found] > 0:
        return None
    direction, strength, fall = directions[found], strength[found], fall[found]
    height, width = problem.envmap.shape[:2]
    omega = latlong.lookup_solid_angles(height, width)
    row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
    for spacing, reach in zip(SPACINGS, REACH, strict=True):
        if transport.capacity < (2 * reach + 1) ** 2:
            break  # memory leaves no exact columns to refine
        steps = spacing * np.arange(-reach, reach + 1)
        first = problem.rows.start
        rows = np.unique(np.clip(row + steps, first, first + layers.shape[0] - 1))
        texels = (rows[:, None] * width + np.unique((column + steps) % width)).ravel()
        unit = flux / omega[texels // width][:, None]
        strengths, falls = model.of_pixels(transport.probe(texels) * unit[:, None, :])
        found = int(np.argmax(falls))
        if not falls[found] > 0:
            return None
        row, column = divmod(int(texels[found]), width)
        strength, fall = strengths[found], falls[found]
        direction = latlong.directions(height, width)[row, column]
    state = {name: value.copy() for name, value in point.state.items()}
    state["turn"][i] = rotation_vector(layers.lights.centres[i], direction)
    state["flux"][i], state["size"][i] = np.log(strength), 0.0
    return state, float(fall)


class _Model:
    """F around a point, as its normal equations have it."""

    def __init__(self, problem, normal):
        self.problem, self.normal = problem, normal
        # numpy has no substitution: the inverse of the factor is what serves two models of candidates.
        self._inverse = np.linalg.inv(np.linalg.cholesky(normal.hessian))
        self._gradient = self._inverse @ normal.gradient

    def of_cells(self, atoms):
        """Return strength and fall of F for pictures in blocks, (blocks, n) per channel."""
        blocks = self.normal.blocks
        channels = zip(blocks.jacobian, blocks.squared.T, atoms, strict=True)
        mixed = np.concatenate([j.T @ (w[:, None] * a) for j, w, a in channels])
        if blocks.lights:
            mixed = np.concatenate([mixed, sum(b.T @ a for b, a in zip(blocks.lights, atoms, strict=True))])
        pull = sum(a.T @ p for a, p in zip(atoms, blocks.pulled.T, strict=True))
        power = sum((a * a).T @ w for a, w in zip(atoms, blocks.squared.T, strict=True))
        return self._best(mixed, pull, power)

    def of_pixels(self, pictures):
        """Return the same for pictures (n, pixels, 3)."""
        normal, blocks, count = self.normal, self.normal.blocks, len(pictures)
        weighted = pictures * (normal.slope**2 * normal.robust).reshape(-1, 3)
        profiled = weighted * normal.profile.reshape(-1, 3)
        by_pixel = profiled.transpose(1, 0, 2).reshape(*normal.slope.shape[:2], -1)
        in_blocks = self.problem.blocks.summed(by_pixel).reshape(-1, count, 3)
        mixed = np.concatenate([j.T @ in_blocks[..., c] for c, j in enumerate(blocks.jacobian)])
        if len(normal.pictures):
            flat = normal.pictures.reshape(len(normal.pictures), -1)
            mixed = np.concatenate([mixed, flat @ weighted.reshape(count, -1).T])
        pull = pictures.reshape(count, -1) @ (normal.slope * normal.robust * normal.residual).ravel()
        return self._best(mixed, pull, (pictures * weighted).sum(axis=(1, 2)))

    def _best(self, mixed, pull, power):
        half = self._inverse @ mixed
        along = half.T @ self._gradient - pull
        rest = power - np.square(half).sum(axis=0)
        strength = np.divide(along, rest, out=np.zeros_like(rest), where=rest > 1e-6 * power)
        fall = np.maximum(strength, 0) * along
        finite = np.isfinite(strength) & np.isfinite(fall)
        return np.where(finite, strength, 0), np.where(finite, fall, 0)
