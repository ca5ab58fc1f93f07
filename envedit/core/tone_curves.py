"""Tone curves of cameras and programs: from exposed linear Rec. 709 radiance to display values in [0, 1].

Every curve is monotone in each channel, between two matrices that mix channels (AgX) or without any. A curve
is undone by a table of its values: what is white in a channel comes back as the radiance where the curve
ends.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from envedit.core.color import linear_to_srgb

LOWEST, HIGHEST = 2.0**-14, 2.0**8
"""Exposed radiance that a table spans, beside 0."""
_STEPS = 4096


@dataclass(frozen=True)
class ToneCurve:
    """A tone curve."""

    by_channel: Callable[[np.ndarray], np.ndarray]  # display values of exposed radiance (...), not falling
    # Matrix (3, 3) that a colour is multiplied by before the curve; its inverse is applied after it
    mixed: tuple[tuple[float, ...], ...] | None = None

    def shown(self, radiance: np.ndarray) -> np.ndarray:
        """Return display values (..., 3) of exposed radiance (..., 3)."""
        if self.mixed is None:
            return np.clip(self.by_channel(np.maximum(radiance, 0)), 0, 1)
        matrix = np.array(self.mixed)
        display = self.by_channel(np.maximum(radiance @ matrix.T, 0))
        return np.clip(display @ np.linalg.inv(matrix).T, 0, 1)

    def exposed(self, display: np.ndarray) -> np.ndarray:
        """Return exposed radiance (..., 3) of display values (..., 3) in [0, 1]."""
        radiance, values = self._table
        if self.mixed is None:
            return np.interp(display, values, radiance)
        matrix = np.array(self.mixed)
        found = np.interp(display @ matrix.T, values, radiance)
        return np.maximum(found @ np.linalg.inv(matrix).T, 0)

    @functools.cached_property
    def _table(self):
        """Radiance and display values, both rising, of which the first are 0."""
        radiance = np.append(0.0, np.geomspace(LOWEST, HIGHEST, _STEPS))
        values = np.clip(self.by_channel(radiance), 0, 1)
        rising = np.append(True, np.diff(np.maximum.accumulate(values)) > 0)
        return radiance[rising], values[rising]


def _hable(x):
    """Hable's curve of *Uncharted 2* (2010), which is 1 at an exposed radiance of 11.2 / 2."""

    def shape(v):
        return (v * (0.15 * v + 0.05) + 0.004) / (v * (0.15 * v + 0.5) + 0.06) - 0.02 / 0.3

    return linear_to_srgb(shape(2 * x) / shape(11.2))


def _aces(x):
    """Narkowicz's fit (2015) of the ACES reference rendering transform for sRGB displays."""
    return linear_to_srgb(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14))


_AGX_STOPS = -12.47393, 4.026069
_AGX_CONTRAST = 15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232


def _agx(x):
    """Wrensch's polynomial (2023) for the default contrast of Sobotka's AgX."""
    low, high = _AGX_STOPS
    stops = np.log2(np.maximum(x, 2.0**low))
    return np.polyval(_AGX_CONTRAST, np.clip((stops - low) / (high - low), 0, 1))


_AGX_INSET = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)

TONE_CURVES = {
    "srgb": ToneCurve(linear_to_srgb),
    "reinhard": ToneCurve(lambda x: linear_to_srgb(x / (1 + x))),
    "filmic": ToneCurve(_hable),
    "aces": ToneCurve(_aces),
    "agx": ToneCurve(_agx, _AGX_INSET),
}
"""Curves by name: that of sRGB alone, x / (1 + x) before it, Hable's, Narkowicz's, and AgX."""
