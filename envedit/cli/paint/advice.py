"""What to do where little of the paint is reached: which strokes, why, and what reaches more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.cli.paint import picking
from envedit.cli.paint.protocol import Document
from envedit.cli.paint.solution import Request
from envedit.core.color import tonemap
from envedit.core.rotations import rotation_vector
from envedit.representations.layers.lights import DARK
from envedit.solve import painted_places
from envedit.solve.feasibility import WARNED_SHARE, Reach
from envedit.solve.light_places import Place
from envedit.solve.map_problem import Problem
from envedit.solve.unknowns import with_light

UNLIT_SHARE = 0.02
"""Light of a white sky at a stroke, over the picture's mean, below which hardly any of the map's reaches it.
Not measured."""
UNEVEN_SHARE = 0.3
"""Mean of what is not feasible in a stroke, over its mean size, up to which its brightness is right and its
pattern is not. Not measured."""
MOST_NAMED = 3
"""Strokes that are named."""


@dataclass(frozen=True)
class Action:
    """What reaches more: a button's text, and what it changes of the document."""

    label: str
    change: dict[str, Any]


def said(
    document: Document,
    request: Request,
    rendering: np.ndarray,
    reach: Reach,
    strokes: Sequence[np.ndarray],
    white: np.ndarray,
    lamps: np.ndarray,
) -> tuple[str, list[Action]]:
    """Say which strokes are missed, why the worst is, and what can be done; "" if enough is reached.

    Of what was asked for, ``request``, the ``rendering`` (h, w, 3) was reached, and ``reach`` is feasible.
    ``strokes`` (h, w, 1) are the coverage of each stroke by itself; ``white`` and ``lamps`` (h, w, 3) are
    renderings under a map of radiance 1, without lamps, and of the scene's lamps alone.
    """
    shares = {
        i: request.of_stroke(rendering, cover)
        for i, cover in enumerate(strokes)
        if document.strokes[i]["type"] != "hold"
    }
    missed = sorted((i for i in shares if shares[i] < WARNED_SHARE), key=lambda i: shares[i])
    if request.reached(rendering) >= WARNED_SHARE or not missed:
        return "", []
    worst = missed[0]
    left = np.float64(tonemap(request.target)) - tonemap(rendering)
    dark = float((strokes[worst] * left).sum()) > 0
    stays = "too dark" if dark else "too bright"
    text = f"stroke {worst + 1} ({document.strokes[worst]['type']}) stays {stays}"
    why, actions = _why(document, request, reach, strokes[worst], white, lamps, worst, dark)
    others = [f"{i + 1} ({_percent(shares[i])})" for i in missed[1:MOST_NAMED]]
    also = f"; little is reached of {', '.join(others)} too" if others else ""
    return f"{text}: {why}{also}", actions


def _why(document, request, reach, cover, white, lamps, i, dark):
    """Return a phrase on why a stroke is missed, and what can be done about it in the document."""
    change = "brighter" if dark else "darker"
    follow = Action("Let the rest follow", {"rest": "follow"})
    free = Action("Let the sky change freely", {"freedom": 1.0})
    area = max(float(cover.sum()), 1e-30)

    def mean(picture):
        return float((cover * picture).sum()) / (3 * area)

    # ---- Where the map cannot make it so
    if dark and mean(white) < UNLIT_SHARE * white.mean():
        return "hardly any light of the map reaches it", []
    if not dark and mean(lamps) > 0.5 * mean(request.base):
        return "most of its light is of lamps of the scene, which no map changes", []
    # ---- Where the settings keep it from being so
    if document.rest == "keep":
        return "the rest, which stays, keeps it so", [follow]
    feasible = request.of_stroke(reach.picture, cover)
    if feasible >= WARNED_SHARE:
        if document.freedom < WARNED_SHARE:
            return f"a sky that may change so little does not make it {change}", [free]
        return f"what would make it {change} is unlikely for a sky", []
    # ---- Where no map makes it so and leaves the mean of the rest
    less = _less(document, i, feasible)
    uneven = abs(float((cover * reach.residual).sum()))
    if uneven < UNEVEN_SHARE * float((cover * np.abs(reach.residual)).sum()):
        return "no light shows a pattern so fine on that surface", less
    return f"what makes it {change} makes the rest {change} too", less


def _less(document, i, feasible):
    """Offer a stroke as strong as is feasible."""
    if feasible < 0.05:  # too little to be seen
        return []
    strokes = [dict(stroke) for stroke in document.strokes]
    strokes[i]["opacity"] = round(feasible * strokes[i].get("opacity", 1.0), 3)
    return [Action(f"Paint {_percent(feasible)} of stroke {i + 1}", {"strokes": strokes})]


def lights(
    problem: Problem,
    start: dict,
    state: dict,
    request: Request,
    listed: list[picking.Placed],
    document: Document,
) -> list[Action]:
    """Find where the map's strongest light, or one more, would by itself reach more than a solution does.

    ``problem`` is of the paint, where the rest follows: it does where a light is placed by hand. ``start`` is
    the map as it is, ``state`` the solution; ``listed`` are the lights of the document, of which strokes are
    taken out. The action that reaches most comes first.
    """
    now = problem.evaluate(state).rendering
    if now is None:
        return []
    held = [stroke for stroke in document.strokes if stroke["type"] == "hold"]
    found = []
    for share, label, entries in _placed(problem, start, state, request, listed, document):
        if share > request.reached(now):
            change = {"lights": entries, "strokes": held}
            found.append((share, Action(f"{label} there: {_percent(share)}", change)))
    return [action for _, action in sorted(found, key=lambda one: -one[0])]


def _placed(problem, start, state, request, listed, document):
    """Yield what a light in its best place reaches, what is done, and the document's lights with it."""
    layers = problem.layers.lights
    own = [k for k in problem.shining(start) if k < layers.own]
    strongest = max(own, key=lambda k: layers.flux[k].sum(), default=None)
    # ---- The strongest light, elsewhere
    i = None if strongest is None else picking.index_of(listed, layers.centres[strongest])
    if i is not None:
        dark = with_light(start, strongest, flux=DARK)
        away = problem.direction(state, strongest)
        share, there = _best(problem, dark, start, strongest, request, away)
        if there is not None:
            flux = [float(np.exp(there.log_flux[0])) * value for value in listed[i].entry["flux"]]
            moved = {"flux": flux} | picking.place(there.direction, document)
            yield share, f"Drag light {i + 1}", picking.changed(listed, i, moved, document)
    # ---- One more
    spare = layers.own
    share, there = _best(problem, start, start, spare, request)
    if there is not None:
        flux = (np.exp(there.log_flux) * layers.flux[spare]).tolist()
        added = {"flux": flux, "size": there.degrees} | picking.place(there.direction, document)
        yield share, "Add a light", [*document.lights, added]


def _best(problem, without, start, k, request, away=None):
    """Return what a light reaches at most, and its place; None where it reaches nothing.

    ``without`` is a state where it is dark, ``start`` the map's, ``away`` where it is not to be.
    """
    lights = problem.layers.lights
    most: tuple[float, Place | None] = 0.0, None
    for there in painted_places.best(problem, without, problem.transport, k, away):
        turn = rotation_vector(lights.centres[k], there.direction)
        size = start["size"][k] if k < lights.own else lights.log_size(there.degrees)
        placed = with_light(start, k, turn=turn, flux=there.log_flux, size=size)
        rendering = problem.evaluate(placed).rendering
        share = 0.0 if rendering is None else request.reached(rendering)
        if share > most[0]:
            most = share, there
    return most


def _percent(share):
    return f"{100 * share:.0f} %"
