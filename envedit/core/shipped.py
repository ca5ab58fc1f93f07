"""Scenes and configurations that come with the package."""

from __future__ import annotations

import re
from pathlib import Path

import envedit

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
"""Endings of USD files, in lower case."""


def folder() -> Path | None:
    """Return the folder of the shipped files; None where the installation lacks them."""
    package = Path(envedit.__file__).parent
    # In a source checkout it lies beside the package, in an installed wheel inside it.
    candidates = (parent / "scenes" for parent in (package, package.parent))
    return next((path for path in candidates if (path / "sphere.xml").is_file()), None)


def scenes() -> tuple[str, ...]:
    """Name the shipped scenes: what ``[scene] file`` takes without a path."""
    root = folder()
    return tuple(sorted(path.stem for path in root.glob("*.xml"))) if root else ()


def complete_scenes() -> tuple[str, ...]:
    """Name the shipped scenes that need no parameter to be given."""
    root = folder()
    texts = {name: (root / f"{name}.xml").read_text(encoding="utf-8") for name in scenes()} if root else {}
    return tuple(
        name
        for name, text in texts.items()
        if set(re.findall(r"\$(\w+)", text)) <= set(re.findall(r'<default name="(\w+)"', text))
    )


def configurations() -> tuple[str, ...]:
    """Name the shipped configurations: what ``envedit run`` takes without a path."""
    root = folder()
    return tuple(sorted(str(p.relative_to(root))[:-5] for p in root.rglob("*.toml"))) if root else ()


def configuration(name: str) -> Path | None:
    """Return the file of a shipped configuration; None if none has that name."""
    root = folder()
    return root / f"{name}.toml" if root and name in configurations() else None


def holds(path: Path) -> bool:
    """Return whether a file is one of the shipped ones."""
    root = folder()
    return root is not None and path.resolve().is_relative_to(root.resolve())
