"""The edited map as files that other programs take: in their formats, as sky and lights, and as a scene."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from envedit import config, inputs
from envedit.core import atomic_files, primaries
from envedit.core.errors import InputError
from envedit.export import light_list
from envedit.images import images
from envedit.maps import look_transfer, looks, map_file, usd_scene
from envedit.report import plain_files
from envedit.scene import scene
from envedit.scene.usd import conversion

if TYPE_CHECKING:
    from envedit import results


def write_map(
    settings: config.Output, path: Path, envmap: np.ndarray, input_map: inputs.InputMap
) -> list[str]:
    """Write a map in the format asked for; returns warnings: what half could not hold.

    ``path`` is the file without its ending; ``envmap`` (H, W, 3) has linear values in the units and colours
    of the file that was edited, ``input_map``.
    """
    return map_file.write(
        path.with_suffix(f".{settings.format}"),
        envmap,
        input_map,
        settings.half,
        rec709=settings.format == "hdr",  # as nearly every program reads it
    )


def write_lights(folder: Path, result: results.Result) -> None:
    """Write ``edited_sky.exr``, ``edited_lights.exr`` and ``lights.json``."""
    source = {"source": result.input_map.source}
    space = result.input_map.chromaticities
    sky, lights = light_list.split(result.envmap, result.input_map.as_stored(result.core))
    images.write_exr(folder / "edited_sky.exr", sky, source, chromaticities=space)
    images.write_exr(folder / "edited_lights.exr", lights, source, chromaticities=space)
    plain_files.write_json(folder / "lights.json", result.lights)


def write_look(folder: Path, result: results.Result) -> list[str]:
    """Write ``look.toml``; returns a warning, if the edited map is too bright to be separated."""
    degrees = result.found.turn_degrees if result.found else 0.0
    try:
        look = look_transfer.of_edit(result.maps["initial"], result.maps["edited"], degrees)
    except InputError as error:
        return [f"look.toml is not written: {error}"]
    looks.write(folder / "look.toml", look)
    return []


def write_scene(folder: Path, result: results.Result) -> list[str]:
    """Write ``edited.xml``, the scene lit by the edited map, which lies beside it, and ``edited.usda``.

    Returns a warning, if it cannot be written, or Mitsuba takes the map's colours for others.
    """
    edited = f"edited.{result.settings.output.format}"
    lights = result.lights["after"]
    chosen = result.settings.scene
    try:
        below = None
        if conversion.is_usd(chosen.file):
            below = os.path.relpath(chosen.file, folder), conversion.kept(chosen.file).stage
        stage = usd_scene.text(
            edited, "edited_sky.exr", lights, result.to_world, result.input_map.scale, below
        )
        atomic_files.write_atomically(folder / "edited.usda", stage.encode())
        text = scene.relit(chosen, edited, result.base)
    except InputError as error:  # the scene's files may be gone by now
        return [f"edited.xml or edited.usda is not written: {error}"]
    atomic_files.write_atomically(folder / "edited.xml", text.encode())
    space = result.input_map.chromaticities
    if space is None or result.settings.output.format == "hdr":
        return []
    return [
        f"edited.xml: {edited} is in {primaries.name_of(space)}, which Mitsuba takes for Rec. 709: it shows "
        'other colours than render_edited.exr; with output.format = "hdr" it shows these'
    ]
