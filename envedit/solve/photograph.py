"""What steps towards a photograph find of its camera: exposure, place and tone curve.

The log factor of every channel between a rendering and the photograph is an unknown of the steps
(``map_problem.py``). Where they end it is taken off the target, so that the next ones begin at none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from envedit.solve import gauss_newton, search
from envedit.solve.edit_state import EditState
from envedit.solve.likelihood import SIGMA


def take_off_camera(edit: EditState, solution: gauss_newton.Solution) -> None:
    """Divide the target by what a solution has of the camera's factor, which is then 1."""
    state = solution.run.state
    if not solution.note:
        edit.target = edit.target.developed(edit.target.photo.exposed_by(state["camera"][0]))
    solution.run.state = state | {"camera": np.zeros((1, 3))}


def settled(edit: EditState, run: gauss_newton.Run) -> tuple[gauss_newton.Run | None, dict[str, float]]:
    """Let the target be the photograph as it is seen best, and return a run that goes on towards it.

    It is aligned again, with the rendering of the solution, and tone curves are compared: by values of the
    photograph, each after a few steps. Returns -2 log likelihoods by curve, too; None and none where no curve
    gives a finite rendering.
    """
    # ---- Where it lies
    photo = edit.target.photo
    rendering = gauss_newton.reached(edit.problem(), run).rendering
    aligned = photo.aligned(rendering)
    if np.abs(aligned.placed.shares).max() <= 1:
        photo = aligned
    before = edit.target.developed(replace(photo, settled=True))

    # ---- Its curve
    tried = []
    for curve in photo.curves:
        edit.target = before.developed(before.photo.under(curve, rendering, before.weight))
        problem = edit.problem()
        one = run.onward()
        point = gauss_newton.reached(problem, one)
        if point.residual is None:
            continue
        point = gauss_newton.descended(problem, one, point, search.EXPLANATION_STEPS)
        seen = edit.target.photo.exposed_by(one.state["camera"][0])
        likelihood = replace(problem.likelihood, least_noise=SIGMA)
        unlikeliness = likelihood.at_best(seen.missed(point.rendering))
        tried.append((unlikeliness + problem.penalty(point, one.start), seen, one))
    if not tried:
        edit.target = before
        return None, {}
    _, seen, one = min(tried, key=lambda three: three[0])
    edit.target = before.developed(seen)
    one.state = one.state | {"camera": np.zeros((1, 3))}
    most = len(one.history) + gauss_newton.MOST_STEPS
    curves = {other.camera.curve: float(value) for value, other, _ in tried}
    return replace(one, finished=False, most=most), curves
