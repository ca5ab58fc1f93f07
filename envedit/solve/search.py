"""Which lights explain what was painted: moves, compared by their evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.rotations import rotation_vector
from envedit.representations.layers.lights import DARK
from envedit.losses import display_curve
from envedit.solve import gauss_newton
from envedit.solve.map_problem import SIGMA, Point, Problem

STEPS = 5
FEW = 3
PLACES = 2
APART = np.cos(np.radians(15.0))
LIGHT = 6.0
STRONG = 6.0
DEBUG = False


@dataclass(frozen=True)
class Explanation:
    """A state with its rendering and -2 log evidence."""

    name: str
    run: gauss_newton.Run
    point: Point
    score: float


def score(problem: Problem, run, point, sigma: float = SIGMA) -> float:
    """Return -2 log evidence, but for a constant: Laplace's approximation at a state."""
    if point.residual is None:
        return np.inf
    noise = problem.noise(point.residual, sigma)
    normal = problem.normal(point, run.start, noise, descent=False)
    try:
        half = [np.linalg.slogdet(m)[1] for m in (normal.hessian, normal.precision)]
    except np.linalg.LinAlgError:
        return np.inf
    fit = problem.loss(point, run.start, noise) + 6 * problem.statements * float(np.log(noise))
    lights = LIGHT * len(problem.added(run.state))
    if DEBUG:
        print(f"      noise {noise:.4f} misfit {problem.misfit(point.residual, noise):.1f} penalty {problem.penalty(run.state, run.start):.1f} "
              f"log det {half[0]-half[1]:.1f} fit {fit:.1f}")
    return fit + half[0] - half[1] + lights


def search(problem: Problem, start: dict, sigma: float = SIGMA, after_step=None) -> Explanation:
    """Find the explanation with the largest evidence."""
    tried = lambda run, point: after_step(None, point) if after_step else None

    def descended(name, state, centre):
        run = gauss_newton.Run(state, centre)
        point = problem.evaluate(state)
        if point.residual is None:
            return None
        point = gauss_newton.descended(problem, run, point, sigma, STEPS)
        tried(run, point)
        found = Explanation(name, run, point, score(problem, run, point, sigma))
        if DEBUG:
            print(f"   {name}: {found.score:.1f}")
        return found

    best = descended("leave", start, start)
    while True:
        found = [descended(name, state, centre) for name, state, centre in moves(problem, best, sigma)]
        found = [one for one in found if one is not None]
        least = min(found, key=lambda one: one.score, default=best)
        if not least.score < best.score - STRONG:
            return best
        best = least
        if DEBUG:
            print("  accepted", best.name, round(best.score, 1))


def _copy(state):
    return {name: value.copy() for name, value in state.items()}


def _centred(start, state, k, names=("turn", "flux", "size")):
    """The centre of the prior, with a light's where it is placed."""
    centre = _copy(start)
    for name in names:
        centre[name][k] = state[name][k]
    return centre


def moves(problem, best, sigma):
    """List the states that a light more, one less, or one elsewhere may lead to: the few most promising.

    Promising is what lowers the misfit, all else as it is, so far that the evidence may rise by it: with the
    noise at its most likely value, -2 log likelihood is the number of values times the misfit's logarithm.
    """
    found = []
    state, start = best.run.state, best.run.start
    lights = problem.layers.lights
    now = problem.misfit(best.point.residual, 1.0)

    def promising(name, changed, centre, misfit, cost=0.0):
        gain = 3 * problem.statements * np.log(now / max(misfit, 1e-30)) - cost
        if DEBUG:
            print(f"    {name}: {gain:.1f}")
        if gain > STRONG:
            found.append((gain, name, changed, centre))

    for k in problem.lit(state):
        dark = _copy(state)
        dark["flux"][k] = DARK
        for direction, strength, misfit in places(problem, dark, k, sigma, problem.direction(state, k)):
            moved = _copy(state)
            moved["turn"][k] = rotation_vector(lights.centres[k], direction)
            moved["flux"][k] = strength
            names = ("turn",) if k < lights.own else ("turn", "flux", "size")
            promising(f"light {k} moved", moved, _centred(start, moved, k, names), misfit)
        if k >= lights.own:
            without = problem.evaluate(dark, resolve=False)
            promising(f"light {k} out", dark, start, problem.misfit(without.residual, 1.0), -LIGHT - STRONG - 1)
    spare = [k for k in range(lights.own, lights.count) if k not in problem.added(state)]
    for k in spare[:1]:
        for direction, strength, misfit in places(problem, state, k, sigma):
            more = _copy(state)
            more["turn"][k] = rotation_vector(lights.centres[k], direction)
            more["flux"][k], more["size"][k] = strength, 0.0
            promising("light added", more, _centred(start, more, k), misfit, LIGHT)
    found.sort(key=lambda one: -one[0])
    return [one[1:] for one in found[:FEW]]


SHARES = 2.0 ** np.arange(-6, 1.5, 0.5)


def places(problem, state, k, sigma, besides=None):
    """Where light k would lower the misfit most: (direction, log flux, misfit), the best first, distinct."""
    lights, blocks = problem.layers.lights, problem.blocks
    point = problem.evaluate(state, resolve=False)
    if point.residual is None:
        return []
    flux = lights.flux[k]
    _, directions = blocks.sky
    count = np.maximum(np.bincount(blocks.block_of, minlength=blocks.count), 1)[:, None]
    before, target = (blocks.summed(one) / count for one in (point.rendering, problem.picture))
    weight = blocks.summed(problem.weight) / problem.area
    rest = blocks.summed(problem.share())
    pictures = np.stack([m.numpy() * np.float32(f) for m, f in zip(blocks._lit, flux, strict=True)], axis=2)
    strength, misfit = _best_strength(pictures.transpose(1, 0, 2), before, target, weight, rest, k < lights.own)
    if besides is not None:
        misfit = np.where(directions @ besides > APART, np.inf, misfit)
    result = []
    for _ in range(PLACES):
        at = int(np.argmin(misfit))
        if not np.isfinite(misfit[at]):
            break
        misfit = np.where(directions @ directions[at] > APART, np.inf, misfit)
        result.append(_refined(problem, point, flux, directions[at], strength[at], k < lights.own))
    return [(direction, np.full(3, np.log(factor)), least) for direction, factor, least in result]


FACTORS = 2.0 ** np.arange(-2, 1.5, 0.5)


def _best_strength(pictures, before, target, weight, rest, fixed):
    """Strength of each picture (n, pixels, 3) that leaves least of the misfit, and what is left."""
    usual = np.ones(len(pictures)) if fixed else before.mean() / np.maximum(pictures.mean(axis=(1, 2)), 1e-30)
    goal = display_curve.to_display(tensor(np.float32(target))).numpy()
    least, found = np.full(len(pictures), np.inf), np.zeros(len(pictures))
    for share in FACTORS if fixed else SHARES:
        shown = np.float32(before) + pictures * np.float32(share * usual)[:, None, None]
        off = display_curve.to_display(tensor(shown)).numpy() - goal
        misfit = np.einsum("npc,np->n", off**2, np.broadcast_to(weight[:, 0], off.shape[:2]))
        misfit += np.square(np.einsum("npc,p->nc", off, rest[:, 0])).sum(axis=1)
        better = misfit < least
        least, found = np.where(better, misfit, least), np.where(better, share * usual, found)
    return found, least


def _refined(problem, point, flux, direction, strength, fixed):
    """Look around a direction, through exact columns."""
    transport, layers = problem.transport, problem.layers
    height, width = problem.envmap.shape[:2]
    omega = latlong.lookup_solid_angles(height, width)
    row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
    least = np.inf
    for spacing in (2, 1):
        if transport.capacity < 9:
            break
        steps = spacing * np.arange(-1, 2)
        first = problem.rows.start
        rows = np.unique(np.clip(row + steps, first, first + layers.shape[0] - 1))
        texels = (rows[:, None] * width + np.unique((column + steps) % width)).ravel()
        unit = (flux / omega[texels // width][:, None]).astype(np.float32)
        pictures = transport.probe(texels) * unit[:, None, :]
        flat = [one.reshape(-1, 3) for one in (point.rendering, problem.picture)]
        weight = problem.weight.reshape(-1, 1) / problem.area
        strengths, misfit = _best_strength(pictures, *flat, weight, problem.share().reshape(-1, 1), fixed)
        at = int(np.argmin(misfit))
        least, strength = misfit[at], strengths[at]
        row, column = divmod(int(texels[at]), width)
        direction = latlong.directions(height, width)[row, column]
    return direction, strength, least
