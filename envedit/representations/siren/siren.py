"""A map as the weights of a network: SIREN, and R-SIREN where it was fitted robustly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.arrays import tensor
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.types import Params
from envedit.representations.siren import fit


@dataclass(eq=False)
class Siren:
    """The weights of a SIREN fitted to the image (Eq. 1-3); robust (R-SIREN) when fitted with awp_gamma > 0.

    ``rows`` says which rows of a map the images are: (first row, rows of the whole map); None: all of it.
    ``fitted`` says, after :meth:`encode`, how well the network reproduces the image. Its radiance is between
    the image's darkest and brightest; ``factor`` (3,) of each channel is what decoded radiance is multiplied
    by.
    """

    network: config.Representation
    settings: config.Fit
    folder: Path | None = None
    progress: Callable[[int, int, float], None] | None = None
    rows: tuple[int, int] | None = None
    fitted: fit.Fitted | None = field(default=None, init=False)
    factor: np.ndarray = field(default_factory=lambda: np.ones(3), init=False)

    lr = 5e-5
    models_edit, separation = False, None

    def encode(self, image: np.ndarray, seed: int = 0) -> Params:
        """Fit the network, or take an earlier fit of the same image from disk."""
        require_radiance(image, "siren", (self.rows or (0,))[0], BRIGHTEST)
        self.fitted = fit.fit(
            image, self.network, self.settings, seed, self.rows, folder=self.folder, progress=self.progress
        )
        self._shape = image.shape[:2]
        self._points = fit.points(self.network, self._shape, self.rows)
        return {name: tensor(value) for name, value in self.fitted.params.items()}

    def decode(self, params: Params) -> mi.TensorXf:
        """Evaluate the network at the resolution of the image."""
        normalisation = self.fitted.normalisation
        radiance = fit.evaluate(params, normalisation, self._points, self._shape, self.network.omega)
        return radiance * tensor(self.factor[None, None])
