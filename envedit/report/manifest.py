"""What a run leaves to be read by programs: history, metrics, and a manifest that explains it later.

Numbers are finite or null.
"""

from __future__ import annotations

import csv
import datetime
import io
import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import envedit
from envedit.core import atomic_files, machine
from envedit.core.atomic_files import write_atomically
from envedit.core.types import FilePath

# ---- Files -------------------------------------------------------------------------------------------------


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


# ---- The manifest ------------------------------------------------------------------------------------------


def manifest(config_summary: dict, inputs: dict, variant: str) -> dict:
    """Collect what it takes to explain a run later: versions, machine, seeds, and the digests of its inputs.

    ``config_summary`` is whatever of the configuration is worth repeating; its keys that name a seed are
    listed as ``seeds``. ``inputs`` are the files read, by role; one that cannot be read any more is listed
    with the reason. ``variant`` is Mitsuba's. ``commit`` is None unless the package runs from its own git
    checkout.
    """
    versions: dict[str, str | None] = {"envedit": envedit.__version__, "python": platform.python_version()}
    versions |= {package: machine.version(package) for package in ("mitsuba", "drjit", "numpy", "OpenEXR")}
    return {
        "time_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": versions,
        "commit": _commit(Path(envedit.__file__).resolve().parent.parent),
        "variant": variant,
        "llvm": _llvm() if variant.startswith("llvm") else None,
        "platform": platform.platform(),
        "cores": {"usable": machine.cores(), "machine": os.cpu_count()},
        "seeds": {key: value for key, value in config_summary.items() if "seed" in str(key)},
        "inputs": {role: _digest(path) for role, path in inputs.items()},
        "config": config_summary,
    }


def changed(file: FilePath) -> list[str]:
    """Return the inputs that a manifest names and that hold something else now; none without a manifest."""
    try:
        listed = json.loads(Path(file).read_text(encoding="utf-8"))["inputs"].values()
        known = {entry["path"]: entry["sha256"] for entry in listed}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return []
    return [path for path, digest in known.items() if _digest(path)["sha256"] not in (digest, None)]


def _digest(path):
    try:
        digest = atomic_files.digest(path).hex()
        return {"path": str(path), "bytes": os.stat(path).st_size, "sha256": digest}
    except (OSError, ValueError) as error:
        return {"path": str(path), "bytes": None, "sha256": None, "error": str(error)}


def _commit(root):
    """Commit of the checkout whose top is ``root``, with ``-dirty`` after it; None for any other folder."""

    def git(*arguments):
        command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()

    try:
        # An installed package may lie inside somebody else's repository: that commit would be a lie.
        top, commit = git("rev-parse", "--show-toplevel", "HEAD").splitlines()
        if Path(top).resolve() != Path(root).resolve():
            return None
        return commit + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, ValueError, subprocess.SubprocessError):
        return None


def _llvm():
    """Version and file of the LLVM that Dr.Jit loaded, as far as they can be had."""
    try:
        version = machine.llvm_version()
    except Exception:  # an optional line of the manifest must not end a finished run
        version = None
    return {"version": version, "path": machine.llvm_library() or os.environ.get("DRJIT_LIBLLVM_PATH")}
