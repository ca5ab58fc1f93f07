"""Where a light raises the likelihood of paint most, all else as it is.

Nothing but the light is to explain the paint: its pictures are compared as they are, display curve and all,
at the largest noise that paint has.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat, tensor
from envedit.core.rotations import rotation_vector
from envedit.losses import display_curve
from envedit.solve.light_places import (
    PLACES_APART_COSINE,
    PROBE_SPACINGS,
    Place,
    is_apart,
    lit_ground,
    most_promising,
    probed,
)
from envedit.solve.likelihood import Likelihood, of_mean
from envedit.solve.map_problem import Problem
from envedit.transport.light_transport import LightTransport

OWN_FLUX_FACTORS = 2.0 ** np.arange(-2, 1.5, 0.5)
"""Fluxes that a light of the map is tried with elsewhere, over its own."""
ADDED_FLUX_SHARES = 2.0 ** np.arange(-6, 1.5, 0.5)
"""Fluxes that an added light is tried with, as shares of the light in the picture."""
LARGER_DEGREES = (2.0, 8.0)
"""Radii of larger lights that are tried: what is painted into something smooth is as large as its image."""
POSITIVE_EVIDENCE = 2.0
"""Difference of -2 log likelihood up to which two places promise as much as each other: "not worth more than
a bare mention" (Kass and Raftery 1995)."""


def best(
    problem: Problem, state: dict, transport: LightTransport, k: int, away: np.ndarray | None = None
) -> list[Place]:
    """List where light ``k``, dark in a state, raises the likelihood most, through ``transport``.

    All cells of the sky are tried through the block transport, with several fluxes each, and texels around
    the best ones through exact columns. Texels are :data:`.light_places.PLACES_APART_COSINE` apart, also from
    ``away``. A light that is added is the smallest there that promises as much as the best one.
    """
    lights, blocks, likelihood = problem.layers.lights, problem.blocks, problem.likelihood
    point = problem.evaluate(state, transport, resolve=False)
    _, directions = blocks.sky
    if point.residual is None or not len(directions):
        return []
    trial = _TriedLight(problem, point, k)
    weight = blocks.summed(likelihood.weight)
    total = np.maximum(weight, 1e-30)
    compared = _Comparison(
        likelihood=likelihood,
        before=blocks.summed(likelihood.weight * point.rendering) / total,
        target=blocks.summed(likelihood.weight * problem.picture) / total,
        weight=weight[:, 0],
        share=blocks.summed(likelihood.share)[:, 0],
    )
    factors, unlikeliness = compared.best(blocks.cells(trial.ground).of(lights.flux[k]), trial.own)
    if away is not None:
        unlikeliness = np.where(directions @ away > PLACES_APART_COSINE, np.inf, unlikeliness)
    places: list[Place] = []
    texels: list[np.ndarray] = []
    for at in most_promising(directions, -unlikeliness):
        texel = trial.texel(directions[at])
        if is_apart(texel.direction, texels):
            texels.append(texel.direction)
            larger = () if trial.own else LARGER_DEGREES
            places.append(_smallest([texel, *(trial.lobe(directions[at], degrees) for degrees in larger)]))
    return places


def _smallest(sizes):
    """Return the first of places, by size, that promises as much as the best one."""
    least = max(place.promise for place in sizes) - POSITIVE_EVIDENCE
    return next(place for place in sizes if not place.promise < least)  # the first where none is finite


class _TriedLight:
    """A light in place of none, in the picture of a point."""

    def __init__(self, problem, point, k):
        self.problem, self.transport, self.k = problem, point.transport, k
        self.own, self.flux = k < problem.layers.lights.own, problem.layers.lights.flux[k]
        self.ground = lit_ground(problem, point)
        self._compared = _Comparison(
            likelihood=problem.likelihood,
            before=point.rendering.reshape(-1, 3),
            target=problem.picture.reshape(-1, 3),
            weight=problem.likelihood.weight.ravel(),
            share=problem.likelihood.share.ravel(),
        )

    def texel(self, direction):
        """Return the best texel around a direction, through exact columns."""
        height, width = self.problem.envmap.shape[:2]
        row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
        for spacing in PROBE_SPACINGS:
            texels, pictures = probed(
                self.problem, self.transport, row, column, self.flux, spacing, reach=1, ground=self.ground
            )
            factors, unlikeliness = self._best(pictures)
            at = int(np.argmin(unlikeliness))
            row, column = divmod(int(texels[at]), width)
        direction = latlong.directions(height, width)[row, column]
        return Place(direction, np.full(3, np.log(factors[at])), -float(unlikeliness[at]))

    def lobe(self, direction, degrees):
        """Return the place of a lobe of some radius."""
        layers = self.problem.layers
        turn = rotation_vector(layers.lights.centres[self.k], direction)
        placement = turn, np.zeros(3), layers.lights.log_size(degrees)
        core = layers.cores_of(self.k, [placement])
        picture = self.transport.pictures(core, self.problem.rows, most=0)
        if self.ground is not None:
            light = layers.ground_light.irradiance(core[0, : layers.shape[0]])
            picture += np.float32(light * self.ground)
        factors, unlikeliness = self._best(picture.reshape(1, -1, 3))
        return Place(direction, np.full(3, np.log(factors[0])), -float(unlikeliness[0]), degrees)

    def _best(self, pictures):
        """Return the best factors of the flux of pictures (k, pixels, 3), and -2 log likelihood then."""
        return self._compared.best([tensor(one) for one in pictures.T], self.own)


@dataclass(frozen=True)
class _Comparison:
    """Pixels or blocks of them, by which pictures of a light are compared.

    ``before`` and ``target`` are linear radiance (n, 3); ``weight`` (n,) and ``share`` (n,) those of the
    likelihood.
    """

    likelihood: Likelihood
    before: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    share: np.ndarray

    def best(self, pictures: list[mi.TensorXf], own: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the likeliest factor of the flux of k pictures, and -2 log likelihood then, (k,) both.

        ``pictures`` are (n, k), per channel.
        """
        strengths = np.ones(pictures[0].shape[1])
        if not own:  # of any flux; on black, as much as was painted
            light = self.before.mean() or max(float(self.target.mean()), 1e-30)
            mean = np.mean([dr.mean(one, axis=0).numpy() for one in pictures], axis=0)
            strengths = light / np.maximum(mean, 1e-30)
        factors = np.float32(np.outer(OWN_FLUX_FACTORS if own else ADDED_FLUX_SHARES, strengths))
        squares, means = self._sums(pictures, factors)
        area, noise = self.likelihood.area, self.likelihood.largest_noise
        unlikeliness = squares / (area * noise**2) + of_mean(means)
        least = unlikeliness.argmin(axis=0)[None]
        factor = np.take_along_axis(factors, least, axis=0)[0]
        return factor.astype(np.float64), unlikeliness.min(axis=0)

    def _sums(self, pictures, factors):
        """Return what is left of display values beside pictures times factors (f, k), summed over n.

        Squares times :attr:`weight`, (f, k), and values times :attr:`share`, (f, k, 3).
        """
        count, k = pictures[0].shape
        column, end, width = dr.arange(mi.UInt32, k), dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, k)
        factors = [flat(mi.Float, row) for row in factors]
        before = flat(mi.Float, np.float32(self.before))
        goal = display_curve.to_display(tensor(self.target), self.likelihood.white).array
        white = dr.opaque(mi.Float, self.likelihood.white)
        weight, share = (flat(mi.Float, np.float32(one)) for one in (self.weight, self.share))
        dr.eval(goal)

        def add(row, squares, means):
            w, part = dr.gather(mi.Float, weight, row), dr.gather(mi.Float, share, row)
            for c, picture in enumerate(pictures):
                more = dr.gather(mi.Float, picture.array, row * width + column)
                now, to = (dr.gather(mi.Float, one, 3 * row + c) for one in (before, goal))
                for i, factor in enumerate(factors):
                    off = display_curve.shown(now + more * factor, white) - to
                    squares[i] = squares[i] + mi.Float64(w * dr.square(off))
                    means[3 * i + c] = means[3 * i + c] + mi.Float64(part * off)
            return row + 1, squares, means

        begun = mi.UInt32(0), [mi.Float64(0)] * len(factors), [mi.Float64(0)] * (3 * len(factors))
        _, squares, means = dr.while_loop(begun, lambda row, *_: row < end, add)
        dr.eval(squares, means)
        squares, means = (np.stack([one.numpy() for one in some]) for some in (squares, means))
        return squares, means.reshape(-1, 3, k).transpose(0, 2, 1)
