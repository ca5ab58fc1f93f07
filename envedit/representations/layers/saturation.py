r"""How saturated the colours of a sky are: one number for all of it, with its luminance as it is.

With L the luminance of a texel's radiance E, and c = E / L,

    E_k = L b^k / lum(b^k),    b = c + (1 - k) VEIL (1 - c)

k = 0 is a grey sky, 1 the sky as it is; b, as a channel that is black has no logarithm. A smooth gain cannot
do that: what takes the blue from a sky makes the white clouds in it orange.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from envedit.representations.layers.gain import VEIL

LEAST = 1e-4
"""Least b, where k is near 1: keeps logarithms finite. Not measured."""


def saturated(radiance: mi.Color3f, exponent: mi.Float) -> mi.Color3f:
    """Return E_k of radiance, k = ``exponent``."""
    light = mi.luminance(radiance)
    chroma = radiance / dr.maximum(light, 1e-36)
    chroma += (1 - exponent) * VEIL * (1 - chroma)
    # The derivative of a channel that is black at k = 1 is that by a smaller k.
    chroma = dr.replace_grad(dr.maximum(chroma, LEAST), chroma)
    chroma = dr.exp(exponent * dr.log(chroma))
    result = chroma * (light / mi.luminance(chroma))
    return dr.replace_grad(dr.select(exponent == 1, radiance, result), result)  # to the bit
