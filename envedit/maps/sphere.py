"""A map blurred on the sphere, which keeps its flux."""

from __future__ import annotations

import functools
import math

import numpy as np

from envedit.core import latlong
from envedit.export import adjustments

BLUR_TEXELS = 3.0
"""Standard deviation of a blur in texels of the grid that it is computed on: finer maps are reduced and
interpolated. Derived: the box and the tent of that add 1/12 and 1/6 to a variance of 9: 1.4 % wider."""
BLUR_REACH = 4.0
"""Standard deviations at which the kernel of a blur ends, at 3e-4 of its peak."""


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
