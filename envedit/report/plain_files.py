"""Files that programs read, JSON and CSV: their numbers are finite or null."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.types import FilePath


def plain(value: Any, where: str, lost: list[str]) -> Any:
    """Turn a nested value into what JSON knows; the places of non-finite numbers are appended to ``lost``."""
    if isinstance(value, dict):
        inside = f"{where}." if where else ""
        return {str(key): plain(item, f"{inside}{key}", lost) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{i}]", lost) for i, item in enumerate(value)]
    if isinstance(value, np.ndarray):
        return plain(list(value) if value.ndim else value[()], where, lost)
    if value is None or isinstance(value, (bool, str, int)):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.floating) and np.isfinite(value):
        return float(str(value))  # the shortest decimal that is this float32, not its 17 digits as a double
    if isinstance(value, np.generic):
        return plain(value.item(), where, lost)
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        lost.append(where)
        return None
    raise TypeError(f"{where}: {type(value).__name__} cannot be written as JSON")


def write_json(path: FilePath, value: Any) -> None:
    """Write ``metrics.json``, ``manifest.json`` or ``lights.json``; numbers are finite or null.

    InputError if the file cannot be written; TypeError for what is neither number, text, list, dict, path nor
    NumPy's.
    """
    text = json.dumps(plain(value, "", []), indent=1, allow_nan=False)
    write_atomically(path, text.encode("ascii") + b"\n")


def write_history(path: FilePath, rows: list[dict]) -> None:
    """Write ``history.csv``, a row an iteration; InputError if it cannot be written.

    The columns are the union of the rows' keys in the order first seen. A value that is missing, None, NaN
    or Inf is an empty cell.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns(rows) or ["iteration"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(plain(rows, "", []))
    write_atomically(path, text.getvalue().encode("utf-8", "backslashreplace"))


def columns(rows: Iterable[dict]) -> list[str]:
    """List the keys of all rows in the order first seen."""
    return list(dict.fromkeys(str(key) for row in rows for key in row))
