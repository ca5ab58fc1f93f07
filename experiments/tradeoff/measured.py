r"""Carry out one run as a process of its own and write what it cost: ``measured.py FOLDER THREADS SESSION``.

Called by the sweep, in place of the run itself; needs nothing but the standard library, so that what it
takes is next to nothing. ``cost.json`` in the folder is written last.
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

CALIBRATED = "levels"
"""The session whose runs are measured beside a calibration of the machine."""
AGAIN_BELOW = 180.0
"""Seconds up to which a run that had to compile kernels is made again: beyond, compiling is a small part."""
DROPPED = (
    "render_initial.exr", "render_target.exr", "render_edited.exr", "edited_layers.exr", "influence.exr",
    "influence.png", "report.html",
)  # fmt: skip
"""What a run leaves and nobody asks for here: some megabytes a run."""
_THREADS = (
    "import sys, drjit; drjit.set_thread_count(int(sys.argv.pop(1)));"
    "from envedit.run import main; sys.exit(main())"
)


def command(folder: Path, threads: int) -> list[str]:
    """Return the command of a run: ``python -m envedit.run``, on some of the cores if not on all of them."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    start = ["-m", "envedit.run"] if threads >= here else ["-c", _THREADS, str(threads)]
    return [sys.executable, *start, str(folder / "job.toml"), "--out", str(folder), "--quiet"]


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
    process = subprocess.Popen(argv, preexec_fn=_die_with_parent if sys.platform == "linux" else None)
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


def calibrated(folder: Path) -> dict:
    """Measure the machine as ``--budget`` does, just before the run: it may change its speed meanwhile."""
    asked = [sys.executable, "-m", "experiments.levels.calibrate", str(folder / "job.toml")]
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    with_us = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    found = subprocess.run(asked, capture_output=True, text=True, check=True, env=with_us)
    return {"calibration": json.loads(found.stdout.splitlines()[-1])}


def kernels() -> int:
    """Count the kernels that Dr.Jit keeps on disk."""
    try:
        with os.scandir(Path.home() / ".drjit") as entries:
            return sum(entry.name.endswith(".bin") for entry in entries)
    except OSError:
        return 0


def _die_with_parent():
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: nothing may run on and be timed beside


def main(argv: list[str]) -> int:
    """Measure the run of a folder; returns its exit code."""
    folder, threads, session = Path(argv[1]), int(argv[2]), argv[3]
    # Ctrl-C reaches the run as well, which ends by itself; a handler is not inherited, to ignore it would be.
    signal.signal(signal.SIGINT, lambda number, frame: None)
    run = command(folder, threads)
    beside = calibrated(folder) if session == CALIBRATED else {}
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
    (folder / "judged.json").unlink(missing_ok=True)  # of an earlier run in this folder
    temporary = folder / "cost.json.tmp"
    temporary.write_text(
        json.dumps(cost | beside | {"session": session, "threads": threads}, indent=1) + "\n"
    )
    temporary.replace(folder / "cost.json")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
