"""What is done to a map as a picture on the sphere: rotation and blur, both of which keep flux.

A map is rotated once, however many angles are asked for. Lights are separated first: their cores are sampled
finely and keep their flux exactly, while the sky is sampled at four points a texel.
"""

from __future__ import annotations

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat
from envedit.core.rotations import rotation_matrix
from envedit.export import adjustments, file_lights
from envedit.representations.layers.separation import Light

SKY_SAMPLES = 2
"""Points along either side of a texel at which a rotated sky is sampled."""
LIGHT_SAMPLES = 8
"""The same of a light, a sun of one texel at worst."""
BLUR_TEXELS = 3.0
"""Standard deviation of a blur in texels of the grid that it is computed on: finer maps are reduced and
interpolated. Derived: the box and the tent of that add 1/12 and 1/6 to a variance of 9: 1.4 % wider."""
BLUR_REACH = 4.0
"""Standard deviations at which the kernel of a blur ends, at 3e-4 of its peak."""
BAND_TEXELS = 1 << 20
"""Texels that are rotated at a time."""


# ---- Rotation ----------------------------------------------------------------------------------------------


def rotation(turn: float = 0.0, tilt: float = 0.0, horizon: float = 0.0) -> np.ndarray:
    """Return the matrix (3, 3) that takes directions of a map to those of the rotated map.

    In the map's frame (+y up, the middle column towards +z): first ``horizon`` raises the middle of the map,
    then ``tilt`` rotates clockwise about it, both as seen in the map as it is, then ``turn`` about the
    vertical moves the picture to the left (:func:`.latlong.rotate`). All in degrees.
    """
    matrix = np.eye(3)
    for vector in ((-horizon, 0.0, 0.0), (0.0, 0.0, tilt), (0.0, turn, 0.0)):
        matrix = rotation_matrix(np.radians(vector)) @ matrix
    return matrix


def rotate(radiance: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Rotate a map (H, W, 3) float32 on the sphere by :func:`rotation`; lights keep their flux.

    The sky is resampled once. Flux is radiance times :func:`.latlong.lookup_solid_angles`.
    """
    shape = radiance.shape[:2]
    lights = file_lights.lights_of(radiance)
    result = resampled(
        file_lights.without(radiance, lights), matrix, (0, shape[0]), (0, shape[0]), SKY_SAMPLES
    )
    for light in lights:
        add_rotated(result, light, matrix)
    return result


def add_rotated(envmap: np.ndarray, light: Light, matrix: np.ndarray, flux: np.ndarray | None = None) -> None:
    """Add a light, of a map of the same size, to a map (H, W, 3) float32 in place, rotated.

    ``matrix`` is of :func:`rotation`; ``flux`` (3,) is that it will have, by default that it has.
    """
    height, width = envmap.shape[:2]
    omega = latlong.lookup_solid_angles(height, width)

    # ---- The light alone, in the rows that hold it
    row, column = np.divmod(light.texels, width)
    first, last = max(int(row.min()) - 1, 0), min(int(row.max()) + 2, height)
    alone = np.zeros((last - first, width, 3), np.float32)
    alone[row - first, column] = light.radiance
    own = (omega[row][:, None] * np.float64(light.radiance)).sum(axis=0)

    # ---- The rows that it comes to, with a margin of a texel and its interpolation
    theta = np.pi * row / (height - 1)
    phi = 2 * np.pi * (column + 0.5) / width
    place, _ = latlong.texel_position(latlong.on_sphere(theta, phi) @ matrix.T, height, width)
    top = max(int(place.min()) - 3, 0)
    bottom = min(int(place.max()) + 4, height)
    image = resampled(alone, matrix, (first, height), (top, bottom), LIGHT_SAMPLES)
    got = np.einsum("h,hwc->c", omega[top:bottom], image, dtype=np.float64)
    aim = own if flux is None else flux
    image *= np.where(got > 0, aim / np.where(got > 0, got, 1), 0).astype(np.float32)
    envmap[top:bottom] += image


def resampled(
    image: np.ndarray, matrix: np.ndarray, rows: tuple[int, int], target: tuple[int, int], samples: int
) -> np.ndarray:
    """Average the rotated interpolant of a map over texels of the same grid.

    Each texel is divided into ``samples`` x ``samples`` parts, weighted by their solid angles, and the map is
    interpolated at their middles as Mitsuba interpolates it.

    Parameters
    ----------
    image : ndarray (rows, W, 3) float32
        Rows of a map; black elsewhere.
    matrix : ndarray (3, 3)
        Of :func:`rotation`.
    rows : (int, int)
        First row of the image in its map, and the rows of the map.
    target : (int, int)
        Rows of the rotated map to return: the first, and the first that is not.
    samples : int
        Points along either side of a texel.

    Returns
    -------
    ndarray (target rows, W, 3) float32
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


# ---- Blur --------------------------------------------------------------------------------------------------


def blur(radiance: np.ndarray, degrees: float) -> np.ndarray:
    """Blur a map (H, W, 3) on the sphere by exp((cos g - 1) / s^2) of the angle g.

    That is a Gaussian where s, the standard deviation in ``degrees``, is small. With less than a fifth of a
    texel the map is returned as it is.
    Flux, radiance times :func:`.latlong.lookup_solid_angles`, is kept.
    """
    height, width = radiance.shape[:2]
    if degrees < 0.2 * 360 / width:
        return radiance
    across = min(width, max(2 * math.ceil(BLUR_TEXELS * 180 / degrees), 64))
    coarse = radiance
    if across < width:
        coarse = latlong.resize(radiance, across // 2, across)
    flux = latlong.lookup_solid_angles(*coarse.shape[:2])
    blurred = _blurred(coarse, flux, math.radians(degrees))
    result = latlong.resize(blurred, height, width)
    result *= adjustments.flux_ratio(radiance, result).astype(np.float32)
    return result


def _blurred(envmap, omega, sigma):
    """Convolve each row with the kernels of the rows around it, by Fourier transforms along the rows."""
    height, width = envmap.shape[:2]
    theta = np.pi * np.arange(height) / (height - 1)
    around = np.cos(2 * np.pi * np.arange(width) / width)
    reach = math.ceil(BLUR_REACH * sigma * height / np.pi) + 1

    @functools.lru_cache(maxsize=2 * reach + 2)
    def spectrum(row):  # in double precision: the rounding of a sun would show in its row
        return np.fft.rfft(envmap[row].astype(np.float64), axis=0)

    result = np.empty_like(envmap)
    for row in range(height):
        rows = np.flatnonzero(np.abs(theta - theta[row]) <= BLUR_REACH * sigma)
        flat_part = np.cos(theta[rows] - theta[row])[:, None] - 1
        cosine = flat_part + np.sin(theta[row]) * np.sin(theta[rows])[:, None] * (around - 1)
        kernel = omega[rows][:, None] * np.exp(cosine / sigma**2)
        kernel /= kernel.sum()
        transform = np.fft.rfft(kernel, axis=1)
        total = sum(part[:, None] * spectrum(k) for k, part in zip(rows.tolist(), transform, strict=True))
        result[row] = np.fft.irfft(total, width, axis=0)
    return np.maximum(result, 0)
