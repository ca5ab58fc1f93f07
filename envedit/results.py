"""What a run found: maps, renderings, figures, and what the map was decoded from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.rows import Rows
from envedit.export import adjustments, full_resolution
from envedit.representations import Representation
from envedit.representations.layers import placed_lights
from envedit.representations.layers.separation import Separation
from envedit.scene.scene import View
from envedit.solve.feasibility import Reach
from envedit.solve.map_problem import Posterior


@dataclass
class Result:
    """What a run found.

    Attributes
    ----------
    envmap : ndarray (H, W, 3)
        The edited map in the units of its file, which the scene's ``scale`` multiplies; rows outside the
        active ones are the original's, bit for bit, and so are frozen texels but where layers move a light or
        its glow across them.
    renders, maps : dict
        ``initial``, ``target``, ``edited``; linear radiance, of maps as it reaches the scene. Renderings of
        several views stand below each other.
        ``maps["target"]`` is None where it is unknown.
    metrics : dict
        As in metrics.json.
    history : list of dict
        A row an iteration.
    notes, warnings : list of str
        What was chosen automatically; what the user should know.
    views : tuple of View
        Name of each view, and its rows in a rendering.
    lights : dict
        Lights ``before`` and ``after``, of :func:`.light_list.matched`.
    core : ndarray (H, W, 3) float32
        The lights alone in the edited map, radiance that reaches the scene.
    influence : ndarray (H, W), optional
        T' 1, how much each texel adds to the picture; None where the renderer does not know.
    frozen : ndarray of bool (H, W), optional
        Active texels that were kept, as this view does not determine them; None as above.
    separation : separation.Separation, optional
        Lights and background of the active rows, where the representation has them.
    scene : Path, optional
        The scene's file.
    reach : feasibility.Reach, optional
        How much of a painted request any light can do; None where T is not at hand or nothing was painted.
    posterior : gauss_newton.Posterior, optional
        How well the target determines the sky; None where that is not known.
    given : inputs.InputMap, optional
        The map that was edited.
    to_world : ndarray (3, 3), optional
        Rotation from the map's frame to the scene's.
    alpha : ndarray (h, w), optional
        Share of each pixel that sees a surface, where the scene hides what lights it.
    found : Found, optional
        What the map was decoded from, for :func:`at_full_resolution`.
    """

    envmap: np.ndarray
    renders: dict
    maps: dict
    metrics: dict
    history: list
    notes: list[str]
    warnings: list[str]
    views: tuple[View, ...]
    lights: dict[str, list[dict]]
    core: np.ndarray
    influence: np.ndarray | None = None
    frozen: np.ndarray | None = None
    separation: Separation | None = None
    scene: Path | None = None
    reach: Reach | None = None
    given: inputs.InputMap | None = None
    to_world: np.ndarray | None = None
    alpha: np.ndarray | None = None
    found: Found | None = None
    posterior: Posterior | None = None

    @property
    def render(self) -> np.ndarray:
        """The rendering under the edited map, by Mitsuba with fresh samples."""
        return self.renders["edited"]


@dataclass(frozen=True)
class Found:
    """The active rows' representation and parameters; ``free`` as for :func:`.full_resolution.carry`.

    ``turn_degrees`` is by how much the map was turned before (:func:`.latlong.rotate`), ``edited`` the edited
    map before its adjustments.
    """

    representation: Representation
    params: dict
    first_row: int
    free: np.ndarray | None
    turn_degrees: float = 0.0
    edited: np.ndarray | None = None


def at_full_resolution(settings: config.Config, result: Result) -> np.ndarray | None:
    """Carry a result to the resolution of its input's file, in its units; None where that has no more texels.

    Raises
    ------
    InputError, NumericalError
        If the file cannot be read any more, or the carried map is not finite.
    """
    if result.given.size[0] <= settings.input.width:
        return None
    full, found = _by_hand(settings.input, result.given), result.found
    adjusted = settings.lights, settings.output, full.scale
    if found is None:
        return full.as_stored(adjustments.adjust(full.radiance, *adjusted)[0])
    before = latlong.rotate(result.maps["initial"], found.turn_degrees)
    source = latlong.rotate(full.radiance, found.turn_degrees)
    rows = inputs.active_rows(settings.input.rows, before.shape[0])
    edited = found.edited
    carried = full_resolution.carry(
        found.representation, found.params, before, edited, source, rows, found.free
    )
    return full.as_stored(adjustments.adjust(carried, *adjusted)[0], found.turn_degrees)


def _by_hand(settings, given):
    """Read a map at its file's size, and place and turn its lights as it was done at working size."""
    full = given.at_file_size(settings.repair)
    if given.placed is not None:
        own = given.placed
        before, rows = own.envmap, Rows.of(len(own.envmap))
        moved = full.radiance
        if any("light" in light for light in settings.lights):
            moved = full_resolution.carry(
                own.layers, own.params(settings.lights), before, before, moved, rows
            )
        moved = placed_lights.add(moved, [light for light in settings.lights if "light" not in light])
        full = replace(full, stored=full.as_stored(moved))
    return replace(full, stored=latlong.rotate(full.stored, settings.rotate_degrees))
