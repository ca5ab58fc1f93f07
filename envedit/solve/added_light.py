"""Where a light that the map does not have would lower F most, and by how much.

With a the picture of a light in display values, r the residual, W its weights, H and g those of the normal
equations and c the mixed part of the larger Hessian, F falls by

    (a' W r - c' H^-1 g)^2 / (a' W a - c' H^-1 c)

for the best strength of the light, beside all other unknowns.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from envedit.core import latlong
from envedit.core.rotations import rotation_vector
from envedit.solve.map_problem import Point, Problem
from envedit.solve.normal_equations import Normal, forward

SPACINGS, REACH = (2, 1), (2, 1)
"""Distances in texels of the exact columns around the best cell, and how many of them to each side."""
LEAST_REST = 1e-4
"""Share of a light's squared picture that other unknowns must leave unexplained for it to be a candidate."""


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
    spare = range(layers.lights.own, layers.lights.count)
    dark = [i for i in spare if i not in problem.added(point.state)] if light is None else [light]
    if not dark:
        return None
    try:
        model = _Model(problem, normal)
    except np.linalg.LinAlgError:
        return None
    i, flux = dark[0], np.float64(layers.lights.flux[dark[0]])
    scale = flux.max()
    if not scale > 0:
        return None
    flux = flux / scale  # of any strength, in single precision
    _, directions = problem.blocks.sky
    if not len(directions):  # so few rows are edited that they fill no cell by half
        return None
    strength, fall = model.of_cells(flux)
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
        unit = (flux / omega[texels // width][:, None]).astype(np.float32)
        strengths, falls = model.of_pixels(transport.probe(texels) * unit[:, None, :])
        found = int(np.argmax(falls))
        if not falls[found] > 0:
            return None
        row, column = divmod(int(texels[found]), width)
        strength, fall = strengths[found], falls[found]
        direction = latlong.directions(height, width)[row, column]
    state = {name: value.copy() for name, value in point.state.items()}
    state["turn"][i] = rotation_vector(layers.lights.centres[i], direction)
    state["flux"][i], state["size"][i] = np.log(strength) - np.log(scale), 0.0
    return state, float(fall)


class _Model:
    """F around a point, as its normal equations have it."""

    def __init__(self, problem, normal):
        self.problem, self.normal = problem, normal
        self._lower = np.linalg.cholesky(normal.hessian)
        self._gradient = forward(self._lower, normal.gradient)

    def of_cells(self, flux):
        """Return strength and fall of F for a flux (3,) in each cell of the sky."""
        parts, blocks = self.normal.blocks, self.problem.blocks
        columns = zip(parts.jacobian, parts.squared.T, flux, strict=True)
        mixed = [*blocks.seen([j * (f * w)[:, None] for j, w, f in columns])]
        if parts.lights:
            mixed.append(sum(blocks.seen([b * f for b, f in zip(parts.lights, flux, strict=True)])))
        pull = sum(blocks.seen(list((parts.pulled * flux).T[..., None])))[0]
        power = blocks.power(parts.squared * flux**2).sum(axis=0)
        by_blocks = self.normal.mean_of_rest.by_blocks.T
        mean = blocks.seen([b[:, None] * f for b, f in zip(by_blocks, flux, strict=True)])
        return self._best(np.concatenate(mixed), pull, power, np.concatenate(mean))

    def of_pixels(self, pictures):
        """Return the same for pictures (n, pixels, 3)."""
        normal, count = self.normal, len(pictures)
        known = normal.pictures.reshape(len(normal.pictures), pictures.shape[1], 3)
        mixed: list[np.ndarray] = []
        seen: Any = 0.0
        pull: Any = 0.0
        power: Any = 0.0
        for c, j in enumerate(normal.blocks.jacobian):
            mine = np.ascontiguousarray(pictures[..., c])
            slope, robust, residual, profile = (
                np.broadcast_to(v, normal.slope.shape)[..., c].ravel()
                for v in (normal.slope, normal.robust, normal.residual, normal.profile)
            )
            weighted = mine * np.float32(slope**2 * robust)
            mixed.append(j.T @ self.problem.blocks.sums(weighted * profile).T)
            seen = seen + known[..., c] @ weighted.T if len(known) else np.zeros((0, count))
            pull = pull + mine @ (slope * robust * residual)
            power = power + np.einsum("np,np->n", mine, weighted)
        by_pixels = normal.mean_of_rest.by_pixels.reshape(-1, 3)
        mean = np.stack([pictures[..., c] @ by_pixels[:, c] for c in range(3)])
        return self._best(np.concatenate([*mixed, seen]), pull, power, mean)

    def _best(self, mixed, pull, power, mean):
        """Return strengths and falls; ``mean`` (3, n) is what the pictures do to the mean of the rest."""
        rest = self.normal.mean_of_rest
        mixed = mixed + rest.jacobian.T @ mean
        pull = pull + rest.residual @ mean
        power = power + np.square(mean).sum(axis=0)
        half = forward(self._lower, mixed)
        along = half.T @ self._gradient - pull
        rest = power - np.square(half).sum(axis=0)
        strength = np.divide(along, rest, out=np.zeros_like(rest), where=rest > LEAST_REST * power)
        fall = np.maximum(strength, 0) * along
        finite = np.isfinite(strength) & np.isfinite(fall)
        return np.where(finite, strength, 0), np.where(finite, fall, 0)
