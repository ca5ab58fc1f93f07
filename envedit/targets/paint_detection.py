"""Where a picture differs from the rendering that it was painted on, beyond what its file format does."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from envedit.core.types import Info

FLOAT_TOLERANCE = {"exr": 1e-3, "hdr": 1e-2}
"""Of a pixel's brightest channel: half floats round by 0.0005, shared exponents by up to 0.008."""
CODE_TOLERANCE = {255: 1.5, 65535: 32.0}
"""In steps: an editor may cut where we round, or compute with 15 bits; 32 are an eighth of an 8-bit step."""
JPEG_FLOOR = 3.0
"""In steps of 255, for encoders that do not round as ours does; see :func:`_painted_jpeg`."""
OVERSHOOT = 0.125
"""Of the local range: resampling a step rings by up to 0.07 of it (bicubic), or 0.12 (Lanczos of 3 lobes)."""
JPEG_SHARE = 1 / 3
"""A difference below this share of the largest within two pixels is colour that bled across an edge."""


def differs(values: np.ndarray, before: np.ndarray, info: Info, top: int, spread: int = 0) -> np.ndarray:
    """Return where (h, w) a picture was painted.

    ``values`` and ``before`` (h, w, 3) float64 are the picture, and what it was painted on: linear radiance
    of a float file, else display values in [0, 1]. ``info`` is of :func:`envedit.images.images.read_stored`,
    ``top`` the largest code of the file, 255 or 65535, not used for float files. Over ``spread`` pixels
    resampling has mixed the values: one within the range that ``before`` has so near, or beyond it by
    :data:`OVERSHOOT`, is not painted.
    """
    if spread:
        planes = np.moveaxis(before, 2, 0)
        low = -np.stack([_largest(-plane, spread) for plane in planes], axis=2)
        high = np.stack([_largest(plane, spread) for plane in planes], axis=2)
        beyond = OVERSHOOT * (high - low)
        before = np.clip(values, low - beyond, high + beyond)
    if info["hdr"]:
        room = FLOAT_TOLERANCE[info["format"]] * before.max(axis=2, keepdims=True) + 1e-7
        same = (np.abs(values - before) <= room) | (np.minimum(values, before) >= 65504)
        return ~same.all(axis=2)
    if info["format"] == "jpeg":
        return _painted_jpeg(values * 255, np.rint(before * 255), info["quality"])
    return np.abs(values - before).max(axis=2) * top > CODE_TOLERANCE[top]


# ---- JPEG --------------------------------------------------------------------------------------------------


def _painted_jpeg(codes, before, quality):
    """Return where (h, w) a JPEG was painted.

    Where there is no paint, the file shows the rendering that was painted on, compressed as the file is.
    Paint adds edges, so the rendering with the paint found is compressed as well, and what its noise explains
    is not paint.
    """
    off = np.abs(codes - before).max(axis=2)
    bled = JPEG_SHARE * _largest(off)
    off_jpeg = np.minimum(off, np.abs(codes - _compressed(before, quality)).max(axis=2))
    painted = off_jpeg > np.maximum(JPEG_FLOOR, bled)
    mixed = np.where(painted[..., None], codes, before)
    noise = _largest(np.abs(_compressed(mixed, quality) - mixed).max(axis=2) * ~painted)
    return _opened(painted & (off > np.maximum(JPEG_FLOOR + noise, bled)))


def _compressed(codes, quality):
    """Return the codes (h, w, 3) in [0, 255] as a JPEG of that quality gives them back."""
    stream, kind = mi.MemoryStream(), mi.Bitmap.FileFormat.JPEG
    mi.Bitmap(np.clip(np.rint(codes), 0, 255).astype(np.uint8)).write(stream, kind, quality)
    stream.seek(0)
    return np.array(mi.Bitmap(stream, kind)).astype(np.float64)


def _largest(values, reach=2):
    """Return the largest value (h, w) within ``reach`` pixels in rows and columns."""
    for _ in range(2):
        padded = np.pad(values, ((reach, reach), (0, 0)), "edge")
        values = padded[reach : reach + len(values)].T
        for start in range(2 * reach + 1):
            values = np.maximum(values, padded[start : start + values.shape[1]].T)
    return values


def _opened(mask):
    """Keep only what holds 3 x 3 pixels: a stroke keeps its shape, noise goes."""
    core = ~_largest(~mask, 1)
    return _largest(core, 1)
