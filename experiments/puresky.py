"""The maps that experiments are made over, by name: those of the folder that ENVEDIT_DATA names."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from envedit.config.validators import meant
from envedit.core.atomic_files import make_folder
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from experiments.harness import Case, calling

_END = "_puresky_1k"
_HOW = "python -m experiments.download_puresky DIR fetches them"


def data(holds: str = "puresky/NAME_puresky_1k.hdr", how: str = _HOW) -> Path:
    """Return the folder that ENVEDIT_DATA names; ConfigError if it is not set.

    The error says what is looked for in the folder, and how it is had.
    """
    if not (root := os.environ.get("ENVEDIT_DATA")):
        raise ConfigError(f"no maps: set ENVEDIT_DATA to a folder with {holds}; {how}")
    return Path(root)


def find() -> dict[str, Path]:
    """List the maps of the folder ``puresky`` of ENVEDIT_DATA by name: files NAME_puresky_1k.hdr, or .exr.

    InputError if there is none; ConfigError as :func:`data`.
    """
    folder = (data() / "puresky").absolute()
    found = {path.name.split(_END)[0]: path for path in sorted(folder.glob(f"*{_END}.[he][dx]r"))}
    if not found:
        raise InputError(f"{folder}: no map NAME{_END}.hdr or .exr in this folder; {_HOW}")
    return found


def others() -> dict[str, Path]:
    """List the maps with ground of ENVEDIT_DATA by name: those of its folder ``hdri``."""
    folder = data("hdri/NAME_1k.hdr", "CONTRIBUTING.md lists the maps") / "hdri"
    return {path.stem.removesuffix("_1k"): path for path in sorted(folder.glob("*_1k.hdr"))}


def scene(name: str) -> dict:
    """Return what ``[scene]`` is for a shipped scene, or for one of ENVEDIT_DATA.

    Under most skies the picture of matpreview would be white with the scene's own factor of the map, 3.
    """
    if name == "matpreview":
        return {"file": str(data() / "scenes" / "matpreview" / "matpreview.xml"), "scale": 0.5}
    if name == "mesh":
        return {"file": "mesh", "parameters": {"mesh": str(data() / "meshes" / "spot.obj")}}
    return {"file": name}


def file(name: str) -> str:
    """Return the file of a map of ENVEDIT_DATA; ConfigError if there is none of this name."""
    found = find()
    if name not in found:
        hint = meant(name, found, f"there are {', '.join(found)}")
        raise ConfigError(f"no map {name}; {hint}")
    return str(found[name])


def written(out: Path, name: str, envmap: np.ndarray) -> str:
    """Write a map (H, W, 3) that an experiment makes to ``maps/NAME.exr``; returns the file."""
    file = make_folder(out.absolute() / "maps") / f"{name.replace(' ', '_')}.exr"
    images.write_exr(file, envmap)
    return str(file)


def cases(function, tables: dict | None = None, **arguments) -> list[Case]:
    """Return a case for each PureSky map, in which a function is called with its ``file``."""
    return [
        calling(name, function, tables or {}, {"map": name}, file=str(path), **arguments)
        for name, path in find().items()
    ]
