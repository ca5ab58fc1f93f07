"""USD files as Mitsuba scenes: ``scene.xml`` and a folder with meshes, made by a process of its own.

The process loads no plugins but USD's own and runs no code of a file. Its bounds are in
:mod:`envedit.scene.usd.stage`.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

from envedit.core import atomic_files, shipped
from envedit.core.array_cache import cache_folder
from envedit.core.errors import ConfigError, InputError
from envedit.core.extras import required
from envedit.core.types import FilePath
from envedit.scene import scene_files

_VERSION = 2  # of what is made of the same file
_KEPT = 64  # converted scenes in the folder of caches
SECONDS = 120
"""Processor time of the other process."""
_ENVIRONMENT = {
    "PXR_PLUGINPATH_NAME": "",
    "PXR_AR_DISABLE_PLUGIN_RESOLVER": "1",
    "PXR_WORK_THREAD_LIMIT": "1",
    "MALLOC_ARENA_MAX": "2",
}


class Converted(NamedTuple):
    """A Mitsuba scene that was made of a USD file."""

    xml: Path  # the scene
    notes: tuple[str, ...]  # what of the file is not used
    sources: tuple[str, ...]  # files that it was made of: layers and textures
    stage: dict  # ``upAxis`` and ``metersPerUnit`` of the USD file, and the paths of its ``domes``


def is_usd(file: object) -> bool:
    """Return whether a name is that of a USD file."""
    return isinstance(file, str | os.PathLike) and os.fspath(file).lower().endswith(shipped.USD_ENDINGS)


def convert(file: FilePath, xml: Path, camera: str = "", time: float | None = None) -> Converted:
    """Write a USD file as a Mitsuba scene, ``xml``, with ``NAME_files`` beside it; neither may exist.

    ``camera`` is the path of a camera; "": the only one; "all": every one, each as a sensor with its path as
    id. ``time`` is the time code of animated values; None: the first of the stage.

    ConfigError if there are several cameras and none is chosen, or none of that path. InputError if the USD
    file is missing, damaged or declares too much, names missing textures, or has no camera or no surface, or
    if a file is in the way. MachineError if the extra ``usd`` is not installed.
    """
    # ---- Refuse what cannot be read or written
    file = Path(file).absolute()
    required("pxr", "usd", os.fspath(file))
    if not os.path.isfile(file):
        raise InputError(f"{file}: no such file")
    folder = xml.with_name(f"{xml.stem}_files")
    for path in (xml, folder):
        if path.exists() or path.is_symlink():
            raise InputError(f"{path}: exists already; give the scene another name")

    # ---- Write beside the result, then rename
    try:
        with tempfile.TemporaryDirectory(prefix=f".{xml.name}.", dir=xml.parent) as temporary:
            draft = Path(temporary) / xml.name
            request = {"file": str(file), "xml": str(draft), "camera": camera, "time": time}
            answer = _answer(file, request)
            if (Path(temporary) / folder.name).exists():
                os.rename(Path(temporary) / folder.name, folder)
            os.rename(draft, xml)
    except OSError as error:
        raise InputError(f"{xml}: cannot be written ({error.strerror})") from None
    notes = tuple(f"{file.name}: {note}" for note in answer["notes"])
    return Converted(xml, notes, tuple(answer["sources"]), answer["stage"])


def _answer(file, request):
    """Let another process convert; raises what it says."""
    lines = scene_files.lines_of("envedit.scene.usd.stage", [request, SECONDS], SECONDS, _ENVIRONMENT)
    if len(lines) < 2:
        raise InputError(f"{file}: declares more than can be read in {SECONDS} s and 8 GiB, or is damaged")
    answer = lines[1]
    if "error" in answer:
        raise (ConfigError if answer["usage"] else InputError)(answer["error"])
    return answer


# ---- Scenes that are kept ----------------------------------------------------------------------------------


def kept(file: FilePath) -> Converted:
    """Return the scene of a USD file in the folder of caches, made anew where one of its sources has changed.

    Errors are those of :func:`convert`, which is asked for all cameras.
    """
    file = Path(file).absolute()
    root = _folder()
    key = json.dumps([str(file), _digests([str(file)]), _VERSION])
    folder = root / hashlib.sha256(key.encode()).hexdigest()[:32]
    xml = folder / f"{file.stem}.xml"
    state = folder / "converted.json"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(state.read_text(encoding="utf-8"))
        if known["sources"] == _digests(known["sources"]) and xml.is_file():
            os.utime(state)
            return Converted(xml, tuple(known["notes"]), tuple(known["sources"]), known["stage"])

    # ---- Made in a folder beside, which takes the place of the old one
    try:
        draft = Path(tempfile.mkdtemp(prefix=".", dir=root))
    except OSError as error:
        raise InputError(f"{root}: cannot be written ({error.strerror})") from None
    try:
        converted = convert(file, draft / xml.name, "all")
        known = {"notes": converted.notes, "sources": _digests(converted.sources), "stage": converted.stage}
        (draft / state.name).write_text(json.dumps(known), encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # another process was faster with the same
            os.rename(draft, folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    with contextlib.suppress(OSError):  # another process deletes some as well
        for old in sorted(root.glob("*/converted.json"), key=os.path.getmtime)[:-_KEPT]:
            shutil.rmtree(old.parent, ignore_errors=True)
    return converted._replace(xml=xml)


def _folder():
    """Return the folder of converted scenes: of caches; where none can be kept, one of this process."""
    root = cache_folder("usd")
    if root is not None:
        with contextlib.suppress(OSError):
            root.mkdir(parents=True, exist_ok=True, mode=0o700)
            if os.access(root, os.W_OK):
                return root
    return Path(_scratch().name)


@functools.cache
def _scratch():
    """Return a folder that is gone when the process ends."""
    return tempfile.TemporaryDirectory(prefix="envedit_usd_")


def _digests(files):
    """Return the digest of each file, by its path; "" of one that cannot be read."""
    digests = {}
    for file in files:
        digests[file] = ""
        with contextlib.suppress(InputError):
            digests[file] = atomic_files.digest(file).hex()
    return digests
