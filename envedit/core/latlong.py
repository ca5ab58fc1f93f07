"""The lat-long texel grid, in one place: directions, solid angles, and Mitsuba's layout of ``envmap.data``.

Frame: the environment emitter's own, +Y up. A direction d looks up

    u = atan2(d_x, -d_z) / 2 pi,   column position  u W - 1/2   (periodic; texel centres),
    v = acos(d_y) / pi,            row position     v (H - 1)   (corner-aligned: row 0 *is* the zenith),

and Mitsuba interpolates bilinearly between the four texels around that position. Two measures follow from it
and both sum to 4 pi over the map: :func:`solid_angles` gives every texel the part of the sphere nearest to
it, which is what area averages use; :func:`lookup_solid_angles` integrates Mitsuba's interpolation weight,
which is what a rendering receives from the texel. With h the row spacing in
radians they differ by a factor 1 + h^2 / 24, and at the poles, per radian of azimuth, the first is h^2 / 8
and the second h^2 / 6.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from envedit.core.errors import InputError
from envedit.core.types import ArrayLike

MIN_HEIGHT, MIN_WIDTH = 3, 2
"""Mitsuba silently resamples anything smaller than this, so that ``envmap.data`` no longer is the image."""
_HALO = ((0, 0), (1, 1), (0, 0))  # columns that ``envmap.data`` repeats on either side


# ---- Directions and positions ------------------------------------------------------------------------------


def directions(height: int, width: int, rows: slice = slice(None)) -> np.ndarray:  # noqa: B008
    """Return unit vectors (H, W, 3) float64 through the texel centres of ``rows``, in the emitter's frame."""
    theta = np.array([math.pi / 2]) if height == 1 else np.pi * np.arange(height) / (height - 1)
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    sin, cos = np.sin(theta), np.cos(theta)
    # sin(pi) is 1e-16 and not 0: the nadir would keep a hint of an azimuth.
    if height > 1:
        sin[-1] = 0.0
    sin, cos = sin[rows], cos[rows]
    d = np.empty((len(sin), width, 3))
    d[..., 0] = sin[:, None] * np.sin(phi)
    d[..., 1] = cos[:, None]
    d[..., 2] = -sin[:, None] * np.cos(phi)
    return d


def on_sphere(theta: ArrayLike, phi: ArrayLike) -> np.ndarray:
    """Return directions (..., 3) in the emitter's frame at a colatitude and an azimuth of the map, 2 pi u."""
    sin = np.sin(theta)
    return np.stack(np.broadcast_arrays(sin * np.sin(phi), np.cos(theta), -sin * np.cos(phi)), axis=-1)


def texel_position(d: ArrayLike, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the fractional (row, column) at which Mitsuba looks up directions, arrays (...).

    ``d`` (..., 3) are directions in the emitter's frame, of any positive length. Rows are in [0, H - 1],
    columns in [-1/2, W - 1/2); whole numbers are texel centres.
    """
    d = np.asarray(d, np.float64)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    u = np.arctan2(x, -z) / (2 * np.pi) % 1.0
    u = np.where(u >= 1.0, 0.0, u)  # a tiny negative angle rounds up to exactly one turn
    v = np.arctan2(np.hypot(x, z), y) / np.pi  # acos(y), without its loss of digits near the poles
    return v * (height - 1), u * width - 0.5


# ---- Solid angles ------------------------------------------------------------------------------------------


def row_edges(height: int) -> np.ndarray:
    """Return the borders between rows as v in [0, 1], ``(H + 1,)``.

    Row y covers [(y - 1/2) / (H - 1), (y + 1/2) / (H - 1)] cut to [0, 1], so the two polar rows are half as
    high as the others; a single row covers the sphere.
    """
    if height == 1:
        return np.array([0.0, 1.0])
    return np.clip((np.arange(height + 1) - 0.5) / (height - 1), 0.0, 1.0)


def solid_angles(height: int, width: int) -> np.ndarray:
    """Return the solid angle in steradian of one texel of each row, ``(H,)``; times W they sum to 4 pi."""
    return _caps(row_edges(height)) * (2 * np.pi / width)


def lookup_solid_angles(height: int, width: int) -> np.ndarray:
    """Return what one texel of each row weighs in an integral of the interpolated map, ``(H,)`` steradian.

    With w_r the bilinear weight of row r and h = pi / (H - 1), the integral of w_r over the sphere is
    2 (1 - cos h) / h sin(r h) per radian of azimuth, and 1 - sin(h) / h at the poles. The irradiance a
    rendering receives from a single lit texel is its radiance times this. Times W they sum to 4 pi.
    """
    if height == 1:
        return np.array([4 * np.pi / width])
    h = np.pi / (height - 1)
    weight = np.sin(h * np.arange(height)) * (4 * math.sin(h / 2) ** 2 / h)
    # 1 - sin(h)/h loses its digits for tall maps: beyond a hundred rows its series is exact to double
    # precision.
    weight[[0, -1]] = h**2 / 6 - h**4 / 120 + h**6 / 5040 if h < 0.03 else 1 - math.sin(h) / h
    return weight * (2 * np.pi / width)


def level_weights(height: int, width: int) -> np.ndarray:
    """Return what one texel of each row, of radiance 1, adds to the irradiance of level ground, ``(H,)``."""
    cosine = directions(height, 1)[:, 0, 1]
    return lookup_solid_angles(height, width) * np.maximum(cosine, 0)


def _caps(v):
    """Return cos(pi v[i]) - cos(pi v[i+1]) without cancellation: the solid angle between two v over 2 pi."""
    a, b = np.pi * v[:-1], np.pi * v[1:]
    return 2 * np.sin((a + b) / 2) * np.sin((b - a) / 2)


# ---- Resampling --------------------------------------------------------------------------------------------


def resize(image: ArrayLike, height: int, width: int) -> np.ndarray:
    """Resample a map to another size on the sphere.

    An axis that shrinks is averaged over the area of the sphere that each new texel covers (columns are
    boxes on the circle, rows have the borders of :func:`row_edges`): sum(E * solid_angles) is kept to
    rounding, and a sun of a few texels keeps its flux. An axis that grows is interpolated at the new
    texels' centres, linearly and periodically in the columns: every direction keeps its radiance, the
    energy is kept as closely as a resampled interpolant can. In Mitsuba's measure
    (:func:`lookup_solid_angles`) a constant is exact; a single lit texel of a 256-wide map, doubled or
    quadrupled, gains 0.7 % at a pole, under 0.2 % elsewhere.

    ``image`` (H, W, C) is linear radiance, returned as (height, width, C) float32. A non-finite texel spreads
    to every new texel that covers it: repair first. Sums are accumulated in float64; memory beyond the result
    is one (height, W, C) float64 array.
    """
    image = np.asarray(image)
    old_height, old_width, channels = image.shape
    if (old_height, old_width) == (height, width):
        return image.astype(np.float32)
    # Rows first: they are contiguous, and only the few source rows in use are ever held in float64.
    rows = np.empty((height, old_width, channels))
    for i, (index, weight) in enumerate(_row_weights(old_height, height)):
        rows[i] = np.tensordot(weight, image[index].astype(np.float64), 1)
    result = np.empty((height, width, channels), np.float32)
    for i, (index, weight) in enumerate(_column_weights(old_width, width)):
        result[:, i] = np.einsum("hkc,k->hc", rows[:, index], weight)
    return result


def _row_weights(old: int, new: int) -> Iterator[tuple[slice | list[int], np.ndarray]]:
    """Yield (source rows, weights) for each new row."""
    if new <= old:
        yield from _overlaps(row_edges(old), row_edges(new), _caps)
    else:
        position = np.zeros(new) if old == 1 else np.arange(new) * ((old - 1) / (new - 1))
        for p in position:
            first = min(int(p), max(old - 2, 0))
            yield [first, min(first + 1, old - 1)], np.array([1 - (p - first), p - first])


def _column_weights(old: int, new: int) -> Iterator[tuple[slice | list[int], np.ndarray]]:
    """Yield (source columns, weights) for each new column."""
    if new <= old:
        yield from _overlaps(np.arange(old + 1) / old, np.arange(new + 1) / new, np.diff)
    else:
        for p in (np.arange(new) + 0.5) * (old / new) - 0.5:
            first = math.floor(p)
            yield [first % old, (first + 1) % old], np.array([1 - (p - first), p - first])


def _overlaps(source, target, measure):
    """Yield (slice of source cells, weights that sum to one) for the target cells between borders."""
    for low, high in zip(target[:-1], target[1:], strict=True):
        first = max(np.searchsorted(source, low, "right") - 1, 0)
        last = min(max(np.searchsorted(source, high, "left"), first + 1), len(source) - 1)
        weight = measure(np.clip(source[first : last + 1], low, high))
        yield slice(first, last), weight / weight.sum()


def rotate(image: ArrayLike, degrees: float) -> np.ndarray:
    """Turn a map about the vertical axis; positive degrees move the picture to the left, to smaller columns.

    360 degrees are one width: new(u) = old(u + degrees / 360). A shift by whole texels (to 1e-6) is exactly
    ``np.roll``; any other is interpolated linearly between the two columns, which keeps the sum of every row.

    The result has the dtype of ``image`` (H, W, ...).
    """
    image = np.asarray(image)
    width = image.shape[1]
    shift = math.fmod(degrees, 360.0) / 360.0 * width
    whole = round(shift)
    if abs(shift - whole) < 1e-6:
        return np.roll(image, -whole, axis=1)
    whole = math.floor(shift)
    part = shift - whole
    near, far = np.roll(image, -whole, axis=1), np.roll(image, -whole - 1, axis=1)
    return ((1 - part) * near + part * far).astype(image.dtype)


# ---- Mitsuba's layout --------------------------------------------------------------------------------------


def halo_index(height: int, width: int) -> np.ndarray:
    """Return flat indices ``(H * (W + 2) * 3,)`` uint32 that gather ``envmap.data`` from a flat map.

    The same layout as :func:`to_envmap_data`, for arrays that must stay on the device or be differentiated:
    ``dr.gather(type(env.array), env.array, index)``.
    """
    index = np.arange(height * width * 3, dtype=np.uint32).reshape(height, width, 3)
    return np.pad(index, _HALO, mode="wrap").ravel()


def to_envmap_data(image: ArrayLike) -> np.ndarray:
    """Return ``envmap.data`` of Mitsuba >= 3.9, ``(H, W + 2, 3)`` float32, for a map ``(H, W, 3)``.

    The first column repeats the last texel of each row and the last column the first. Mitsuba does not
    validate the width: an (H, W, 3) tensor would silently be read as W - 2 columns. InputError if the map has
    fewer than 3 rows or 2 columns.
    """
    image = np.asarray(image, np.float32)
    check_envmap_size(*image.shape[:2])
    return np.pad(image, _HALO, mode="wrap")


def from_envmap_data(data: ArrayLike) -> np.ndarray:
    """Return the map ``(H, W, 3)`` float32 held by Mitsuba's ``envmap.data``, ``(H, W + 2, 3)``."""
    return np.ascontiguousarray(np.array(data, np.float32)[:, 1:-1])


def check_envmap_size(height: int, width: int) -> None:
    """Refuse a grid that Mitsuba would silently replace by a larger one, with an InputError."""
    if height < MIN_HEIGHT or width < MIN_WIDTH:
        raise InputError(
            f"an environment map of {width} x {height} texels is too small for Mitsuba: "
            f"use at least {2 * MIN_HEIGHT} x {MIN_HEIGHT}"
        )
