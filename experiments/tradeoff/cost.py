"""Run a command and write what it cost as JSON: ``cost.py FILE COMMAND``.

Needs nothing but the standard library: the most memory of a process, as the system counts it, is no less than
that of the process which started it.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path


def measured(command: list, folder: Path, **options) -> dict:
    """Run a command; returns what it cost, as :func:`main`. EnveditError if it failed.

    It is started by a process between this one and itself, whose peak of memory would else be no less than
    ours. ``options`` are those of ``subprocess.run``.
    """
    from envedit.core.errors import EnveditError

    file = folder / "cost.json"
    code = subprocess.run([sys.executable, "-S", __file__, file, *command], **options).returncode
    if code:
        said = f"{' '.join(map(str, command))} ended with exit code {code}; see above in log.txt"
        raise EnveditError(f"{folder}: {said}")
    return json.loads(file.read_text())


def main(file: str, command: list[str]) -> int:
    """Write ``wall_s``, ``cpu_s`` of all threads and ``peak_bytes``; returns the command's exit code."""
    begun = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begun
    process.returncode = os.waitstatus_to_exitcode(status)
    scale = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes on macOS, KiB elsewhere
    cost = {
        "wall_s": round(wall, 3),
        "cpu_s": round(used.ru_utime + used.ru_stime, 3),
        "peak_bytes": used.ru_maxrss * scale,
    }
    Path(file).write_text(json.dumps(cost))
    return process.returncode if process.returncode >= 0 else 128 - process.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
