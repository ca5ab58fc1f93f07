"""Initialise the edit of a painted picture: find the lights that explain the painted change.

Only the change is explained, so that errors of the overview (a fifth of a block's light) are errors of the
change. Otherwise as :mod:`.matching_pursuit` and :mod:`.light_search`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from envedit.core.arrays import tensor
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import LOBE_DEGREES, SPARE
from envedit.representations.layers.separation import Light
from envedit.solve.light_search import LEAST, MOST, PROBES, Question, SearchProblem, rotations
from envedit.solve.matching_pursuit import LEAST_FLUX, Given, Place, Pursuit, not_negative, relative

ADDED_BESIDE, ADDED_ASKED = 0.3, 0.1
"""For a painted change a light is added where it explains the first share of what is left unexplained, and
the second of the squared change."""
BOLD = 0.01
"""Used in place of the first of these shares for a second start, which is compared with the first."""
TAKEN = 0.3
"""Where another light is added, a light that loses more than this share of its strength is taken to have
moved there."""
CHANGE_ORDER = 0
"""Order of the background's gains for a painted change: an extreme gain explains any small stroke."""
BESIDE = 8.0
"""Degrees from all others that an added light has at least."""
SOFT = 2.0
"""Radius in degrees of the lobes that take the place of lights where a shadow is to be softer."""


def start(problem: SearchProblem, params: dict, bold: bool = False) -> tuple[dict, list[str]]:
    """Find where the optimisation starts for a picture that was painted on the initial rendering.

    Parameters
    ----------
    problem, params
        As for :func:`.light_search.start`, with ``initial``.
    bold : bool
        Also add lights with a low score: a shadow takes a light elsewhere and a darker sky together,
        and either alone explains next to nothing.

    Returns
    -------
    params : dict
        Of the start; the gain is zero, for paint need not be what any sky does.
    notes : list of str
        What was found.
    """
    # Paint does not weigh more than the rest here: what is added must leave the rest as it is.
    layers, transport, weight = problem.layers, problem.transport, problem.weight
    weight = None if weight is None or (weight > 0).all() else (weight > 0).astype(np.float32)
    scene = Question(replace(problem, weight=weight))
    lights = layers.separation.lights
    places = place(scene.given(), scene.target, lights, SPARE, layers.lights.flux[-1], bold)
    notes, moved = [], {i for i, found in enumerate(places) if found.direction is not None}
    there = [scene.light(i, Place(None, np.ones(3))) for i in range(len(lights))]
    new: dict = {}
    for i in sorted(moved):
        direction, glow = places[i].direction, lights[i].glow if i < len(lights) else None
        if transport.capacity >= PROBES:
            flux = layers.lights.flux[i] * places[i].flux
            direction, _ = scene.refine(direction, flux, glow, [*there, *new.values()])
        places[i] = Place(direction, places[i].flux)
        new[i] = scene.light(i, places[i])
        if i < len(lights):
            angle = np.degrees(np.arccos(np.clip(direction @ lights[i].direction, -1, 1)))
            notes.append(
                f"light {i + 1} of {len(lights)}: the steps start with it {angle:.1f} degrees from "
                "its place in the map"
            )
        else:
            notes.append("added a light, in a direction in which the map has none")
    if moved:
        for i, factor in _strengths(scene, there, new).items():
            places[i] = Place(places[i].direction, places[i].flux * factor if i in new else factor)
    turn, flux = scene.parameters(places)
    found = {"turn": tensor(turn / layers.scales["turn"]), "flux": tensor(flux / layers.scales["flux"])}
    return params | found, notes


def softened(layers: Layers, params: dict) -> tuple[dict, list[str]]:
    """Return a start with lobes in place of the strongest lights, as softer shadows need them.

    A light of few texels cannot grow: its texels would part. A lobe can.
    """
    lights = layers.separation.lights[:SPARE]
    places = [Place(None, np.ones(3)) for _ in layers.separation.lights]
    spare = [Place(None, np.zeros(3))] * SPARE
    for i, light in enumerate(lights):
        own, other = layers.lights.flux[i], layers.lights.flux[len(places) + i]
        places[i], spare[i] = Place(None, np.zeros(3)), Place(light.direction, own / np.maximum(other, 1e-30))
    turn, flux = rotations(layers.lights, places + spare)
    size = np.zeros((len(turn), 1))
    size[len(places) :] = np.log(SOFT / LOBE_DEGREES)
    real = {"turn": turn, "flux": flux, "size": size}
    found = {name: tensor(value / layers.scales[name]) for name, value in real.items()}
    return params | found, [f"{len(lights)} lights initialised as soft lobes"]


def place(
    given: Given,
    difference: np.ndarray,
    lights: list[Light],
    spare: int,
    spare_flux: np.ndarray,
    bold: bool = False,
) -> list[Place]:
    """Find which lights a painted change requires; parameters as for :func:`.matching_pursuit.place`.

    ``difference`` (h, w, 3) is what was painted less what was there, 0 beside the paint. Beside a gain of the
    background, lights that are there may become stronger or weaker, and lights are added. If one is added
    while another loses more than :data:`TAKEN` of its strength, the other has moved there. ``bold``: of
    the first added light :data:`BOLD` of what is left unexplained is enough.
    """
    overview, search = given.overview, Pursuit(given, difference, CHANGE_ORDER)
    stays = []
    for light in lights:
        atom = search.atom_of(given.cells(light), given.flux(light), light.direction, light.glow)
        stays.append(atom[..., 0])
        search.explain(stays[-1])
    own = [given.flux(light).sum(axis=0) for light in lights]
    new_places: list[np.ndarray] = []
    added, atom = [], search.atoms(spare_flux, None)
    for _ in range(spare + len(lights)):
        score = search.scores(atom)
        for there in [*(light.direction for light in lights), *new_places]:
            score[overview.directions[search.candidates] @ there > np.cos(np.radians(BESIDE))] = 0
        best = int(score.argmax())
        enough = BOLD * search.left() if bold else ADDED_BESIDE * search.left()
        if not score[best] > max(enough, 0 if bold and not new_places else ADDED_ASKED * search.asked()):
            break
        new_places.append(search.between(score, best))
        added.append(atom[..., best])
        search.explain(added[-1])
    factors = search.solve([a * sign for a in stays for sign in (1, -1)] + added, signed=True)
    grown = factors[: 2 * len(stays)].reshape(len(stays), 2, 3)
    factor = np.clip(1 + grown[:, 0] - grown[:, 1], 0, None)
    places, moved = [Place(None, f if new_places else np.ones(3)) for f in factor], []
    for direction, strength in zip(new_places, factors[2 * len(stays) :], strict=True):
        flux = strength * spare_flux
        left = [1.0 if i in moved else factor[i].mean() for i in range(len(lights))]
        if left and min(left) < 1 - TAKEN:
            i = int(np.argmin(left))
            moved.append(i)
            more = np.divide(flux, own[i], out=np.zeros(3), where=own[i] > 0)  # no factor colours a light
            places[i] = Place(direction, factor[i] + more)
        elif len(places) < len(lights) + spare:
            places.append(Place(direction, np.maximum(strength, LEAST_FLUX)))
    return places + [Place(None, np.zeros(3))] * (len(lights) + spare - len(places))


def _strengths(scene, there, new):
    """Factors (3,) by light, beside a gain of the background, under which their pictures make the change.

    ``there``: pictures of the lights as they were; ``new``: of those that are placed anew, by number,
    which are gone from where they were.
    """
    background = scene.render(scene.background)
    scale = relative(scene.known, scene.target, scene.weight)
    stay = [i for i in range(len(there)) if i not in new]
    found = {i: np.ones(3) for i in [*stay, *new]}
    for c in range(3):
        gone = sum((there[i][..., c] for i in range(len(there)) if i in new), 0.0)
        spans = [background[..., c], *(there[i][..., c] for i in stay)]
        columns = [*spans, *(-span for span in spans), *(picture[..., c] for picture in new.values())]
        a = np.stack([(column * scale).ravel() for column in columns], axis=1)
        x = not_negative(a, ((scene.target[..., c] + gone) * scale).ravel())
        grown = x[: len(spans)] - x[len(spans) : 2 * len(spans)]
        for i, value in zip(stay, grown[1:], strict=True):
            found[i][c] = np.clip(1 + value, LEAST, MOST)
        for i, value in zip(new, x[2 * len(spans) :], strict=True):
            found[i][c] = np.clip(value, LEAST, MOST)
    return found
