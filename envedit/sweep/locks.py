"""Who works in a folder: locks that outlive nobody, on one machine or on a shared file system."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
import uuid
from pathlib import Path

from envedit.core.atomic_files import write_atomically

BEAT, LOST = 20.0, 150.0
"""Seconds between signs of life, and without any until another machine's lock is taken for dead."""


class Lock:
    """The right to work in a folder, as long as one of the processes named in it lives; a context manager.

    .. code-block:: python

       with Lock(folder) as lock:
           if lock.holder:
               return f"{lock.holder} is at it"
           ...

    Every process that asks for it writes a file with a name of its own, then looks for others. Of two that do
    so at the same time at least one sees the other and steps back; a file that nobody but its owner ever
    writes can be removed without asking once its owner is dead. Whether it is: on the same machine by its
    processes, on another one by the age of the file, which its owner touches now and then.

    Attributes
    ----------
    holder : str
        Who has it; empty: we do.
    """

    def __init__(self, folder: Path):
        self._path = Path(folder) / f"lock-{uuid.uuid4().hex}"
        self._processes: list[list[int]] = []
        self._beaten = time.monotonic()
        self.holder = ""

    def __enter__(self) -> Lock:
        self.add(os.getpid())
        now = self._path.stat().st_mtime  # by the clock of whoever keeps the files
        named = self._path.parent.glob(f"lock-{32 * '[0-9a-f]'}")
        for other in [path for path in named if path != self._path and path.is_file()]:
            if holder := _holder(other, now):
                self.holder = holder
                break
            other.unlink(missing_ok=True)
        return self

    def __exit__(self, *exception: object) -> None:
        self._path.unlink(missing_ok=True)

    def add(self, pid: int) -> None:
        """Name one more process, in whose life the lock is held."""
        self._processes.append([pid, _started(pid)])
        write_atomically(self._path, json.dumps({"host": _host(), "processes": self._processes}).encode())

    def beat(self) -> bool:
        """Give a sign of life when it is time; False if the lock was taken for dead and removed."""
        if time.monotonic() - self._beaten < BEAT:
            return True
        self._beaten = time.monotonic()
        try:
            os.utime(self._path)
        except FileNotFoundError:
            return False
        except OSError:  # a file server that is away for a moment
            pass
        return True


def _holder(path, now):
    """Who holds a lock, in words; empty if its owner is dead or it is gone.

    A time far in the future is no sign of a living owner, as one far in the past is none.
    """
    try:
        age = abs(now - path.stat().st_mtime)
        owner = json.loads(path.read_bytes())
        host, processes = owner["host"], owner["processes"]
        if host == _host():
            alive = [pid for pid, started in processes if started is not None and _started(pid) == started]
        else:
            alive = [pid for pid, _ in processes if age < LOST]
    except FileNotFoundError:
        return ""
    except (OSError, ValueError, KeyError, TypeError):
        return f"the lock {path.name}" if age < LOST else ""
    return f"process {alive[0]} on {host.partition(' ')[0]}" if alive else ""


def _host():
    """Name of the machine, and of the space in which process ids count: a container has its own."""
    space = ""
    with contextlib.suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    return f"{socket.gethostname()} {space}"


def _started(pid):
    """When a living process was started, in the system's ticks, as ids come again; 0: unknown; None: dead."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] in "ZX" else int(fields[19])  # a zombie has ended
    except OSError:
        if Path("/proc/self/stat").exists():
            return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except OSError:
        pass
    return 0
