"""Adjustments of a map alone: rotation, exposure, colour, lights, blur, in this order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit import config
from envedit.core.color import luminance
from envedit.core.rotations import Orientation
from envedit.core.rows import bands
from envedit.export import adjustments
from envedit.maps import sphere
from envedit.representations.layers.oriented import oriented


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
        radiance = sphere.blur(radiance, how.blur)
        notes.append(f"blurred by {how.blur:g} degrees")
    return radiance, notes


def saturated(radiance: np.ndarray, factor: float) -> np.ndarray:
    """Scale the distance of colours (H, W, 3) from grey: max(L + s (E - L), 0) of luminance L, float32."""
    result = np.empty_like(radiance)
    for rows in bands(len(radiance)):
        grey = luminance(radiance[rows])[..., None]
        result[rows] = np.maximum(grey + factor * (radiance[rows] - grey), 0)
    return result
