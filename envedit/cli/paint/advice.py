"""What to do where little of the paint is reached: one line, and a light that would reach more elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from envedit.cli.paint import picking
from envedit.cli.paint.protocol import Document
from envedit.core.color import tonemap
from envedit.core.rotations import rotation_vector
from envedit.losses import metrics
from envedit.representations.layers.lights import DARK
from envedit.solve import painted_places
from envedit.solve.feasibility import WARNED_SHARE, Reach
from envedit.solve.map_problem import SIGMA, Problem


@dataclass(frozen=True)
class Painted:
    """What was painted.

    Attributes
    ----------
    base, target : ndarray (h, w, 3)
        What was painted on, and what was asked for, linear radiance.
    coverage : ndarray (h, w, 1)
        How much each pixel was painted; 0 of those that do not count.
    """

    base: np.ndarray
    target: np.ndarray
    coverage: np.ndarray

    def reached(self, rendering: np.ndarray) -> float:
        """Return the share of the painted change that a rendering has made; 1 where nothing is asked."""
        towards = metrics.painted(rendering, self.target, self.base, self.coverage)["towards"]
        return 1.0 if towards is None else towards


def said(
    document: Document, painted: Painted, rendering: np.ndarray, reach: Reach, strokes: Sequence[np.ndarray]
) -> str:
    """Return one line on the stroke of which most is left, and what reaches more; "" if enough is reached.

    Parameters
    ----------
    document : Document
        What was painted, and how it is solved for.
    painted, rendering
        What was asked for, and what was reached of it, (h, w, 3).
    reach : Reach
        What is feasible.
    strokes : sequence of ndarray (h, w, 1)
        Coverage of each stroke by itself.
    """
    if painted.reached(rendering) >= WARNED_SHARE:
        return ""
    # ---- Which stroke, and how
    left = np.float64(tonemap(painted.target)) - tonemap(rendering)
    missed = [
        (float((cover * np.abs(left)).sum()), i)
        for i, (one, cover) in enumerate(zip(document.strokes, strokes, strict=True))
        if one["type"] != "hold"
    ]
    _, i = max(missed, key=lambda one: one[0])
    dark = float((strokes[i] * left).sum()) > 0
    stays, wanted = ("too dark", "brighter") if dark else ("too bright", "darker")
    which = f"stroke {i + 1} ({document.strokes[i]['type']}) stays {stays}"
    # ---- Why, and what reaches more
    if document.rest == "keep":
        return f"{which}: the rest, which stays, keeps it so; try “follows”"
    if reach.share < WARNED_SHARE:
        return f"{which}: no light makes it {wanted} and leaves the mean of the rest; paint less"
    if document.freedom < WARNED_SHARE:
        return f"{which}: lights alone do not make it {wanted}; let the sky change more"
    return f"{which}: what would make it {wanted} is unlikely for a sky; move or add a light"


@dataclass(frozen=True)
class Better:
    """A light that reaches more of the paint by itself.

    Attributes
    ----------
    light : int
        Index among those of :func:`.picking.lights`.
    direction : ndarray (3,)
        Where it must stand, in the turned map.
    factor : float
        Of its flux.
    share : float
        What the rendering then has of the painted change.
    """

    light: int
    direction: np.ndarray
    factor: float
    share: float


def moved(
    problem: Problem, start: dict, state: dict, painted: Painted, lights: list[picking.Placed]
) -> Better | None:
    """Find where the map's strongest light would reach more by itself than a solution does.

    Parameters
    ----------
    problem : Problem
        Of the paint, where the rest follows: it does where a light is moved by hand.
    start, state : dict
        The map as it is, and the solution.
    painted : Painted
        What was asked for.
    lights : list of Placed
        The document's.

    Returns
    -------
    Better or None
        None where there is no such place.
    """
    own = [k for k in problem.shining(start) if k < problem.layers.lights.own]
    if not own:
        return None
    flux = problem.layers.lights.flux
    k = max(own, key=lambda k: flux[k].sum())
    toward = problem.layers.lights.centres[k]
    i, now = picking.index_of(lights, toward), problem.evaluate(state, resolve=False).rendering
    if i is None or now is None:
        return None
    without = _with(start, k, flux=DARK)
    most, best = painted.reached(now), None
    for direction, factor, _ in painted_places.best(problem, without, k, SIGMA, problem.direction(state, k)):
        turn = rotation_vector(toward, direction)
        rendering = problem.evaluate(_with(start, k, turn=turn, flux=factor)).rendering
        share = -np.inf if rendering is None else painted.reached(rendering)
        if share > most:
            most, best = share, Better(i, direction, float(np.exp(factor[0])), share)
    return best


def _with(state, k, **values):
    """Return a state with other values of one light."""
    found = {name: value.copy() for name, value in state.items()}
    for name, value in values.items():
        found[name][k] = value
    return found
