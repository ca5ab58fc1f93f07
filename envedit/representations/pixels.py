"""Texels as parameters: radiance, or its logarithm."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.types import Params
from envedit.representations.base import EPSILON, not_negative


class Pixels:
    """Radiance itself, one parameter a texel and channel; the paper's baseline.

    Negative parameters decode to black.
    """

    lr = 0.02
    models_edit, fitted, separation = False, None, None

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Store the image; ``seed`` is not used."""
        require_radiance(image, "pixels")
        return {"radiance": tensor(image)}

    def decode(self, params: Params) -> mi.TensorXf:
        """Return the stored radiance, clipped below at zero."""
        return not_negative(params["radiance"])


class LogPixels:
    """log(E + 0.01), one parameter a texel and channel; decoded radiance is bounded by float32's range."""

    lr = 0.01
    models_edit, fitted, separation = False, None, None

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Store the logarithms; ``seed`` is not used."""
        require_radiance(image, "log-pixels", brightest=BRIGHTEST)
        logs = np.log(np.asarray(image, np.float64) + EPSILON)
        return {"log_radiance": tensor(logs)}

    def decode(self, params: Params) -> mi.TensorXf:
        """Return exp(x) - 0.01, not below zero; x is held under 80, as float32 would overflow in a sum."""
        return not_negative(dr.exp(dr.minimum(params["log_radiance"], 80)) - EPSILON)
