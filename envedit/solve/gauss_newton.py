"""Gauss-Newton steps with Levenberg's and Marquardt's damping, for the problem of ``map_problem.py``.

A step solves the normal equations, and is kept if it lowers F. Huber's threshold s and sigma are at first as
large as the residual, never rise, and are at most halved at every step, so that a distant start is not
dominated by outliers.

Longer than 400 lines: the steps, their damping and the trials of added lights share the state of a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from envedit.core.errors import NumericalError
from envedit.core.rotations import rotation_vector
from envedit.representations.layers.lights import DARK
from envedit.solve import added_light
from envedit.solve.derivatives import ANGLE, WIDE
from envedit.solve.map_problem import SIGMA, Point, Posterior, Problem

ITERATIONS, LITTLE = 16, 2e-3
"""Most steps where no light is added or moved, and the relative decrease of F below which no further step is
made."""
TRIES = 5
"""Dampings that are tried in one step."""
NEAR, CLEARLY = 2.0, 0.95
"""Noise of the start over that of the solution up to which their renderings are compared, and the share of
the start's squared error that the solution's must be below."""
WORTH, ADDED_STEPS = 20.0, 6
"""By how much a further light must lower F to be tried and to be kept: twice the logarithm of the places that
it could have had, some 20,000, of which the best has been chosen; and the steps after which that is decided,
which are allowed beyond the others."""
PLACINGS = 3
"""Most times that the map's light is placed, each time with the noise that the last has left."""
FADED, NEEDED = -1.0, 1.1
"""Log flux below which a light of the map is put out if the rest of the sky can stand in for it, and how many
times as large the noise must be without it for it to stay: under clouds there is no sun, and its disc would
be seen."""
STRAIN = 5.0
"""By how much the penalty x' K x may rise where the sky stands in for an added light: two standard deviations
of one node. What the sky can do with less strain is no light but brighter cloud."""
SAME_PLACE = np.cos(np.radians(1.0))
"""Cosine of the angle below which an added light is where it would be added again."""


@dataclass
class Run:
    """State of a solution between two steps: all that is needed to continue.

    Attributes
    ----------
    state, start : dict of str to ndarray
        Unknowns now, and the centre of the prior of lights: ``gain`` (nodes, 3), ``turn``, ``flux``
        (lights, 3) and ``size`` (lights, 1), logarithms and radians.
    damping, scale : float
        Of the next step; the threshold s.
    finished : bool
        No further step is made.
    history : list of dict
        A row a step: ``loss`` F, its parts ``data`` and ``prior``, the ``sigma`` at which they were
        taken, ``residual`` RMS of display values, ``damping``, ``step_ms``.
    asked : int
        Rounds of adding and moving lights that were made after convergence.
    most : int
        Steps after which it ends; more once a light was added or moved.
    hold : float
        Weight of what was not painted, where it is raised (:mod:`.hold`).
    corrected : bool
        The last steps, towards a target without T's error (:mod:`.transport_error`): no light is added.
    wide : bool
        Derivatives by a light's direction are wide differences: with narrow ones no step leads further.
    """

    state: dict
    start: dict
    damping: float = 1e-3
    scale: float = np.inf
    finished: bool = False
    history: list[dict] = field(default_factory=list)
    asked: int = 0
    most: int = ITERATIONS
    hold: float = 1.0
    wide: bool = False
    corrected: bool = False

    def elsewhere(self, state: dict, start: dict) -> Run:
        """Return a run that goes on from another state, with steps of its own."""
        history = list(self.history)
        return replace(self, state=state, start=start, history=history, finished=False, wide=False)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all but the history as arrays, for a checkpoint."""
        both = {f"{part}.{k}": v for part in ("state", "start") for k, v in getattr(self, part).items()}
        scale = self.scale if np.isfinite(self.scale) else 0.0  # before the first step
        numbers = self.damping, scale, self.finished, self.asked, self.most, self.hold
        return both | {"numbers": np.array([*numbers, self.wide, self.corrected])}

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray], history: list[dict]) -> Run:
        """Make a run of what :meth:`arrays` returned."""
        state, start = (
            {k.removeprefix(f"{part}."): v for k, v in arrays.items() if k.startswith(f"{part}.")}
            for part in ("state", "start")
        )
        damping, scale, finished, asked, most, hold, wide, corrected = arrays["numbers"].tolist()
        done = bool(finished), list(history), int(asked), int(most), hold, bool(wide), bool(corrected)
        return cls(state, start, damping, scale or np.inf, *done)


@dataclass
class Solution:
    """What :func:`solve` found.

    Attributes
    ----------
    params : dict
        Of the layers.
    history : list of dict
        A row a step: ``loss`` F, its parts ``data`` and ``prior``, the ``sigma`` at which they were
        taken, ``residual`` RMS of display values, ``damping``, ``step_ms``.
    loss : float
        Akaike's (1974) criterion, lower for what is likelier: F at the noise that the residual shows, twice
        that noise's logarithm for each independent residual, and two for every unknown that the picture
        determines, where any was changed.
    run : Run
        From which a trial can be continued.
    posterior : Posterior or None
        How well the picture determines the sky; None of a trial.
    note : str
        What a user should know.
    """

    params: dict
    history: list[dict]
    loss: float
    run: Run
    posterior: Posterior | None = None
    note: str = ""


def solve(
    problem: Problem,
    params: dict,
    sigma: float = SIGMA,
    iterations: int = 2 * ITERATIONS,
    after_step: Callable[[Run | None, Point], None] | None = None,
    run: Run | None = None,
    trial: bool = False,
    most_added: int = 0,
    sparing: bool = True,
    judge: Callable[[np.ndarray], float] | None = None,
) -> Solution:
    """Minimise F.

    Parameters
    ----------
    problem : Problem
        What is minimised.
    params : dict
        Where lights start, and are drawn to; the gain starts at zero, unless no step is asked for.
    sigma : float
        Standard error that display values are known to.
    iterations : int
        Most steps.
    after_step : callable, optional
        Called after every step, and when no further one is made, with where the solution is; with None in
        place of the run while lights are tried, when there is nothing to go on from yet. What it raises ends
        the solution.
    run : Run, optional
        To continue an earlier solution, in place of ``params``.
    trial : bool
        Only :attr:`Solution.loss` is asked for: no posterior is computed, and no lights are added where steps
        end.
    most_added : int
        Most lights that may be added.
    sparing : bool
        Stay at the start where steps lower the misfit by no more than noise would let them.
    judge : callable, optional
        Error of a map (H, W, 3) that is measured without T; used where the start is nearly as good as the
        solution (:data:`NEAR`), as steps may then follow the errors of T.

    Raises
    ------
    NumericalError
        If the start is not finite.
    """
    search, start = _Search(problem, sigma, iterations, most_added, after_step), problem.state(params)
    if run is None:
        run, point = search.begun(start)
    else:  # it has the columns with which its last point was rendered
        point = problem.evaluate(run.state, resolve=False)
        if after_step:
            after_step(run, point)
    if trial:
        point = search._descended(run, point, min(iterations, run.most), after_step)
    else:
        run, point = search.solved(run, point)
    normal = problem.normal(point, run.start, problem.noise(point.residual, sigma), descent=False)
    loss, note = _unlikeliness(problem, run, point, sigma), ""
    loss += 2 * normal.determined if run.history else 0
    whole = run
    if sparing and run.history:
        problem.clear(start)
        before = replace(run, state=start, start=start)
        first = problem.evaluate(start, resolve=False)
        least = _unlikeliness(problem, before, first, sigma)
        near = problem.noise(first.residual, sigma) < NEAR * problem.noise(point.residual, sigma)
        if least <= loss:
            note = "kept the initialisation: the better match of the rendering does not justify "
            note += f"{normal.determined:.0f} parameters (Akaike criterion)"
        elif judge is not None and near and CLEARLY * judge(first.edited) <= judge(point.edited):
            note = "kept the initialisation: path-traced, it is as close to the target as the solution"
        if note:
            run, point, loss = before, first, least
            normal = problem.normal(point, run.start, problem.noise(point.residual, sigma), descent=False)
    posterior = None if trial else problem.posterior(normal)
    return Solution(problem.found(run.state), run.history, loss, whole, posterior, note)


def descended(problem: Problem, run: Run, point: Point, sigma: float = SIGMA, steps: int = 1) -> Point:
    """Make a few steps from where a run is, without lights that are added; the run goes along.

    Parameters
    ----------
    problem, run, sigma
        As of :func:`solve`.
    point : Point
        Of the run's state.
    steps : int
        Most steps; the run may be finished before.
    """
    return _Search(problem, sigma, steps, 0, None)._descended(run, point, len(run.history) + steps, None)


def _copy(state):
    return {name: value.copy() for name, value in state.items()}


def _without(state, k):
    """Return a state in which a light is out."""
    state = _copy(state)
    state["flux"][k] = DARK
    return state


def _unlikeliness(problem, run, point, sigma):
    """Return -2 log posterior at the noise that the residual shows, but for a constant."""
    noise = problem.noise(point.residual, sigma)
    return problem.loss(point, run.start, noise) + 6 * problem.likelihood.independent * float(np.log(noise))


class _Search:
    """Descents with and without further lights."""

    def __init__(self, problem, sigma, iterations, most_added, after_step):
        self.problem, self.sigma, self.iterations = problem, sigma, iterations
        self.most_added, self.after_step = most_added, after_step

    def begun(self, start):
        """Return the run that begins at a start, with lights beside it that lower F; and its point."""
        problem = self.problem
        more = problem.beyond(start) if self.iterations and self.most_added else None
        if self.iterations:
            problem.clear(start)
        run = Run(start, start)
        point = problem.evaluate(start)
        if point.residual is None:
            raise NumericalError("the initial map is not finite: check the input map for extreme values")
        if not self.iterations:
            if self.after_step:
                self.after_step(run, point)
            return run, point
        if self.most_added:
            run, point = self._placed(run, point)
        if more is not None:
            run, point = self._better(run, point, self._new(run, more))
        for _ in range(self.most_added):
            began = point
            if run.state["gain"].any():
                began = problem.evaluate(run.state | {"gain": np.zeros_like(run.state["gain"])})
            spread = max(self.sigma, 1.4826 * float(np.median(np.abs(began.residual))))
            found = added_light.best(problem, began, problem.normal(began, run.start, spread))
            if found is None or found[1] < WORTH:
                break
            before = run
            run, point = self._better(run, point, *self._additions(run, found[0]))
            if run is before:
                break
        return run, point

    def solved(self, run, point):
        """Descend, put added lights where they lower F more, and add others while they lower it."""
        while True:
            point = self._descended(run, point, min(self.iterations, run.most), self.after_step)
            if not self.most_added or not run.history:
                return run, point
            if run.asked > self.most_added:
                return self._without_faded(run, point)
            before, run.asked = run, run.asked + 1
            run, point = self._placed_again(run, point)
            if len(self.problem.added(run.state)) < self.most_added:
                noise = self.problem.noise(point.residual, self.sigma)
                normal = self.problem.normal(point, run.start, noise)
                found = added_light.best(self.problem, point, normal)
                if found is not None and found[1] >= WORTH:
                    run, point = self._better(run, point, *self._additions(run, found[0]))
            if run is before:
                run.asked = self.most_added + 1  # what continues this run need not ask again
                return self._without_faded(run, point)

    def _without_faded(self, run, point):
        """Put out lights that are no longer needed, where steps make up for them.

        Tried are lights of the map that have faded (:data:`FADED`), and all that were added, those with
        least flux first. An added one goes out only if the sky has to change little for it (:data:`STRAIN`),
        and if the map has at most one light of its own: among several lamps a further lamp is likely.
        """
        problem = self.problem
        flux = (problem.layers.lights.flux * np.exp(run.state["flux"])).sum(axis=1)
        added = sorted(problem.added(run.state), key=lambda k: flux[k])
        own = [k for k in problem.lit(run.state) if k not in added]
        for k in own if problem.layers.lights.own > 1 else [*own, *added]:
            if k in own and run.state["flux"][k].mean() > FADED:
                continue
            without = _without(run.state, k)
            rival = replace(run.elsewhere(without, run.start), damping=Run.damping)
            most = min(self.iterations, len(run.history) + ADDED_STEPS)
            end = self._descended(rival, problem.evaluate(without), most, self._tried)
            noise = problem.noise(point.residual, self.sigma)
            loss, before = (problem.loss(one, run.start, noise) for one in (end, point))
            strain = problem.penalty(end.state, run.start) - problem.penalty(point.state, run.start)
            if loss < NEEDED**2 * before and (k in own or strain < STRAIN):
                run, point = rival, end
        return run, point

    def _placed_again(self, run, point):
        """Place every added light where it would be added now, or remove it, if that lowers F.

        :meth:`_better` decides. The light was placed under the sky before these steps.
        """
        problem = self.problem
        for i in problem.added(run.state) if run.history and self.most_added else ():
            if i not in problem.added(run.state):  # it went out for another's sake
                continue
            without = _without(run.state, i)
            dark = problem.evaluate(without, resolve=False)
            noise = problem.noise(point.residual, self.sigma)
            found = added_light.best(problem, dark, problem.normal(dark, run.start, noise), i)
            rivals = [self._moved(run, run.state, i)]
            if found is None or found[1] < WORTH:
                rivals.append((without, []))
            elif problem.direction(found[0], i) @ problem.direction(run.state, i) < SAME_PLACE:
                rivals.append((found[0], [i]))
            run, point = self._better(run, point, *rivals)
        return run, point

    def _additions(self, run, state):
        """Return the rivals of a run where a state has added a light."""
        new, lights = self._new(run, state)
        return [(new, lights), *(self._moved(run, state, i) for i in lights)]

    def _new(self, run, state):
        """Return a state with more added lights, and which are new."""
        return state, [i for i in self.problem.added(state) if i not in self.problem.added(run.state)]

    def _strongest(self, run):
        """Return the number of the map's own light with the largest flux, None where it has none."""
        own = [k for k in self.problem.lit(run.state) if k not in self.problem.added(run.state)]
        flux = self.problem.layers.lights.flux * np.exp(run.state["flux"])
        return max(own, key=lambda k: flux[k].sum(), default=None)

    def _placed(self, run, point):
        """Place the map's lights anew, that first without which there is least noise.

        The search has placed them for the picture alone, without a prior on the sky, and of several one may
        have made up for another. Only the strongest is placed where there is more noise without it.
        """
        problem, strongest = self.problem, self._strongest(run)
        dark: dict[int, float] = {}
        own = [k for k in problem.lit(run.state) if k not in problem.added(run.state)]
        if self._noise_of(point) / 2 < self.sigma:  # no noise is below sigma
            return run, point
        if len(own) > 1:
            dark = {k: self._noise_of(problem.evaluate(_without(run.state, k), resolve=False)) for k in own}
        for k in sorted(own, key=lambda k: dark.get(k, 0.0)):
            if k == strongest or dark[k] < self._noise_of(point):
                run, point = self._placed_one(run, point, k)
        return run, point

    def _placed_one(self, run, point, k):
        """Put a light out, or where it would be added were it not there, if noise is halved by it.

        Where it is lower by less, steps from there decide (:meth:`_better`).
        """
        problem, now = self.problem, self._noise_of(point)
        last, began, least = problem.direction(run.state, k), run, now
        without = problem.evaluate(_without(run.state, k), resolve=False)
        noise = self._noise_of(without)
        if not np.isfinite(noise):
            return run, point
        if noise < least / 2:
            run, least = Run(without.state, without.state), noise
        for _ in range(PLACINGS):
            found = added_light.best(problem, without, problem.normal(without, began.start, noise), k)
            if found is None or problem.direction(found[0], k) @ last > SAME_PLACE:
                break
            state, last = _copy(began.state), problem.direction(found[0], k)
            state["turn"][k] = found[0]["turn"][k]
            there = problem.evaluate(state, resolve=False)  # the columns that it was found by will do
            left = self._noise_of(there)
            if left < least:
                run, least = Run(state, state), left
            if left >= noise:
                break
            noise = left
        if run is began:
            return run, point
        if least >= now / 2:
            return self._better(began, point, (run.state, [k]))
        return run, problem.evaluate(run.state)

    def _moved(self, run, state, i):
        """Return the state in which the map's strongest light is where a state has light i, and its number.

        What looks like a new light may be the one that the map has: no light is added. None where the map has
        none, or where its start errs more than where the map's lights have started.
        """
        problem, k = self.problem, self._strongest(run)
        if k is None:
            return None
        lights, moved, alone = problem.layers.lights, _copy(run.state), _copy(run.start)
        moved["turn"][k] = rotation_vector(lights.centres[k], problem.direction(state, i))
        # What has made up for the light is in the gain and in other lights that were added.
        for one in (moved, alone):
            one["flux"][problem.added(one)], one["gain"][:], one["saturation"][:] = DARK, 0, 0
        moved["flux"][k] = 0
        if self._noise_of(problem.evaluate(moved)) >= self._noise_of(problem.evaluate(alone)):
            return None
        return moved, [k]

    def _noise_of(self, point):
        return np.inf if point.residual is None else self.problem.noise(point.residual, self.sigma)

    def _better(self, run, point, *rivals):
        """Return the best of a run and of those from other states, after some steps.

        ``rivals`` are states and which lights they have placed anew; None: there is none. One with no fewer
        added lights than the best so far must have F lower by :data:`WORTH`, one with fewer may have it
        higher by that.
        """
        problem, ends = self.problem, []
        most = min(self.iterations, len(run.history) + ADDED_STEPS)
        for state, new in filter(None, rivals):
            start = _copy(run.start)
            for name in ("turn", "flux", "size"):
                start[name][new] = state[name][new]
            rival = run.elsewhere(state, start)
            first = problem.evaluate(state)
            if first.residual is not None:
                ends.append((rival, self._descended(rival, first, most, self._tried)))
        if not ends:
            return run, point
        if not run.finished:
            run = replace(run, history=list(run.history))
            point = self._descended(run, point, most, self._tried)
        scale = max(one.scale for one, _ in [(run, point), *ends])
        for rival, end in ends:
            fewer = len(problem.added(rival.state)) < len(problem.added(run.state))
            loss, other = (problem.loss(p, r.start, scale) for p, r in ((point, run), (end, rival)))
            if other + (-WORTH if fewer else WORTH) < loss:
                run, point = replace(rival, most=len(rival.history) + ITERATIONS - ADDED_STEPS), end
        return run, point

    def _tried(self, _, point):
        if self.after_step:
            self.after_step(None, point)

    def _descended(self, run, point, most, after_step):
        """Make steps until none lowers F, or there are ``most`` in all; returns where they end."""
        problem, sigma = self.problem, self.sigma
        while len(run.history) < most and not run.finished:
            began = time.perf_counter()
            halved = run.scale / 2 if np.isfinite(run.scale) else 0
            run.scale = min(run.scale, max(problem.noise(point.residual, sigma), halved))
            before = problem.loss(point, run.start, run.scale)
            problem.derivatives.angle = WIDE if run.wide else ANGLE
            normal = problem.normal(point, run.start, run.scale)
            problem.derivatives.angle = ANGLE
            better = None
            for _ in range(TRIES):
                moved = problem.step(run.state, normal, run.damping)
                tried = None if moved is None else problem.evaluate(moved)
                if tried is not None and tried.residual is not None:
                    data = problem.misfit(tried.residual, run.scale)
                    penalty = problem.penalty(tried.state, run.start)
                    if data + penalty >= before:
                        # Columns of T that were traced for it are not in what it is compared with.
                        again = problem.evaluate(run.state, resolve=False)
                        if again.residual is not None:
                            point, before = again, problem.loss(again, run.start, run.scale)
                    if data + penalty < before:
                        better = tried
                        break
                run.damping = max(10 * run.damping, 1e-2)
            little = better is None or before - data - penalty < LITTLE * before
            ended = little and run.scale <= 1.01 * problem.noise(point.residual, sigma)
            run.finished = ended and (run.wide or not problem.lit(run.state))
            if ended and not run.wide:  # other derivatives: what damping those needed says nothing of them
                run.wide, run.damping = True, Run.damping
            if better is not None:
                point, run.state, run.damping = better, better.state, max(run.damping / 10, 1e-4)
                row = {"loss": data + penalty, "data": data, "prior": penalty, "sigma": run.scale}
                row["residual"] = float(np.sqrt(np.square(point.residual).mean()))
                row |= {"damping": run.damping, "step_ms": round(1000 * (time.perf_counter() - began), 3)}
                run.history.append({"iteration": len(run.history), **row})
            if after_step and (better is not None or run.finished):
                after_step(run, point)
        return point
