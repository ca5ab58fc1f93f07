"""The edit of a run, carried from working resolution to that of its input's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.rows import Rows
from envedit.export import adjustments, full_resolution
from envedit.representations import Representation
from envedit.representations.layers import placed_lights

if TYPE_CHECKING:
    from envedit import results


@dataclass(frozen=True)
class Found:
    """The active rows' representation and parameters; ``free`` as for :func:`.full_resolution.carry`.

    ``turn_degrees`` is by how much the map was turned before (:func:`.latlong.rotate`), ``edited`` the edited
    map before its adjustments.
    """

    representation: Representation
    params: dict[str, Any]
    free: np.ndarray | None
    turn_degrees: float = 0.0
    edited: np.ndarray | None = None


def at_full_resolution(settings: config.Config, result: results.Result) -> np.ndarray | None:
    """Carry a result to the resolution of its input's file, in its units; None where that has no more texels.

    Raises
    ------
    InputError, NumericalError
        If the file cannot be read any more, or the carried map is not finite.
    """
    if result.given.size[0] <= settings.input.width:
        return None
    full = _by_hand(settings.input, result.given)
    solution = result.found
    if solution is None:
        adjusted, _ = adjustments.adjust(full.radiance, settings.lights, settings.output, full.scale)
        return full.as_stored(adjusted)
    before = latlong.rotate(result.maps["initial"], solution.turn_degrees)
    source = latlong.rotate(full.radiance, solution.turn_degrees)
    rows = inputs.active_rows(settings.input.rows, before.shape[0])
    edited = solution.edited
    carried = full_resolution.carry(
        solution.representation, solution.params, before, edited, source, rows, solution.free
    )
    adjusted, _ = adjustments.adjust(carried, settings.lights, settings.output, full.scale)
    return full.as_stored(adjusted, solution.turn_degrees)


def _by_hand(settings: config.Input, input_map: inputs.InputMap) -> inputs.InputMap:
    """Read a map at its file's size, and place and turn its lights as it was done at working size."""
    full = input_map.at_file_size(settings)
    if input_map.placed is not None:
        own = input_map.placed
        before = own.envmap
        rows = Rows.of(len(own.envmap))
        moved = full.radiance
        if any("light" in light for light in settings.lights):
            moved = full_resolution.carry(
                own.layers, own.params(settings.lights), before, before, moved, rows
            )
        moved = placed_lights.add(moved, [light for light in settings.lights if "light" not in light])
        full = replace(full, stored=full.as_stored(moved))
    return replace(full, stored=latlong.rotate(full.stored, settings.rotate_degrees))
