r"""How saturated the colours of a sky are: one number for all of it, with its luminance as it is.

With L the luminance of a texel's radiance E, and c = E / L,

    E_k = L b^k / lum(b^k),    b = c + (1 - k) VEIL (1 - c)

k = 0 is a grey sky, 1 the sky as it is; b, as a channel that is black has no logarithm. A smooth gain cannot
do that: what takes the blue from a sky makes the white clouds in it orange.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.representations.layers.gain import VEIL

LEAST = 1e-4
"""Least b, where k is near 1."""
FURTHER = 0.05
"""Step of the finite difference by log k."""


def saturated(radiance: mi.Color3f, exponent: mi.Float) -> mi.Color3f:
    """Return E_k of radiance, k = ``exponent``."""
    light = mi.luminance(radiance)
    chroma = radiance / dr.maximum(light, 1e-36)
    chroma += (1 - exponent) * VEIL * (1 - chroma)
    # The derivative of a channel that is black at k = 1 is that by a smaller k.
    chroma = dr.replace_grad(dr.maximum(chroma, LEAST), chroma)
    chroma = dr.exp(exponent * dr.log(chroma))
    made = chroma * (light / mi.luminance(chroma))
    return dr.replace_grad(dr.select(exponent == 1, radiance, made), made)  # to the bit


def by_saturation(
    image: np.ndarray, parts: list[tuple[slice, mi.Color3f]], log: mi.Float
) -> tuple[np.ndarray, np.ndarray]:
    """Return an image (rows, W, 3) with a log saturation, and the derivative by it, a finite difference.

    ``parts`` are rows that have this saturation, and their radiance where it is 0; others stay as they are.
    """
    found, slope = image.copy(), np.zeros_like(image)
    for rows, radiance in parts:
        here, before = (
            dr.ravel(saturated(radiance, dr.exp(k))).numpy().reshape(found[rows].shape)
            for k in (log, log - FURTHER)
        )
        found[rows], slope[rows] = here, (here - before) / np.float32(FURTHER)
    return found, slope
