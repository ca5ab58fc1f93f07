"""Clocks and counters: seconds of an evaluated result, kernels compiled, memory in use."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import numpy as np

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


def side_by_side(functions: dict[str, Callable], repeats: int = REPEATS, warm_up: int = WARM_UP) -> dict:
    """Time functions in turns, so that whatever else the machine does meets all of them alike.

    Returns
    -------
    dict
        For each name ``median_s`` and ``min_s``.
    """
    for function in functions.values():
        for _ in range(warm_up):
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


def resident_bytes() -> int | None:
    """Return the memory that the process occupies now; None where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


def growth(function: Callable, calls: int, settle: int) -> dict:
    """Measure by how much the process grows over ``calls`` calls, after ``settle`` that do not count."""
    for _ in range(settle):
        once(function)
    before = resident_bytes()
    for _ in range(calls):
        once(function)
    return {"calls": calls, "bytes": None if before is None else resident_bytes() - before}
