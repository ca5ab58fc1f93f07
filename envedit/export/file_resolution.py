"""The edit of a run, carried from working resolution to that of its input's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.rows import Rows
from envedit.export import adjustments, full_resolution
from envedit.representations import Layers, Representation
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
    found, own = result.found, result.given.at_file_size(settings.input)
    adjusted = settings.lights, settings.output, own.scale
    if found is None:
        full = _by_hand(settings.input, result.given, own)
        return full.as_stored(adjustments.adjust(full.radiance, *adjusted)[0])
    full, made = carried(settings.input, result.given, own, found, result.maps["initial"])
    return full.as_stored(adjustments.adjust(made, *adjusted)[0], found.turn_degrees)


def carried(
    settings: config.Input, given: inputs.InputMap, own: inputs.InputMap, found: Found, initial: np.ndarray
) -> tuple[inputs.InputMap, np.ndarray]:
    """Carry an edit to the map as its file has it.

    Parameters
    ----------
    settings : config.Input
        With the lights that were placed by hand.
    given, own : InputMap
        The map at working size, and as the file has it.
    found : Found
        The edit.
    initial : ndarray (h, w, 3)
        The working map that was edited.

    Returns
    -------
    InputMap, ndarray (H, W, 3)
        The map with its lights placed, and its edit, radiance before adjustments.
    """
    full = _by_hand(settings, given, own)
    before = latlong.rotate(initial, found.turn_degrees)
    source = latlong.rotate(full.radiance, found.turn_degrees)
    rows = inputs.active_rows(settings.rows, before.shape[0])
    others = placed_lights.without_locked(settings.lights)
    locked = None
    if others is not None and isinstance(found.representation, Layers):
        dark = _by_hand(replace(settings, lights=others), given, own).radiance
        locked = np.clip(source - dark, 0, source)
        source = source - locked
    edited = found.edited
    made = full_resolution.carry(
        found.representation, found.params, before, edited, source, rows, found.free
    )
    return full, made if locked is None else made + locked


def _by_hand(settings: config.Input, given: inputs.InputMap, own: inputs.InputMap) -> inputs.InputMap:
    """Place and turn the lights of the map as the file has it as it was done at working size."""
    full = own
    if given.placed is not None:
        placed = given.placed
        before, rows = placed.envmap, Rows.of(len(placed.envmap))
        moved = full.radiance
        if any("light" in light for light in settings.lights):
            moved = full_resolution.carry(
                placed.layers, placed.params(settings.lights), before, before, moved, rows
            )
        moved = placed_lights.add(moved, [light for light in settings.lights if "light" not in light])
        full = replace(full, stored=full.as_stored(moved))
    return replace(full, stored=latlong.rotate(full.stored, settings.rotate_degrees))
