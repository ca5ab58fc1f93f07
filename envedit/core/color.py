"""Luminance, and the curves between linear radiance and what a display shows.

Everything here is numpy on arrays of any shape. The losses take their luminance weights from here.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from envedit.core.errors import ConfigError
from envedit.core.types import ArrayLike

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Rec.709 weights of red, green and blue (Eq. 7)."""
NOT_WHITE = 0.95
"""Share of the pixels of a picture that are not shown white, where it is exposed to be looked at."""

AXES = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Luminance, blue-amber and green-magenta, as unit vectors of log RGB."""


def luminance(image: ArrayLike) -> np.ndarray:
    """Return Rec.709 luminance float64 ``(...)`` of radiance ``(..., 3)``: 0.2126 R + 0.7152 G + 0.0722 B."""
    image = np.asarray(image)
    r, g, b = (np.float64(w) for w in LUMINANCE)  # float64, so that 3e38 does not overflow
    return r * image[..., 0] + g * image[..., 1] + b * image[..., 2]


def brightest_shown(image: ArrayLike) -> float:
    """Return the luminance that :data:`NOT_WHITE` of the pixels of linear radiance (h, w, 3) are below."""
    return float(np.quantile(luminance(image), NOT_WHITE))


def srgb_to_linear(t: ArrayLike) -> np.ndarray:
    """Undo the sRGB curve (IEC 61966-2-1) of display values in [0, 1]."""
    t = np.clip(t, 0, 1)
    return np.where(t <= 0.04045, t / 12.92, ((t + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(e: ArrayLike) -> np.ndarray:
    """Apply the sRGB curve (IEC 61966-2-1) to linear values, cut to [0, 1]."""
    e = np.clip(e, 0, 1)
    return np.where(e <= 0.0031308, 12.92 * e, 1.055 * e ** (1 / 2.4) - 0.055)


LOG_SCALE = 100.0
"""The "log" tonemap is linear well below 1/100 and logarithmic above; it ends at a radiance of 100."""

REINHARD_WHITE = 1e4
"""Radiance that the "reinhard" tonemap shows as white: a reflected sun is below."""

TONEMAPS: dict[str, Callable] = {
    "gamma": lambda e: np.clip(e, 0, 1) ** (1 / 2.2),
    "srgb": linear_to_srgb,
    "log": lambda e: np.log1p(LOG_SCALE * np.clip(e, 0, LOG_SCALE)) / math.log1p(LOG_SCALE**2),
    "reinhard": lambda e: _reinhard(np.clip(e, 0, REINHARD_WHITE)) ** (1 / 2.2),
    "linear": lambda e: np.clip(e, 0, 1),
}
INVERSE_TONEMAPS: dict[str, Callable] = {
    "gamma": lambda t: np.clip(t, 0, 1) ** 2.2,
    "srgb": srgb_to_linear,
    "log": lambda t: np.expm1(np.clip(t, 0, 1) * math.log1p(LOG_SCALE**2)) / LOG_SCALE,
    "reinhard": lambda t: _reinhard_inverse(np.clip(t, 0, 1) ** 2.2),
    "linear": lambda t: np.clip(t, 0, 1),
}


def _reinhard(e):
    return e / (1 + e) * (1 + 1 / REINHARD_WHITE)


def _reinhard_inverse(t):
    return t / (1 + 1 / REINHARD_WHITE - t)


def tonemap(image: ArrayLike, name: str = "gamma") -> np.ndarray:
    """Map linear radiance to display values in [0, 1], element by element; NaN stays NaN.

    - ``gamma``: clip(E, 0, 1)^(1/2.2)
    - ``srgb``: the sRGB curve of clip(E, 0, 1)
    - ``log``: log(1 + 100 E) / log(1 + 100^2) of clip(E, 0, 100), so that 1 maps to 0.50
    - ``reinhard``: ((1 + 1/W) E / (1 + E))^(1/2.2) of clip(E, 0, W), W = 10^4 (Reinhard et al. 2002, Eq. 3,
      scaled so that W is white), so that 1 maps to 0.73
    - ``linear``: clip(E, 0, 1)

    ConfigError if there is no such tonemap.
    """
    return _named(TONEMAPS, name)(np.asarray(image))


def inverse_tonemap(image: ArrayLike, name: str = "gamma") -> np.ndarray:
    """Map display values back to linear radiance; what :func:`tonemap` has cut does not come back."""
    return _named(INVERSE_TONEMAPS, name)(np.asarray(image))


def _named(table, name):
    if name not in table:
        raise ConfigError(f"unknown tonemap '{name}'; use one of {', '.join(table)}")
    return table[name]
