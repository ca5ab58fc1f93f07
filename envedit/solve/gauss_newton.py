"""Gauss-Newton steps with Levenberg's and Marquardt's damping, for the problem of ``map_problem.py``.

A step solves the normal equations, and is kept if it lowers F. Huber's threshold s and sigma are at first as
large as the residual, never rise, and are at most halved at every step, so that a distant start is not
dominated by outliers. Which lights there are is decided before (``search.py``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from envedit.core.array_cache import under
from envedit.core.errors import NumericalError
from envedit.solve.derivatives import NARROW_ANGLE, WIDE_ANGLE
from envedit.solve.map_problem import Point, Posterior, Problem
from envedit.transport.exact_columns import Columns

MOST_STEPS, LEAST_DECREASE = 16, 2e-3
"""Most steps, and the relative decrease of F below which no further step is made."""
DAMPINGS_TRIED = 5
"""Dampings that are tried in one step."""
DAMPING_FACTOR = 10.0
"""By how much damping rises after a step that does not lower F, and falls after one that does (Marquardt)."""
FIRST_DAMPING, LEAST_DAMPING, RAISED_DAMPING = 1e-3, 1e-4, 1e-2
"""Damping at first, at least, and at least after a step that did not lower F."""
COMPARED_NOISE_RATIO, KEPT_ERROR_SHARE = 2.0, 0.95
"""Noise of the start over that of the solution up to which their renderings are compared, and the share of
the start's squared error that the solution's must be below."""


@dataclass
class Run:
    """State of a solution between two steps: all that is needed to continue."""

    # state, start: unknowns now, and the centre of the prior of lights: ``gain`` (nodes, 3), ``turn``,
    # ``flux`` (lights, 3) and ``size`` (lights, 1), logarithms and radians
    state: dict
    start: dict
    # damping, scale: of the next step; the threshold s
    damping: float = FIRST_DAMPING
    scale: float = np.inf
    finished: bool = False  # no further step is made
    # A row a step: ``loss`` F, its parts ``data`` and ``prior``, the ``sigma`` at which they were taken,
    # ``residual`` RMS of display values, ``damping``, ``step_ms``
    history: list[dict] = field(default_factory=list)
    most: int = MOST_STEPS  # steps after which it ends
    columns: Columns | None = None  # of T, with which the state was rendered last
    hold: float = 1.0  # weight of what was not painted, where it is raised (:mod:`.hold`)
    # Derivatives by a light's direction are wide differences: with narrow ones no step leads further
    wide: bool = False
    corrected: bool = False  # the last steps, towards a target without T's error (:mod:`.layers_solver`)

    @property
    def angle(self) -> float:
        """Rotation of the differences by a light's direction, radians."""
        return WIDE_ANGLE if self.wide else NARROW_ANGLE

    def onward(self, **changes: Any) -> Run:
        """Return another run, with the defaults but for changes, that goes on from where this one is."""
        return Run(self.state, self.start, history=list(self.history), columns=self.columns, **changes)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all but the history as arrays, for a checkpoint."""
        both = {f"{part}.{k}": v for part in ("state", "start") for k, v in getattr(self, part).items()}
        scale = self.scale if np.isfinite(self.scale) else 0.0  # before the first step
        numbers = self.damping, scale, self.finished, self.most, self.hold
        if self.columns is not None:
            both["columns"] = np.stack([self.columns.texels, self.columns.paths])
        return both | {"numbers": np.array([*numbers, self.wide, self.corrected])}

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray], history: list[dict]) -> Run:
        """Make a run of what :meth:`arrays` returned."""
        damping, scale, finished, most, hold, wide, corrected = arrays["numbers"].tolist()
        columns = arrays.get("columns")
        return cls(
            state=under(arrays, "state."),
            start=under(arrays, "start."),
            damping=damping,
            scale=scale or np.inf,
            finished=bool(finished),
            history=list(history),
            most=int(most),
            columns=None if columns is None else Columns(*columns),
            hold=hold,
            wide=bool(wide),
            corrected=bool(corrected),
        )


@dataclass
class Solution:
    """What :func:`solve` found."""

    params: dict  # of the layers
    run: Run  # as it ended, also where the start was kept
    posterior: Posterior  # how well the picture determines the sky
    note: str = ""  # what a user should know


def solve(
    problem: Problem,
    params: dict,
    iterations: int = 2 * MOST_STEPS,
    after_step: Callable[[Run, Point], None] | None = None,
    run: Run | None = None,
    sparing: bool = True,
    judge: Callable[[np.ndarray], float] | None = None,
) -> Solution:
    """Minimise F.

    Parameters
    ----------
    problem : Problem
        What is minimised.
    params : dict
        The map as it is: where lights start, and are drawn to.
    iterations : int
        Most steps.
    after_step : callable, optional
        Called after every step, and when no further one is made, with where the solution is. What it raises
        ends the solution.
    run : Run, optional
        To continue an earlier solution, in place of ``params``.
    sparing : bool
        Stay at the start where steps lower the misfit by no more than noise would let them.
    judge : callable, optional
        Error of a map (H, W, 3) that is measured without T; used where the start is nearly as good as the
        solution (:data:`COMPARED_NOISE_RATIO`), as steps may then follow the errors of T.

    Raises
    ------
    NumericalError
        If the start is not finite.
    """
    start, known = problem.state(params), run is not None
    if run is None:
        run = Run(start, start)
    point = reached(problem, run)
    run.columns = point.transport.exact
    if point.residual is None:
        raise NumericalError("the initial map is not finite: check the input map for extreme values")
    if after_step and (known or not iterations):
        after_step(run, point)
    left = min(iterations, run.most) - len(run.history)
    point = descended(problem, run, point, left, after_step)
    normal = problem.curvature(point, run.start)
    note, state = "", run.state
    first = problem.evaluate(start, point.transport, resolve=False) if sparing and run.history else None
    if first is not None and first.residual is not None:
        loss = problem.unlikeliness(point, run.start) + 2 * normal.determined
        noise = problem.likelihood.noise(point.residual)
        near = problem.likelihood.noise(first.residual) < COMPARED_NOISE_RATIO * noise
        if problem.unlikeliness(first, start) <= loss:
            note = "kept the initialisation: the better match of the rendering does not justify "
            note += f"{normal.determined:.0f} parameters (Akaike criterion)"
        elif judge is not None and near and KEPT_ERROR_SHARE * judge(first.edited) <= judge(point.edited):
            note = "kept the initialisation: path-traced, it is as close to the target as the solution"
        if note:
            state, normal = start, problem.curvature(first, start)
    return Solution(problem.solution_params(state), run, problem.posterior(state, normal), note)


def reached(problem: Problem, run: Run) -> Point:
    """Return the point where a run is, rendered as it was last; InputError if its columns cannot be T's."""
    if run.columns is None:
        return problem.evaluate(run.state)
    return problem.evaluate(run.state, problem.transport.restored(run.columns), resolve=False)


def descended(
    problem: Problem,
    run: Run,
    point: Point,
    steps: int = 1,
    after_step: Callable[[Run, Point], None] | None = None,
    hopeless: Callable[[Point, float], bool] | None = None,
    largest_noise: float | None = None,
) -> Point:
    """Make at most some ``steps`` from where a run is, at ``point``, and return where they end.

    The run goes along; it may be finished before. ``hopeless`` is called before each step, with the point and
    by how much F falls in the steps that are left if in each by what this one promises; where it returns
    true, no further step is made. ``largest_noise`` is that of paint, by default that down to which it is
    followed. Other parameters are those of :func:`solve`.
    """
    largest_noise = largest_noise or problem.likelihood.followed_noise
    most = len(run.history) + steps
    while len(run.history) < most and not run.finished:
        began = time.perf_counter()

        # ---- Huber's threshold: the noise, at most halved at once
        noise = problem.likelihood.noise(point.residual, largest_noise)
        halved = run.scale / 2 if np.isfinite(run.scale) else 0
        run.scale = min(run.scale, max(noise, halved))

        # ---- F linearised
        normal = problem.normal(point, run.start, run.scale, run.angle)

        # ---- A step that lowers F, where one may by enough
        better, promised = None, normal.decrement
        if hopeless and hopeless(point, (most - len(run.history)) * promised):
            break
        if promised >= LEAST_DECREASE * problem.loss(point, run.start, run.scale):
            point, better = _lower(problem, run, point, normal)

        # ---- Whether it is the last one
        before, after = (problem.loss(one, run.start, run.scale) for one in (point, better or point))
        little = better is None or before - after < LEAST_DECREASE * before
        ended = little and run.scale <= 1.01 * problem.likelihood.noise(point.residual, largest_noise)
        run.finished = ended and (run.wide or not problem.shining(run.state))
        if ended and not run.wide:  # other derivatives: what damping those needed says nothing of them
            run.wide, run.damping = True, Run.damping

        # ---- Taken, and noted
        if better is not None:
            point = better
            run.state = point.state
            run.damping = max(run.damping / DAMPING_FACTOR, LEAST_DAMPING)
            run.history.append(
                {
                    "iteration": len(run.history),
                    "loss": after,
                    "data": problem.likelihood.misfit(point.residual, run.scale),
                    "prior": problem.penalty(point, run.start),
                    "sigma": run.scale,
                    "residual": float(np.sqrt(np.square(point.residual).mean())),
                    "damping": run.damping,
                    "step_ms": round(1000 * (time.perf_counter() - began), 3),
                }
            )
        run.columns = point.transport.exact
        if after_step and (better is not None or run.finished):
            after_step(run, point)
    return point


def _lower(problem, run, point, normal):
    """Try steps of more and more damping until one lowers F.

    Returns the point that the run is at, as of :func:`_tried`, and the one that is lower, or None. F does not
    depend on how white the sky is until more of it is white than was: from the first step on that leads
    there, the equations count that.
    """
    bounded = False
    for _ in range(DAMPINGS_TRIED):
        point, there, lower = _tried(problem, run, point, normal)
        if there and not (lower or bounded) and problem.whitens(there) and not problem.whitens(point):
            bounded = True
            normal = problem.normal(point, run.start, run.scale, run.angle, bounded=True)
            point, there, lower = _tried(problem, run, point, normal)
        if lower:
            return point, there
        run.damping = max(DAMPING_FACTOR * run.damping, RAISED_DAMPING)
    return point, None


def _tried(problem, run, point, normal):
    """Make one step; returns where it is from, where it leads, or None, and whether F is lower there.

    Where it is not, the former is rendered anew, with the columns of T that the latter has more.
    """
    state = problem.step(run.state, normal, run.damping)
    there = None if state is None else problem.evaluate(state, point.transport)
    if there is None or there.residual is None:
        return point, None, False
    before, after = (problem.loss(one, run.start, run.scale) for one in (point, there))
    if after >= before:
        again = problem.evaluate(run.state, there.transport, resolve=False)
        if again.residual is not None:
            point, before = again, problem.loss(again, run.start, run.scale)
    return point, there, after < before
