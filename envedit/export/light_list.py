"""The lights of a map as a list, for programs that take the sun as a lamp and the sky as a map.

The lights are those that :mod:`.separation` separates from the background, of any map, however it was edited.
Radiance is what reaches the scene, ``scale`` included. Lights of a map before and after an edit are matched
by where they are and how much flux they have, beginning with where an edit is known to have put them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from envedit.core import latlong
from envedit.core.rotations import Orientation
from envedit.inputs import InputMap
from envedit.representations.layers.placed_lights import direction
from envedit.representations.layers.separation import Light, Separation, separate

FARTHEST = math.pi + 1
"""Cost up to which two lights may be one: any angle at equal flux, or half a turn and a factor e of flux."""
SAME_DEGREES = 2.0
"""Angle up to which a light that an edit has moved is one of the list, as both are separated from one map,
and up to which two lights are one whatever their flux."""
MOST_NAMED = 8
"""Lights that :func:`summary` names."""
_POINTS = 100_000  # of a light, by which its radii are measured


def split(envmap: np.ndarray, core: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split radiance (..., 3) into the sky, without lights but with their glow, and its lights.

    ``core`` is :attr:`.Separation.core` of the map, in its units. Sky and lights are float32 and not
    negative; their sum in float32 is the map, bit for bit. Without a light the sky has the map's bits.
    """
    envmap = np.asarray(envmap, np.float32)
    lights = np.minimum(core, envmap).astype(np.float32)
    sky = np.where(lights > 0, envmap - lights, envmap)
    lights = envmap - sky
    # Where the rounded sum is a neighbour of the map's value: both are made multiples of its spacing, and
    # are then exact differences.
    rounded = sky + lights != envmap
    spacing = envmap[rounded] - np.nextafter(envmap[rounded], np.float32(0))
    lights[rounded] = np.floor(lights[rounded] / spacing) * spacing
    sky[rounded] = envmap[rounded] - lights[rounded]
    return sky, lights


def of_edit(
    input_map: InputMap,
    edited: np.ndarray,
    to_world: np.ndarray,
    by_hand: Orientation,
    degrees: float = 0.0,
    moves: Sequence[tuple[np.ndarray, np.ndarray, float]] = (),
) -> tuple[dict[str, list[dict]], np.ndarray]:
    """Match the lights of a map as its file has it and as edited.

    ``edited`` (H, W, 3) is linear radiance that reaches the scene, ``to_world`` as of :func:`listed`;
    ``by_hand`` is how the map was rotated when it was read, ``degrees`` by how much the edit turned it, and
    ``moves`` are as of :func:`matched`. Returns what :func:`matched` does, and the lights of the edited map
    alone, (H, W, 3) float32.
    """
    first = last = separate(input_map.radiance if input_map.unmoved is None else input_map.unmoved)
    if input_map.unmoved is not None:
        last = separate(input_map.radiance)
        if by_hand.level:  # other rotations resample every texel
            last = kept(first, last, input_map.unmoved, input_map.radiance, by_hand.turn)
    last = kept(last, separate(edited), input_map.radiance, edited, degrees)
    before, after = (listed(separation.lights, edited.shape[:2], to_world) for separation in (first, last))
    rotation = Orientation(degrees).matrix @ by_hand.matrix
    return matched(before, after, rotation, moves), np.minimum(last.core, edited).astype(np.float32)


def listed(separated: list[Light], shape: tuple[int, int], to_world: np.ndarray) -> list[dict]:
    """List the lights of a map of a shape, those with most flux first.

    They are ``separated`` from linear radiance that reaches the scene; ``to_world`` (3, 3) is the rotation
    from the map's frame (+y up) to the scene's.

    Returns a dict each, with ``azimuth``, ``elevation``, ``direction``, ``solid_angle``, ``radius_50``,
    ``radius_97``, ``angle``, ``flux`` and ``irradiance`` as ``docs/pipelines.md`` describes them.
    """
    height, width = shape
    omega = latlong.lookup_solid_angles(height, width)
    lights = []
    for light in separated:
        weight = omega[light.texels // width]
        flux = (np.float64(light.radiance) * weight[:, None]).sum(axis=0)
        solid = float(weight.sum())
        x, y, z = light.direction
        elevation = math.atan2(y, math.hypot(x, z))
        half, most = radii(light, (height, width))
        lights.append(
            {
                "azimuth": math.degrees(math.atan2(x, -z)) % 360,
                "elevation": math.degrees(elevation),
                "direction": (np.asarray(to_world, np.float64) @ light.direction).tolist(),
                "solid_angle": solid,
                "radius_50": half,
                "radius_97": most,
                "angle": 2 * most,
                "flux": flux.tolist(),
                "irradiance": (flux * max(math.sin(elevation), 0)).tolist(),
            }
        )
    return sorted(lights, key=lambda light: -sum(light["flux"]))


def radii(light: Light, shape: tuple[int, int]) -> list[float]:
    """Return the angles from a light's direction within which half and 97 % of its flux lie, degrees.

    A texel counts as the tent that Mitsuba interpolates by, sampled at up to 8 x 8 points.
    """
    height, width = shape
    row, column = np.divmod(light.texels, width)
    count = int(np.clip(math.sqrt(_POINTS / len(row)), 1, 8))
    offset = (2 * np.arange(count) + 1) / count - 1
    tent = (1 - np.abs(offset)) / (1 - np.abs(offset)).sum()
    theta = np.pi * np.abs(row[:, None] + offset) / (height - 1)
    phi = 2 * np.pi * (column[:, None] + 0.5 + offset) / width
    toward = latlong.on_sphere(theta[:, :, None], phi[:, None, :])
    weight = np.abs(np.sin(theta))[:, :, None] * tent[:, None] * tent
    flux = (weight * light.radiance.mean(axis=1)[:, None, None]).ravel()
    chord = np.linalg.norm(toward - light.direction, axis=-1).ravel()
    order = np.argsort(chord)
    share = np.cumsum(flux[order]) / flux.sum()
    chords = np.interp([0.5, 0.97], share, chord[order])
    return np.degrees(2 * np.arcsin(np.clip(chords / 2, 0, 1))).tolist()


def kept(
    before: Separation, after: Separation, start: np.ndarray, end: np.ndarray, degrees: float
) -> Separation:
    """Let texels that an edit did not change be the same lights as before, whatever has been separated.

    ``start`` and ``end`` (H, W, 3) are the map before and after the edit, of which ``before`` and ``after``
    are separations; the whole map was turned by ``degrees`` (:func:`.latlong.rotate`) before it was edited.
    Returns ``after`` with other lights, and the core of these.
    """
    same = np.asarray((latlong.rotate(start, degrees) == end).all(axis=2)).ravel()
    rotation = Orientation(degrees).matrix
    lights = []
    others = list(after.lights)
    touched = np.zeros(len(same), bool)
    for light in before.lights:
        core = np.zeros_like(after.core)
        core.reshape(-1, 3)[light.texels] = light.radiance
        core = latlong.rotate(core, degrees).reshape(-1, 3)
        occupied = np.asarray(core.any(axis=1))
        touched |= occupied
        overlapping = [other for other in others if occupied[other.texels].any()]
        if same[occupied].all() and all(same[other.texels].all() for other in overlapping):
            toward = rotation @ light.direction
            texels = np.flatnonzero(occupied)
            lights.append(replace(light, direction=toward, texels=texels, radiance=core[occupied]))
            others = [other for other in others if not occupied[other.texels].any()]
    lights += [other for other in others if touched[other.texels].any() or not same[other.texels].all()]
    core = np.zeros_like(after.core)
    for light in lights:
        core.reshape(-1, 3)[light.texels] += light.radiance
    return replace(after, core=core, lights=lights)


def matched(
    before: list[dict],
    after: list[dict],
    rotation: np.ndarray | None = None,
    moves: Sequence[tuple[np.ndarray, np.ndarray, float]] = (),
) -> dict[str, list[dict]]:
    """Find which light of a map has become which light of the edited map.

    Of all ways to pair them, the one with the least sum of angle + abs(ln(flux ratio)) (radians; fluxes are
    means over channels), where a light of ``before`` that is left without another costs :data:`FARTHEST`.
    Angles are to where
    ``rotation`` (3, 3), of the whole map between them, brings a light; of one that is known to have gone from
    there, ``moves`` has both directions and the factor of its flux (:meth:`.Layers.light_moves`).

    Returns the lists ``before`` and ``after``, of :func:`listed`, with the same ``id`` for a light in both,
    from 1. ``before`` has ``removed``, whether it is gone, and ``after`` has ``added``, whether it is new,
    and ``moved_degrees`` from where it was before any rotation, None if it is new.
    """
    # ---- Pair lights that are near to each other and of similar flux
    start, end = (
        np.array([direction(light["azimuth"], light["elevation"]) for light in lights]).reshape(-1, 3)
        for lights in (before, after)
    )
    flux = [np.log([max(np.mean(light["flux"]), 1e-30) for light in lights]) for lights in (before, after)]
    rotated = start if rotation is None else start @ rotation.T
    there = rotated.copy()
    for place, now, factor in moves:
        near = rotated @ place
        if near.size and near.max() > math.cos(math.radians(SAME_DEGREES)):
            there[near.argmax()] = now
            flux[0][near.argmax()] += math.log(max(factor, 1e-30))
    apart = np.arccos(np.clip(there @ end.T, -1, 1))
    change = np.abs(flux[0][:, None] - flux[1])
    partner = _paired(apart + np.minimum(change, FARTHEST - math.radians(SAME_DEGREES)))
    moved = np.degrees(np.arccos(np.clip(start @ end.T, -1, 1)))

    # ---- Number them: those before, then those added
    numbered = [{"id": i + 1, "removed": partner[i] is None, **light} for i, light in enumerate(before)]
    found = [{"id": 0, "added": True, "moved_degrees": None, **light} for light in after]
    for i, j in enumerate(partner):
        if j is not None:
            found[j] |= {"id": i + 1, "added": False, "moved_degrees": float(moved[i, j])}
    added = [light for light in found if light["added"]]
    for number, light in enumerate(added, len(before) + 1):
        light["id"] = number
    return {"before": numbered, "after": found}


def summary(lights: dict[str, list[dict]], height: int) -> str | None:
    """Say which lights moved, stayed, came and went, those with most flux first; None without any.

    ``lights`` are of :func:`matched`; what has moved by less than one of ``height`` rows has stayed.
    """
    after = {light["id"]: light for light in lights["after"]}
    parts = []
    for light in lights["before"]:
        if light["removed"]:
            parts.append(f"{_named(light)} no longer stands out")
            continue
        end = after.pop(light["id"])
        stayed = end["moved_degrees"] < 180 / height
        how = "stayed" if stayed else f"moved by {end['moved_degrees']:.1f} degrees to {_place(end)}"
        ratio = sum(end["flux"]) / max(sum(light["flux"]), 1e-30)
        parts.append(f"{_named(light)} {how}" + (f", flux x {ratio:.2g}" if abs(ratio - 1) > 0.1 else ""))
    parts += [f"{_named(light)} is new" for light in after.values()]
    more = f"; and {len(parts) - MOST_NAMED} more in lights.json" if len(parts) > MOST_NAMED else ""
    return "; ".join(parts[:MOST_NAMED]) + more if parts else None


def _named(light):
    return f"light {light['id']} at {_place(light)}"


def _place(light):
    return f"azimuth {round(light['azimuth']) % 360}, elevation {round(light['elevation'])}"


def _paired(cost):
    """Return for each row the column that it is paired with, or None, by the least sum of costs.

    By dynamic programming over the sets of columns taken: a map has at most eight lights.
    """
    rows, columns = cost.shape

    @functools.cache
    def cheapest(row, taken):
        """Return the least sum for this row and those after it, and their columns."""
        if row == rows:
            return 0.0, ()
        rest, partners = cheapest(row + 1, taken)
        best = FARTHEST + rest, (None, *partners)
        for j in range(columns):
            if j not in taken:
                rest, partners = cheapest(row + 1, taken | {j})
                best = min(best, (cost[row, j] + rest, (j, *partners)), key=lambda pairing: pairing[0])
        return best

    return list(cheapest(0, frozenset())[1])
