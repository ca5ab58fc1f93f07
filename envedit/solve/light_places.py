"""Where a light lowers F most, and by how much, beside all other unknowns.

With a the picture of a light in display values, r the residual, W its weights, H and g those of the normal
equations and c the mixed part of the larger Hessian, F falls by

    (a' W r - c' H^-1 g)^2 / (a' W a - c' H^-1 c)

for the best strength of the light (Tipping and Faul 2003).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.representations.layers.lights import FAINTEST, LOBE_DEGREES
from envedit.solve.map_problem import Point, Problem
from envedit.solve.normal_equations import Normal, forward
from envedit.transport.light_transport import LightTransport

PROBE_SPACINGS = (2, 1)
"""Distances in texels of the exact columns around the best cell, one after the other."""
PLACES_REFINED = 2
"""Best places of one light that are refined."""
PLACES_APART_COSINE = np.cos(np.radians(15.0))
"""Cosine of the angle between two places of a light that are different explanations."""
LEAST_UNEXPLAINED = 1e-4
"""Share of a light's squared picture that other unknowns must leave unexplained for it to be a candidate;
by this share its channels are held to 0 where their strengths are found."""


@dataclass(frozen=True)
class Place:
    """Where a light could be."""

    direction: np.ndarray  # (3,)
    log_flux: np.ndarray  # (3,), over its own
    # By how much F falls there; of paint -2 log likelihood with the light, negated
    promise: float
    degrees: float = LOBE_DEGREES  # radius of a light that is added


def lit_ground(problem: Problem, point: Point) -> np.ndarray | None:
    """Return the picture (h, w, 3) of the map's ground under light of an irradiance of 1; None of none.

    At a point, whose ground has so much radiance under so much light.
    """
    layers, light = problem.layers, problem.layers.ground_light
    if light is None:
        return None
    up = layers.shape[0]
    irradiance = light.irradiance(point.edited[problem.rows][:up])
    ground = np.zeros_like(point.edited)
    ground[problem.rows] = point.sky * layers.lit[:, None, None] / np.maximum(irradiance, 1e-30)
    picture = point.transport.linear(tensor(ground)).numpy()
    return picture if picture.any() else None


def probed(
    problem: Problem,
    transport: LightTransport,
    row: int,
    column: int,
    flux: np.ndarray,
    spacing: int,
    reach: int,
    ground: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return texels (n,) of the sky around one, and pictures (n, pixels, 3) of a flux (3,) in each.

    They are so many texels apart, ``reach`` of them to each side; the pictures are of exact columns, and of
    the ``ground`` that is lit (:func:`lit_ground`).
    """
    height, width = problem.envmap.shape[:2]
    first = problem.rows.start
    steps = spacing * np.arange(-reach, reach + 1)
    rows = np.unique(np.clip(row + steps, first, first + problem.layers.shape[0] - 1))
    texels = (rows[:, None] * width + np.unique((column + steps) % width)).ravel()
    omega = latlong.lookup_solid_angles(height, width)[texels // width]
    unit = (flux / omega[:, None]).astype(np.float32)
    pictures = transport.probe(texels) * unit[:, None, :]
    if ground is not None:
        upward = np.maximum(latlong.directions(height, width)[texels // width, texels % width, 1], 0)
        pictures += np.float32(np.outer(upward, flux)[:, None, :] * ground.reshape(-1, 3))
    return texels, pictures


def most_promising(directions: np.ndarray, promise: np.ndarray) -> Iterator[int]:
    """Yield :data:`PLACES_REFINED` cells (n,), apart, that promise most; none where that is not finite."""
    for _ in range(PLACES_REFINED):
        at = int(np.argmax(promise))
        if not np.isfinite(promise[at]):
            return
        yield at
        promise = np.where(directions @ directions[at] > PLACES_APART_COSINE, -np.inf, promise)


def is_apart(direction: np.ndarray, others: list[np.ndarray]) -> bool:
    """Whether a direction is another explanation than all others."""
    return all(direction @ other <= PLACES_APART_COSINE for other in others)


class Places:
    """Places of lights that are dark at a point, by the problem's normal equations there.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the normal equations have no solution.
    """

    def __init__(self, problem: Problem, point: Point, normal: Normal):
        self.problem, self.point, self.normal = problem, point, normal
        self._ground = lit_ground(problem, point)
        self._cells = problem.blocks.cells(self._ground)
        self._lower = np.linalg.cholesky(normal.hessian)
        self._gradient = forward(self._lower, normal.gradient)

    def best(self, light: int) -> list[Place]:
        """List the :data:`PLACES_REFINED` best places of a light, :data:`PLACES_APART_COSINE`.

        They are the best texels, through exact columns, around the best cells of the block transport.
        """
        _, directions = self.problem.blocks.sky
        flux = np.float64(self.problem.layers.lights.flux[light])
        scale = flux.max()
        if not scale > 0 or not len(directions):  # so few rows that they fill no cell by half
            return []
        flux = flux / scale  # of any strength, in single precision
        strengths, falls = self._of_cells(flux)
        places_refined: list[Place] = []
        for at in most_promising(directions, np.where(falls > 0, falls, -np.inf)):
            place = self._refined(directions[at], strengths[at], falls[at], flux, scale)
            if is_apart(place.direction, [other.direction for other in places_refined]):
                places_refined.append(place)
        return places_refined

    def _refined(self, direction, strength, fall, flux, scale):
        """Return the best place around a cell's; strengths are of a flux (3,), that of the light / scale."""
        height, width = self.problem.envmap.shape[:2]
        row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
        strengths = np.full(3, strength)
        picture = None
        for spacing in PROBE_SPACINGS:
            reach = spacing  # texels to each side: as many as they are apart
            texels, pictures = probed(
                self.problem, self.point.transport, row, column, flux, spacing, reach, self._ground
            )
            of_texels, falls = self._of_pixels(pictures)
            at = int(np.argmax(falls))
            if not falls[at] > 0:
                break
            row, column = divmod(int(texels[at]), width)
            direction = latlong.directions(height, width)[row, column]
            strengths, fall, picture = np.full(3, of_texels[at]), falls[at], pictures[at]
        if picture is not None:
            strengths = self._of_channels(picture, strengths)
        return Place(direction, np.log(strengths / scale), float(fall))

    def fall(self, rendering: np.ndarray) -> float:
        """Return by how much F falls with the light that makes another rendering of the point's."""
        picture = np.float32(rendering - self.point.rendering).reshape(1, -1, 3)
        return float(self._of_pixels(picture)[1][0])

    # ---- F around the point, as its normal equations have it -----------------------------------------------

    def _of_cells(self, flux):
        """Return strength and fall of F for a flux (3,) in each cell of the sky."""
        normal, cells = self.normal, self._cells
        columns = zip(normal.linear.jacobian, normal.squared.T, flux, strict=True)
        mixed: list[Any] = [*cells.products([j * (f * w)[:, None] for j, w, f in columns])]
        if len(normal.linear.pictures):
            mixed.append(sum(cells.products([b * f for b, f in zip(normal.lights, flux, strict=True)])))
        pull: Any = sum(cells.products(list((normal.pulled * flux).T[..., None])))
        power = cells.power(normal.squared * flux**2).sum(axis=0)
        of_mean = zip(normal.mean_by_blocks.T, flux, strict=True)
        mean = cells.products([b[:, None] * f for b, f in of_mean])
        return self._best(np.concatenate(mixed), pull[0], power, np.concatenate(mean))

    def _of_pixels(self, pictures):
        """Return the same for pictures (n, pixels, 3)."""
        return self._best(*self._products(pictures))

    def _of_channels(self, picture, strengths):
        """Return the best strengths (3,) of a picture (pixels, 3) that has one in each channel.

        At least :data:`FAINTEST` of the strongest; those given, where they have no solution.
        """
        products = self._products(np.float32(picture * np.eye(3)[:, None]))
        half, along, power = self._reduced(*products)
        rest = np.diag((1 + LEAST_UNEXPLAINED) * power) - half.T @ half
        try:
            flux = np.linalg.solve(rest, along)
        except np.linalg.LinAlgError:
            flux = np.zeros(3)
        if not (np.isfinite(flux).all() and flux.max() > 0):
            return strengths
        return np.maximum(flux, FAINTEST * flux.max())

    def _products(self, pictures):
        """Return the weighted products of pictures (n, pixels, 3) that F falls by.

        With the derivatives by the unknowns (m, n), with the residual and with themselves, (n,) both; and
        what they do to the mean of what was not painted, (3, n).
        """
        normal, linear = self.normal, self.normal.linear
        known = linear.pictures.reshape(len(linear.pictures), pictures.shape[1], 3)
        mixed: list[np.ndarray] = []
        by_pictures: Any = 0.0
        pull: Any = 0.0
        power: Any = 0.0
        for c, j in enumerate(linear.jacobian):
            mine = np.ascontiguousarray(pictures[..., c])
            slope, robust, residual, profile = (
                np.broadcast_to(v, normal.slope.shape)[..., c].ravel()
                for v in (normal.slope, normal.robust, self.point.residual, linear.profile)
            )
            weighted = mine * np.float32(slope**2 * robust)
            mixed.append(j.T @ self.problem.blocks.sums(weighted * profile).T)
            by_pictures = by_pictures + known[..., c] @ weighted.T
            pull = pull + mine @ (slope * robust * residual)
            power = power + np.einsum("np,np->n", mine, weighted)
        by_pixels = normal.mean_by_pixels.reshape(-1, 3)
        mean = np.stack([pictures[..., c] @ by_pixels[:, c] for c in range(3)])
        return np.concatenate([*mixed, by_pictures]), pull, power, mean

    def _reduced(self, mixed, pull, power, mean):
        """Return L^-1 times the mixed part, the slope beside the other unknowns, and the power."""
        half = forward(self._lower, mixed + self.normal.mean_by_unknowns.T @ mean)
        along = half.T @ self._gradient - (pull + self.normal.mean @ mean)
        return half, along, power + np.square(mean).sum(axis=0)

    def _best(self, mixed, pull, power, mean):
        """Return strengths and falls of single pictures, by what :meth:`_products` returns of them."""
        half, along, power = self._reduced(mixed, pull, power, mean)
        rest = power - np.square(half).sum(axis=0)
        strength = np.divide(along, rest, out=np.zeros_like(rest), where=rest > LEAST_UNEXPLAINED * power)
        fall = np.maximum(strength, 0) * along
        finite = np.isfinite(strength) & np.isfinite(fall)
        return np.where(finite, strength, 0), np.where(finite, fall, 0)
