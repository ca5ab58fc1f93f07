"""The folder ``maps`` of the working folder, for maps that come by way of the page: none is overwritten."""

from __future__ import annotations

import filecmp
import secrets
from pathlib import Path

MAPS = "maps"


def part(name: str) -> Path:
    """Return a file to write a map to that is to have a name, in the folder, which is made."""
    folder = Path.cwd() / MAPS
    folder.mkdir(exist_ok=True)
    return folder / f".{secrets.token_hex(8)}-{name}"


def place(written: Path, name: str) -> str:
    """Give a written map its name, with a number where another map has it; returns ``maps/NAME``."""
    stem, ending, number = Path(name).stem, Path(name).suffix, 1
    while (there := written.parent / name).exists() and not filecmp.cmp(written, there, shallow=False):
        number += 1
        name = f"{stem}-{number}{ending}"
    written.replace(there)
    return f"{MAPS}/{name}"
