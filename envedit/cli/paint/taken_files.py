"""Files that come by way of the page, in folders of the working folder: none is overwritten."""

from __future__ import annotations

import filecmp
import secrets
from pathlib import Path

MAPS, IMAGES = "maps", "images"
"""Folders of maps, and of images on lights."""


def part(name: str, folder: str = MAPS) -> Path:
    """Return a file to write to what is to have a name, in a folder, which is made."""
    parent = Path.cwd() / folder
    parent.mkdir(exist_ok=True)
    return parent / f".{secrets.token_hex(8)}-{name}"


def place(written: Path, name: str) -> str:
    """Give a written file its name, with a number where another has it; returns ``FOLDER/NAME``."""
    stem, ending, number = Path(name).stem, Path(name).suffix, 1
    while (there := written.parent / name).exists() and not filecmp.cmp(written, there, shallow=False):
        number += 1
        name = f"{stem}-{number}{ending}"
    written.replace(there)
    return f"{written.parent.name}/{name}"
