"""Arrays kept on disk under a hash of what they were made from, in a folder of bounded size.

An entry is one file: a header with the whole key and a digest of every array, by SHA-256, then the raw
arrays, which are mapped into memory and not parsed. A file that is damaged, cut short or foreign is as good
as none, as is one in a folder that others may write to, and one that cannot be written costs nothing but the
time to make its arrays again. A digest detects damage, not intent: callers check shapes and ranges too
(``is_whole``).

SHA-256 reads 1.8 GB/s a core where the processor has instructions for it, BLAKE2b 0.9 GB/s.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import stat
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from envedit.core.atomic_files import opened, replacing
from envedit.core.errors import InputError

MOST_BYTES = 4_000_000_000
"""Size above which a folder loses the entries that were not used for longest."""
_MAGIC = b"envedit3"
_ALIGNED = 64
_PART = 1 << 23
_START = len(_MAGIC) + 8 + 32  # magic, length and SHA-256 of the description
_OURS = re.compile(r"[0-9a-f]{32}\.arrays|(?P<temporary>\.[0-9a-f]{32}\.arrays\.\d+)")
_ABANDONED = 3600.0  # seconds after which a temporary file belongs to no writer that is still alive


class DiskCache:
    """Dicts of arrays by key, in files of at most ``most_bytes`` in all.

    ``folder`` is made when first needed; None: nothing is kept.
    """

    def __init__(self, folder: Path | None, most_bytes: int = MOST_BYTES):
        self.folder, self.most_bytes = folder, most_bytes

    def load(
        self, key: dict, is_whole: Callable[[dict[str, np.ndarray]], bool] | None = None
    ) -> dict[str, np.ndarray] | None:
        """Return the arrays that were stored under a key; None if there are none, or none that are whole.

        ``key`` is what they were made from, as JSON knows it. ``is_whole`` returns whether arrays are such as
        :meth:`store` was given: names, types, shapes and ranges; what it raises is a no. Arrays are read-only
        and mapped: to be copied if they are to outlive their use.
        """
        if self.folder is None or not _private(self.folder):
            return None
        path = self._path(key)
        try:
            arrays = _read(path, _text(key))
            if is_whole is not None and not is_whole(arrays):
                return None
        except Exception:  # what a header that is believed can lead to has many names
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
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _private(self.folder):
                return
            self._make_room(size, path)
            with replacing(path) as temporary, open(temporary, "wb") as file:
                file.write(head)
                for array in arrays.values():
                    file.write(array.reshape(-1).view(np.uint8).data)
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
        assert self.folder is not None  # without one nothing is read or written
        return self.folder / f"{hashlib.sha256(_text(key).encode()).hexdigest()[:32]}.arrays"

    def _make_room(self, size, replaced):
        """Delete the entries used longest ago until ``size`` bytes fit; nothing that is not ours."""
        entries = []
        for entry in os.scandir(self.folder):
            if (ours := _OURS.fullmatch(entry.name)) and entry.is_file(follow_symlinks=False):
                about = entry.stat(follow_symlinks=False)
                if ours["temporary"] and time.time() - about.st_mtime > _ABANDONED:
                    os.unlink(entry.path)
                elif entry.name != replaced.name:
                    entries.append((about.st_mtime_ns, about.st_size, entry.path, ours["temporary"]))
        total = sum(bytes_ for _, bytes_, _, _ in entries)
        for _, bytes_, path, temporary in sorted(entries, key=lambda entry: entry[0]):
            if total + size <= self.most_bytes:
                break
            if not temporary:  # somebody is writing it
                Path(path).unlink(missing_ok=True)
                total -= bytes_


def _text(key):
    return json.dumps(key, sort_keys=True)


def _padded(size):
    return -(-size // _ALIGNED) * _ALIGNED


def _digest(array):
    """SHA-256 of the SHA-256 of every :data:`_PART` bytes, which all cores work on."""
    data = array.reshape(-1).view(np.uint8)
    parts = [data[i : i + _PART] for i in range(0, max(len(data), 1), _PART)]
    if len(parts) == 1:
        digests = [hashlib.sha256(parts[0]).digest()]
    else:
        with ThreadPoolExecutor(min(len(parts), os.cpu_count() or 1)) as pool:
            digests = list(pool.map(lambda part: hashlib.sha256(part).digest(), parts))
    return hashlib.sha256(b"".join(digests)).hexdigest()


def _header(text, arrays):
    """Magic number, length and SHA-256 of the description, and the description in JSON, padded."""
    listed = [[name, a.dtype.str, a.shape, _digest(a)] for name, a in arrays.items()]
    description = json.dumps({"key": text, "arrays": listed}).encode()
    length = len(description).to_bytes(8, "little")
    head = _MAGIC + length + hashlib.sha256(description).digest() + description
    return head.ljust(_padded(len(head)), b"\0")


def _read(path, text):
    """Map the arrays of a file; raises if it is not whole or holds another key."""
    with opened(path) as file:
        raw = np.memmap(file, np.uint8, "r")
    length = int.from_bytes(raw[8:16].tobytes(), "little")
    description = raw[_START : _START + length].tobytes()
    if raw[:8].tobytes() != _MAGIC or hashlib.sha256(description).digest() != raw[16:_START].tobytes():
        raise ValueError
    description = json.loads(description)
    if description["key"] != text:
        raise ValueError
    place = _padded(_START + length)
    arrays = {}
    for name, kind, shape, digest in description["arrays"]:
        dtype = np.dtype(kind)
        if dtype.kind not in "biuf" or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError
        size = dtype.itemsize * math.prod(shape)
        array = raw[place : place + size].view(dtype).reshape(shape)
        if _digest(array) != digest:
            raise ValueError
        arrays[name] = array
        place += _padded(size)
    return arrays


def holds(arrays: dict[str, np.ndarray], expected: dict[str, tuple]) -> bool:
    """Return whether arrays have these names, types and shapes, and hold finite numbers.

    ``expected`` has type and shape by name; a length of None in a shape is any.
    """
    return arrays.keys() == expected.keys() and all(
        array.dtype == np.dtype(dtype)
        and len(array.shape) == len(shape)
        and all(size in (None, length) for length, size in zip(array.shape, shape, strict=True))
        and bool(np.isfinite(array).all())
        for array, (dtype, shape) in ((arrays[name], expected[name]) for name in expected)
    )


def _private(folder):
    """Return whether only this user (and the system's) can have written into a folder; True of none."""
    try:
        about = os.stat(folder)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    ours = not hasattr(os, "geteuid") or about.st_uid in (os.geteuid(), 0)
    return stat.S_ISDIR(about.st_mode) and ours and not about.st_mode & stat.S_IWOTH


def cache_home() -> Path | None:
    """Folder of all that is kept between runs: $XDG_CACHE_HOME/envedit, or ~/.cache/envedit.

    None where the user has no home: in a folder for everybody, others could have put what they like.
    """
    if not os.path.isabs(base := os.environ.get("XDG_CACHE_HOME") or ""):  # as its specification has it
        base = os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "envedit" if os.path.isabs(base) else None


def cache_folder(kind: str) -> Path | None:
    """Folder in which one kind of file is kept between runs, in :func:`cache_home`; None: nowhere."""
    home = cache_home()
    return None if home is None else home / kind
