"""Clocks and counters: seconds of an evaluated result, kernels compiled, the machine."""

import importlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.report.manifest import manifest
from envedit.report.plain_files import plain

REPEATS = 7
WARM_UP = 3  # a first call compiles; a second may still see other literals


def once(function: Callable) -> float:
    """Return the seconds that a call takes until all it returns is in memory.

    Dr.Jit is lazy: without ``dr.eval`` a call only writes down what is to be computed, and without
    ``dr.sync_thread`` it returns while the cores still work.
    """
    dr.sync_thread()
    start = time.perf_counter()
    result = function()
    dr.eval(result)
    dr.sync_thread()
    return time.perf_counter() - start


def side_by_side(functions: dict[str, Callable], repeats: int = REPEATS) -> dict:
    """Time functions in turns, so that whatever else the machine does meets all of them alike.

    Returns ``median_s`` and ``min_s`` for each name.
    """
    for function in functions.values():
        for _ in range(WARM_UP):
            once(function)
    seconds = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            seconds[name].append(once(function))
    return {name: {"median_s": float(np.median(s)), "min_s": min(s)} for name, s in seconds.items()}


def compiled(function: Callable, calls: int = 5) -> dict:
    """Count the kernels that calls launch, and those among them that were not in memory yet."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for _ in range(calls):
            once(function)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    fresh = sum(not k["cache_hit"] or k["cache_disk"] for k in kernels)
    return {"calls": calls, "launched": len(kernels), "compiled": fresh}


def machine() -> dict:
    """Describe machine and versions, and how busy the machine is with other things."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None)
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        load = os.getloadavg()[0]
    except (OSError, ValueError):
        cpu = memory = load = None
    found = {"cpu": cpu, "threads": dr.thread_count(), "memory_bytes": memory, "load": load}
    return manifest({}, {}, mi.variant()) | found


def measured(settings, folder, measuring: str, **arguments) -> dict:
    """Describe the machine, and then measure by ``module:name`` of this package.

    That is a function (settings, **arguments) -> the rows of each table. Returns ``machine``, as it was
    before; ``seconds``; ``tables``: rows by table; ``not_finite``: where numbers of them are NaN or infinite.
    """
    module, _, name = measuring.partition(":")
    called = getattr(importlib.import_module(f"experiments.engine.{module}"), name)
    before = machine()
    begun = time.perf_counter()
    not_finite = []
    tables = plain(called(settings, **arguments), "", not_finite)
    seconds = time.perf_counter() - begun
    return {"machine": before, "seconds": seconds, "tables": tables, "not_finite": not_finite}
