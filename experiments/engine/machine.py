"""The machine that times are measured on, and how busy it was before."""

import importlib
import os
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi

from envedit.report.manifest import manifest, plain


def about() -> dict:
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
    """Describe the machine, and then measure.

    Parameters
    ----------
    measuring : str
        ``module:name`` of this package: (settings, **arguments) -> the rows of each table.

    Returns
    -------
    dict
        ``machine``, as it was before; ``seconds``; ``tables``: rows by table; ``not_finite``: where numbers
        of them are NaN or infinite.
    """
    module, _, name = measuring.partition(":")
    called, machine = getattr(importlib.import_module(f"experiments.engine.{module}"), name), about()
    begun, not_finite = time.perf_counter(), []
    tables = plain(called(settings, **arguments), "", not_finite)
    seconds = time.perf_counter() - begun
    return {"machine": machine, "seconds": seconds, "tables": tables, "not_finite": not_finite}
