"""What is seen where the glow of a light has gone: the sky of the same elevation.

Dividing a map by a glow leaves what the glow was not: its own asymmetry, a tint, and clouds whose contrast
was measured beside a light. What is seen there instead (r, c and w of docs/method.md, "Where the sun was")
keeps the texture, at no more than the contrast that it has at this elevation; within a blur of a light's core
it is bloom and no cloud. Level and colour are those of the elevation. Means are weighted by 1 / glow^2, and
by less where it is darker than they are: they describe the sky away from the lights, and no roofs or trees. A
light that has not moved changes nothing, and there is no edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.color import LUMINANCE
from envedit.representations.layers.separation import Light, away_weight, mean_at_elevation, sky_weight

BLUR_DEGREES = 4.0
"""Standard deviation of the blur: what is finer is texture, what is coarser the sky's brightness. Measured:
with 2 and 8 degrees maps whose lights have moved are 0.05 dB better and 0.13 dB worse."""
LEAST_VARIANCE = 1e-12
"""Variance of log luminance that is added before a quotient of two: keeps it finite. Not measured."""


@dataclass(frozen=True)
class BehindGlow:
    """r = offset + slope log(B + faint), which holds at any resolution of the background B."""

    # offset, slope: (rows, W, 3), smooth; slope is c - 1
    offset: np.ndarray
    slope: np.ndarray
    faint: float  # added before logarithms, 1e-6 of the mean radiance

    def log_change(self, background: np.ndarray) -> np.ndarray:
        """Return r of a background (rows, W, 3)."""
        return self.offset + self.slope * np.log(background + self.faint)


def degrees_to_cores(lights: list[Light], shape: tuple[int, int], rows: tuple[int, int]) -> np.ndarray:
    """Return degrees from each texel to the nearest light that has a glow, ``shape``; 0 within its core.

    A core is taken to be a disc of the solid angle of its texels. ``rows`` is as of :func:`behind_glow`.
    """
    first, total = rows
    width = shape[1]
    toward = latlong.directions(total, width, slice(first, first + shape[0]))
    omega = latlong.lookup_solid_angles(total, width)
    glowing = [light for light in lights if light.glow is not None]
    radii = [np.sqrt(omega[first + light.texels // width].sum() / np.pi) for light in glowing]
    if not glowing:
        return np.full(shape, 180.0)
    angles = np.arccos(np.clip(toward @ np.transpose([light.direction for light in glowing]), -1, 1))
    return np.degrees(np.maximum(angles - radii, 0).min(axis=2))


def near_core(away: np.ndarray) -> np.ndarray:
    """Return how near a core is, of degrees to it: 1 within, where texture is bloom and no cloud."""
    return np.exp(-0.5 * np.square(away / BLUR_DEGREES))


def behind_glow(
    background: np.ndarray, glow: np.ndarray, away: np.ndarray, rows: tuple[int, int]
) -> BehindGlow:
    """Predict the sky where the glow has gone.

    ``background`` (rows, W, 3) is linear radiance without lights, ``glow`` the factor by which they
    brightened it, at least 1, ``away`` (rows, W) degrees to the core of the nearest light that has a glow.
    ``rows`` are the first row in the map, and the rows of the map.
    """
    faint = float(max(1e-6 * background.mean(), 1e-30))
    shape = background.shape[:2]
    logs = np.log(background + faint)
    low = _blurred(logs, BLUR_DEGREES, rows)
    texture = np.square((logs - low) @ LUMINANCE)[..., None]
    around = np.maximum(_blurred(texture, 2 * BLUR_DEGREES, rows), 0)  # a cut spectrum rings
    weight = sky_weight(low, away_weight(glow))

    def at_elevation(values):
        mean = mean_at_elevation(values, weight)[:, 0]
        return (_along_rows(shape[0], BLUR_DEGREES, rows[1]) @ mean)[:, None]

    contrast = np.sqrt(np.minimum((at_elevation(texture) + LEAST_VARIANCE) / (around + LEAST_VARIANCE), 1))
    contrast *= 1 - near_core(away)[..., None]
    slope = np.broadcast_to(contrast - 1, background.shape)
    offset = at_elevation(low) - contrast * low
    return BehindGlow(offset.astype(np.float32), slope.astype(np.float32), faint)


def _blurred(values, degrees, rows):
    """Blur (rows, W, n) by a Gaussian on the sphere, along columns and then along rows."""
    height, width, _ = values.shape
    sine = np.sin(np.pi * (np.arange(height) + rows[0]) / max(rows[1] - 1, 1))
    # At a pole columns meet: there the blur goes all around.
    sd = np.radians(degrees) / np.maximum(sine, np.radians(degrees) / 2)
    cycles = np.arange(width // 2 + 1)
    passed = np.exp(-0.5 * np.square(sd[:, None] * cycles))
    around = np.fft.irfft(np.fft.rfft(values, axis=1) * passed[..., None], width, axis=1)
    # By solid angle: rows near a pole are small.
    mean = _along_rows(height, degrees, rows[1]) * np.maximum(sine, 0.5 * np.pi / max(rows[1], 2))
    mean /= mean.sum(axis=1, keepdims=True)
    return (mean @ around.reshape(height, -1)).reshape(values.shape)


def _along_rows(height, degrees, total):
    """Return a Gaussian along rows, (rows, rows); each of its rows sums to 1."""
    apart = np.subtract.outer(np.arange(height), np.arange(height)) * (180 / max(total - 1, 1))
    mean = np.exp(-0.5 * np.square(apart / degrees))
    return mean / mean.sum(axis=1, keepdims=True)
