"""A map between two maps: lights move on great circles, skies blend in log radiance.

The lights of the maps are matched (:func:`.light_list.matched`). A matched light goes from one direction to
the other; its flux changes geometrically, and its shape is that of both, at one place. One without a partner
fades where it is. Glows move with their lights, and the backgrounds under them blend texel by texel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.rotations import rotated, rotation_between, rotation_matrix, rotation_vector
from envedit.core.rows import bands
from envedit.export import light_list
from envedit.representations.layers import file_lights, oriented
from envedit.representations.layers.separation import GLOW_DEGREES, Light, glow_at

BLACK = 1e-4
"""Share of a sky's mean radiance that is added before its logarithm, and taken off again: black has none."""
_ROWS = 128  # of a map that are worked on at a time


@dataclass(frozen=True)
class _Move:
    """A light of the result: its direction, its parts with their fluxes, and the logarithm of 1 + glow."""

    direction: np.ndarray
    parts: list[tuple[Light, np.ndarray]]
    log_glow: np.ndarray


def blend(first: np.ndarray, second: np.ndarray, amount: float) -> tuple[np.ndarray, list[dict]]:
    """Blend two maps of one size.

    ``first`` and ``second`` (H, W, 3) float32 are linear radiance in Rec. 709. Both are overwritten: two maps
    of 8192 x 4096 texels are 0.8 GB. Returns the blended map, at an ``amount`` of 1 the second, and
    ``direction`` and ``flux`` of each light of it, none of the second.
    """
    if amount >= 1:
        return second, []

    # ---- Lights, matched, and the skies without them
    maps = first, second
    lights = [file_lights.lights_of(envmap) for envmap in maps]
    moves = _moves(lights, first.shape[:2], amount)
    for envmap, own_lights in zip(maps, lights, strict=True):
        file_lights.take_out(envmap, own_lights)
    offset = [max(BLACK * float(envmap.mean(dtype=np.float64)), 1e-30) for envmap in maps]
    share = np.array([1 - amount, amount])
    least = np.float32(np.exp(share @ np.log(offset)))

    # ---- Backgrounds in log radiance, and the glows where the lights are
    height, width = first.shape[:2]
    for rows in bands(height, _ROWS):
        directions = latlong.directions(height, width, rows).astype(np.float32)
        log_sky = np.zeros_like(first[rows])
        for envmap, own_lights, e, weight in zip(maps, lights, offset, share, strict=True):
            for light in own_lights:
                if light.glow is not None:
                    envmap[rows] /= 1 + glow_at(light.glow, directions @ np.float32(light.direction))
            log_sky += np.float32(weight) * np.log(envmap[rows] + np.float32(e))
        first[rows] = np.maximum(np.exp(log_sky) - least, 0)
        for move in moves:
            if move.log_glow.any():
                first[rows] *= 1 + glow_at(np.expm1(move.log_glow), directions @ np.float32(move.direction))

    # ---- Lights
    for move in moves:
        for light, flux in move.parts:
            matrix = rotation_matrix(rotation_vector(light.direction, move.direction))
            oriented.add_rotated(first, light, matrix, flux)
    return first, [
        {
            "direction": move.direction.tolist(),
            "flux": np.sum([flux for _, flux in move.parts], axis=0).tolist(),
        }
        for move in moves
    ]


def _moves(lights, shape, amount):
    """Return what each light of the two maps becomes."""
    tables = [[light_list.listed([light], shape, np.eye(3))[0] for light in own] for own in lights]
    matched = light_list.matched(tables[0], tables[1])
    ends = [
        {row["id"]: (light, np.array(row["flux"])) for row, light in zip(rows, own, strict=True)}
        for rows, own in zip((matched["before"], matched["after"]), lights, strict=True)
    ]
    moves = []
    for number in sorted({*ends[0], *ends[1]}):
        start, end = (side.get(number) for side in ends)
        if start is None or end is None:  # it fades where it is
            (light, flux), weight = (start, 1 - amount) if end is None else (end, amount)
            moves.append(_Move(light.direction, [(light, weight * flux)], weight * _log_glow(light)))
            continue
        (light_before, before), (light_after, after) = start, end
        flux = before ** (1 - amount) * after**amount
        turn = amount * rotation_between(light_before.direction, light_after.direction)
        parts = [(light_before, (1 - amount) * flux), (light_after, amount * flux)]
        glow = (1 - amount) * _log_glow(light_before) + amount * _log_glow(light_after)
        moves.append(_Move(rotated(light_before.direction, turn), parts, glow))
    return moves


def _log_glow(light):
    return np.zeros((len(GLOW_DEGREES), 3)) if light.glow is None else np.log1p(light.glow)
