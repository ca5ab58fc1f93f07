"""A process that reads damaged files, one after another, and reports how each went.

Started by :class:`.drive.Worker` with the name of a kind of files, or ``module:function``. Requests on stdin
and answers on stdout are a line of JSON each. A crash ends it by a signal, a hang by SIGPROF: the parent sees
either.
"""

import importlib
import json
import os
import resource
import signal
import sys
import warnings
from pathlib import Path

import mitsuba as mi

from envedit.core.errors import ConfigError, InputError

from .kinds import KINDS, WrongError

MIB = 1 << 20
MULTIPLE, ROOM = 8, 64 * MIB
"""Memory a reader may use: in units of the declared float32 image, and beyond that whatever the file says."""
ADDRESS_ROOM = 512 * MIB
"""Address space beyond the multiple: pools and stacks of threads take it, and do not touch it."""
MOST_ADDRESS = 8192 * MIB
LONGEST_MESSAGE = 600


def cpu_limit(declared: int, least: float = 5.0) -> float:
    """Seconds of processor time, all threads together, after which a case counts as hung."""
    return min(least + declared / (20 * MIB), 120)


def main(reader: str, answers) -> None:
    """Answer requests, as :meth:`.drive.Worker.read` makes them, until stdin ends."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    module, _, function = reader.partition(":")
    read = getattr(importlib.import_module(module), function) if function else KINDS[reader].read
    warnings.simplefilter("always")  # each is a line on a user's terminal
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    answers.write("ready\n")
    answers.flush()
    for line in sys.stdin:
        request = json.loads(line)
        path = Path(request["path"])
        declared = request["declared"]
        printed = os.fstat(2).st_size
        start = _reset_peak()
        room = min(ADDRESS_ROOM + MULTIPLE * declared, MOST_ADDRESS)
        if request["limited"]:
            resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + room, hard))
        signal.setitimer(signal.ITIMER_PROF, request["seconds"])  # its default action ends the process
        try:
            answer = judged(read, path, request["index"])
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
        sys.stdout.flush()
        sys.stderr.flush()
        answer["peak"] = _status("VmHWM") - start
        if answer["peak"] > ROOM + MULTIPLE * declared:
            error = f"{answer['peak'] >> 20} MiB for {declared} bytes declared"
            answer |= {"outcome": "memory", "error": error}
        elif "not enough memory" in answer.get("error", "") and room < MOST_ADDRESS:
            answer["outcome"] = "memory"
        elif answer["outcome"] in ("read", "refused") and os.fstat(2).st_size > printed:
            answer |= {"outcome": "printed", "error": os.pread(2, 500, printed).decode(errors="replace")}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def judged(read, path: Path, index: int) -> dict:
    """Call a reader and say how it went: "read", "refused", "unclear", "wrong" or "traceback"."""
    try:
        read(path, index)
        return {"outcome": "read"}
    except (ConfigError, InputError) as error:
        fault = unclear(str(error), str(path))
        said = f"{fault}{error}"[:2000].encode("utf-8", "replace").decode()
        return {"outcome": "unclear" if fault else "refused", "kind": type(error).__name__, "error": said}
    except WrongError as error:
        return {"outcome": "wrong", "error": str(error)}
    except Exception as error:  # what a user must never see
        return {"outcome": "traceback", "error": f"{type(error).__name__}: {error}"[:2000]}


def unclear(message: str, path: str) -> str:
    """Return what is wrong with a message to the user; nothing if it is clear."""
    lines = message.splitlines()
    if path not in message:
        return "it does not name the file: "
    if not 1 <= len(lines) <= 2 or len(message) - len(path) > LONGEST_MESSAGE:
        return f"{len(lines)} lines, {len(message)} characters: "
    if not all(line.isprintable() for line in lines):
        return "it holds control characters: "
    return ""


def _status(key):
    """Return a field of /proc/self/status in bytes."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(f"{key}:"))


def _reset_peak():
    """Set the peak of resident memory to what is resident now, and return that."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    return _status("VmRSS")


if __name__ == "__main__":
    own = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what anything prints counts against it
    main(sys.argv[1], own)
