"""Adjustments of a map alone: rotation, exposure, colour, lights, blur, in this order."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from envedit import config
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.core.rotations import Orientation
from envedit.core.rows import bands
from envedit.export import adjustments
from envedit.representations.layers.oriented import oriented

BLUR_TEXELS = 3.0
"""Standard deviation of a blur in texels of the grid that it is computed on: finer maps are reduced and
interpolated, by which it is 1.4 % wider."""
BLUR_REACH = 4.0
"""Standard deviations at which the kernel of a blur ends, at 3e-4 of its peak."""


@dataclass(frozen=True)
class Adjustments:
    """What is changed of a map; the defaults change nothing."""

    # turn, tilt, horizon: degrees, as of :class:`.Orientation`
    turn: float = 0.0
    tilt: float = 0.0
    horizon: float = 0.0
    exposure: float = 0.0  # stops
    white_balance: float = 0.0  # kelvin of the light that becomes neutral; 0: as it is
    saturation: float = 1.0  # factor on the distance of a colour from grey of its luminance
    soften: float = 0.0  # radius in degrees over which each texel of a light is spread
    max_radiance: float = 0.0  # bound that lights are spread to keep to, in the units of the file; 0: none
    blur: float = 0.0  # standard deviation in degrees, of all of the map


def adjusted(radiance: np.ndarray, how: Adjustments) -> tuple[np.ndarray, list[str]]:
    """Adjust a map; returns one that is not negative, and what was done, with the errors of :func:`.adjust`.

    ``radiance`` (H, W, 3) float32 is linear, in Rec. 709.
    """
    # ---- Orientation
    notes = []
    orientation = Orientation(how.turn, how.tilt, how.horizon)
    radiance = oriented(radiance, orientation)
    if not orientation.level:
        notes.append(f"turned by {how.turn:g}, tilted by {how.tilt:g}, raised by {how.horizon:g} degrees")
    elif how.turn:
        notes.append(f"turned by {how.turn:g} degrees")

    # ---- Exposure, white balance and saturation
    colour = config.Output(exposure=how.exposure, white_balance=how.white_balance)
    radiance, done = adjustments.adjust(radiance, config.Lights(), colour)
    notes += done
    if how.saturation != 1:
        radiance = saturated(radiance, how.saturation)
        notes.append(f"saturation x {how.saturation:g}")

    # ---- Lights, and blur
    lights = config.Lights(soften_degrees=how.soften, max_radiance=how.max_radiance)
    radiance, done = adjustments.adjust(radiance, lights, config.Output())
    notes += done
    if how.blur:
        radiance = blur(radiance, how.blur)
        notes.append(f"blurred by {how.blur:g} degrees")
    return radiance, notes


def saturated(radiance: np.ndarray, factor: float) -> np.ndarray:
    """Scale the distance of colours (H, W, 3) from grey: max(L + s (E - L), 0) of luminance L, float32."""
    result = np.empty_like(radiance)
    for rows in bands(len(radiance)):
        grey = luminance(radiance[rows])[..., None]
        result[rows] = np.maximum(grey + factor * (radiance[rows] - grey), 0)
    return result


def blur(radiance: np.ndarray, degrees: float) -> np.ndarray:
    """Blur a map (H, W, 3) on the sphere by exp((cos g - 1) / s^2) of the angle g.

    That is a Gaussian where s, the standard deviation in ``degrees``, is small. Flux, radiance times
    :func:`.latlong.lookup_solid_angles`, is kept; below a fifth of a texel the map itself is returned.
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
