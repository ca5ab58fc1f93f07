"""An edit of layers: the search for lights, Gauss-Newton steps, and what is done between them.

Steps are made until none leads further. Of a rendered target another explanation follows if one is likelier
by now, and then some steps towards the target without T's error; of paint, more weight on the rest, where
that is to be kept. Each of these is a new run that goes on from the last.

T is an estimate: it errs around bright areas that are too large for exact columns, at shadow edges, in
caustics. An edit that compares R(E) = T E + I_0 with the target t makes up for these errors by the map. Its
last steps, from E^, are therefore made towards

    R(E^) min(t / I(E^), 1) + max(t - I(E^), 0),        R(E^) = T E^ + I_0 through T, I(E^) by Mitsuba,

so that T's error cancels near E^ (output space mapping, Bandler et al. 2004): where these steps end, it is
the path-traced rendering that meets the target.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from envedit.core.interrupts import ctrl_c
from envedit.core.seeds import Seeds
from envedit.core.types import Params
from envedit.losses import display_curve
from envedit.representations.layers.unseen import unseen_kept
from envedit.scene.renderings import rendered
from envedit.solve import adam_loop, checkpoint, gauss_newton, hold, photograph, search
from envedit.solve.edit_state import EditState, Interrupted
from envedit.solve.map_problem import Posterior
from envedit.transport.light_transport import LightTransport

CHECK_SPP = 256
"""Samples a pixel of I, and of renderings by which start and solution are compared."""
CORRECTED_STEPS = 6
"""Most steps towards the target without T's error. Nine edits, mean: without 43.86 dB (map 27.63), 3 steps
44.07 (27.99), 6 steps 44.09 (28.24), the same where lights may be added."""


@dataclass
class LayersSolver:
    """Solver of one edit of layers."""

    edit: EditState  # what is edited
    params: Params  # where it starts: those of the map as it is, or of a solution on coarse grids
    begun: gauss_newton.Run | None = None  # where :meth:`optimise` goes on from
    # Of paint: explanations that are less likely than the one that is solved for
    others: tuple[search.Explanation, ...] = ()
    # How well the target determines the sky, once :meth:`optimise` knows it
    posterior: Posterior | None = None
    note: str = ""  # what a user should know of the solution
    # Whether :attr:`params` are a solution on coarse grids that explains the target; it is kept
    coarse: bool = False
    _likelier: list[str] = field(default_factory=list)
    _curves: dict[str, float] = field(default_factory=dict)

    # ---- Before the steps ----------------------------------------------------------------------------------

    def explain(self, transport: LightTransport) -> search.Explanation:
        """Return the likeliest explanation of the target through T."""
        edit, tried = self.edit, itertools.count(1)
        problem = edit.problem(transport)

        with ctrl_c() as interrupt:

            def after_step():
                done = next(tried)
                edit.watch.progress(done, done, "trying lights")
                if interrupt.is_set():
                    raise KeyboardInterrupt

            explanation = search.search(
                problem,
                problem.state(self.params),
                after_step,
                most=edit.settings.optimizer.iterations if edit.newton else search.EXPLANATION_STEPS,
            )
        others = explanation.others if edit.target.painted else ()
        self.others = tuple(search.completed(problem, one) for one in others)
        return explanation

    def map_of(self, explanation: search.Explanation) -> np.ndarray:
        """Return the map of an explanation of :meth:`explain`, whatever grids the gain has got since."""
        return unseen_kept(self.edit.original, explanation.point.edited)

    def solved(self, begun: gauss_newton.Run, transport: LightTransport) -> Params:
        """Return where Gauss-Newton steps end, for what Adam goes on from.

        Raises
        ------
        NumericalError
            If they cannot begin.
        """
        problem = self.edit.problem(transport)
        return self._steps(problem, begun, sparing=not self.edit.target.painted).params

    def settle(self) -> float:
        """Go on from :attr:`begun` until no step and no light leads further; returns -2 log evidence."""
        most, problem = self.edit.settings.optimizer.iterations, self.edit.problem()
        while self.begun is not None:
            solution = gauss_newton.solve(problem, self.params, most, run=self.begun, sparing=False)
            self.begun = self._another(solution)
        point = gauss_newton.reached(problem, solution.run)
        self.begun = solution.run
        if point.residual is not None:  # what T errs by may have been fitted
            shown = self._path_traced(point.edited)
            point = replace(point, residual=problem.residual(point.state, shown))
        return search.score(problem, solution.run, point)

    def go_on_from(self, file: str) -> None:
        """Let :meth:`optimise` go on from a solution on disk; InputError if it is not of these layers."""
        self.begun = checkpoint.load_solution(file, self.edit.problem().state(self.params))

    # ---- Steps ---------------------------------------------------------------------------------------------

    def optimise(self, checkpoints: checkpoint.Checkpoints) -> tuple[Params, adam_loop.State]:
        """Make Gauss-Newton steps from :attr:`begun` or the map as it is, or from the checkpoint.

        Raises
        ------
        Interrupted
            After Ctrl-C.
        NumericalError
            If the start is not finite.
        """
        # ---- Where it starts
        edit, run = self.edit, self.begun
        settings = edit.settings.optimizer
        digest = checkpoint.digest(edit.settings, edit.scene.digest, [edit.original, *edit.target.asked])
        if stored := checkpoints.load(digest):
            state, arrays, _, picture = stored
            if edit.target.photo is not None:
                edit.target = edit.target.developed(edit.target.photo.of_array(arrays.pop("photo")))
            edit.target = replace(edit.target, picture=picture, compared=arrays.pop("aim"))
            run = gauss_newton.Run.of_arrays(arrays, state.history)
        self._hold(run)

        # ---- Runs, one from where the last has ended
        with ctrl_c() as interrupt:
            watched = _Watched(edit, checkpoints, digest, interrupt)
            while True:
                # Paint is no noisy picture, and asks for what it shows.
                sparing = not (edit.target.painted or (run and run.corrected))
                solution = self._steps(edit.problem(), run, sparing, settings.iterations, watched.after_step)
                following = self._following(solution, interrupt)
                if following is None:
                    break
                run = following
        self.posterior = solution.posterior
        edit.renderer.transport = edit.renderer.transport.with_columns(solution.run.columns)
        self.note = "; ".join(self._notes(solution))
        history = solution.run.history
        return solution.params, adam_loop.State(step=len(history), history=history)

    def _steps(self, problem, run, sparing, iterations=2 * gauss_newton.MOST_STEPS, after_step=None):
        """Make steps; what those towards a photograph find of its camera is taken off the target."""
        photographed = self.edit.target.photo is not None
        judge = self._display_error if sparing and not photographed else None
        solution = gauss_newton.solve(problem, self.params, iterations, after_step, run, sparing, judge)
        if photographed:
            photograph.take_off_camera(self.edit, solution)
        return solution

    def _following(self, solution, interrupt):
        """Return the run that goes on from a solution; None where it is the last."""
        if self.edit.target.painted:
            return self._held_more(solution.run)
        if not self._goes_on(solution):
            return None
        photo = self.edit.target.photo
        if photo is not None and not photo.settled:
            run, self._curves = photograph.settled(self.edit, solution.run)
            if run is not None:
                return run
        return self._another(solution, interrupt) or self._corrected(solution)

    def _notes(self, solution):
        notes = list(self._likelier)
        if solution.note:
            notes = [] if self.coarse else [solution.note]
        run = solution.run
        if run.hold > 1:
            notes.append(hold.said(run.hold, self._changed_rest(run)))
        if "saturation" in solution.params and not solution.note:
            kept = 100 * float(np.exp(solution.params["saturation"].numpy()[0, 0]))
            notes.append(f"saturation of the sky's colours: {kept:.0f} % of the original's")
        if len(self._curves) > 1:
            values = ", ".join(f"{name} {value:.0f}" for name, value in self._curves.items())
            notes.append(f"-2 log likelihood of the photograph by tone curve: {values}")
        if run.corrected:
            missed = f"the stored transport's error at the solution ({CHECK_SPP} samples a pixel)"
            notes.append(f"{missed} was taken off the target for the last steps")
        return notes

    def _another(self, solution, interrupt=None):
        """Return a run that goes on from a likelier explanation than a solution; None where there is none."""
        edit, run = self.edit, solution.run
        if not self._goes_on(solution):
            return None

        def after_step():
            edit.watch.progress(len(run.history), len(run.history), "trying lights")
            if interrupt and interrupt.is_set():
                raise Interrupted(edit.decode(solution.params), len(run.history))

        likelier = search.further(edit.problem(), run, after_step)
        if likelier is None:
            return None
        self._likelier.append(f"then likelier: {likelier.name} (-2 log evidence {likelier.score:.1f})")
        return replace(likelier.run, most=len(likelier.run.history) + gauss_newton.MOST_STEPS)

    def _corrected(self, solution):
        """Return a run that goes on towards the target without T's error."""
        edit, run = self.edit, solution.run
        point = gauss_newton.reached(edit.problem(), run)
        edit.target = edit.target.seen_as(point.rendering, self._path_traced(point.edited))
        most = len(run.history) + CORRECTED_STEPS
        return run.onward(most=most, corrected=True)

    def _goes_on(self, solution):
        """Whether steps were made and kept, more are allowed, and T's error is not yet off the target."""
        made, most = len(solution.run.history), self.edit.settings.optimizer.iterations
        return not solution.note and not solution.run.corrected and 0 < made < most

    # ---- What was not painted ------------------------------------------------------------------------------

    def _hold(self, run):
        """Take the weight of what was not painted that a run has come to."""
        if run is not None and run.hold > 1:
            self.edit.target = self.edit.target.held(self.edit.settings.target.paint, run.hold)
        return run

    def _held_more(self, run):
        """Return a run that goes on with more weight on what was not painted; None where it need not."""
        if len(run.history) >= self.edit.settings.optimizer.iterations:
            return None
        more = hold.further(self.edit.settings.target, run.hold, self._changed_rest(run))
        if more is None:
            return None
        most = len(run.history) + gauss_newton.MOST_STEPS
        return self._hold(run.onward(most=most, hold=more))

    def _changed_rest(self, run):
        """Return how what was not painted has changed at the point of a run, through T."""
        target = self.edit.target
        rendering = gauss_newton.reached(self.edit.problem(), run).rendering
        return hold.change(rendering, target.aim, target.coverage, target.weight)

    # ---- What T has no part in -----------------------------------------------------------------------------

    def _path_traced(self, envmap):
        """Return I(E) of a map, (h, w, 3); kept on disk, so that a run that is resumed has the same."""
        settings = self.edit.settings
        seed = Seeds(settings.seed).solution_check
        return rendered(self.edit.scene, envmap, CHECK_SPP, seed, settings.renderer.cache)[0]

    def _display_error(self, envmap):
        """Return the mean square of display values of Mitsuba's rendering of a map less the target's."""
        target = self.edit.target
        seed = Seeds(self.edit.settings.seed).step_check
        shown = display_curve.values(self.edit.scene.render(envmap, CHECK_SPP, seed))
        missed = shown - display_curve.values(target.picture)
        return float((np.square(missed) * target.known_weight).mean())


class _Watched:
    """Reports steps, saves them when that is due, and ends the edit after Ctrl-C."""

    def __init__(self, edit, checkpoints, digest, interrupt):
        self.edit, self.checkpoints = edit, checkpoints
        self.digest, self.interrupt = digest, interrupt

    def after_step(self, run, point):
        edit, settings, done = self.edit, self.edit.settings.optimizer, len(run.history)
        most = min(settings.iterations, gauss_newton.MOST_STEPS)
        if done:
            edit.watch.progress(done, max(most, done), f"loss {run.history[-1]['loss']:.4g}")
        last = run.finished or done >= most  # what follows may be interrupted too
        if self.checkpoints.due(last or self.interrupt.is_set()):
            state = adam_loop.State(step=done, history=run.history)
            arrays = run.arrays() | {"aim": edit.target.aim}
            if edit.target.photo is not None:
                arrays["photo"] = edit.target.photo.array
            self.checkpoints.save(self.digest, state, arrays, {}, edit.target.picture)
        if self.interrupt.is_set():
            raise Interrupted(point.edited, done)
