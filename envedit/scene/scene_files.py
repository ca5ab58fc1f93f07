"""Checks of the files that a scene names, before Mitsuba reads them.

Mitsuba believes the sizes and indices that a file states: it stops the process on an index that no vertex
has, asks for the memory that a header declares, and repeats lines of a file that is something else.
"""

from __future__ import annotations

import os
import re
import stat
import zlib
from pathlib import Path
from typing import Literal

import numpy as np

from envedit.core.errors import InputError
from envedit.images import exr, images
from envedit.images.headers import damaged, head_of

MOST_BYTES = 2**31
"""Size of a file that a scene may name: 60 million triangles."""
MOST_VALUES = 2**29
"""Numbers in a mesh or a volume, 2 GB in single precision."""
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "half": "f2", "float16": "f2", "int64": "i8", "long": "i8",
    "uint64": "u8", "ulong": "u8",
}  # fmt: skip
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+|inf|nan)([eE][-+]?\d+)?", re.IGNORECASE)


def check(plugin: str, path: str) -> None:
    """Refuse a file that a plugin could not survive, or that is not what the plugin reads.

    Parameters
    ----------
    plugin : str
        Mitsuba's plugin that names the file.
    path : str
        The file; absolute.

    Raises
    ------
    InputError
        Naming the file and what is wrong; never with text out of it.
    """
    size_of(Path(path), "a file")
    checks = {
        "ply": _ply, "serialized": _serialized, "gridvolume": _volume, "bsplinecurve": check_numbers,
        "linearcurve": check_numbers, "irregular": check_numbers, "bitmap": _texture, "envmap": _texture,
    }  # fmt: skip
    if plugin in checks:
        checks[plugin](Path(path))


def size_of(path: Path, wanted: str) -> int:
    """Return the size of a regular file of a size that can be read."""
    try:
        about = os.stat(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not stat.S_ISREG(about.st_mode):  # opening a pipe would wait for ever
        raise InputError(f"{path}: is no regular file, expected {wanted}")
    if about.st_size > MOST_BYTES:
        raise InputError(f"{path}: {about.st_size} bytes, expected at most {MOST_BYTES}; make it smaller")
    return about.st_size


def check_numbers(path: Path) -> None:
    """Check a text of numbers, such as a spectrum or curves; comments begin with #."""
    size_of(path, "a text of numbers")
    with open(path, "rb") as file:
        for number, line in enumerate(iter(lambda: file.readline(1 << 16), b""), 1):
            text = line.partition(b"#")[0].replace(b",", b" ")
            if any(_NUMBER.fullmatch(word) is None for word in text.split()):
                raise InputError(f"{path}, line {number}: expected numbers; is this the right file?")


# ----------------------------------------------------------------------------------------------------------
# Meshes


def _ply(path):
    with open(path, "rb") as file:
        head = file.read(1 << 16)
    end = re.search(rb"(?m)^end_header\r?\n", head)
    if not re.match(rb"ply\s", head) or end is None:
        raise InputError(f"{path}: no PLY header; export the mesh again")
    elements, form = _ply_header(path, head[: end.start()].decode("latin-1"))
    counted = {name: count for name, count, _ in elements}
    vertices = counted.get("vertex", 0)
    place, size = end.end(), os.path.getsize(path)
    words = None
    if form == "ascii":
        raw = np.fromfile(path, np.uint8, offset=place).tobytes()
        words = raw.split()
        place = 0
    for name, count, properties in elements:
        lists = [p for p in properties if isinstance(p[1], tuple)]
        indices = [p[0] for p in lists if re.fullmatch(r"vertex_ind(ex|ices)", p[0])]
        # As Mitsuba reads them: triangles.
        dtype = np.dtype([
            field
            for key, kind in properties
            for field in ([(f"{key} count", kind[0]), (key, kind[1], (3,))] if isinstance(kind, tuple)
                          else [(key, kind)])
        ])  # fmt: skip
        width = sum(4 if isinstance(kind, tuple) else 1 for _, kind in properties)
        if count * width > MOST_VALUES:
            raise damaged(path, f"the header declares {count} x {width} values")
        if count == 0 or width == 0:
            continue
        if words is not None:
            if place + count * width > len(words):
                raise damaged(path, f"the file ends before its {count} {name} elements")
            table = words[place : place + count * width]
            place += count * width
            column = 0
            for key, kind in properties:
                if isinstance(kind, tuple):
                    _triangles(path, _whole(path, table[column::width]))
                    if key in indices:
                        found = [_whole(path, table[column + i :: width]) for i in (1, 2, 3)]
                        _in_range(path, np.stack(found, axis=-1), vertices)
                column += 4 if isinstance(kind, tuple) else 1
            continue
        if place + count * dtype.itemsize > size:
            raise damaged(path, f"the file ends before its {count} {name} elements")
        if indices:
            order: Literal["<", ">"] = ">" if form == "binary_big_endian" else "<"
            rows = np.fromfile(path, dtype.newbyteorder(order), count, offset=place)
            for key, _ in lists:
                _triangles(path, rows[f"{key} count"])
            for key in indices:
                _in_range(path, rows[key], vertices)
        place += count * dtype.itemsize


def _ply_header(path, text):
    """Return [(element, count, [(property, type or (type of count, type))])] and the format."""
    elements: list = []
    form = None
    for line in text.splitlines()[1:]:
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, *_]:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 19:
                elements.append((name, int(count), []))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= _TYPES.keys():
                elements[-1][2].append((name, (_TYPES[count], _TYPES[kind])))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, _TYPES[kind]))
            case _:
                raise InputError(f"{path}: a line of the PLY header is not understood; export the mesh again")
    if form is None or any(len({p[0] for p in e[2]}) != len(e[2]) for e in elements):
        raise InputError(f"{path}: the PLY header has no format or names a property twice; export it again")
    return elements, form


def _whole(path, words):
    try:
        return np.array([int(word) for word in words], np.int64)
    except (ValueError, OverflowError):
        raise damaged(path, "an index is no whole number") from None


def _triangles(path, counts):
    if (np.asarray(counts) != 3).any():
        raise InputError(f"{path}: holds polygons that are no triangles; triangulate the mesh")


def _in_range(path, indices, vertices):
    bad = (indices.astype(np.float64) < 0) | (indices.astype(np.float64) >= vertices)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"{path}: face {row} names vertex {indices[row, column]} of {vertices}; export the mesh again"
        )


def _serialized(path):
    """Walk through every mesh of Mitsuba 0.x's format: magic, zlib, then counts, coordinates, indices."""
    with open(path, "rb") as file:
        data = file.read()
    if len(data) < 12 or data[:2] != b"\x1c\x04" or int.from_bytes(data[2:4], "little") not in (3, 4):
        raise InputError(f"{path}: no serialized mesh; export it again")
    version, meshes = int.from_bytes(data[2:4], "little"), int.from_bytes(data[-4:], "little")
    wide = 8 if version == 4 else 4
    if meshes * wide + 4 > len(data):
        raise damaged(path, f"{meshes} meshes are declared")
    table = np.frombuffer(data[len(data) - 4 - meshes * wide : -4], f"<u{wide}")
    for offset in {0, *map(int, table)}:  # Mitsuba reads the first mesh wherever the table has it
        if offset + 4 > len(data):
            raise damaged(path, "a mesh begins after the end of the file")
        unpacked = zlib.decompressobj()
        try:
            body = unpacked.decompress(data[offset + 4 :], 4 * MOST_VALUES)
        except zlib.error as error:
            raise damaged(path, error) from None
        _serialized_mesh(path, version, body)


def _serialized_mesh(path, version, body):
    flags = int.from_bytes(body[:4], "little")
    place = 4
    if version == 4:
        place = body.find(b"\0", 4) + 1
        if place == 0:
            raise damaged(path, "a mesh's name does not end")
    vertices, faces = (int.from_bytes(body[place + i : place + i + 8], "little") for i in (0, 8))
    real = 8 if flags & 0x2000 else 4
    numbers = 3 + (3 if flags & 1 else 0) + (2 if flags & 2 else 0) + (3 if flags & 8 else 0)
    place += 16 + vertices * numbers * real
    index = 8 if vertices > 0xFFFFFFFF else 4
    if place + 3 * faces * index > len(body):
        raise damaged(path, f"the file ends before its {vertices} vertices and {faces} faces")
    found = np.frombuffer(body, f"<u{index}", 3 * faces, place).reshape(-1, 3)
    _in_range(path, found, vertices)


# ----------------------------------------------------------------------------------------------------------
# Volumes and textures


def _volume(path):
    with open(path, "rb") as file:
        head = file.read(48)
    if len(head) < 48 or head[:4] != b"VOL\3":
        raise InputError(f"{path}: no volume of Mitsuba's format")
    kind, *shape = np.frombuffer(head[4:24], "<i4").tolist()
    if kind != 1 or min(shape) < 1:
        raise damaged(path, f"the header declares {shape} values of type {kind}")
    count = shape[0] * shape[1] * shape[2] * shape[3]
    if count > MOST_VALUES or 48 + 4 * count > os.path.getsize(path):
        raise damaged(path, f"the header declares {count} values")


def _texture(path):
    """Decode a texture: Mitsuba's decoders print, stop the process or corrupt memory on damaged ones."""
    head = head_of(str(path))
    if head.startswith(b"v/1\x01"):
        exr.require_whole(str(path))
    elif head.startswith((b"#?", b"\x89PNG", b"\xff\xd8")):
        images.read_stored(path)
