"""The representation that a configuration asks for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from envedit import config
from envedit.core import extensions
from envedit.core.types import Params
from envedit.representations.base import Encoder, Representation
from envedit.representations.layers.gain import CYCLES
from envedit.representations.layers.layers import Horizon, Layers
from envedit.representations.pixels import LogPixels, Pixels
from envedit.representations.siren import fit
from envedit.representations.siren.siren import Siren


def make(
    settings: config.Config,
    folder: Path | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    rows: tuple[int, int] | None = None,
) -> Encoder:
    """Return the representation that a configuration asks for, of ``rows`` (first, total) of a map.

    Not layers, which are made of a map: :func:`encoded`. ConfigError as of :func:`.extensions.load`, of a
    kind that another package adds.
    """
    kind = settings.representation.kind
    if kind == "pixels":
        return Pixels()
    if kind == "log-pixels":
        return LogPixels()
    if kind != "siren":
        encoder: Encoder = extensions.load(extensions.REPRESENTATIONS, kind)(settings, rows)
        return encoder
    recipe = settings.fit if settings.fit.polish == "always" else fit.unpolished(settings.fit)
    return Siren(settings.representation, recipe, folder, progress, rows)


def encoded(
    image: np.ndarray,
    settings: config.Config,
    folder: Path | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    rows: tuple[int, int] | None = None,
    horizon: Horizon = "free",
    fixed: np.ndarray | None = None,
    kept: np.ndarray | None = None,
) -> tuple[Representation, Params]:
    """Return an image (rows, W, 3) in the representation that a configuration asks for, and its parameters.

    ``horizon``, ``fixed`` and ``kept`` are of layers alone (:meth:`.Layers.of`); the others are as for
    :func:`make`.
    """
    if settings.representation.kind != "layers":
        fitted = make(settings, folder, progress, rows)
        return fitted, fitted.encode(image, settings.seed)
    # Towards a rendering an added light may be a haze, or stand where the map has a sun with a glow.
    aureoles = settings.target.painted
    layers = layers_of(image, settings, rows, horizon, aureoles=aureoles, fixed=fixed, kept=kept)
    return layers, layers.start()


def layers_of(
    image: np.ndarray,
    settings: config.Config,
    rows: tuple[int, int] | None = None,
    horizon: Horizon = "free",
    aureoles: bool = True,
    fixed: np.ndarray | None = None,
    kept: np.ndarray | None = None,
) -> Layers:
    """Separate an image (rows, W, 3) as :meth:`.Layers.of` does, with the gain of a configuration."""
    asked = settings.representation.cycles
    cycles = CYCLES if isinstance(asked, str) else asked
    return Layers.of(image, rows, cycles, horizon, aureoles=aureoles, fixed=fixed, kept=kept)
