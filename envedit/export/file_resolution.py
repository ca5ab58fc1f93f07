"""The edit of a run, carried from working resolution to that of its input's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.rows import Rows
from envedit.export import adjustments, full_resolution
from envedit.images import map_regions
from envedit.representations import Layers, Representation
from envedit.representations.layers import placed_lights
from envedit.representations.layers.oriented import oriented, oriented_share

if TYPE_CHECKING:
    from envedit import results


@dataclass(frozen=True)
class Found:
    """The active rows' representation and parameters; ``free`` as for :func:`.full_resolution.carry`.

    ``turn_degrees`` is by how much the map was turned before (:func:`.latlong.rotate`), ``edited`` the edited
    map before ``level``, a factor of all of it, and its adjustments.
    """

    representation: Representation
    params: dict[str, Any]
    free: np.ndarray | None
    turn_degrees: float = 0.0
    edited: np.ndarray | None = None
    level: float = 1.0


def at_full_resolution(result: results.Result) -> np.ndarray | None:
    """Carry a result to the resolution of its input's file, in its units; None where that has no more texels.

    InputError or NumericalError if the file cannot be read any more, or the carried map is not finite.
    """
    settings = result.settings
    if result.input_map.size[0] <= settings.input.width:
        return None
    own = result.input_map.at_file_size(settings.input)
    if result.found is None:
        full = _by_hand(settings.input, result.input_map, own)
        edited = full.radiance
        turn_degrees = 0.0
    else:
        full, edited = carried(settings.input, result.input_map, own, result.found, result.maps["initial"])
        turn_degrees = result.found.turn_degrees
    adjusted, _ = adjustments.adjust(edited, settings.lights, settings.output, own.scale)
    return full.as_stored(adjusted, turn_degrees)


def carried(
    settings: config.Input,
    input_map: inputs.InputMap,
    own: inputs.InputMap,
    solution: Found,
    initial: np.ndarray,
) -> tuple[inputs.InputMap, np.ndarray]:
    """Carry an edit to the map as its file has it.

    ``input_map`` is the map at working size, ``own`` as the file has it, and ``initial`` (h, w, 3) the
    working map that was edited. Returns the map with its lights placed and its regions changed, as
    ``settings`` have them, and its edit (H, W, 3), radiance before adjustments.
    """
    if input_map.placed is not None:  # lights that stand in regions that are kept are locked
        kept = map_regions.kept(settings.regions, *input_map.placed.envmap.shape[:2])
        settings = replace(settings, lights=input_map.placed.locking(settings.lights, kept))
    full = _by_hand(settings, input_map, own)
    before = latlong.rotate(initial, solution.turn_degrees)
    source = latlong.rotate(full.radiance, solution.turn_degrees)
    rows = inputs.active_rows(settings.rows, before.shape[0])

    # ---- Locked lights and regions, which stay as they are
    kept = map_regions.kept(settings.regions, *source.shape[:2])
    original = source
    locked = None
    others = placed_lights.without_locked(settings.lights)
    if others is not None and isinstance(solution.representation, Layers):
        dark = _by_hand(replace(settings, lights=others), input_map, own).radiance
        locked = np.clip(source - dark, 0, source)
        source = source - locked

    # ---- The rest, edited
    edited = full_resolution.carry(
        solution.representation, solution.params, before, solution.edited, source, rows, solution.free
    )
    edited = edited if locked is None else edited + locked
    edited = edited if solution.level == 1 else edited * np.float32(solution.level)
    if kept is not None:
        kept = latlong.rotate(oriented_share(kept, settings.orientation), solution.turn_degrees)
        edited = map_regions.blended(edited, original, kept)
    return full, edited


def _by_hand(settings: config.Input, input_map: inputs.InputMap, own: inputs.InputMap) -> inputs.InputMap:
    """Place lights, change regions, and rotate the map as the file has it, as at working size."""
    full = own
    if input_map.placed is not None:
        placed = input_map.placed
        moved = full.radiance
        if any("light" in light for light in settings.lights):
            params = placed.params(settings.lights)
            rows = Rows.of(len(placed.envmap))
            moved = full_resolution.carry(placed.layers, params, placed.envmap, placed.envmap, moved, rows)
        moved = placed_lights.add(moved, [light for light in settings.lights if "light" not in light])
        full = replace(full, stored=full.as_stored(moved))
    if settings.regions:
        changed = map_regions.changed(full.radiance, settings.regions)
        full = replace(full, stored=full.as_stored(changed))
    return replace(full, stored=oriented(full.stored, settings.orientation))
