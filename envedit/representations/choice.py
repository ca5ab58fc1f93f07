"""The representation that a configuration asks for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from envedit import config
from envedit.representations.base import Representation
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
    horizon: Horizon = "free",
) -> Representation:
    """Return the representation that a configuration asks for, of ``rows`` (first, total) of a map.

    ``horizon`` is of layers alone (:class:`.Layers`).
    """
    kind = settings.representation.kind
    if kind == "layers":
        cycles = settings.representation.cycles
        # Towards a rendering an added light may be a haze, or stand where the map has a sun with a glow.
        painted = settings.target.kind in ("image", "strokes")
        return Layers(rows, CYCLES if isinstance(cycles, str) else cycles, horizon, aureoles=painted)
    if kind == "pixels":
        return Pixels()
    if kind == "log-pixels":
        return LogPixels()
    recipe = settings.fit if settings.fit.polish == "always" else fit.unpolished(settings.fit)
    return Siren(settings.representation, recipe, folder, progress, rows)
