"""The Mitsuba scene that a USD stage becomes: its XML, and what of the stage is not used."""

from __future__ import annotations

import hashlib
import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar

from envedit.core.errors import InputError

_TAGS = {bool: "boolean", int: "integer", str: "string"}
_POINTS = {"center": "point", "position": "point", "direction": "vector"}


@dataclass
class Description:
    """A scene that is being written."""

    file: str  # what errors call the USD file
    folder: Path  # folder of the XML file
    files: str  # name of the folder in it where meshes and textures go
    stage: Any  # what is read
    time: Any  # when animated values are taken
    root: ET.Element = field(default_factory=lambda: ET.Element("scene", version="3.0.0"))  # ``<scene>``
    textures: set[str] = field(default_factory=set)  # absolute paths of the textures that it names
    # What is not used, and the paths of the first prims with it
    unused: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, what: str, path: Any) -> None:
        """Note that something of a prim is not used; it is named once."""
        paths = self.unused.setdefault(what, [])
        if str(path) not in paths:
            paths.append(str(path))

    def notes(self) -> list[str]:
        """Return a line for everything that is not used."""
        lines = []
        for what, paths in self.unused.items():
            more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
            said = what if ":" in what else f"not read: {what}"
            lines.append(f"{said} ({paths[0]}{more})")
        return lines

    def error(self, path: Any, text: str) -> InputError:
        """Return an error that names the file and a prim."""
        return InputError(f"{self.file}: {path}: {text}")

    def new_file(self, name: str) -> tuple[Path, str]:
        """Return the path of a file beside the XML, and its name in the XML."""
        (self.folder / self.files).mkdir(exist_ok=True)
        return self.folder / self.files / name, f"{self.files}/{name}"

    def texture_file(self, path: Any, asset: Any) -> str:
        """Return the name of a texture's file in the XML: an absolute path, or a copy out of a package.

        ``path`` (pxr.Sdf.Path) is the prim that names it, ``asset`` (pxr.Sdf.AssetPath) its value. InputError
        if there is no such file.
        """
        resolved = asset.resolvedPath
        if not resolved:
            what = "tiles (UDIM) are not read" if "<UDIM>" in asset.path else "the file is missing"
            raise self.error(path, f"texture {asset.path}: {what}")
        if not Ar.IsPackageRelativePath(resolved):
            if not os.path.isfile(resolved):
                raise self.error(path, f"texture {asset.path}: the file is missing")
            self.textures.add(os.path.abspath(resolved))
            return os.path.abspath(resolved)
        opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
        if not opened:
            raise self.error(path, f"texture {asset.path}: the file is missing in the package")
        inner = Ar.SplitPackageRelativePathInner(resolved)[1]
        short = hashlib.sha256(resolved.encode()).hexdigest()[:8]
        copy, name = self.new_file(f"{short}_{Path(inner).name}")
        copy.write_bytes(opened.GetBuffer())
        return name


def add(parent: ET.Element, tag: str, plugin: str = "", name: str = "", **values: Any) -> ET.Element:
    """Add an object of a plugin with plain properties: numbers, texts, colours (3,) or matrices (4, 4)."""
    element = ET.SubElement(parent, tag)
    if plugin:
        element.set("type", plugin)
    if name:
        element.set("name", name)
    put(element, **values)
    return element


def put(element: ET.Element, **values: Any) -> None:
    """Give an object plain properties, as of :func:`add`."""
    for key, value in values.items():
        if isinstance(value, np.ndarray) and value.shape == (4, 4):
            add_matrix(element, key, value)
        elif isinstance(value, np.ndarray):
            ET.SubElement(element, _POINTS.get(key, "rgb"), name=key, value=_numbers(value))
        elif isinstance(value, float):
            ET.SubElement(element, "float", name=key, value=_numbers([value]))
        else:
            text = str(value).lower() if isinstance(value, bool) else str(value).replace("$", "\\$")
            ET.SubElement(element, _TAGS[type(value)], name=key, value=text)


def add_matrix(element: ET.Element, name: str, matrix: np.ndarray) -> None:
    """Apply a matrix (4, 4) after those that a transform of this name has."""
    transform = element.find(f"./transform[@name='{name}']")
    if transform is None:
        transform = ET.SubElement(element, "transform", name=name)
    ET.SubElement(transform, "matrix", value=_numbers(matrix.ravel()))


def _numbers(values):
    return " ".join(f"{value:.9g}" for value in values)


def column_matrix(matrix: Any) -> np.ndarray:
    """Return USD's matrix for row vectors as (4, 4) float64 for column vectors."""
    return np.array(matrix, np.float64).T
