"""The machine: cores that this process may use, installed packages, and the LLVM that Dr.Jit has loaded."""

from __future__ import annotations

import importlib.metadata
import os
from pathlib import Path


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def version(package: str) -> str | None:
    """Return the version of an installed package; None without it."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def llvm_version() -> str:
    """Return the version of the LLVM that Dr.Jit has loaded, ``19.1.7``; raises as Dr.Jit without one."""
    from drjit.detail import llvm_version as numbers

    return ".".join(map(str, numbers()))


def llvm_library() -> str | None:
    """Return the file of the LLVM that Dr.Jit has loaded; None where the system lists no libraries.

    It is named libLLVM, or as DRJIT_LIBLLVM_PATH says.
    """
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return None
    path = os.environ.get("DRJIT_LIBLLVM_PATH") or "libLLVM"
    names = {os.path.basename(path), os.path.basename(os.path.realpath(path)), "libLLVM"}
    mapped_files = [line.split(None, 5)[-1].strip() for line in lines]
    return next((file for file in mapped_files if any(n in os.path.basename(file) for n in names)), None)
