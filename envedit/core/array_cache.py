"""Arrays kept on disk under a hash of what they were made from, in a folder of bounded size.

An entry is an uncompressed npz file that holds the whole key beside the arrays. Damaged, truncated or foreign
files are ignored, as are those in a folder that others may write to; an entry that cannot be written only
costs the time to make its arrays again. A CRC detects damage, not intent: the folder must be the user's own
(``SECURITY.md``).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import stat
import time
from pathlib import Path
from typing import Any

import numpy as np

from envedit.core.atomic_files import opened, replacing
from envedit.core.errors import InputError

MOST_BYTES = 4_000_000_000
"""Size above which a folder loses the entries that were not used for longest."""
KEY = "__key__"
"""Name of the array in an entry that holds its key."""
_OURS = re.compile(r"[0-9a-f]{32}\.arrays|(?P<temporary>\.[0-9a-f]{32}\.arrays\.\d+)")
_ABANDONED = 3600.0  # seconds after which a temporary file belongs to no writer that is still alive


class DiskCache:
    """Dicts of arrays by key, in files of at most ``most_bytes`` in all.

    ``folder`` is made when first needed; None: nothing is kept.
    """

    def __init__(self, folder: Path | None, most_bytes: int = MOST_BYTES):
        self.folder, self.most_bytes = folder, most_bytes

    def load(self, key: dict) -> dict[str, np.ndarray] | None:
        """Return the arrays that were stored under a key; None if there are none, or none that are whole.

        ``key`` is what they were made from, as JSON knows it.
        """
        if self.folder is None or not _private(self.folder):
            return None
        path = self._path(key)
        try:
            arrays = _read(path, _text(key))
        except Exception:  # what a header that is believed can lead to has many names
            return None
        with contextlib.suppress(OSError):  # somebody else's folder is as good to read from
            os.utime(path)  # the time of last use, by which entries are dropped
        return arrays

    def store(self, key: dict, arrays: dict[str, np.ndarray]) -> None:
        """Keep arrays under a key, in place of older ones that would take the folder beyond its bound."""
        if self.folder is None:
            return
        text = _text(key)
        size = len(text) + sum(np.asarray(array).nbytes for array in arrays.values())
        if size > self.most_bytes:
            return
        path = self._path(key)
        with contextlib.suppress(OSError, InputError):
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _private(self.folder):
                return
            self._make_room(size, path)
            with replacing(path) as temporary, open(temporary, "wb") as file:
                entries: dict[str, Any] = {**arrays, KEY: np.array(text)}  # the key last: lost if cut short
                np.savez(file, **entries)

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
        return self.folder / f"{hashlib.sha256(_text(key)).hexdigest()[:32]}.arrays"

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
    return json.dumps(key, sort_keys=True).encode()


def _read(path, text):
    """Read the arrays of a file; raises if it is not whole or holds another key."""
    with opened(path) as file, np.load(file) as archive:
        # Beside the CRCs of what is read: those of what a damaged header leaves unread.
        if archive.zip.testzip() is not None or archive[KEY].item() != text:
            raise ValueError
        return {name: archive[name] for name in archive.files if name != KEY}


def under(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names have a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


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
