"""Which explanation of a painted picture is likeliest: moves of lights, compared by their evidence.

An explanation is a local maximum of the posterior: the lights where they are, one of them elsewhere, softer or
out, one more. No small step leads from one to the other. Each is begun where a search over all directions puts
the light, descended to by a few Gauss-Newton steps, and judged by one number, -2 log evidence in Laplace's
approximation (MacKay 1992),

    F(x) + 6 n log(sigma) + log det H - log det K,

with sigma the most likely noise, n of ``likelihood.py``, H = K + the misfit's Hessian / 2. What an unknown
gains in misfit it pays for by how far it is determined beyond its prior. The best explanation is kept if its
number is lower by :data:`STRONG`, and the search goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.rotations import rotation_vector
from envedit.losses import display_curve
from envedit.representations.layers.lights import DARK, LOBE_DEGREES
from envedit.solve import gauss_newton
from envedit.solve.map_problem import SIGMA, Problem
from envedit.solve.unknowns import Point

STRONG = 6.0
"""By how much -2 log evidence must be lower for another explanation: strong evidence (Kass and Raftery 1995)."""
LIGHT = 2 * np.log(20.0)
"""What a light costs that the map does not have: one sky in twenty gets one."""
STEPS = 5
"""Gauss-Newton steps after which explanations are compared."""
CANDIDATES = 2
"""Places of one light that are tried, and explanations that are descended to in one round."""
APART = np.cos(np.radians(15.0))
"""Cosine of the angle between two places of a light that are different explanations."""
SOFT_DEGREES = 2.0
"""Radius of the lobe that takes the place of a light where a shadow is to be softer."""
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
        for move in _moves(problem, best):
            found.append(_descended(problem, move.name, move.state, move.centre, sigma))
            if after_step:
                after_step()
        least = min(found, key=lambda one: one.score, default=best)
        if not least.score < best.score - STRONG:
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
    likelihood = problem.loss(point, run.start, noise) + 6 * problem.likelihood.values * np.log(noise)
    found = float(likelihood + known - expected + LIGHT * len(problem.added(run.state)))
    return found if np.isfinite(found) else np.inf


def _descended(problem, name, state, centre, sigma):
    """Return the explanation that a few steps from a state lead to."""
    run = gauss_newton.Run(state, centre)
    point = problem.evaluate(state)
    if point.residual is not None:
        point = gauss_newton.descended(problem, run, point, sigma, STEPS)
    return Explanation(name, run, point, score(problem, run, point, sigma))


# ---- Moves ---------------------------------------------------------------------------------------------------


def _moves(problem, best):
    """List the most promising moves from an explanation.

    Promising is what lowers the misfit, all else as it is, so far that the evidence may rise by it: with the
    noise at its most likely value, -2 log likelihood is 3 n times the logarithm of the misfit.
    """
    now = problem.misfit(best.point.residual, 1.0)
    found = []
    for name, state, centre, misfit, cost in _changes(problem, best):
        gain = 3 * problem.likelihood.values * np.log(now / max(misfit, 1e-30)) - cost
        if gain > STRONG:
            found.append(_Move(name, state, centre, gain))
    return sorted(found, key=lambda move: -move.gain)[:CANDIDATES]


def _changes(problem, best) -> Iterator[tuple[str, dict, dict, float, float]]:
    """Yield what can be done to the lights: name, state, centre of the prior, misfit, cost of the light."""
    state, start = best.run.state, best.run.start
    lights = problem.layers.lights
    spare = [k for k in range(lights.own, lights.count) if k not in problem.added(state)]

    for k in problem.lit(state):
        own = k < lights.own
        dark = _changed(state, k, flux=DARK)
        # ---- elsewhere
        away = problem.direction(state, k)
        for direction, flux, misfit in _places(problem, dark, k, away):
            turn = rotation_vector(lights.centres[k], direction)
            moved = _changed(state, k, turn=turn, flux=flux)
            centre = _changed(start, k, turn=turn) if own else _changed(start, k, turn=turn, flux=flux)
            yield f"light {k + 1} moved", moved, centre, misfit, 0.0
        # ---- softer: a light of few texels cannot grow, as its texels would part; a lobe can
        if own and spare:
            flux = state["flux"][k] + np.log(lights.flux[k] / np.maximum(lights.flux[spare[0]], 1e-30))
            turn = rotation_vector(lights.centres[spare[0]], away)
            size = np.log(SOFT_DEGREES / LOBE_DEGREES)
            soft = _changed(dark, spare[0], turn=turn, flux=flux, size=size)
            centre = _changed(start, spare[0], turn=turn, flux=flux, size=size)
            yield f"light {k + 1} softened", soft, centre, _misfit(problem, soft), 0.0
        # ---- out, if it was added
        if not own:
            yield f"light {k + 1} removed", dark, start, _misfit(problem, dark), -LIGHT

    # ---- one more
    for k in spare[:1]:
        for direction, flux, misfit in _places(problem, state, k):
            turn = rotation_vector(lights.centres[k], direction)
            more = _changed(state, k, turn=turn, flux=flux, size=0.0)
            centre = _changed(start, k, turn=turn, flux=flux, size=0.0)
            yield "light added", more, centre, misfit, LIGHT


def _changed(state, k, **values):
    """Return a state with other values of one light."""
    state = {name: value.copy() for name, value in state.items()}
    for name, value in values.items():
        state[name][k] = value
    return state


def _misfit(problem, state):
    point = problem.evaluate(state)
    return np.inf if point.residual is None else problem.misfit(point.residual, 1.0)


# ---- Where a light lowers the misfit -------------------------------------------------------------------------


def _places(problem, state, k, away=None):
    """List where light ``k``, dark in a state, lowers the misfit most: direction, log flux (3,), misfit.

    All cells of the sky are tried through the block transport, with several fluxes each, and texels around
    the best ones through exact columns. Places differ by :data:`APART`, also from ``away``.
    """
    lights, blocks, likelihood = problem.layers.lights, problem.blocks, problem.likelihood
    point = problem.evaluate(state, resolve=False)
    _, directions = blocks.sky
    if point.residual is None or not len(directions):
        return []
    own, flux = k < lights.own, lights.flux[k]
    pixels = np.maximum(np.bincount(blocks.block_of, minlength=blocks.count), 1)[:, None]
    seen = _Seen(
        before=blocks.summed(point.rendering) / pixels,
        target=blocks.summed(problem.picture) / pixels,
        weight=blocks.summed(likelihood.weight)[:, 0] / likelihood.area,
        share=blocks.summed(likelihood.share * np.ones_like(likelihood.weight))[:, 0],
    )
    factors, misfit = seen.best(blocks.of_cells(flux), own)
    if away is not None:
        misfit = np.where(directions @ away > APART, np.inf, misfit)
    found = []
    for _ in range(CANDIDATES):
        at = int(np.argmin(misfit))
        if not np.isfinite(misfit[at]):
            break
        misfit = np.where(directions @ directions[at] > APART, np.inf, misfit)
        found.append(_refined(problem, point, flux, own, directions[at], factors[at], misfit[at]))
    return [(direction, np.full(3, np.log(factor)), least) for direction, factor, least in found]


def _refined(problem, point, flux, own, direction, factor, least):
    """Look around a direction through exact columns; returns direction, factor of the flux, misfit."""
    transport, likelihood = problem.transport, problem.likelihood
    height, width = problem.envmap.shape[:2]
    omega = latlong.lookup_solid_angles(height, width)
    seen = _Seen(
        before=point.rendering.reshape(-1, 3),
        target=problem.picture.reshape(-1, 3),
        weight=likelihood.weight.ravel() / likelihood.area,
        share=(likelihood.share * np.ones_like(likelihood.weight)).ravel(),
    )
    row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
    for spacing in SPACINGS:
        if transport.capacity < 9:  # memory leaves no exact columns to refine
            break
        steps = spacing * np.arange(-1, 2)
        first = problem.rows.start
        rows = np.unique(np.clip(row + steps, first, first + problem.layers.shape[0] - 1))
        texels = (rows[:, None] * width + np.unique((column + steps) % width)).ravel()
        unit = (flux / omega[texels // width][:, None]).astype(np.float32)
        factors, misfit = seen.best(transport.probe(texels) * unit[:, None, :], own)
        at = int(np.argmin(misfit))
        factor, least = factors[at], misfit[at]
        row, column = divmod(int(texels[at]), width)
        direction = latlong.directions(height, width)[row, column]
    return direction, factor, float(least)


@dataclass(frozen=True)
class _Seen:
    """Pixels or blocks of them, by which pictures of a light are compared.

    ``before`` and ``target`` are linear radiance (n, 3); ``weight`` (n,) and ``share`` (n,) those of the
    likelihood.
    """

    before: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    share: np.ndarray

    def best(self, pictures, own):
        """Return the factor by which each picture (k, n, 3) lowers the misfit most, and the misfit then."""
        unit = np.ones(len(pictures))
        if not own:  # of any flux
            unit = self.before.mean() / np.maximum(pictures.mean(axis=(1, 2)), 1e-30)
        goal = _display(self.target)
        least, found = np.full(len(pictures), np.inf), np.ones(len(pictures))
        for factor in FACTORS if own else SHARES:
            more = pictures * np.float32(factor * unit)[:, None, None]
            off = _display(np.float32(self.before) + more) - goal
            misfit = np.einsum("knc,knc,n->k", off, off, self.weight)
            misfit += np.square(np.einsum("knc,n->kc", off, self.share)).sum(axis=1)
            better = misfit < least
            least, found = np.where(better, misfit, least), np.where(better, factor * unit, found)
        return found, least


def _display(radiance):
    return display_curve.to_display(tensor(np.float32(radiance))).numpy()
