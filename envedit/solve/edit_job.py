"""An edit in progress: its loop with checkpoints and Ctrl-C.

Longer than 400 lines: the ways in which Adam and Gauss-Newton go on after an interruption stand side by side.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from envedit import config
from envedit.core.arrays import tensor
from envedit.core.errors import NumericalError, place_of
from envedit.core.interrupts import ctrl_c
from envedit.core.seeds import Seeds
from envedit.core.types import Params
from envedit.losses import display_curve, optimizer
from envedit.losses.perceptual import distances
from envedit.renderers import Renderer
from envedit.representations.layers.gain import LEVELS
from envedit.representations.layers.unseen import unseen_kept
from envedit.scene import scene
from envedit.solve import (
    adam_loop,
    block_jacobian,
    checkpoint,
    gauss_newton,
    hold,
    search,
    task,
    transport_error,
)
from envedit.solve.map_problem import Posterior
from envedit.targets.target import Target
from envedit.transport.light_transport import LightTransport

CHECKED_SPP = 64
"""Samples a pixel of renderings by which start and solution are compared."""
RISEN = 2.0
"""Largest ratio of the last loss to the first where a user has raised Adam's rate. Measured on
quickstart, four representations at rates of 0.1 to 1e38: it is 0.02 to 1.7, or the loss runs away, to 7 to
1e6 times the first."""


class Interrupted(Exception):
    """Ctrl-C during the edit; ``envmap`` is the map so far, that of the checkpoint where there is one.

    ``given`` is the input map in whose units ``envmap`` is, once the run has brought it there.
    """

    given: Any

    def __init__(self, envmap: np.ndarray, step: int):
        super().__init__(f"interrupted at iteration {step}")
        self.envmap, self.step = envmap, step


class Stopped(NumericalError):
    """The optimisation could not go on; ``envmap`` is the last good map, ``given`` as of Interrupted."""

    given: Any

    def __init__(self, message: str, envmap: np.ndarray):
        super().__init__(message)
        self.envmap = envmap


@dataclass
class Watch:
    """What a run reports while it works.

    ``stage(text)`` when a part begins, ``progress(done, total, text)`` within one.
    """

    stage: Callable[[str], None] = lambda text: None
    progress: Callable[[int, int, str], None] = lambda done, total, text: None


@dataclass
class Job:
    """One edit in progress.

    Attributes
    ----------
    settings : config.Config
        What is carried out.
    lit : scene.Scene
        The scene.
    original : ndarray (H, W, 3)
        The map.
    first : int
        Its first active row.
    free : ndarray of bool (rows, W), optional
        Active texels that may change; None: all.
    target : Target
        What the renderer is to make.
    representation, renderer : Representation, Renderer
        As :func:`.adam_loop.optimise` takes them; of layers, more than the protocol is used.
    folder : Path, optional
        Of the checkpoint.
    watch : Watch
        Receives progress.
    dists : distances.Dists, optional
        As for :class:`.adam_loop.Objective`.
    posterior : Posterior, optional
        How well the target determines the sky, where :meth:`optimise` knows it.
    note : str
        What the solver has to say.
    begun : gauss_newton.Run, optional
        Where :meth:`optimise` goes on from.
    likelier : list of str
        Explanations that were found to be likelier on the way.
    others : tuple of search.Explanation
        Of paint: explanations that are less likely than the one that is solved for.
    """

    settings: config.Config
    lit: scene.Scene
    original: np.ndarray
    first: int
    free: np.ndarray | None
    target: Target
    representation: Any
    renderer: Renderer
    folder: Path | None
    watch: Watch
    dists: distances.Dists | None = None
    posterior: Posterior | None = None
    note: str = ""
    begun: gauss_newton.Run | None = None
    likelier: list[str] = field(default_factory=list)
    others: tuple[search.Explanation, ...] = ()
    _blocks: dict = field(default_factory=dict, repr=False)

    @property
    def newton(self) -> bool:
        """Whether Gauss-Newton steps are made: for layers through T, without grids of detail."""
        if not self.representation.models_edit or self.renderer.transport is None:
            return False
        return self.settings.optimizer.kind != "adam" and len(self.representation.gain.sizes) == LEVELS

    @property
    def raised_rate(self) -> bool:
        """Whether Adam's rate is a user's, and higher than usual."""
        chosen = self.settings.optimizer.lr
        return not self.newton and chosen != "auto" and chosen > self.representation.lr

    def decode(self, params: Params) -> np.ndarray:
        """Parameters to a whole map on the host, refusing what is not finite."""
        crop = self.representation.decode(params).numpy()
        rows = slice(self.first, self.first + crop.shape[0])
        if self.free is not None:
            crop = np.where(self.free[..., None], crop, self.original[rows])
        if (bad := ~np.isfinite(crop)).any():
            where = place_of(bad, self.first)
            remedy = "scale the map down" if self.newton else "lower [optimizer] lr"
            raise NumericalError(f"the edited map is not finite at {where}: {remedy}")
        edited = self.original.copy()
        edited[rows] = crop
        return unseen_kept(self.original, edited) if self.representation.models_edit else edited

    def last_good(self, adam: optimizer.Adam) -> np.ndarray:
        """Return the last map that is finite: after the last step, before it, or else the original."""
        for _ in range(2):
            try:
                return self.decode(adam.params)
            except NumericalError:
                adam.take_back()
        return self.original.copy()

    @property
    def _rendered(self):
        """Whether the target is a rendering, and not painted."""
        return self.target.coverage is None

    def explain(self, params: Params, transport: LightTransport) -> search.Explanation:
        """Return the likeliest explanation of the target through T; the parameters are those of the map."""
        problem, tried = self._problem(transport), itertools.count(1)
        most = self.settings.optimizer.iterations if self.newton else search.STEPS

        with ctrl_c() as interrupt:

            def after_step():
                done = next(tried)
                self.watch.progress(done, done, "trying lights")
                if interrupt.is_set():
                    raise Interrupted(self.original.copy(), 0)

            found = search.search(problem, problem.state(params), self._sigma, after_step, most)
        self.others = () if self._rendered else found.others
        return found

    def map_of(self, explanation: search.Explanation) -> np.ndarray:
        """Return the map of an explanation of :meth:`explain`, whatever grids the gain has got since."""
        return unseen_kept(self.original, explanation.point.edited)

    def solved(self, params: Params, begun: gauss_newton.Run, transport: LightTransport) -> Params:
        """Return where Gauss-Newton steps end, for what Adam goes on from.

        Raises
        ------
        NumericalError
            If they cannot begin.
        """
        problem = self._problem(transport)
        problem.evaluate(begun.state)  # another explanation may have taken its columns of T
        return gauss_newton.solve(
            problem,
            params,
            self._sigma,
            run=begun,
            sparing=self._rendered,
            judge=self._display_error if self._rendered else None,
        ).params

    def settle(self, params: Params) -> float:
        """Go on from :attr:`begun` until no step and no light leads further; returns -2 log evidence."""
        most, problem = self.settings.optimizer.iterations, self._problem()
        problem.evaluate(self.begun.state)  # another edit may have taken its columns of T
        while self.begun is not None:
            made = gauss_newton.solve(problem, params, self._sigma, most, run=self.begun, sparing=False)
            self.begun = self._another(made)
        point = problem.evaluate(made.run.state)  # what was tried since may have taken its columns
        self.begun = made.run
        if point.residual is not None:  # what T errs by may have been fitted
            point = replace(point, residual=np.float64(self._missed(point.edited)))
        return search.score(problem, made.run, point, self._sigma)

    def optimise(self, params: Params, crop: np.ndarray, resume: bool) -> tuple[Params, adam_loop.State]:
        """Optimise from the start, or from the checkpoint; returns parameters and state."""
        if self.newton:
            return self._solve(params, resume)
        chosen, target = self.settings.optimizer, self.target
        adam, state = adam_loop.adam_for(self.representation, params, chosen), adam_loop.State()
        what = checkpoint.digest(self.settings, self.lit.digest, [self.original, *target.asked])
        if self.folder and resume and (found := checkpoint.load(self.folder, what)):
            state, optimiser, traced, picture = found
            adam.load_state_dict(optimiser)
            self.renderer.restore(traced)
            # Rendered anew, the target may differ in its last bits: Mitsuba's film adds in any order.
            target = self.target = target.aimed_at(picture)
        objective = adam_loop.Objective(
            self.settings.loss,
            target.aim,
            target.weight,
            crop,
            chosen.iterations,
            dists=self.dists,
            every=self.settings.perceptual.dists_every,
            views=self.lit.rows,
        )
        objective.resume(state.history)
        saved = time.perf_counter()

        with ctrl_c() as interrupt:

            def after_step(state, adam):
                nonlocal saved
                self.watch.progress(state.step, chosen.iterations, f"loss {state.history[-1]['loss']:.4g}")
                stop, due = interrupt.is_set(), time.perf_counter() - saved >= chosen.checkpoint_s
                due |= state.step == chosen.iterations  # what follows may be interrupted too
                if self.folder and (stop or due):
                    traced = self.renderer.state()
                    checkpoint.save(self.folder, what, state, adam.state_dict(), traced, target.aim)
                    saved = time.perf_counter()
                if stop:
                    raise Interrupted(self.last_good(adam), state.step)

            try:
                self._loop(params, objective, chosen, adam=adam, state=state, after_step=after_step)
                self._look_at_the_last(adam, state)
                if error := self._ran_away(objective, params, adam.params, len(crop), state.bad_steps):
                    raise Stopped(error, self.decode(params))
            except NumericalError as error:
                if isinstance(error, Stopped):
                    raise
                raise Stopped(str(error), self.last_good(adam)) from error
        return adam.params, state

    def go_on_from(self, file: str, params: Params) -> None:
        """Let :meth:`optimise` go on from a solution on disk; InputError if it is not of these layers."""
        self.begun = checkpoint.load_solution(file, self._problem().state(params))

    def _problem(self, transport=None):
        """Return what is minimised through T, by default the renderer's."""
        traced = transport or self.renderer.transport
        if traced not in self._blocks:
            shape = self.original.shape[:2]
            self._blocks = {traced: block_jacobian.BlockJacobian(self.representation, traced, shape)}
        return task.problem(
            self.settings,
            self.target,
            self.representation,
            traced,
            self.original,
            self._blocks[traced],
        )

    @property
    def _sigma(self):
        return task.sigma(self.target)

    def _solve(self, params, resume):
        """Make Gauss-Newton steps from the start, or from the checkpoint."""
        chosen, run = self.settings.optimizer, self.begun
        what = checkpoint.digest(self.settings, self.lit.digest, [self.original, *self.target.asked])
        if self.folder and resume and (found := checkpoint.load(self.folder, what)):
            state, arrays, traced, picture = found
            self.renderer.restore(traced)
            self.target = replace(self.target, picture=picture, compared=arrays.pop("aim"))
            run = gauss_newton.Run.of_arrays(arrays, state.history)
        elif run is not None:
            self._problem().evaluate(run.state)  # another explanation may have taken its columns
        saved, most = time.perf_counter(), min(chosen.iterations, gauss_newton.ITERATIONS)
        done = 0

        with ctrl_c() as interrupt:

            def after_step(run, point):
                nonlocal saved, done
                done = len(run.history)
                if done:
                    self.watch.progress(done, max(most, done), f"loss {run.history[-1]['loss']:.4g}")
                due = time.perf_counter() - saved >= chosen.checkpoint_s
                due |= run.finished or done >= most  # what follows may be interrupted too
                if self.folder and (due or interrupt.is_set()):
                    reached_so_far = adam_loop.State(step=done, history=run.history)
                    arrays = run.arrays() | {"aim": self.target.aim}
                    kept = what, reached_so_far, arrays, self.renderer.state(), self.target.picture
                    checkpoint.save(self.folder, *kept)
                    saved = time.perf_counter()
                if interrupt.is_set():
                    raise Interrupted(point.edited, done)

            self._hold(run)
            asked = params, self._sigma, chosen.iterations, after_step
            while True:
                # Paint is no noisy picture, and asks for what it shows.
                more: dict[str, Any] = {"sparing": False}
                if self._rendered and not (run and run.corrected):
                    more = {"judge": self._display_error}
                made = gauss_newton.solve(self._problem(), *asked, run, **more)
                if self._rendered:
                    further = self._another(made, interrupt) or self._corrected(made)
                else:
                    further = self._held_more(made.run)
                if further is None:
                    break
                run = further
        self.posterior, said = made.posterior, [made.note] if made.note else self.likelier
        if made.run.hold > 1:
            said.append(hold.said(made.run.hold, hold.change(*self._without_paint(made.run))))
        if "saturation" in made.params and not made.note:
            kept = 100 * float(np.exp(made.params["saturation"].numpy()[0, 0]))
            said.append(f"saturation of the sky's colours: {kept:.0f} % of the original's")
        if made.run.corrected:
            missed = f"the stored transport's error at the solution ({transport_error.SPP} samples a pixel)"
            said.append(f"{missed} was taken off the target for the last steps")
        self.note = "; ".join(said)
        return made.params, adam_loop.State(step=len(made.history), history=made.history)

    def _another(self, made, interrupt=None):
        """Return a run that goes on from a likelier explanation than a solution; None where there is none."""
        run, most = made.run, self.settings.optimizer.iterations
        if made.note or run.corrected or not 0 < len(run.history) < most:
            return None

        def after_step():
            self.watch.progress(len(run.history), len(run.history), "trying lights")
            if interrupt and interrupt.is_set():
                raise Interrupted(self.decode(made.params), len(run.history))

        found = search.further(self._problem(), run, self._sigma, after_step)
        if found is None:
            return None
        self.likelier.append(f"then likelier: {found.name} (-2 log evidence {found.score:.1f})")
        return replace(found.run, most=len(found.run.history) + gauss_newton.ITERATIONS)

    def _corrected(self, made):
        """Return a run that goes on towards the target without T's error; None where it need not."""
        run, most = made.run, self.settings.optimizer.iterations
        if made.note or run.corrected or not 0 < len(run.history) < most:
            return None
        point = self._problem().evaluate(run.state)
        how = self.settings.seed, self.settings.renderer.cache
        seen = point.edited, point.rendering
        self.target = transport_error.corrected(self.target, self.lit, *seen, *how)
        most = len(run.history) + transport_error.STEPS
        return gauss_newton.Run(run.state, run.start, history=run.history, most=most, corrected=True)

    def _hold(self, run):
        """Take the weight of what was not painted that a run has come to."""
        if run is not None and run.hold > 1:
            self.target = self.target.held(self.settings.target.paint, run.hold)
        return run

    def _held_more(self, run):
        """Return a run that goes on with more weight on what was not painted; None where it need not."""
        chosen, most = self.settings.target, self.settings.optimizer.iterations
        if self._rendered or len(run.history) >= most:
            return None
        more = hold.further(chosen, run.hold, *self._without_paint(run))
        if more is None:
            return None
        most = len(run.history) + gauss_newton.ITERATIONS
        return self._hold(gauss_newton.Run(run.state, run.start, history=run.history, most=most, hold=more))

    def _without_paint(self, run):
        """Return what :func:`.hold.change` compares, at the point of a run, through T."""
        seen = self._problem().evaluate(run.state, resolve=False).rendering
        return seen, self.target.aim, self.target.coverage, self.target.weight

    def _display_error(self, envmap):
        """Return the mean square of :meth:`_missed`, weighed as the target."""
        weight = 1 if self.target.weight is None else self.target.weight
        return float((np.square(self._missed(envmap)) * weight).mean())

    def _missed(self, envmap):
        """Return display values of Mitsuba's rendering of a map less the target's; T has no part in it."""
        seed = Seeds.of(self.settings.seed).step_check
        shown = display_curve.to_display(tensor(self.lit.render(envmap, CHECKED_SPP, seed)))
        return shown.numpy() - display_curve.to_display(tensor(self.target.picture)).numpy()

    def _look_at_the_last(self, adam, state):
        """Take the last step back if it led to no map: the loop sees only what a next step starts from."""
        try:
            self.decode(adam.params)
        except NumericalError:
            state.bad_steps += 1
            adam.take_back()
            self.decode(adam.params)

    def _ran_away(self, objective, start, params, rows, bad):
        """Say that a rate that a user has raised led nowhere: the loss has risen, or most steps were bad.

        Both are weighed as in the last step, through the same samples.
        """
        chosen, usual = self.settings.optimizer, self.representation.lr
        if not (chosen.iterations and self.raised_rate):
            return ""
        before, after = (self._loss(objective, one, rows, chosen.iterations - 1) for one in (start, params))
        stuck = 2 * bad >= chosen.iterations and not after < before
        if after <= RISEN * before and not stuck:
            return ""
        return (
            f"optimizer.lr = {chosen.lr:g} is too high: the loss went from {before:.3g} to {after:.3g}, "
            f"{bad} of {chosen.iterations} steps were not finite; the map that the edit began with is kept; "
            f"lower optimizer.lr, {usual:g} is usual"
        )

    def _loss(self, objective, params, rows, step):
        edited = self.decode(params)
        rendering = self.renderer.render(tensor(edited), step)
        return float(objective(rendering, tensor(edited[self.first : self.first + rows]), step)[0][0])

    def _loop(self, params, objective, chosen, **more):
        parts = self.representation, params, self.renderer, objective, self.original, self.first, chosen
        return adam_loop.optimise(*parts, free=self.free, **more)


@contextlib.contextmanager
def keeping(envmap: np.ndarray) -> Iterator[None]:
    """Let numbers that fail after the loop carry the map that it found: Stopped for NumericalError."""
    try:
        yield
    except NumericalError as error:
        raise Stopped(str(error), envmap) from error
