"""A process that reads damaged files, one after another, and how each went."""

import contextlib
import faulthandler
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import mitsuba as mi

from envedit.core.errors import ConfigError, InputError

from .kinds import WrongError

MIB = 1 << 20
MULTIPLE, ROOM = 8, 64 * MIB
"""Memory a reader may use: in units of the declared float32 image, and beyond that whatever the file says."""
MOST_ADDRESS = 16384 * MIB
"""Address space of the process, so that no file takes the whole memory of the machine."""
LONGEST_MESSAGE = 600
ALLOCATOR = {"MALLOC_PERTURB_": "165", "MALLOC_MMAP_THRESHOLD_": "65536"}
"""Freed memory is overwritten, so that its use is seen; large blocks go back to the system at once."""


def cpu_limit(declared: int, least: float) -> float:
    """Seconds of processor time, all threads together, after which a case counts as hung."""
    return min(least + declared / (20 * MIB), 120)


class Worker:
    """The process, started anew when a file has ended it.

    ``reader`` is a function (path, index) of a module, ``seconds`` the processor time that a small file may
    take, ``patience`` the wall time, for each second of processor time that a case has, after which it is
    stuck.
    """

    def __init__(self, reader: Callable[[Path, int], None], seconds: float = 5.0, patience: float = 20.0):
        self.reader = reader
        self.seconds = seconds
        self.patience = patience
        self.process = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def _start(self):
        self.printed = tempfile.NamedTemporaryFile()  # noqa: SIM115 it lives as long as the process
        spawn = multiprocessing.get_context("spawn")
        self.connection, other = spawn.Pipe()
        asked = (self.reader, other, self.printed.name)
        self.process = spawn.Process(target=_serve, args=asked, daemon=True)
        with mock.patch.dict(os.environ, ALLOCATOR):
            self.process.start()
        other.close()
        self.connection.recv()  # it is ready: starting counts for no file

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.connection.close()
            self.printed.close()
            self.process = None

    def read(self, path: Path, index: int, declared: int) -> dict:
        """Have a file read; returns its ``outcome``, ``error`` and ``peak`` bytes of memory."""
        if self.process is None:
            self._start()
        seconds = cpu_limit(declared, self.seconds)
        wait = self.patience * seconds
        with contextlib.suppress(EOFError, ConnectionError):
            self.connection.send((path, index, declared, seconds))
            if not self.connection.poll(wait):
                self.stop()
                return {"outcome": "hung", "error": f"no answer in {wait:.0f} s of wall time"}
            return self.connection.recv()
        self.process.join()
        code = self.process.exitcode
        said = Path(self.printed.name).read_text(errors="replace")[-1500:]
        self.stop()
        if code == -signal.SIGPROF:
            return {"outcome": "hung", "error": f"{seconds:g} s of processor time\n{said}"}
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return {"outcome": "crashed", "error": f"{name}\n{said}"}


# ---- in the process ----------------------------------------------------------------------------------------


def _serve(reader, connection, printed: str) -> None:
    """Answer requests of :meth:`Worker.read`; what anything prints goes to the file ``printed``."""
    with open(printed, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    faulthandler.enable(file=2)
    resource.setrlimit(resource.RLIMIT_AS, (MOST_ADDRESS, MOST_ADDRESS))
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    warnings.simplefilter("always")  # each is a line on a user's terminal
    connection.send("ready")
    while True:
        connection.send(_limited(reader, printed, *connection.recv()))


def _limited(reader, printed, path, index, declared, seconds) -> dict:
    """Call a reader within its limits; returns how it went, with the ``peak`` of memory."""
    before = os.path.getsize(printed)
    Path("/proc/self/clear_refs").write_text("5")  # the peak is what is resident now
    start = _status("VmRSS")
    signal.setitimer(signal.ITIMER_PROF, seconds)  # its default action ends the process
    try:
        answer = judged(reader, path, index)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    sys.stdout.flush()
    answer["peak"] = _status("VmHWM") - start
    if answer["peak"] > ROOM + MULTIPLE * declared:
        error = f"{answer['peak'] >> 20} MiB for {declared} bytes declared"
        return answer | {"outcome": "memory", "error": error}
    said = Path(printed).read_bytes()[before:]
    if said and answer["outcome"] in ("read", "refused"):
        return answer | {"outcome": "printed", "error": said[:500].decode(errors="replace")}
    return answer


def _status(key):
    """Return a field of /proc/self/status in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


def judged(reader, path: Path, index: int) -> dict:
    """Call a reader and say how it went: "read", "refused", "unclear", "wrong" or "traceback"."""
    try:
        reader(path, index)
        return {"outcome": "read"}
    except (ConfigError, InputError) as error:
        fault = unclear(str(error), str(path))
        said = f"{fault}{error}"[:2000]
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
