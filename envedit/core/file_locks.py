"""Locks that end with the processes that hold them, however these end.

A lock belongs to an open file. A child process that inherits the file holds the lock as well; the kernel
releases it when the last of them has closed the file or has died. On Linux this includes NFS.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from envedit.core.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


class Busy(Exception):
    """Another process holds a lock; its text says which one."""


def lock(descriptor: int) -> bool:
    """Lock an open file or folder until it is closed; False if somebody else has locked it.

    Also True where there are no locks, as on some network file systems.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


@contextlib.contextmanager
def locked(path: Path) -> Iterator[TextIO]:
    """Make a lock file, hold its lock, and remove it at the end; yields the open file.

    Busy if another process holds it: "process 1234 on HOST"; InputError if the file cannot be made.
    """
    try:
        file = open(path, "a+", encoding="utf-8")  # noqa: SIM115
    except OSError as error:
        reason = f"cannot be written ({error.strerror}); check folder and free space"
        raise InputError(f"{path}: {reason}") from None
    with file:
        # A file without a name was removed by its holder after it was opened here: it locks nothing.
        if not lock(file.fileno()) or os.fstat(file.fileno()).st_nlink == 0:
            file.seek(0)
            raise Busy(file.read() or "another process")
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        try:
            yield file
        finally:
            path.unlink(missing_ok=True)
