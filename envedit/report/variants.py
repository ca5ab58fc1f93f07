"""Other explanations of paint than the one that is the result.

Paint is ambiguous: a highlight is gone because the sun is elsewhere, softer, or dimmer. What the search has
found beside the likeliest explanation can be looked at, and gone on from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envedit import config, inputs
from envedit.core.atomic_files import make_folder, write_atomically
from envedit.report import map_files, preview
from envedit.solve import checkpoint, gauss_newton

FOLDER, SHEET = "variants", "variants.png"
"""Where they are written in a run's folder, and what shows them beside each other."""
SPP = 64
"""Samples a pixel of their renderings."""


@dataclass(frozen=True)
class Variant:
    """An explanation of paint, as it is after the few steps by which explanations are compared."""

    name: str  # what was done to the map's lights
    # -2 log evidence, but for a constant that all explanations of a run have: lower is likelier
    evidence: float
    envmap: np.ndarray  # (H, W, 3), its map, in the units of the file that was edited
    render: np.ndarray  # (h, w, 3), mitsuba's rendering of it, linear radiance
    # towards, elsewhere: how far the paint is followed, and the rest changed, as of :func:`.metrics.painted`
    towards: float | None
    elsewhere: float | None
    run: gauss_newton.Run  # where an edit goes on from it

    @property
    def summary(self) -> str:
        """One phrase for a note: what was done, and what it reaches."""
        if self.towards is None:
            return self.name
        return f"{self.name} ({round(100 * self.towards)} % of the painted change)"

    @property
    def measures(self) -> dict:
        """What metrics.json has of it."""
        return {key: getattr(self, key) for key in ("name", "evidence", "towards", "elsewhere")}


def write(
    folder: Path, variants: Sequence[Variant], settings: config.Output, input_map: inputs.InputMap
) -> list[str]:
    """Write the map and the solution of each, numbered from 1, and a sheet; returns warnings.

    ``optimizer.start`` takes a solution, ``1.npz``: an edit then goes on from it. InputError if a file cannot
    be written.
    """
    if not variants:
        return []
    make_folder(folder)
    warnings = []
    for number, one in enumerate(variants, 1):
        warnings += map_files.write_map(settings, folder / str(number), one.envmap, input_map)
        checkpoint.save_solution(folder / f"{number}.npz", one.run)
    sheet = preview.sheet(
        {f"{number}: {one.name}": one.render for number, one in enumerate(variants, 1)},
        {f"{number}: {one.name}": one.envmap for number, one in enumerate(variants, 1)},
        settings.tonemap,
    )
    write_atomically(folder / SHEET, sheet)
    return warnings
