r"""How saturated the colours of a sky are: one number for all of it, with its luminance as it is.

With L the luminance of a texel's radiance E, and c = E / L,

    E_k = L c^k / lum(c^k)

k = 0 is a grey sky, 1 the sky as it is. A smooth gain cannot do that: what takes the blue from a sky makes
the white clouds in it orange.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

LEAST = 1e-4
"""Least c: a channel that is black has no logarithm."""


def saturated(radiance: mi.Color3f, exponent: mi.Float) -> mi.Color3f:
    """Return E_k of radiance, k = ``exponent``."""
    light = mi.luminance(radiance)
    chroma = dr.exp(exponent * dr.log(dr.maximum(radiance / dr.maximum(light, 1e-36), LEAST)))
    return chroma * (light / mi.luminance(chroma))
