"""Arrays kept on disk under a hash of what they were made from, in a folder of bounded size.

An entry is one file: a header with the whole key and a checksum of every array, then the raw arrays, which
are mapped into memory and not parsed. A file that is damaged, cut short or foreign is as good as none, and
one that cannot be written costs nothing but the time to make its arrays again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import tempfile
import time
import zlib
from pathlib import Path

import numpy as np

from envedit.core.atomic_files import replacing
from envedit.core.errors import InputError

MOST_BYTES = 4_000_000_000
"""Size above which a folder loses the entries that were not used for longest."""
_MAGIC = b"envedit1"
_ALIGNED, _PAGE = 64, 4096
_OURS = re.compile(r"[0-9a-f]{32}\.arrays|(?P<temporary>\.[0-9a-f]{32}\.arrays\.\d+)")
_ABANDONED = 3600.0  # seconds after which a temporary file belongs to no writer that is still alive


class DiskCache:
    """Dicts of arrays by key.

    Parameters
    ----------
    folder : Path or None
        Where the files lie; made when first needed. None: nothing is kept.
    most_bytes : int
        Bound on the size of the files in it.
    """

    def __init__(self, folder: Path | None, most_bytes: int = MOST_BYTES):
        self.folder, self.most_bytes = folder, most_bytes

    def load(self, key: dict) -> dict[str, np.ndarray] | None:
        """Return the arrays that were stored under a key; None if there are none, or none that are whole.

        Parameters
        ----------
        key : dict
            What the arrays were made from, as JSON knows it.

        Returns
        -------
        dict of str to ndarray
            Read-only, and mapped: to be copied if they are to outlive their use.
        """
        if self.folder is None:
            return None
        path = self._path(key)
        try:
            arrays = _read(path, _text(key))
        except (OSError, ValueError):
            return None
        with contextlib.suppress(OSError):  # somebody else's folder is as good to read from
            os.utime(path)  # the time of last use, by which entries are dropped
        return arrays

    def store(self, key: dict, arrays: dict[str, np.ndarray]) -> None:
        """Keep arrays under a key, in place of older ones that would take the folder beyond its bound."""
        if self.folder is None:
            return
        arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
        head = _header(_text(key), arrays)
        size = len(head) + sum(_padded(array.nbytes) for array in arrays.values())
        if size > self.most_bytes:
            return
        path = self._path(key)
        with contextlib.suppress(OSError, InputError):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._make_room(size, path)
            with replacing(path) as temporary, open(temporary, "wb") as file:
                file.write(head)
                for array in arrays.values():
                    file.write(array.reshape(-1).view(np.uint8))
                    file.write(bytes(_padded(array.nbytes) - array.nbytes))

    def remove(self, key: dict) -> None:
        """Delete what is stored under a key, if anything is."""
        if self.folder is not None:
            with contextlib.suppress(OSError):
                self._path(key).unlink(missing_ok=True)

    def files(self) -> list[Path]:
        """List the entries on disk."""
        if self.folder is None or not self.folder.is_dir():
            return []
        return [p for p in sorted(self.folder.iterdir()) if _OURS.fullmatch(p.name) and p.is_file()]

    def _path(self, key):
        return self.folder / f"{hashlib.sha256(_text(key).encode()).hexdigest()[:32]}.arrays"

    def _make_room(self, size, replaced):
        """Delete the entries used longest ago until ``size`` bytes fit; nothing that is not ours."""
        found = []
        for entry in os.scandir(self.folder):
            if (ours := _OURS.fullmatch(entry.name)) and entry.is_file(follow_symlinks=False):
                about = entry.stat(follow_symlinks=False)
                if ours["temporary"] and time.time() - about.st_mtime > _ABANDONED:
                    os.unlink(entry.path)
                elif entry.name != replaced.name:
                    found.append((about.st_mtime_ns, about.st_size, entry.path, ours["temporary"]))
        total = sum(bytes_ for _, bytes_, _, _ in found)
        for _, bytes_, path, temporary in sorted(found, key=lambda one: one[0]):
            if total + size <= self.most_bytes:
                break
            if not temporary:  # somebody is writing it
                Path(path).unlink(missing_ok=True)
                total -= bytes_


def _text(key):
    return json.dumps(key, sort_keys=True)


def _padded(size):
    return -(-size // _ALIGNED) * _ALIGNED


def _checksum(array):
    """CRC of the sums of an array's 4 kB pages: as quick as memory, which a CRC of all bytes is not."""
    raw = array.reshape(-1).view(np.uint8)
    whole = len(raw) // _PAGE * _PAGE
    sums = raw[:whole].view(np.uint64).reshape(-1, _PAGE // 8).sum(axis=1)
    return zlib.crc32(raw[whole:], zlib.crc32(sums))


def _header(text, arrays):
    """Magic number, length and CRC of the description, and the description in JSON, padded."""
    listed = [[name, a.dtype.str, a.shape, _checksum(a)] for name, a in arrays.items()]
    description = json.dumps({"key": text, "arrays": listed}).encode()
    numbers = len(description), zlib.crc32(description)
    head = _MAGIC + b"".join(number.to_bytes(4, "little") for number in numbers) + description
    return head.ljust(_padded(len(head)), b"\0")


def _read(path, text):
    """Map the arrays of a file; ValueError if it is not whole or holds another key."""
    raw = np.memmap(path, np.uint8, "r")
    length, checksum = (int.from_bytes(raw[i : i + 4].tobytes(), "little") for i in (8, 12))
    description = raw[16 : 16 + length].tobytes()
    if raw[:8].tobytes() != _MAGIC or zlib.crc32(description) != checksum:
        raise ValueError
    description = json.loads(description)
    if description["key"] != text:
        raise ValueError
    place, arrays = _padded(16 + length), {}
    for name, kind, shape, checksum in description["arrays"]:
        dtype = np.dtype(kind)
        size = dtype.itemsize * math.prod(shape)
        array = raw[place : place + size].view(dtype).reshape(shape)
        if _checksum(array) != checksum:
            raise ValueError
        arrays[name] = array
        place += _padded(size)
    return arrays


def cache_folder(kind: str) -> Path:
    """Folder in which one kind of file is kept between runs: $XDG_CACHE_HOME/envedit/KIND or in ~/.cache.

    In the system's folder for temporary files where the user has no home.
    """
    if not (base := os.environ.get("XDG_CACHE_HOME")):
        try:
            base = Path.home() / ".cache"
        except RuntimeError:
            base = tempfile.gettempdir()
    return Path(base) / "envedit" / kind
