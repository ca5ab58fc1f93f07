"""Where runs under overrides lie: apart from those without, so that none passes for another."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

_DIGITS = 8


def folder(out: Path, overrides: Iterable[str]) -> Path:
    """Return ``out``, or a folder in it that belongs to these overrides ``table.key=value``."""
    if not (said := "\n".join(overrides)):
        return out
    return out / f"set-{hashlib.sha256(said.encode()).hexdigest()[:_DIGITS]}"
