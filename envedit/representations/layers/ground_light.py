"""The light that falls on photographed ground, by which its brightness follows an edit of the sky.

Ground under an open sky, and a floor under lamps, reflect what falls on them: with H the irradiance of a
horizontal plane from all rows above the horizon and A the albedo, radiance is A H / pi. A does not change
with the light, so that the radiance goes by H / H_0. Whether a map's lower half is lit in that way at all is
measured: pi times its median luminance over H_0 is the albedo of a real surface, or it is not.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE

ALBEDO = 0.02, 1.0
"""Least and greatest albedo of ground that is lit by what is above; outside it keeps its brightness. Measured
(``test_maps_with_ground_have_an_albedo_that_there_is``): four photographs with ground or floor have 0.06 to
0.16, the maps of two public scenes 0.1 and 0.3. Ground that shines itself has more than 1."""
LUMINANCE_SHARE = 0.01
"""Share of its luminance in every channel of H: a ratio to a black channel says nothing. Not measured."""
LEAST_IRRADIANCE = 1e-30
"""Irradiance below which there is none: keeps logarithms finite."""


class GroundLight:
    """Irradiance of a horizontal plane under rows ``above`` the horizon (rows, W, 3), with cores of lights.

    ``ground`` (low, W, 3) are the rows below. ``initial`` (3,) is H_0, ``albedo`` the median of pi times the
    ground's luminance over that of H_0, 0 of black. In H a texel's radiance is multiplied by ``cosine``
    (rows, 1): its solid angle times the cosine.
    """

    def __init__(self, above: np.ndarray, ground: np.ndarray):
        up, width, _ = above.shape
        total = len(above) + len(ground)
        self.cosine = latlong.level_weights(total, width)[:up, None]
        self.initial = self.irradiance(above)
        light = float(self.initial @ LUMINANCE)
        radiance = float(np.median(ground @ LUMINANCE))
        self.albedo = np.pi * radiance / light if light > LEAST_IRRADIANCE else 0.0
        # Products of matrices: their sums, and those of their adjoints, have one order.
        self._rows = tensor(self.cosine.T)
        self._columns = tensor(np.tile(with_luminance(LUMINANCE_SHARE), (width, 1)))
        self._size = up * width * 3
        self._before = self._log_light(tensor(above))

    @property
    def plausible(self) -> bool:
        """Whether the ground's albedo is one that surfaces have."""
        return ALBEDO[0] <= self.albedo <= ALBEDO[1]

    def irradiance(self, above: np.ndarray) -> np.ndarray:
        """Return H (3,) under rows above the horizon (rows, W, 3)."""
        return np.asarray(np.einsum("rwc,rk->c", above, self.cosine, optimize=True), np.float64)

    def log_change(self, sky: mi.TensorXf, core: mi.TensorXf) -> mi.TensorXf:
        """Return log H / H_0, (1, 3), differentiably.

        ``sky`` (rows, W, 3) are the rows above the horizon, without cores of lights, ``core`` (rows or more,
        W, 3) the cores; rows beyond those of the sky do not count.
        """
        core = dr.gather(mi.Float, core.array, dr.arange(mi.UInt32, self._size))
        return self._log_light(mi.TensorXf(sky.array + core, sky.shape)) - self._before

    def _log_light(self, above):
        flat = dr.reshape(above, (above.shape[0], 3 * above.shape[1]))
        light = dr.matmul(dr.matmul(self._rows, flat), self._columns)
        return dr.log(dr.maximum(light, LEAST_IRRADIANCE))


def with_luminance(share: float) -> np.ndarray:
    """Return the matrix (3, 3) by which a row of channels is multiplied to mix its luminance into each."""
    return (1 - share) * np.eye(3) + share * np.asarray(LUMINANCE)[:, None]
