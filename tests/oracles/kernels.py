"""Which kernels some work launches, and which of them are new."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np


def launched(work):
    """Do some work and return the hashes of the kernels it launched, compiled for it or found in a cache."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work()
        dr.sync_thread()
        return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}


def own(array):
    return dr.opaque(mi.TensorXf(np.asarray(array, np.float32)))


def history():
    """Count the kernels since it was last called, and those that were not in memory yet.

    The latter are compiled, or fetched from the disk.
    """
    kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return len(kernels), sum(not k["cache_hit"] or k["cache_disk"] for k in kernels)


def compiled(call):
    """Do some work and return what :func:`history` counts of it.

    Arguments of virtual calls are in the order of their variables' numbers. Those that Python's collector
    frees are given out again: where it collects while a kernel is traced, the kernel is another.
    """
    gc.collect()
    gc.disable()
    try:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            call()
            return history()
    finally:
        gc.enable()
