"""Carry out one run as a process of its own and write what it cost: ``measured.py FOLDER COMMAND``.

Needs nothing but the standard library, so that what it takes is next to nothing. ``cost.json`` in the folder,
where the command leaves its results, is written last.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

COST = "cost.json"
AGAIN_BELOW = 180.0
"""Seconds up to which a run that had to compile kernels is made again: beyond, compiling is a small part."""
DROPPED = (
    "render_initial.exr", "render_target.exr", "render_edited.exr", "edited_layers.exr", "influence.exr",
    "influence.png", "report.html",
)  # fmt: skip
"""What a run leaves and nobody asks for here: some megabytes a run."""


def measure(argv: list[str]) -> tuple[int, dict]:
    """Run a command to its end.

    Returns
    -------
    code : int
        Its exit code.
    cost : dict
        ``wall_s``, from before it was started until it has ended; ``cpu_s``, of all its threads;
        ``peak_bytes``, the most memory that it occupied at a time, and no less than this process does, which
        it is a copy of for a moment; ``compiled``, files that came into
        Dr.Jit's folder of kernels meanwhile.
    """
    before, begun = kernels(), time.perf_counter()
    process = subprocess.Popen(argv, preexec_fn=die_with_parent if sys.platform == "linux" else None)
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begun
    process.returncode = os.waitstatus_to_exitcode(status)
    scale = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes on macOS, KiB elsewhere
    return process.returncode, {
        "wall_s": round(wall, 3),
        "cpu_s": round(used.ru_utime + used.ru_stime, 3),
        "peak_bytes": used.ru_maxrss * scale,
        "compiled": kernels() - before,
    }


def kernels() -> int:
    """Count the kernels that Dr.Jit keeps on disk."""
    try:
        with os.scandir(Path.home() / ".drjit") as entries:
            return sum(entry.name.endswith(".bin") for entry in entries)
    except OSError:
        return 0


def die_with_parent() -> None:
    """Ask to be killed when the thread ends that started this process (Linux), before exec."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: nothing may run on and be timed beside


def main(argv: list[str]) -> int:
    """Measure the run of a folder; returns its exit code."""
    folder, run = Path(argv[1]), argv[2:]
    # Ctrl-C reaches the run as well, which ends by itself; a handler is not inherited, to ignore it would be.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    code, cost = measure(run)
    if code == 0 and cost["compiled"] and cost["wall_s"] < AGAIN_BELOW:
        first = cost
        code, cost = measure(run)
        cost["first"] = first
    if code:
        return code if code > 0 else 128 - code
    for earlier in folder.glob("earlier-*"):
        shutil.rmtree(earlier, ignore_errors=True)
    for name in DROPPED:
        (folder / name).unlink(missing_ok=True)
    (folder / COST).write_text(json.dumps(cost, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
