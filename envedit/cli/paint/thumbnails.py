"""Small pictures of maps and of earlier paintings for the start page, made by a process of its own.

The process reads files as they are read when they are opened (:mod:`.images`): no file runs code in it. It
has the lowest priority and ends when a painting is opened, which it therefore does not slow down. What cannot
be read has no picture; should a damaged file end the process, the larger ones have none either.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from envedit.core.color import brightest_shown, tonemap
from envedit.core.errors import EnveditError, InputError
from envedit.core.resampling import fit
from envedit.images import images

WIDTH = 240
"""Pixels across: the page shows them 120 wide, on displays of two pixels a point."""
MOST_MAPS = 24
"""Maps that are offered, those written last."""
ENDINGS = (".exr", ".hdr")
MEMORY = 2**31
"""Address space for reading, beside the program's: a map of 8192 x 4096 takes 1.0 GB; one that takes more
than this has no picture."""


def maps(folders: Sequence[Path]) -> list[Path]:
    """List the maps that are offered: OpenEXR and Radiance files of folders, by name."""
    found = []
    for folder in folders:
        try:
            files = [file for file in folder.iterdir() if file.suffix.lower() in ENDINGS and file.is_file()]
            found += [(file.stat().st_mtime, file) for file in files]
        except OSError:  # no such folder, or a file that has just gone
            continue
    return sorted(file for _, file in sorted(found, reverse=True)[:MOST_MAPS])


class Thumbnails:
    """Makes pictures of files until :meth:`stop`.

    Each is said as soon as it is made: a message ``thumbnail`` with ``file`` and ``picture``, a PNG in
    base 64, or None for a file that cannot be read or, where it should be a map, is not 2:1.
    """

    def __init__(self, say: Callable[[dict], None]):
        self._say = say
        self._running: list[subprocess.Popen] = []
        self._lock = threading.Lock()
        self._stopped = False

    def make(self, files: Sequence[tuple[str, bool]]) -> None:
        """Begin with some files, each with whether it should be a map."""
        self._stopped = False
        threading.Thread(target=self._tell, args=([*files],), daemon=True).start()

    def stop(self) -> None:
        """End at once; safe to call twice."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.kill()

    def _tell(self, files):
        from envedit.scene.scene_files import CODE, request

        with self._lock:
            if self._stopped or not files:
                return
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", CODE],  # -P: no module of the working folder
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process
            )
            self._running.append(process)
        with process:
            try:
                process.stdin.write(request(__name__, [files]))
                process.stdin.close()
            except BrokenPipeError:  # it was stopped
                return
            for line in process.stdout:
                if line.endswith(b"\n"):  # or it was stopped while it wrote
                    self._say({"type": "thumbnail", **json.loads(line)})


# ---- In the other process ----------------------------------------------------------------------------------


def main(files: Sequence[tuple[str, bool]]) -> None:
    """Write a line of JSON for each file, the smallest files first."""
    from envedit.scene.scene_files import address_space, begin, limit

    say = begin()
    if hasattr(os, "nice"):
        os.nice(19)
    limit("RLIMIT_AS", address_space() + MEMORY)
    there = [(os.path.getsize(file), file, panorama) for file, panorama in files if os.path.exists(file)]
    for _, file, panorama in sorted(there):
        picture = None
        with contextlib.suppress(EnveditError, MemoryError):
            picture = base64.b64encode(thumbnail(file, panorama)).decode()
        say({"file": file, "picture": picture})


def thumbnail(file: str, panorama: bool) -> bytes:
    """Return a PNG, :data:`WIDTH` across, of an image; InputError if it cannot be read, or is no map.

    Exposed for its :func:`.brightest_shown`, under gamma.
    """
    image, _ = images.read(file)
    height, width, _ = image.shape
    if panorama and abs(width - 2 * height) > 1:
        raise InputError(f"{file}: is no map: got {width} x {height}, expected 2:1")
    step = max(1, width // (4 * WIDTH))  # of a large one 16 texels a pixel are enough
    few = np.nan_to_num(image[::step, ::step], nan=0.0, posinf=0.0, neginf=0.0)
    small = np.maximum(fit(few, max(1, round(WIDTH * height / width)), WIDTH), 0)
    brightest = brightest_shown(small)
    shown = tonemap(small / brightest if brightest > 0 else small)
    return images.png(np.round(255 * np.clip(shown, 0, 1)).astype(np.uint8))
