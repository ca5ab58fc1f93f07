"""Packages that only a part of the program needs: the extras of ``pyproject.toml``."""

from __future__ import annotations

import importlib
from typing import Any

from envedit.core.errors import MachineError


def required(module: str, extra: str, needed_by: str) -> Any:
    """Import a module of an extra; MachineError, which begins with ``needed_by``, if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        how = f"run pip install '.[{extra}]' in the checkout"
        missing = error.name or module
        raise MachineError(f"{needed_by}: needs {missing}, which is not installed: {how}") from None
