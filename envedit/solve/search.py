"""Which explanation of a painted picture is likeliest: moves of lights, compared by their evidence.

An explanation is a local maximum of the posterior: the lights where they are, one of them elsewhere, softer
or out, one more. No small step leads from one to the other. Each is begun where a search over all directions
puts the light, descended to by a few Gauss-Newton steps, and judged by one number, -2 log evidence in
Laplace's approximation (MacKay 1992),

    F(x) + 6 n log(sigma) + log det H - log det K,

with sigma the most likely noise, n of ``likelihood.py``, H = K + the misfit's Hessian / 2. What an unknown
gains in misfit it pays for by how far it is determined beyond its prior. The best explanation is kept if its
number is lower by :data:`POSITIVE`, and the search goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.rotations import rotation_vector
from envedit.losses import display_curve
from envedit.representations.layers.lights import DARK, LOBE_DEGREES
from envedit.solve import gauss_newton
from envedit.solve.likelihood import Likelihood, of_mean
from envedit.solve.map_problem import SIGMA, Problem
from envedit.solve.unknowns import Point

POSITIVE = 2.0
"""By how much -2 log evidence must be lower for another explanation: "positive" evidence by Kass and Raftery
(1995), below which it is "not worth more than a bare mention"."""
LIGHT = 2 * np.log(20.0)
"""What a light costs that the map does not have: one sky in twenty gets one."""
STEPS = 5
"""Gauss-Newton steps after which explanations are compared."""
CANDIDATES = 2
"""Best places of one light that are refined."""
APART = np.cos(np.radians(15.0))
"""Cosine of the angle between two places of a light that are different explanations."""
SOFT_DEGREES = 2.0
"""Radius of the lobe that takes the place of a light where a shadow is to be softer, and of a light that is
added to a map without any."""
FACTORS = 2.0 ** np.arange(-2, 1.5, 0.5)
"""Fluxes that a light of the map is tried with elsewhere, over its own."""
SHARES = 2.0 ** np.arange(-6, 1.5, 0.5)
"""Fluxes that an added light is tried with, as shares of the light in the picture."""
SPACINGS = (2, 1)
"""Distances in texels of the places that are tried around the best cell, one after the other."""


@dataclass(frozen=True)
class Explanation:
    """A solution after a few steps.

    Attributes
    ----------
    name : str
        What was done to the map's lights, for a note.
    run, point : Run, Point
        Where the solution goes on.
    score : float
        -2 log evidence, but for a constant.
    """

    name: str
    run: gauss_newton.Run
    point: Point
    score: float


@dataclass(frozen=True)
class _Move:
    """A state to descend from, the centre of its prior, and what it is expected to lower the score by."""

    name: str
    state: dict
    centre: dict
    gain: float


def search(
    problem: Problem,
    start: dict,
    sigma: float = SIGMA,
    after_step: Callable[[], None] | None = None,
) -> Explanation:
    """Find the likeliest explanation.

    Parameters
    ----------
    problem : Problem
        Of a painted picture.
    start : dict
        State of the map as it is.
    sigma : float
        Least standard error of display values.
    after_step : callable, optional
        Called now and then; what it raises ends the search.
    """
    best = _descended(problem, "lights left where they are", start, start, sigma)
    while best.point.residual is not None:
        found = []
        for move in _moves(problem, best, sigma):
            found.append(_descended(problem, move.name, move.state, move.centre, sigma))
            if after_step:
                after_step()
        least = min(found, key=lambda one: one.score, default=best)
        if not least.score < best.score - POSITIVE:
            break
        best = least
    return best


def score(problem: Problem, run: gauss_newton.Run, point: Point, sigma: float) -> float:
    """Return -2 log evidence at a point, but for a constant; inf where it is not finite."""
    if point.residual is None:
        return np.inf
    noise = problem.noise(point.residual, sigma)
    normal = problem.normal(point, run.start, noise, descent=False)
    (_, known), (_, expected) = np.linalg.slogdet(normal.hessian), np.linalg.slogdet(normal.precision)
    likelihood = problem.likelihood.at_best(point.residual, sigma) + problem.penalty(run.state, run.start)
    found = float(likelihood + known - expected + LIGHT * len(problem.added(run.state)))
    return found if np.isfinite(found) else np.inf


def _descended(problem, name, state, centre, sigma):
    """Return the explanation that a few steps from a state lead to."""
    run = gauss_newton.Run(state, centre)
    point = problem.evaluate(state)
    if point.residual is not None:
        point = gauss_newton.descended(problem, run, point, sigma, STEPS)
    return Explanation(name, run, point, score(problem, run, point, sigma))


# ---- Moves -------------------------------------------------------------------------------------------------


def _moves(problem, best, sigma):
    """List the most promising move of each kind from an explanation.

    Lights come first: the sky's gain is as in the original. Promising is what raises the likelihood then, all
    else as it is; steps raise it further.
    """
    state = best.run.state | {name: np.zeros_like(best.run.state[name]) for name in ("gain", "saturation")}
    now = _unlikeliness(problem, state, sigma)
    found: dict[str, _Move] = {}
    for name, changed, centre, unlikeliness, cost in _changes(problem, state, best.run.start, sigma):
        move = _Move(name, changed, centre, gain=now - unlikeliness - cost)
        if move.gain > (found[name].gain if name in found else 0.0):
            found[name] = move
    return list(found.values())


def _changes(problem, state, start, sigma):
    """Yield what can be done to the lights: (str, dict, dict, float, float).

    Its name, state, centre of the prior, -2 log likelihood, and what it costs to add the light.
    """
    lights = problem.layers.lights
    spare = [k for k in range(lights.own, lights.count) if k not in problem.added(state)]

    for k in problem.lit(state):
        own = k < lights.own
        dark = _changed(state, k, flux=DARK)
        # ---- elsewhere
        away = problem.direction(state, k)
        for direction, flux, unlikeliness in places(problem, dark, k, sigma, away):
            turn = rotation_vector(lights.centres[k], direction)
            moved = _changed(state, k, turn=turn, flux=flux)
            centre = _changed(start, k, turn=turn) if own else _changed(start, k, turn=turn, flux=flux)
            yield f"light {k + 1} moved", moved, centre, unlikeliness, 0.0
        # ---- softer: a light of few texels cannot grow, as its texels would part; a lobe can
        if own and spare:
            flux = state["flux"][k] + np.log(lights.flux[k] / np.maximum(lights.flux[spare[0]], 1e-30))
            turn = rotation_vector(lights.centres[spare[0]], away)
            size = lights.log_size(SOFT_DEGREES)
            soft = _changed(dark, spare[0], turn=turn, flux=flux, size=size)
            centre = _changed(start, spare[0], turn=turn, flux=flux, size=size)
            yield f"light {k + 1} softened", soft, centre, _unlikeliness(problem, soft, sigma), 0.0
        # ---- out, if it was added
        if not own:
            yield f"light {k + 1} removed", dark, start, _unlikeliness(problem, dark, sigma), -LIGHT

    # ---- one more
    size = lights.log_size(LOBE_DEGREES if lights.own else SOFT_DEGREES)
    for k in spare[:1]:
        for direction, flux, unlikeliness in places(problem, state, k, sigma):
            turn = rotation_vector(lights.centres[k], direction)
            more = _changed(state, k, turn=turn, flux=flux, size=size)
            centre = _changed(start, k, turn=turn, flux=flux, size=size)
            yield "light added", more, centre, unlikeliness, LIGHT


def _changed(state, k, **values):
    """Return a state with other values of one light."""
    state = {name: value.copy() for name, value in state.items()}
    for name, value in values.items():
        state[name][k] = value
    return state


def _unlikeliness(problem, state, sigma):
    point = problem.evaluate(state)
    return np.inf if point.residual is None else problem.likelihood.at_best(point.residual, sigma)


# ---- Where a light raises the likelihood -------------------------------------------------------------------


def places(
    problem: Problem, state: dict, k: int, sigma: float, away: np.ndarray | None = None
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """List where light ``k``, dark in a state, raises the likelihood most: direction, log flux (3,), -2 log.

    All cells of the sky are tried through the block transport, with several fluxes each, and texels around
    the best ones through exact columns. Places differ by :data:`APART`, also from ``away``, (3,).
    """
    lights, blocks, likelihood = problem.layers.lights, problem.blocks, problem.likelihood
    point = problem.evaluate(state, resolve=False)
    _, directions = blocks.sky
    if point.residual is None or not len(directions):
        return []
    own, flux = k < lights.own, lights.flux[k]
    pixels = np.maximum(np.bincount(blocks.block_of, minlength=blocks.count), 1)[:, None]
    seen = _Seen(
        likelihood=likelihood,
        sigma=sigma,
        before=blocks.summed(point.rendering) / pixels,
        target=blocks.summed(problem.picture) / pixels,
        weight=blocks.summed(likelihood.weight)[:, 0],
        share=blocks.summed(likelihood.share)[:, 0],
    )
    factors, unlikeliness = seen.best(blocks.of_cells(flux), own)
    if away is not None:
        unlikeliness = np.where(directions @ away > APART, np.inf, unlikeliness)
    found = []
    for _ in range(CANDIDATES):
        at = int(np.argmin(unlikeliness))
        if not np.isfinite(unlikeliness[at]):
            break
        unlikeliness = np.where(directions @ directions[at] > APART, np.inf, unlikeliness)
        found.append(_refined(problem, point, flux, own, directions[at], sigma))
    return [(direction, np.full(3, np.log(factor)), least) for direction, factor, least in found]


def _refined(problem, point, flux, own, direction, sigma):
    """Look around a direction through exact columns; returns direction, factor of the flux, and -2 log."""
    transport, likelihood = problem.transport, problem.likelihood
    height, width = problem.envmap.shape[:2]
    omega = latlong.lookup_solid_angles(height, width)
    seen = _Seen(
        likelihood=likelihood,
        sigma=sigma,
        before=point.rendering.reshape(-1, 3),
        target=problem.picture.reshape(-1, 3),
        weight=likelihood.weight.ravel(),
        share=likelihood.share.ravel(),
    )
    row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
    for spacing in SPACINGS:
        steps = spacing * np.arange(-1, 2)
        first = problem.rows.start
        rows = np.unique(np.clip(row + steps, first, first + problem.layers.shape[0] - 1))
        texels = (rows[:, None] * width + np.unique((column + steps) % width)).ravel()
        unit = (flux / omega[texels // width][:, None]).astype(np.float32)
        factors, unlikeliness = seen.best(transport.probe(texels) * unit[:, None, :], own)
        at = int(np.argmin(unlikeliness))
        row, column = divmod(int(texels[at]), width)
    return latlong.directions(height, width)[row, column], factors[at], float(unlikeliness[at])


@dataclass(frozen=True)
class _Seen:
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

    def best(self, pictures: Any, own: bool) -> tuple[Any, Any]:
        """Return the likeliest factor of the flux of each picture (k, n, 3), and -2 log likelihood then."""
        unit: Any = np.ones(len(pictures))
        if not own:  # of any flux; on black, as much as was painted
            light = self.before.mean() or max(float(self.target.mean()), 1e-30)
            unit = light / np.maximum(pictures.mean(axis=(1, 2)), 1e-30)
        goal = _display(self.target)
        count = 3 * self.likelihood.independent
        least = np.full(len(pictures), np.inf)
        found = np.ones(len(pictures))
        for factor in FACTORS if own else SHARES:
            more = np.float32(pictures * (factor * unit)[:, None, None])
            off = _display(np.float32(self.before) + more) - goal
            squares = np.einsum("knc,knc,n->k", off, off, self.weight) / self.likelihood.area
            mean = of_mean(np.einsum("knc,n->kc", off, self.share))
            variance = self.likelihood.variance(squares / count, self.sigma)
            unlikeliness = squares / variance + count * np.log(variance) + mean
            better = unlikeliness < least
            least = np.where(better, unlikeliness, least)
            found = np.where(better, factor * unit, found)
        return found, least


def _display(radiance):
    return display_curve.to_display(tensor(np.float32(radiance))).numpy()
