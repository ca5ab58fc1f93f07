"""Scenes and configurations that come with the package."""

from __future__ import annotations

import re
from pathlib import Path

import envedit

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
"""Endings of USD files, in lower case."""


def folder() -> Path:
    """Return the folder of the shipped files: inside an installed package, beside it in a source checkout."""
    package = Path(envedit.__file__).parent
    inside = package / "scenes"
    return inside if inside.is_dir() else package.parent / "scenes"


def scenes() -> tuple[str, ...]:
    """Name the shipped scenes: what ``[scene] file`` takes without a path."""
    return tuple(sorted(path.stem for path in folder().glob("*.xml")))


def complete_scenes() -> tuple[str, ...]:
    """Name the shipped scenes that need no parameter to be given."""
    names = []
    for name in scenes():
        text = (folder() / f"{name}.xml").read_text(encoding="utf-8")
        if set(re.findall(r"\$(\w+)", text)) <= set(re.findall(r'<default name="(\w+)"', text)):
            names.append(name)
    return tuple(names)


def configurations() -> tuple[str, ...]:
    """Name the shipped configurations: what ``envedit run`` takes without a path."""
    root = folder()
    return tuple(sorted(str(path.relative_to(root).with_suffix("")) for path in root.rglob("*.toml")))


def configuration(name: str) -> Path | None:
    """Return the file of a shipped configuration; None if none has that name."""
    return folder() / f"{name}.toml" if name in configurations() else None


def holds(path: Path) -> bool:
    """Return whether a file is one of the shipped ones."""
    return path.resolve().is_relative_to(folder().resolve())
