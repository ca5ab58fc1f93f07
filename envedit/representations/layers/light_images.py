"""Images on lights that are added (``[[input.lights]] image``): a window, a softbox, a sky of another map."""

from __future__ import annotations

import functools
import math
import os

import numpy as np

from envedit.core import resampling
from envedit.core.color import LUMINANCE
from envedit.core.errors import InputError
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.images import images

MOST_PIXELS = 1024
"""Pixels of the longer side that are kept: of a light half a sphere wide they are 0.18 degrees."""

DARKEST = np.float32(1e-6)
"""Least radiance over the image's brightest: a light of few texels, in its dark part, keeps its flux."""


def shares(path: str) -> tuple[float, float]:
    """Return the width and the height of an image over the longer of them; errors as of :func:`sampled`."""
    height, width = _levels(path)[0].shape[:2]
    return width / max(width, height), height / max(width, height)


def sampled(path: str, u: np.ndarray, v: np.ndarray, spacing: float) -> np.ndarray:
    """Interpolate an image at places, from averages of as many pixels as lie between two of them.

    ``path`` is a file that :func:`.images.read` reads. ``u`` and ``v`` (...) are shares of its width from the
    left and of its height from the top; beyond its border it goes on. ``spacing`` of the places is a share of
    the longer side. Returns (..., 3) float32, linear radiance over the image's largest luminance. InputError
    if the file cannot be read, is black, or has a value that is no radiance.
    """
    levels = _levels(path)
    pixels = max(levels[0].shape[:2])
    level = levels[min(max(math.ceil(math.log2(max(spacing * pixels, 1))), 0), len(levels) - 1)]
    height, width, _ = level.shape
    return resampling.bilinear(level, v * height - 0.5, u * width - 0.5).astype(np.float32)


def _levels(path):
    """Return an image at full, half, quarter size ..., to one pixel."""
    try:
        return _read(path, os.stat(path).st_mtime_ns)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


@functools.lru_cache(maxsize=8)
def _read(path, _changed):
    image, _ = images.read(path)
    require_radiance(image, path, brightest=BRIGHTEST)
    image = _smaller(image, max(1.0, max(image.shape[:2]) / MOST_PIXELS))
    brightest = float((image @ np.array(LUMINANCE, np.float32)).max())
    if not brightest > 0:
        raise InputError(f"{path}: is black: a light with it has no colour")
    levels = [np.maximum(image / np.float32(brightest), DARKEST)]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_smaller(levels[-1], 2))
    return levels


def _smaller(image, factor):
    height, width, _ = image.shape
    return resampling.fit(image, height=math.ceil(height / factor), width=math.ceil(width / factor))
