"""What explains a run later: versions, machine, seeds, and the digests of its inputs."""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
from pathlib import Path

import envedit
from envedit.core import atomic_files, machine
from envedit.core.types import FilePath


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
