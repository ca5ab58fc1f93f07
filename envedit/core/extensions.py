"""Kinds of representation, renderer and target that other installed packages add, by their entry points.

A package that lists ``mine = "package.module:function"`` in a group of entry points adds the kind "mine".
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from typing import Any

from envedit.core.errors import ConfigError

REPRESENTATIONS = "envedit.representations"
"""Group of functions ``(settings, rows) -> Encoder``."""
RENDERERS = "envedit.renderers"
"""Group of functions ``(settings, scene, shape) -> Renderer``."""
TARGETS = "envedit.targets"
"""Group of functions ``(settings, scene, envmap) -> picture (h, w, 3)``, linear radiance, as rendered."""


def names(group: str) -> tuple[str, ...]:
    """Return the names of the kinds that installed packages add to a group, sorted."""
    return tuple(sorted({entry.name for entry in importlib.metadata.entry_points(group=group)}))


def load(group: str, name: str) -> Callable[..., Any]:
    """Return the function of a kind.

    ConfigError if no installed package adds it, two do, or its module cannot be imported.
    """
    entries = importlib.metadata.entry_points(group=group, name=name)
    values = sorted({entry.value for entry in entries})
    if len(values) != 1:
        reason = f"{' and '.join(values)} both add it" if values else "no installed package adds it"
        raise ConfigError(f"kind {name!r} of {group}: {reason}")
    try:
        function: Callable[..., Any] = next(iter(entries)).load()
    except Exception as error:  # whatever a module of somebody else raises
        raise ConfigError(
            f"kind {name!r} of {group}: {values[0]} cannot be imported ({type(error).__name__}: {error})"
        ) from error
    return function
