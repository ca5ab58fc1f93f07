"""An edit by Adam, with checkpoints and Ctrl-C: networks, texels, and the detail that a mirror shows."""

from __future__ import annotations

import numpy as np

from envedit.core.arrays import tensor
from envedit.core.errors import NumericalError
from envedit.core.interrupts import ctrl_c
from envedit.core.types import Params
from envedit.losses import optimizer
from envedit.solve import adam_loop, checkpoint
from envedit.solve.edit_state import EditState, Interrupted, Stopped

MOST_RISEN_LOSS = 2.0
"""Largest ratio of the last loss to the first where a user has raised Adam's rate. Measured on
quickstart, four representations at rates of 0.1 to 1e38: it is 0.02 to 1.7, or the loss runs away, to 7 to
1e6 times the first."""


def optimise(
    edit: EditState, params: Params, checkpoints: checkpoint.Checkpoints
) -> tuple[Params, adam_loop.State]:
    """Optimise from the start, or from the checkpoint where the run is resumed and there is one.

    ``params`` is where to start. A resumed run takes its target's picture from the checkpoint.

    Raises
    ------
    Interrupted
        After Ctrl-C.
    Stopped
        If most steps are not finite, or the loss has run away at a rate that a user has raised.
    """
    # ---- Where it starts
    settings = edit.settings.optimizer
    adam = adam_loop.adam_for(edit.representation, params, settings)
    state = adam_loop.State()
    digest = checkpoint.digest(edit.settings, edit.scene.digest, [edit.original, *edit.target.asked])
    if stored := checkpoints.load(digest):
        state, moments, traced, picture = stored
        adam.load_state_dict(moments)
        edit.renderer.restore(traced)
        # Rendered anew, the target may differ in its last bits: Mitsuba's film adds in any order.
        edit.target = edit.target.aimed_at(picture)
    objective = adam_loop.Objective(
        edit.settings.loss,
        edit.target.aim,
        edit.target.known_weight,
        edit.crop,
        settings.iterations,
        dists=edit.dists,
        every=edit.settings.perceptual.dists_every,
        views=edit.scene.rows,
    )
    objective.resume(state.history)

    # ---- Steps
    with ctrl_c() as interrupt:

        def after_step(state, adam):
            edit.watch.progress(state.step, settings.iterations, f"loss {state.history[-1]['loss']:.4g}")
            done = state.step == settings.iterations  # what follows may be interrupted too
            if checkpoints.due(done or interrupt.is_set()):
                traced = edit.renderer.state()
                checkpoints.save(digest, state, adam.state_dict(), traced, edit.target.aim)
            if interrupt.is_set():
                raise Interrupted(_last_good(edit, adam), state.step)

        try:
            adam_loop.optimise(
                edit.representation,
                params,
                edit.renderer,
                objective,
                edit.original,
                edit.rows.first,
                settings,
                free=edit.free,
                adam=adam,
                state=state,
                after_step=after_step,
            )
            _look_at_the_last(edit, adam, state)
            if error := _ran_away(edit, objective, params, adam.params, state.bad_steps):
                raise Stopped(error, edit.decode(params))
        except NumericalError as error:
            if isinstance(error, Stopped):
                raise
            raise Stopped(str(error), _last_good(edit, adam)) from error
    return adam.params, state


def raised_rate(edit: EditState) -> bool:
    """Whether Adam's rate is a user's, and higher than usual."""
    rate = edit.settings.optimizer.lr
    return not edit.newton and rate != "auto" and rate > edit.representation.lr


def _last_good(edit: EditState, adam: optimizer.Adam) -> np.ndarray:
    """Return the last map that is finite: after the last step, before it, or else the original."""
    for _ in range(2):
        try:
            return edit.decode(adam.params)
        except NumericalError:
            adam.take_back()
    return edit.original.copy()


def _look_at_the_last(edit, adam, state):
    """Take the last step back if it led to no map: the loop sees only what a next step starts from."""
    try:
        edit.decode(adam.params)
    except NumericalError:
        state.bad_steps += 1
        adam.take_back()
        edit.decode(adam.params)


def _ran_away(edit, objective, start, params, bad_steps):
    """Say that a rate that a user has raised led nowhere: the loss has risen, or most steps were bad.

    Both are weighed as in the last step, through the same samples.
    """
    settings = edit.settings.optimizer
    if not (settings.iterations and raised_rate(edit)):
        return ""
    before, after = (_loss(edit, objective, one, settings.iterations - 1) for one in (start, params))
    stuck = 2 * bad_steps >= settings.iterations and not after < before
    if after <= MOST_RISEN_LOSS * before and not stuck:
        return ""
    return (
        f"optimizer.lr = {settings.lr:g} is too high: the loss went from {before:.3g} to {after:.3g}, "
        f"{bad_steps} of {settings.iterations} steps were not finite; the map that the edit began with is "
        f"kept; lower optimizer.lr, {edit.representation.lr:g} is usual"
    )


def _loss(edit, objective, params, step):
    edited = edit.decode(params)
    rendering = edit.renderer.render(tensor(edited), step)
    total, _ = objective(rendering, tensor(edited[edit.rows.slice]), step)
    return float(total[0])
