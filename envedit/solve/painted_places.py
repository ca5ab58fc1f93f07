"""Where a light raises the likelihood of paint most, all else as it is.

Nothing but the light is to explain the paint: its pictures are compared as they are, display curve and all.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat, tensor
from envedit.losses import display_curve
from envedit.solve.light_places import PLACES_APART_COSINE, PLACES_REFINED, is_apart, lit_ground, probed
from envedit.solve.likelihood import Likelihood, of_mean
from envedit.solve.map_problem import Problem

OWN_FLUX_FACTORS = 2.0 ** np.arange(-2, 1.5, 0.5)
"""Fluxes that a light of the map is tried with elsewhere, over its own."""
ADDED_FLUX_SHARES = 2.0 ** np.arange(-6, 1.5, 0.5)
"""Fluxes that an added light is tried with, as shares of the light in the picture."""
TRIAL_SPACINGS = (2, 1)
"""Distances in texels of the places that are tried around the best cell, one after the other."""


def best(
    problem: Problem, state: dict, k: int, sigma: float, away: np.ndarray | None = None
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """List where light ``k``, dark in a state, raises the likelihood most: direction, log flux (3,), -2 log.

    All cells of the sky are tried through the block transport, with several fluxes each, and texels around
    the best ones through exact columns. Places are :data:`.light_places.PLACES_APART_COSINE` apart, also from
    ``away``.
    """
    lights, blocks, likelihood = problem.layers.lights, problem.blocks, problem.likelihood
    point = problem.evaluate(state, resolve=False)
    _, directions = blocks.sky
    if point.residual is None or not len(directions):
        return []
    own, flux = k < lights.own, lights.flux[k]
    ground = lit_ground(problem, point)
    weight = blocks.summed(likelihood.weight)
    total = np.maximum(weight, 1e-30)
    compared = _Comparison(
        likelihood=likelihood,
        sigma=sigma,
        before=blocks.summed(likelihood.weight * point.rendering) / total,
        target=blocks.summed(likelihood.weight * problem.picture) / total,
        weight=weight[:, 0],
        share=blocks.summed(likelihood.share)[:, 0],
    )
    factors, unlikeliness = compared.best(blocks.cells(ground).of(flux), own)
    if away is not None:
        unlikeliness = np.where(directions @ away > PLACES_APART_COSINE, np.inf, unlikeliness)
    lights_refined: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(PLACES_REFINED):
        at = int(np.argmin(unlikeliness))
        if not np.isfinite(unlikeliness[at]):
            break
        unlikeliness = np.where(directions @ directions[at] > PLACES_APART_COSINE, np.inf, unlikeliness)
        direction, factor, least = _refined(problem, point, flux, own, directions[at], sigma, ground)
        if is_apart(direction, [other for other, _, _ in lights_refined]):
            lights_refined.append((direction, np.full(3, np.log(factor)), least))
    return lights_refined


def _refined(problem, point, flux, own, direction, sigma, ground):
    """Look around a direction through exact columns; returns direction, factor of the flux, and -2 log."""
    likelihood = problem.likelihood
    height, width = problem.envmap.shape[:2]
    compared = _Comparison(
        likelihood=likelihood,
        sigma=sigma,
        before=point.rendering.reshape(-1, 3),
        target=problem.picture.reshape(-1, 3),
        weight=likelihood.weight.ravel(),
        share=likelihood.share.ravel(),
    )
    row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
    for spacing in TRIAL_SPACINGS:
        texels, pictures = probed(problem, row, column, flux, spacing, reach=1, ground=ground)
        factors, unlikeliness = compared.best([tensor(one) for one in pictures.T], own)
        at = int(np.argmin(unlikeliness))
        row, column = divmod(int(texels[at]), width)
    return latlong.directions(height, width)[row, column], factors[at], float(unlikeliness[at])


@dataclass(frozen=True)
class _Comparison:
    """Pixels or blocks of them, by which pictures of a light are compared.

    ``before`` and ``target`` are linear radiance (n, 3); ``weight`` (n,) and ``share`` (n,) those of the
    likelihood.
    """

    likelihood: Likelihood
    sigma: float
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
        count = 3 * self.likelihood.independent
        squares = squares / self.likelihood.area
        variance = self.likelihood.variance(squares / count, self.sigma)
        unlikeliness = squares / variance + count * np.log(variance) + of_mean(means)
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
