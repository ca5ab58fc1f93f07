"""That an edit leaves the sky as white as it was.

Paint that asks for more light than lights give is followed best by a sky that turns white: around a light
that is added, in clouds beside a sun that moves. A photograph with so much more white would be another
photograph. So the share s(E) of the sky's solid angle that is white is one more statement of a painted edit,
as the mean of what was not painted is (``likelihood.py``), of whose pixels u is the share:

    3 N rho_1(q),    q = sqrt(u) max(0, s(E) - s(E_0)) / k,

free where less is white, linear where more than k is, and nothing where all is painted, as a brighter
picture has a brighter sky. k is KNOWN, or two texels if they are more: a light is at least one. A texel
counts by its darkest channel m, as m^p / (1 + m^p): half where it is as bright as white.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.solve.likelihood import STATEMENTS, huber

KNOWN = 0.02
"""Share of the sky that may turn white before it counts fully."""
SHARPNESS = 12
"""p: texels count by 1 to 99 % where they have 0.68 to 1.5 times the radiance of white."""
LIMIT = 100.0
"""Radiance beyond which a texel is white and no more."""


@dataclass(frozen=True)
class WhiteSky:
    """The statement of one original map.

    ``share`` is s(E_0), ``per_share`` sqrt(u) / k; ``solid_angle`` (rows, 1) that of a texel of the upper
    half, of which it is 1.
    """

    solid_angle: np.ndarray
    share: float
    per_share: float

    @classmethod
    def of(cls, envmap: np.ndarray, unpainted: float) -> WhiteSky:
        """Return that of an original (H, W, 3), where a share of the picture was not painted."""
        height, width, _ = envmap.shape
        solid_angle = latlong.solid_angles(height, width)[: max(1, height // 2), None]
        solid_angle = solid_angle / (width * solid_angle.sum())
        known = max(KNOWN, 2 * float(solid_angle.max()))
        return cls(solid_angle, _share(envmap, solid_angle), np.sqrt(unpainted) / known)

    def loss(self, edited: np.ndarray) -> float:
        """Return the formula above for an edited map (H, W, 3)."""
        return 3 * STATEMENTS * float(huber(np.maximum(self._size(edited), 0), 1.0))

    def linear(self, edited: np.ndarray, bounded: bool = False) -> tuple[np.ndarray, float]:
        """Return a slope by texels (H, W, 3), and a value whose square has the gradient of :meth:`loss`.

        Both are 0 where no more is white, but if ``bounded``: then q counts below 0 as well, for steps that
        would lead beyond.
        """
        size = self._size(edited) if bounded else max(0.0, self._size(edited))
        scale = float(np.sqrt(3 * STATEMENTS / max(1.0, size)))
        slope = np.zeros(edited.shape, np.float32)
        if size > 0 or bounded:
            sky = edited[: len(self.solid_angle)]
            darkest = sky.argmin(axis=2)[..., None]
            radiance = np.clip(np.take_along_axis(sky, darkest, axis=2).astype(np.float64), 1 / LIMIT, LIMIT)
            white = radiance**SHARPNESS
            by_radiance = SHARPNESS * white / (radiance * (1 + white) ** 2)
            change = scale * self.per_share * self.solid_angle[..., None] * by_radiance
            np.put_along_axis(slope[: len(sky)], darkest, change, axis=2)
        return slope, scale * size

    def _size(self, edited):
        """Return q, negative where less is white."""
        return float(self.per_share * (_share(edited, self.solid_angle) - self.share))


def _share(envmap, solid_angle):
    """Return s, the share of the sky that is white."""
    darkest = envmap[: len(solid_angle)].min(axis=2).astype(np.float64)
    white = np.clip(darkest, 1 / LIMIT, LIMIT) ** SHARPNESS
    return float((solid_angle * white / (1 + white)).sum())
