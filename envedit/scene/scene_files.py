"""Files that a scene names are read by a process of their own first, before Mitsuba reads them here.

Mitsuba 3.9 believes the sizes and indices that a file states: it stops the process on a damaged one, takes
the memory that a header declares, and repeats lines of a file that is something else. Whatever happens to the
other process becomes an error that names the file. What it has read well is remembered by content in the
folder of caches, and not tried again. Why so: ``docs/decisions/files_of_scenes.md``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import atomic_files, installed_plugins, shipped
from envedit.core.array_cache import DiskCache, cache_folder
from envedit.core.errors import InputError, MachineError
from envedit.images import exr, images
from envedit.images.headers import head_of

MESHES = {"ply", "obj", "serialized"}
CURVES = {"bsplinecurve", "linearcurve"}
VOLUMES = {"gridvolume", "sdfgrid"}
PLUGINS = MESHES | CURVES | VOLUMES | {"bitmap", "ellipsoids", "ellipsoidsmesh", "spectrum"}
"""Those whose files are tried; ``spectrum`` is the XML element."""
SECONDS, BYTES_PER_SECOND = 60, 2**23
"""Processor time of the other process: 60 s, and a second for every 8 MiB that it reads."""
MEMORY, MEMORY_PER_BYTE = 2**30, 20
"""Its address space for a mesh or a volume: 1 GiB, and 20 bytes for each that the file has."""
IMAGE_MEMORY = 2**34
"""For an image, whose size is bounded by what its header may declare."""
_WAIT = 4  # times the processor time, on the clock
_REMEMBERED_BYTES = 2**20  # of entries in the folder of caches: some 2,000 files
CODE = """
import importlib, json, sys
sys.path[:], module, arguments = json.load(sys.stdin)
importlib.import_module(module).main(*arguments)
"""
"""Runs ``main`` of a module in a process of its own, which reads ``sys.path``, the module's name and
arguments from standard input, as JSON."""
_HINTS = {"ply": ", as triangles", "spectrum": ", as NAME.spd"}  # what Mitsuba reads of these


class SceneFile(NamedTuple):
    """A file, by absolute path, the plugin that reads it, and which of several meshes in it."""

    plugin: str
    path: str
    shape_index: int = 0


def errors(files: Sequence[SceneFile]) -> list[InputError]:
    """Return what is wrong with files; no error holds text out of one.

    Files of the package, those of other plugins, and those whose content is known are not tried. InputError
    if a file cannot be read from the disk, or is larger than 4 GiB; MachineError if no other process starts.
    """
    store = DiskCache(cache_folder("scene_files"), _REMEMBERED_BYTES)
    unknown: dict[str, SceneFile] = {}
    for file in files:
        if file.plugin in PLUGINS and not shipped.holds(Path(file.path)):
            key = _key(file)
            if store.load({"good": key}) is None:
                unknown[key] = file
    wrong = []
    while unknown:  # files without an answer are tried again
        for key, answer in zip([*unknown], _answers([*unknown.values()]), strict=False):
            path = unknown.pop(key).path
            if answer:
                wrong.append(InputError(f"{path}: {answer}"))
            else:
                store.store({"good": key}, {})
    return wrong


def _key(file):
    """Return what a file's being good depends on."""
    digest = atomic_files.digest(file.path)
    return f"{file.plugin} {file.shape_index} {digest.hex()} Mitsuba {mi.__version__}"


def _answers(files):
    """Return what another process has to say of files: "" or what is wrong, up to the one that ended it."""
    seconds = SECONDS + sum(os.path.getsize(file.path) for file in files) // BYTES_PER_SECOND
    _, *answers = lines_of(__name__, [files, seconds], seconds)
    if len(answers) < len(files):
        answers.append(f"Mitsuba stops as it reads this file, or takes over {seconds} s; export it again")
    return answers


def lines_of(
    module: str, arguments: Sequence, seconds: float, environment: Mapping[str, str] | None = None
) -> list[Any]:
    """Return the lines of JSON that the ``main`` of a module writes in a process of its own.

    It writes a first line as soon as it has begun. ``arguments`` are those of its ``main``, as JSON knows
    them, ``seconds`` the processor time that it allows itself, and ``environment`` more variables of its
    environment. MachineError if it cannot be started.
    """
    try:
        output = subprocess.run(
            [sys.executable, "-P", "-c", CODE],
            input=request(module, arguments),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_WAIT * seconds,
            start_new_session=True,  # Ctrl-C is for this process
            env={**os.environ, **(environment or {})},
        ).stdout
    except subprocess.TimeoutExpired as error:
        output = error.stdout or b""
    except OSError as error:
        raise MachineError(f"{sys.executable}: cannot be started to read files ({error.strerror})") from None
    lines = [json.loads(line) for line in output.splitlines()]
    if not lines:
        raise MachineError(f"{sys.executable}: the process that reads files of a scene does not start")
    return lines


def request(module: str, arguments: Sequence) -> bytes:
    """Return what :data:`CODE` reads to run the ``main`` of a module."""
    return json.dumps([[os.fspath(folder) for folder in sys.path], module, arguments]).encode()


# ---- In the other process ----------------------------------------------------------------------------------


def begin() -> Callable[[Any], None]:
    """Select a variant of Mitsuba, and silence what libraries print of odd files.

    Returns a function that writes a value as a line of JSON to the process that has started this one.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    mi.set_variant("scalar_rgb" if "scalar_rgb" in mi.variants() else mi.variants()[0])
    mi.set_log_level(mi.LogLevel.Error)
    return lambda value: print(json.dumps(value), file=answers, flush=True)


def main(files: Sequence[Sequence], seconds: int) -> None:
    """Read files in turn, and write lines of JSON: one at the beginning, and what is wrong with each file."""
    say = begin()
    dr.set_thread_count(2)  # on one, Mitsuba waits for ever for an EXR texture
    installed_plugins.come_first()
    limit("RLIMIT_CPU", seconds)
    say("begun")
    for plugin, path, shape_index in files:
        memory = IMAGE_MEMORY if plugin == "bitmap" else MEMORY + MEMORY_PER_BYTE * os.path.getsize(path)
        limit("RLIMIT_AS", address_space() + memory)
        wrong = ""
        try:
            _read(plugin, path, shape_index)
        except InputError as error:
            wrong = str(error).removeprefix(f"{path}: ")
        except Exception as error:  # its text may be a line of the file
            if isinstance(error, MemoryError) or "bad_alloc" in str(error):
                wrong = "declares more than a file of this size holds; it is damaged: export it again"
            else:
                wrong = f"cannot be read as {plugin}; is this the right file? If so, export it again"
                wrong += _HINTS.get(plugin, "")
        say(wrong)


def _read(plugin, path, shape_index):
    """Read a file as a scene does; raises if it cannot be, or is a mesh with an index that no vertex has."""
    if plugin == "spectrum":
        mi.spectrum_from_file(path)
        return
    if plugin == "bitmap":  # Mitsuba's decoders write beyond their memory on damaged ones: ours come first
        head = head_of(path)
        if head.startswith(b"v/1\x01"):
            exr.require_whole(path)
        elif head.startswith((b"#?", b"\x89PNG", b"\xff\xd8")):
            images.read_stored(path)
    properties = {"type": plugin, "filename": path}
    if plugin == "serialized":
        properties["shape_index"] = shape_index
    if plugin not in MESHES:
        mi.load_dict(properties)
        return
    mesh = mi.load_dict(properties | {"face_normals": True})  # computed from indices otherwise
    if mesh.vertex_count() == 0:
        raise InputError("holds no vertex; is this the right file?")
    faces = np.array(mi.traverse(mesh)["faces"])
    if faces.size and faces.max() >= mesh.vertex_count():
        face = int(faces.argmax()) // 3
        raise InputError(f"face {face} names vertex {faces.max()} of {mesh.vertex_count()}; export it again")


def address_space() -> int:
    """Return the bytes of address space that this process has; 1 GiB where that is unknown."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 2**30


def limit(name: str, most: int) -> None:
    """Bound a resource of this process, where the platform has bounds."""
    try:
        import resource
    except ImportError:
        return
    kind = getattr(resource, name)
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
