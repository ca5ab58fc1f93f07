"""The rendering to paint on: the scene under the map as it is, and its export as a picture."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from envedit import config
from envedit.core.atomic_files import write_atomically
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError, InputError
from envedit.core.seeds import Seeds
from envedit.core.types import FilePath, Info, Shape
from envedit.images import images
from envedit.scene.renderings import rendered
from envedit.scene.scene import Scene

ENDINGS = (".exr", ".png")
"""What the initial rendering can be exported as; a JPEG would not keep it."""
CLIPPED = 0.001
"""Share of the pixels that may be clipped in an exported PNG before another tonemap is used."""
NEIGHBOUR = ".envedit.json"
"""Ending of the file beside an exported picture that says what the picture's own metadata says."""
KEYS = {
    "width": "scene.width", "height": "scene.height", "map_width": "input.width", "spp": "target.spp",
    "seed": "seed", "turn": "input.rotate_degrees", "tilt": "input.tilt_degrees",
    "horizon": "input.horizon_degrees",
}  # fmt: skip
"""What must be the same where a picture is exported and where it is read, and the key that sets it."""
_MOST_BYTES = 1 << 16  # of a neighbour that is read
_PREFIX = "envedit."  # of a fact in the picture's metadata


def initial(scene: Scene, envmap: np.ndarray, settings: config.Config) -> np.ndarray:
    """Render the picture to paint on, (h, w, 3): the scene under the map as it is, at [target] spp."""
    picture, _, _ = rendered(
        scene, envmap, settings.target.spp, Seeds(settings.seed).exported, settings.renderer.cache
    )
    return picture


def check_export(file: FilePath) -> None:
    """Refuse a file that :func:`export` should not write.

    ConfigError if its ending says neither OpenEXR nor PNG, InputError if it exists, or its folder does not.
    """
    file = Path(os.fsdecode(file))
    if file.suffix.lower() not in ENDINGS:
        raise ConfigError(f"--export-initial: got {str(file)!r}, expected a name that ends in .exr or .png")
    if os.path.lexists(file):
        raise InputError(f"{file}: exists and is not overwritten: name another file, or move it away")
    if not os.path.isdir(file.parent):
        raise InputError(f"{file}: cannot be written (its folder does not exist)")


def export_tonemap(file: FilePath, picture: np.ndarray, settings: config.Config) -> str:
    """Return the tonemap of an exported picture (h, w, 3): "linear" for OpenEXR, or :func:`png_tonemap`."""
    linear = Path(os.fsdecode(file)).suffix.lower() == ".exr"
    return "linear" if linear else png_tonemap(picture, settings)


def png_tonemap(picture: np.ndarray, settings: config.Config) -> str:
    """Return the tonemap of a PNG of a rendering (h, w, 3): [target] tonemap where it names one.

    With "auto" it is "gamma" where that clips less than :data:`CLIPPED` of the pixels, and otherwise
    "reinhard", which clips nothing below a radiance of 10^4.
    """
    chosen = settings.target
    if chosen.tonemap != "auto" or _clipped(tonemap(picture, chosen.display_tonemap)) < CLIPPED:
        return chosen.display_tonemap
    return "reinhard"


def _clipped(shown):
    """Return the share of pixels with a channel that is white in a PNG of 16 bits."""
    return float((shown >= 1 - 0.5 / 65535).any(axis=2).mean())


def export(
    file: FilePath, picture: np.ndarray, settings: config.Config, name: str | None = None
) -> list[str]:
    """Write the picture to paint on, (h, w, 3) linear radiance; returns warnings.

    It is float32 OpenEXR, or 16-bit PNG. The file says which tonemap it is under (``name``, by default
    :func:`export_tonemap`), and what it was rendered from. As editors drop that, a file beside it, with
    :data:`NEIGHBOUR` after its name, says it too. InputError if the file cannot be
    written; :func:`check_export` is what refuses others.
    """
    linear = Path(os.fsdecode(file)).suffix.lower() == ".exr"
    name = name or export_tonemap(file, picture, settings)
    facts = origin(settings, picture.shape, name)
    marks = {f"{_PREFIX}{key}": value for key, value in facts.items()}
    write_atomically(f"{os.fsdecode(file)}{NEIGHBOUR}", json.dumps(facts, indent=1).encode())
    if linear:
        images.write_exr(file, picture, marks, panorama=False)
        return []
    shown = tonemap(picture, name)
    images.write_png(file, shown, 16, marks)
    share = _clipped(shown)
    if share < CLIPPED:
        return []
    return [
        f"{file}: {100 * share:.3g} % of the pixels are clipped under the '{name}' tonemap, and cannot be "
        "painted on: export an .exr"
    ]


# ---- What a picture was exported with ----------------------------------------------------------------------


def origin(settings: config.Config, shape: Shape, name: str) -> Info:
    """Return what an exported picture (h, w, ...) under a tonemap of this name says of itself."""
    return {
        "tonemap": name,
        "scene": Path(settings.scene.file).name,
        "envmap": Path(settings.input.envmap).name,
        "width": shape[1],
        "height": shape[0],
        "map_width": settings.input.width,
        "spp": settings.target.spp,
        "seed": settings.seed,
        **{name: float(value) for name, value in settings.input.orientation._asdict().items()},
    }


def stated_origin(file: FilePath, info: Info, expected: Mapping[str, object]) -> dict[str, str]:
    """Return what a painted picture was exported with, as its metadata or a file beside it says.

    The file beside it is the one with its name, where it was saved over the export; otherwise, of those in
    its folder that are of the same scene, the one that differs from this run in the fewest values. ``info``
    is of :func:`envedit.images.images.read_stored`, ``expected`` what an export of this run says. Returns
    values as of :func:`origin`, as text. InputError if one of :data:`KEYS` is not that of this run.
    """
    file = Path(os.fsdecode(file))
    facts = {k[len(_PREFIX) :]: str(v) for k, v in info["metadata"].items() if k.startswith(_PREFIX)}
    neighbour = None
    if not facts:
        facts, neighbour = _beside(file, expected)
        if neighbour is not None and (info["hdr"] or neighbour.name.lower().endswith(f".exr{NEIGHBOUR}")):
            facts.pop("tonemap", None)  # of another format
    if keys := _differing(facts, expected):
        stated = ", ".join(f"{KEYS[key]} {facts[key][:20]!a}".replace("'", "") for key in keys)
        own = ", ".join(str(expected[key]) for key in keys)
        source = "was" if neighbour is None else f"{neighbour.name} says that it was"
        remedy = "give these to this run, or export it again"
        remedy += "" if neighbour is None else f"; if it is no such picture, remove {neighbour.name}"
        raise InputError(f"{file}: {source} exported with {stated}, where this run has {own}: {remedy}")
    return facts


def _differing(facts, expected):
    """Return the keys of :data:`KEYS` whose values differ."""
    return [key for key in KEYS if key in facts and facts[key] != str(expected.get(key, facts[key]))]


def _beside(file, expected):
    """Return what a file beside a picture says of its export, and the file; {} and None without one."""
    own = file.with_name(f"{file.name}{NEIGHBOUR}")
    stated = {}
    for path in filter(os.path.isfile, (own, *sorted(file.parent.glob(f"*{NEIGHBOUR}")))):
        try:
            with open(path, "rb") as stream:
                facts = json.loads(stream.read(_MOST_BYTES))
        except (OSError, ValueError, RecursionError):  # no JSON, or none of ours
            continue
        if isinstance(facts, dict) and (path == own or facts.get("scene") == expected.get("scene")):
            stated[path] = {str(key): str(value) for key, value in facts.items()}
    if not stated:
        return {}, None

    def unlike(path):
        """Values that make it another rendering come before those of its map's name and tonemap."""
        facts = stated[path]
        others = [key for key, value in facts.items() if value != str(expected.get(key))]
        return len(_differing(facts, expected)), len(others)

    chosen = own if own in stated else min(stated, key=unlike)
    return stated[chosen], chosen
