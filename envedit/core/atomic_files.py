"""Files that are written whole or not at all, and read only where they are regular files."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
import stat
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING

from envedit.core.errors import EnveditError, InputError

if TYPE_CHECKING:
    from envedit.core.types import FilePath

MOST_BYTES = 2**32
"""Size of a file that is hashed: twice what the largest map (four channels, float32) or mesh may have."""


@contextlib.contextmanager
def replacing(path: FilePath, suffix: str = "") -> Iterator[Path]:
    """Give a temporary name in the same folder, and move what was written there to ``path`` at the end.

    A reader sees the old file or the new one. If anything fails the old file stays and the temporary one is
    removed.

    ``suffix`` is the ending of the temporary name, for libraries that read the format from it. InputError if
    the file cannot be written: for an OSError, RuntimeError or ValueError (libraries raise any of these)
    inside the block or while moving.
    """
    target = Path(os.fsdecode(path))
    temporary = target.with_name(f".{target.name}.{os.getpid()}{suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except EnveditError:
        raise
    except (OSError, RuntimeError, ValueError) as e:
        if not target.parent.is_dir():
            reason = "its folder does not exist"
        else:  # the libraries' texts name the temporary file; what follows the last stop is the cause
            reason = (getattr(e, "strerror", None) or re.split(r"[:.] ", str(e))[-1]).strip(" .")
        raise InputError(f"{target}: cannot be written ({reason}); check folder and free space") from None
    finally:
        with contextlib.suppress(OSError, ValueError):
            temporary.unlink(missing_ok=True)


def write_atomically(path: FilePath, data: bytes) -> None:
    """Write bytes as a file, whole or not at all; InputError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def opened(path: FilePath) -> BufferedReader:
    """Open a regular file for reading bytes; OSError as of ``open``, and for what is no regular file.

    A pipe or a device would wait or never end.
    """
    not_waiting = getattr(os, "O_NONBLOCK", 0)
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | not_waiting))  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "is no regular file", os.fspath(path))
    return file


def make_folder(folder: Path) -> Path:
    """Make a folder where there is none, and return it; InputError if it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}): give another folder") from None
    return folder


def digest(path: FilePath) -> bytes:
    """Return the SHA-256 of a regular file, computed once while size and time of change stay the same.

    InputError if it cannot be read, or has more than :data:`MOST_BYTES`: it is no input of a run.
    """
    try:
        about = os.stat(path)
        return _digest(os.fspath(path), about.st_size, about.st_mtime_ns, about.st_ino)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


@functools.lru_cache(maxsize=4096)
def _digest(path, size, changed, inode):
    if size > MOST_BYTES:
        raise InputError(f"{path}: {size} bytes, expected at most {MOST_BYTES}")
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").digest()
