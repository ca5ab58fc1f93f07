"""A map rotated on the sphere, once, however many angles are asked for; lights keep their flux.

Lights are separated first: their cores are sampled finely and keep their flux exactly, while the sky is
sampled at four points a texel.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import ROUNDING, flat
from envedit.core.rotations import Orientation
from envedit.representations.layers import file_lights
from envedit.representations.layers.separation import Light

SKY_SAMPLES = 2
"""Points along either side of a texel at which a rotated sky is sampled."""
LIGHT_SAMPLES = 8
"""The same of a light, a sun of one texel at worst."""
BAND_TEXELS = 1 << 20
"""Texels that are rotated at a time."""


def oriented(image: np.ndarray, orientation: Orientation, lights: list[Light] | None = None) -> np.ndarray:
    """Rotate a map (H, W, 3) float32; columns that are only turned move as of :func:`.latlong.rotate`.

    Otherwise the sky is resampled once, and ``lights`` keep their flux, which is radiance times
    :func:`.latlong.lookup_solid_angles`. They are those of the map; None: they are looked for. With [] all is
    sampled as sky is, quickly, and a sun keeps its flux to 4 %.
    """
    if orientation.level:
        return latlong.rotate(image, orientation.turn)
    if lights is None:
        lights = file_lights.lights_of(image)
    matrix, rows = orientation.matrix, (0, len(image))
    result = resampled(file_lights.without(image, lights), matrix, rows, rows, SKY_SAMPLES)
    for light in lights:
        add_rotated(result, light, matrix)
    return result


def oriented_share(share: np.ndarray, orientation: Orientation) -> np.ndarray:
    """Rotate a share of every texel (H, W), 0 to 1, as :func:`oriented` does the map: 0 and 1 stay exact."""
    if orientation.level:
        return latlong.rotate(share, orientation.turn)
    rotated = oriented(np.repeat(share[..., None], 3, axis=2), orientation, [])[..., 0]
    rotated[rotated > 1 - ROUNDING] = 1
    return rotated


def add_rotated(envmap: np.ndarray, light: Light, matrix: np.ndarray, flux: np.ndarray | None = None) -> None:
    """Add a light, of a map of the same size, to a map (H, W, 3) float32 in place, rotated.

    ``matrix`` takes directions of the map to those of the rotated one; ``flux`` (3,) is that it will have, by
    default that it has.
    """
    height, width = envmap.shape[:2]
    omega = latlong.lookup_solid_angles(height, width)
    row, column = np.divmod(light.texels, width)
    own = (omega[row][:, None] * np.float64(light.radiance)).sum(axis=0)
    aim = own if flux is None else flux

    # ---- A light that stays keeps its texels, and the shape that resampling would blur
    if (matrix == np.eye(3)).all():
        envmap[row, column] += _scaled(light.radiance, own, aim)
        return

    # ---- The light alone, in the rows that hold it
    first, last = max(int(row.min()) - 1, 0), min(int(row.max()) + 2, height)
    alone = np.zeros((last - first, width, 3), np.float32)
    alone[row - first, column] = light.radiance

    # ---- The rows that it comes to, with a margin of a texel and its interpolation
    theta = np.pi * row / (height - 1)
    phi = 2 * np.pi * (column + 0.5) / width
    place, _ = latlong.texel_position(latlong.on_sphere(theta, phi) @ matrix.T, height, width)
    top = max(int(place.min()) - 3, 0)
    bottom = min(int(place.max()) + 4, height)
    image = resampled(alone, matrix, (first, height), (top, bottom), LIGHT_SAMPLES)
    got = np.einsum("h,hwc->c", omega[top:bottom], image, dtype=np.float64)
    envmap[top:bottom] += _scaled(image, got, aim)


def _scaled(image, flux, aim):
    """Return radiance (..., 3) of a flux (3,) with another one; a channel without flux stays black."""
    return image * np.where(flux > 0, aim / np.where(flux > 0, flux, 1), 0).astype(np.float32)


def resampled(
    image: np.ndarray, matrix: np.ndarray, rows: tuple[int, int], target: tuple[int, int], samples: int
) -> np.ndarray:
    """Average the rotated interpolant of a map over texels of the same grid: (target rows, W, 3) float32.

    Each texel is divided into ``samples`` x ``samples`` parts, weighted by their solid angles, and the map is
    interpolated at their middles as Mitsuba interpolates it. ``image`` (rows, W, 3) float32 is some rows of a
    map, black elsewhere; ``rows`` are its first in the map, and the rows of the map. ``matrix`` (3, 3) takes
    directions of the map to those of the rotated one, of which the rows from the first of ``target`` up to
    its second are returned.
    """
    # ---- The source on the device, and places of samples within a texel
    width = image.shape[1]
    first, height = rows
    source = flat(mi.Float, image)
    back = [[dr.opaque(mi.Float, float(value)) for value in column] for column in matrix.T]  # its inverse
    edges = latlong.row_edges(height) * np.pi
    parts = (np.arange(samples) + 0.5) / samples
    begin = dr.opaque(mi.Int32, first)
    phi = 2 * np.pi * (np.arange(width)[:, None] + parts) / width

    # ---- Bands of rows
    result = np.empty((target[1] - target[0], width, 3), np.float32)
    step = max(BAND_TEXELS // width, 1)
    for top in range(target[0], target[1], step):
        bottom = min(top + step, target[1])
        size = bottom - top
        index = dr.arange(mi.UInt32, size * width)
        row = index // width
        column = index - row * width
        total = mi.Color3f(0)
        low, high = edges[top:bottom, None], edges[top + 1 : bottom + 1, None]
        theta = low + (high - low) * parts
        half = (high - low) / (2 * samples)
        weight = np.sin(theta) * np.sin(half)
        weight = weight / (samples * weight.sum(axis=1, keepdims=True))
        for i in range(samples):
            sine, cosine, share = (
                dr.gather(mi.Float, flat(mi.Float, np.float32(table[:, i])), row)
                for table in (np.sin(theta), np.cos(theta), weight)
            )
            for j in range(samples):
                x, z = (
                    sine * dr.gather(mi.Float, flat(mi.Float, np.float32(table[:, j])), column)
                    for table in (np.sin(phi), -np.cos(phi))
                )
                direction = mi.Vector3f(*(a * x + b * cosine + c * z for a, b, c in back))
                total += share * _lookup(source, direction, (begin, len(image)), height, width)
            dr.eval(total)  # one kernel for all parts
        result[top - target[0] : bottom - target[0]] = np.array(total).T.reshape(size, width, 3)
    return result


def _lookup(source, d, rows, height, width):
    """Interpolate rows of a map at directions as Mitsuba does (:mod:`.latlong`); black where they are not."""
    first, count = rows
    across = dr.atan2(d.x, -d.z) * (width / (2 * math.pi)) - 0.5
    down = dr.atan2(dr.sqrt(d.x * d.x + d.z * d.z), d.y) * ((height - 1) / math.pi)
    top, left = dr.floor(down), dr.floor(across)
    near_row, near_column = down - top, across - left
    c0 = mi.Int32(left)
    c0 = dr.select(c0 < 0, c0 + width, c0)
    c0 = mi.UInt32(dr.clip(c0, 0, width - 1))
    c1 = dr.select(c0 == width - 1, mi.UInt32(0), c0 + 1)
    value = mi.Color3f(0)
    for step, share in ((0, 1 - near_row), (1, near_row)):
        line = mi.Int32(top) + step - first
        inside = (line >= 0) & (line < count)
        begin = mi.UInt32(dr.clip(line, 0, count - 1)) * width
        a = dr.gather(mi.Color3f, source, begin + c0, inside)
        b = dr.gather(mi.Color3f, source, begin + c1, inside)
        value += share * (a + (b - a) * near_column)
    return value
