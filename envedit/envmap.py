"""What the optimiser's parameters are: representations of the part of a map that is edited.

All share one interface, so that the edit loop knows none of them:

* ``encode(image, seed) -> params``: a flat dict name -> tensor that reproduces the image (H, W, 3) as well
  as the representation can;
* ``decode(params) -> (H, W, 3)``: linear radiance, finite and not negative, differentiable in the parameters;
* ``lr``: the learning rate that suits its parameters.

``encode`` refuses what is not radiance, and what it could not give back, with an InputError.
``layers.Layers`` represents the edit and not the map; the others are here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from . import config, fit
from .device import tensor
from .gain import CYCLES
from .health import BRIGHTEST, require_radiance
from .layers import Layers

Params = dict[str, "mi.TensorXf"]


def _not_negative(radiance):
    """Clip below at zero, but keep the slope: with the clip's, a black texel would stay black for good."""
    return dr.replace_grad(dr.maximum(radiance, 0), radiance)


class Pixels:
    """Radiance itself, one parameter a texel and channel; the paper's baseline.

    Negative parameters decode to black.
    """

    lr = 0.02

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Store the image; ``seed`` is not used."""
        require_radiance(image, "pixels")
        return {"radiance": tensor(image)}

    def decode(self, params: Params) -> mi.TensorXf:
        """Return the stored radiance, clipped below at zero."""
        return _not_negative(params["radiance"])


class LogPixels:
    """log(E + 0.01), one parameter a texel and channel; decoded radiance is bounded by float32's range."""

    lr = 0.01

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Store the logarithms; ``seed`` is not used."""
        require_radiance(image, "log-pixels", brightest=BRIGHTEST)
        logs = np.log(np.asarray(image, np.float64) + fit.EPSILON)
        return {"log_radiance": tensor(logs)}

    def decode(self, params: Params) -> mi.TensorXf:
        """Return exp(x) - 0.01, not below zero; x is held under 80, as float32 would overflow in a sum."""
        return _not_negative(dr.exp(dr.minimum(params["log_radiance"], 80)) - fit.EPSILON)


class Siren:
    """The weights of a SIREN fitted to the image (Eq. 1-3); robust (R-SIREN) when fitted with awp_gamma > 0.

    ``rows`` tells which rows of a map the images are: (first row, rows of the whole map); None: all of it.
    ``fitted`` tells, after :meth:`encode`, how well the network reproduces the image.
    """

    lr = 5e-5

    def __init__(
        self,
        network: config.Representation,
        settings: config.Fit,
        folder: Path | None = None,
        progress: Callable[[int, int, float], None] | None = None,
        rows: tuple[int, int] | None = None,
    ):
        self.network, self.settings, self.folder, self.progress = network, settings, folder, progress
        self.fitted: fit.Fitted | None = None
        self._rows, self._shape, self._points = rows, None, {}

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Fit the network, or take an earlier fit of the same image from disk."""
        require_radiance(image, "siren", (self._rows or (0,))[0], BRIGHTEST)
        self.fitted = fit.fit(
            image, self.network, self.settings, seed, self._rows, folder=self.folder, progress=self.progress
        )
        self._shape, self._points = image.shape[:2], {}
        return {name: tensor(value) for name, value in self.fitted.params.items()}

    def decode(self, params: Params, shape: tuple[int, int] | None = None) -> mi.TensorXf:
        """Evaluate the network at the resolution of the image, or at any other ``shape``."""
        shape = tuple(shape or self._shape)
        if shape not in self._points:
            first, total = self._rows or (0, self._shape[0])
            finer = shape[0] / self._shape[0]
            above, below = (round(n * finer) for n in (first, total - first - self._shape[0]))
            rows = above, above + shape[0] + below
            self._points[shape] = fit.points(self.network, shape, rows)
        normalisation = self.fitted.normalisation
        return fit.evaluate(params, normalisation, self._points[shape], shape, self.network.omega)


def make(settings: config.Config, folder: Path | None = None, progress=None, rows=None):
    """Return the representation that a configuration asks for, of ``rows`` (first, total) of a map."""
    kind = settings.representation.kind
    if kind == "layers":
        cycles = settings.representation.cycles
        return Layers(rows, CYCLES if cycles == "auto" else cycles)
    if kind == "pixels":
        return Pixels()
    if kind == "log-pixels":
        return LogPixels()
    recipe = settings.fit if settings.fit.polish == "always" else fit.unpolished(settings.fit)
    return Siren(settings.representation, recipe, folder, progress, rows)
