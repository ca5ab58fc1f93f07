"""Which explanation of a picture is likeliest: moves of lights, compared by their evidence.

An explanation is a local maximum of the posterior: the lights where they are, one of them elsewhere, softer
or out, one more. No small step leads from one to the other. Each is begun with the sky's gain as in the
original and the light where it promises most, descended to by a few Gauss-Newton steps, and judged by one
number beside what lights cost. Of a rendering that is -2 log evidence in Laplace's approximation (MacKay
1992),

    F(x) + 6 n log(sigma) + log det H - log det K,

with sigma the most likely noise, n of ``likelihood.py``, H = K + the misfit's Hessian / 2: what an unknown
gains in misfit it pays for by how far it is determined beyond its prior. Paint is no measurement that could
determine unknowns: it is F(x) alone, at the largest noise that paint has. The likeliest is kept, and the
search goes on from there.

Under a rendered target all of the sky may have changed: where a light promises most is asked beside what the
sky can do (``light_places.py``). Of paint lights come first: it is asked under the sky of the original.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from envedit.core.rotations import rotation_vector
from envedit.representations.layers.lights import DARK, log_flux_of
from envedit.solve import gauss_newton, painted_places
from envedit.solve.light_places import Place, Places
from envedit.solve.likelihood import INDEPENDENT
from envedit.solve.map_problem import LARGEST_STEP, Problem
from envedit.solve.painted_places import POSITIVE_EVIDENCE
from envedit.solve.unknowns import Point, with_light

MOVED, SOFTENED, REMOVED, ADDED = "moved", "softened", "removed", "light added"
STRONG_EVIDENCE = 6.0
"""By how much -2 log evidence must be lower where Mitsuba's renderings decide: "strong" evidence by Kass and
Raftery (1995). By chance of their samples the difference of the edits of a turned and an unturned sky varies
by 1 and by 10 between three seeds (statue, two skies)."""
ADDED_LIGHT_COST = 2 * np.log(20.0)
"""What a light costs that the map does not have: one sky in twenty gets one."""

EXPLANATION_STEPS = 3
"""Most Gauss-Newton steps after which explanations are compared."""
MOST_OTHERS = 3
"""Most explanations that are kept beside the likeliest."""
FADED_LOG_FLUX, FADED_LIGHT_COST = -1.0, 6 * INDEPENDENT * np.log(1.1)
"""Log flux of a light of the map, over its own, below which it has faded, and what such a light costs under a
rendered target: as noise that is a tenth larger. Under clouds there is no sun; its disc would be seen."""


@dataclass(frozen=True)
class Explanation:
    """A solution after a few steps."""

    done: dict[int, str]  # what was done to lights, by their numbers
    # run, point: where the solution goes on
    run: gauss_newton.Run
    point: Point
    score: float  # -2 log evidence, but for a constant
    # latest, rivals: light that the last move has placed, and places that promised less; of paint alone
    latest: int | None = None
    rivals: tuple[Place, ...] = ()
    # Of the likeliest that :func:`search` finds: the next ones, each of another :attr:`name`
    others: tuple[Explanation, ...] = ()

    @property
    def name(self) -> str:
        """What was done to the map's lights, for a note."""
        names = [what if what == ADDED else f"light {k + 1} {what}" for k, what in sorted(self.done.items())]
        return ", ".join(names) or "lights left where they are"


@dataclass(frozen=True)
class _Move:
    """A state to descend from, the centre of its prior, and what it is expected to lower the score by."""

    light: int
    what: str
    state: dict
    centre: dict
    gain: float
    rivals: tuple[Place, ...] = ()  # places of the light that promise less

    def after(self, done: dict[int, str], own: int) -> dict[int, str]:
        """Return what is done to lights with this move beside earlier ones; ``own`` lights are the map's."""
        if self.light < own or self.what == ADDED:
            return done | {self.light: self.what}
        return {k: what for k, what in done.items() if k != self.light or self.what != REMOVED}


def search(
    problem: Problem,
    start: dict,
    after_step: Callable[[], None] = lambda: None,
    most: int = EXPLANATION_STEPS,
    left: Explanation | None = None,
) -> Explanation:
    """Find the likeliest explanation, from ``start``, the state of the map as it is.

    ``most`` bounds the Gauss-Newton steps after which explanations are compared. ``after_step`` is called now
    and then; what it raises ends the search. ``left`` is the explanation that leaves lights where they are,
    if it is known.
    """
    steps = min(most, EXPLANATION_STEPS)
    best = left or _descended(problem, {}, gauss_newton.Run(start, start), problem.transport, steps, np.inf)
    compared: list[Explanation] = [best]
    better = best if best.point.residual is not None else None
    while better:
        best = better
        moves = _moves(problem, best)
        kinds = _best_kinds(moves) if len(compared) == 1 and _unfollowed(problem, best) else ()
        promising = [move for move in moves if move.gain > 0 or (move.light, move.what) in kinds]
        neighbours = _neighbours(problem, best, promising, after_step, steps, anew=True)
        compared += neighbours
        better = _likelier(problem, best, neighbours)
    return replace(best, others=_others(best, compared))


def further(
    problem: Problem, run: gauss_newton.Run, after_step: Callable[[], None] = lambda: None
) -> Explanation | None:
    """Find an explanation that is likelier than a solution, whose sky it begins with; None if there is none.

    ``run`` is where no step leads further; other parameters are those of :func:`search`.
    """
    point = gauss_newton.reached(problem, run)
    best = Explanation({}, run, point, score(problem, run, point))
    promising = [move for move in _moves(problem, best) if move.gain > 0]
    neighbours = _neighbours(problem, best, promising, after_step, EXPLANATION_STEPS, anew=False)
    return _likelier(problem, best, neighbours)


def completed(problem: Problem, explanation: Explanation) -> Explanation:
    """Return an explanation whose steps may have been ended as another was likelier, some steps on."""
    run = explanation.run.onward()
    point = gauss_newton.descended(problem, run, explanation.point, EXPLANATION_STEPS)
    return replace(explanation, run=run, point=point, score=score(problem, run, point))


def _likelier(problem, best, explanations):
    """Return the likeliest of some explanations that are likelier than the best so far, None of none.

    Where lights are where they were, they stay there unless there is evidence for another explanation; so
    they do where paint has put them.
    """
    painted = problem.likelihood.painted

    def least(one):
        settled = not best.done or (painted and one.done == best.done)
        return POSITIVE_EVIDENCE if settled else 0.0

    likelier = [one for one in explanations if one.score < best.score - least(one)]
    return min(likelier, key=lambda one: one.score, default=None)


def _others(best, compared):
    """List the likeliest explanation of each other name, likeliest first."""
    others: dict[str, Explanation] = {}
    for one in sorted(compared, key=lambda one: one.score):
        if one.name != best.name and np.isfinite(one.score):
            others.setdefault(one.name, one)
    return tuple(others.values())[:MOST_OTHERS]


def _unfollowed(problem, best):
    """Whether paint is followed so little that its noise is the largest there may be."""
    likelihood = problem.likelihood
    if not likelihood.painted or likelihood.largest_noise <= likelihood.least_noise:
        return False
    return likelihood.noise(best.point.residual) >= likelihood.largest_noise


def _neighbours(problem, best, moves, after_step, steps, anew):
    """List the explanations one of some moves from another; ``anew``: begun under the original's sky."""
    neighbours: list[Explanation] = []
    likeliest = best.score
    for move in moves:
        run = gauss_newton.Run(move.state, move.centre, history=list(best.run.history))
        if anew:
            run = gauss_newton.Run(_under_original_sky(move.state), move.centre)
        done = move.after(best.done, problem.layers.lights.own)
        reached = _descended(problem, done, run, best.point.transport, steps, likeliest)
        neighbours.append(replace(reached, latest=move.light, rivals=move.rivals))
        likeliest = min(likeliest, neighbours[-1].score)
        after_step()
    return neighbours


def _cost_of_place(problem: Problem) -> float:
    """Return what a light's place costs that was looked for: of a rendering it could be in any cell."""
    _, directions = problem.blocks.sky
    return 0.0 if problem.likelihood.painted else 2 * np.log(max(len(directions), 1))


def _cost_of_choice(problem: Problem) -> float:
    """Return what it costs that a light of the map shines elsewhere: it could be any of them."""
    return 2 * np.log(max(problem.layers.lights.own, 1))


def score(problem: Problem, run: gauss_newton.Run, point: Point) -> float:
    """Return what explanations are compared by, lower where likelier; inf where it is not finite."""
    if point.residual is None:
        return np.inf
    # ---- What lights cost
    cost_of_place = _cost_of_place(problem)
    cost = (ADDED_LIGHT_COST + cost_of_place) * len(problem.added(run.state))
    cost += (_cost_of_choice(problem) + cost_of_place) * len(_replaced(problem, run))
    # ---- How likely all else is
    if problem.likelihood.painted:
        cost += problem.loss(point, run.start, problem.likelihood.largest_noise)
    else:
        cost += FADED_LIGHT_COST * len(_faded(problem, run.state))
        cost += problem.unlikeliness(point, run.start) + _determined(problem, run, point)
    return float(cost) if np.isfinite(cost) else np.inf


def _determined(problem, run, point):
    """Return log det H - log det K: how far unknowns are determined beyond their prior."""
    normal = problem.curvature(point, run.start)
    _, posterior = np.linalg.slogdet(normal.hessian)
    _, prior = np.linalg.slogdet(normal.precision)
    return posterior - prior


def _replaced(problem, run):
    """List the map's own lights that shine elsewhere than they did, farther than steps led them."""
    own = problem.layers.lights.own
    return [k for k in problem.shining(run.state) if k < own and run.start["turn"][k].any()]


def _faded(problem, state):
    """List the map's own lights that have faded."""
    own = problem.layers.lights.own
    return [k for k in problem.shining(state) if k < own and state["flux"][k].mean() < FADED_LOG_FLUX]


def _descended(problem, done, run, transport, steps, likeliest):
    """Return the explanation that a few steps from where a run is lead to, first through ``transport``.

    Of paint, steps end where they promise no explanation with a lower score than the ``likeliest``.
    """

    def hopeless(point, promised):
        return score(problem, run, point) - promised > likeliest

    point = problem.evaluate(run.state, transport)
    if point.residual is not None:
        painted, largest_noise = problem.likelihood.painted, problem.likelihood.largest_noise
        point = gauss_newton.descended(
            problem,
            run,
            point,
            steps,
            hopeless=hopeless if painted else None,
            largest_noise=largest_noise,
        )
        run.finished &= not painted  # paint is followed further
    return Explanation(done, run, point, score(problem, run, point))


# ---- Moves -------------------------------------------------------------------------------------------------


def _moves(problem, best):
    """List the moves of each kind that promise as much from an explanation as the best one does."""
    promised = _under_the_original if problem.likelihood.painted else _beside_the_sky
    of_kind: dict[tuple[int, str], list[_Move]] = {}
    for move in promised(problem, best):
        of_kind.setdefault((move.light, move.what), []).append(move)
    return [
        move
        for moves in of_kind.values()
        for move in moves
        if move.gain >= max(one.gain for one in moves) - POSITIVE_EVIDENCE
    ]


def _best_kinds(moves):
    """List the kinds of moves, light and what, that promise most: as many as are shown."""
    ranked = sorted(moves, key=lambda move: -move.gain)
    return list(dict.fromkeys((move.light, move.what) for move in ranked))[:MOST_OTHERS]


def _beside_the_sky(problem, best):
    """Yield moves that lower F together with one step of all else."""
    lights, state, start = problem.layers.lights, best.run.state, best.run.start
    transport = best.point.transport
    for k in problem.shining(state):
        own, dark = k < lights.own, with_light(state, k, flux=DARK)
        places = _places(problem, dark, start, transport)
        if places is None:
            continue
        stays = places.fall(best.point.rendering)
        # ---- out
        worth = ADDED_LIGHT_COST if own else ADDED_LIGHT_COST + _cost_of_place(problem)
        if k in _faded(problem, state):
            worth = FADED_LIGHT_COST
        yield _Move(k, REMOVED, dark, start, gain=worth - stays)
        # ---- elsewhere: farther than a step goes
        for there in places.best(k):
            if there.direction @ problem.direction(state, k) > np.cos(LARGEST_STEP["turn"]):
                continue
            turn = rotation_vector(lights.centres[k], there.direction)
            flux = start["flux"][k] if own else there.log_flux
            moved, centre = (with_light(one, k, turn=turn, flux=flux) for one in (state, start))
            yield _Move(k, MOVED, moved, centre, gain=there.promise - stays)

    # ---- one more
    spare = problem.spare(state)
    places = None if spare is None else _places(problem, state, start, transport)
    for there in places.best(spare) if places else []:
        turn, flux = rotation_vector(lights.centres[spare], there.direction), there.log_flux
        more, centre = (with_light(one, spare, turn=turn, flux=flux, size=0.0) for one in (state, start))
        yield _Move(spare, ADDED, more, centre, gain=there.promise - ADDED_LIGHT_COST)


def _places(problem, state, start, transport):
    """Return the places of lights that are dark in a state; None where F has no value there."""
    point = problem.evaluate(state, transport, resolve=False)
    if point.residual is None:
        return None
    try:
        normal = problem.normal(point, start, problem.likelihood.noise(point.residual))
        return Places(problem, point, normal)
    except np.linalg.LinAlgError:
        return None


def _under_the_original(problem, best):
    """Yield moves that raise the likelihood under the gain of the original, all else as it is."""
    state, start = _under_original_sky(best.run.state), best.run.start
    lights, transport = problem.layers.lights, best.point.transport
    spare = problem.spare(state)
    now = _unlikeliness(problem, state, transport)

    for k in problem.shining(state):
        own = k < lights.own
        dark = with_light(state, k, flux=DARK)
        # ---- elsewhere
        away = problem.direction(state, k)
        cost = _cost_of_choice(problem) if own and not start["turn"][k].any() else 0.0
        placed = k == best.latest  # all else is as it was when its place was looked for
        places = list(best.rivals) if placed else painted_places.best(problem, dark, transport, k, away)
        for there in places:
            moved = _put(lights, state, k, there)
            centre = with_light(start, k, turn=moved["turn"][k]) if own else _put(lights, start, k, there)
            gain = now + there.promise - cost
            yield _Move(k, MOVED, moved, centre, gain, _rivals(there, places))
        # ---- softer: a light of few texels cannot grow, as its texels would part; a lobe can
        if own and spare is not None:
            flux = state["flux"][k] + log_flux_of(lights.flux[k] / lights.flux[spare])
            turn = rotation_vector(lights.centres[spare], away)
            size = lights.log_size(painted_places.LARGER_DEGREES[0])
            soft = with_light(dark, spare, turn=turn, flux=flux, size=size)
            centre = with_light(start, spare, turn=turn, flux=flux, size=size)
            yield _Move(k, SOFTENED, soft, centre, gain=now - _unlikeliness(problem, soft, transport))
        # ---- out, if it was added
        if not (own or placed):
            gain = now - _unlikeliness(problem, dark, transport) + ADDED_LIGHT_COST
            yield _Move(k, REMOVED, dark, start, gain)

    # ---- one more, as large as it must be
    places = [] if spare is None else painted_places.best(problem, state, transport, spare)
    for there in places:
        more, centre = (_put(lights, one, spare, there) for one in (state, start))
        gain = now + there.promise - ADDED_LIGHT_COST
        yield _Move(spare, ADDED, more, centre, gain, _rivals(there, places))


def _rivals(there, places):
    """Return the places that are not tried beside one, as they promise less."""
    return tuple(one for one in places if one.promise < there.promise - POSITIVE_EVIDENCE)


def _under_original_sky(state):
    """Return a state with the gain and the saturation of the original."""
    return state | {name: np.zeros_like(state[name]) for name in ("gain", "saturation")}


def _put(lights, state, k, there):
    """Return a state with light ``k`` in a place; an added one has a size there."""
    turn = rotation_vector(lights.centres[k], there.direction)
    if k < lights.own:
        return with_light(state, k, turn=turn, flux=there.log_flux)
    return with_light(state, k, turn=turn, flux=there.log_flux, size=lights.log_size(there.degrees))


def _unlikeliness(problem, state, transport):
    point, likelihood = problem.evaluate(state, transport), problem.likelihood
    return np.inf if point.residual is None else likelihood.misfit(point.residual, likelihood.largest_noise)
