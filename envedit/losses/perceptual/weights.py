"""Network weights from files that the user names: ``safetensors`` or ``npz``, read as if they were hostile.

Only the tensors that are asked for are read, after their names, types and shapes are found to be as expected:
a file cannot make the reader allocate more than the network needs. PyTorch's own ``.pth`` is refused, because
reading it runs code.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from envedit.config.validators import show
from envedit.core.errors import EnveditError, InputError
from envedit.core.types import FilePath

MOST_HEADER = 2**24
"""Bytes of a safetensors header, at most; that of VGG16 has 3 kB."""

_SAFETENSORS: dict[str, np.dtype] = {
    "F16": np.dtype("<f2"),
    "F32": np.dtype("<f4"),
    "F64": np.dtype("<f8"),
    "BF16": np.dtype("<u2"),
}
_NPZ_COMPRESSION = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED
_NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read(file: FilePath, shapes: dict[str, tuple[int, ...]], what: str, source: str) -> dict[str, np.ndarray]:
    """Read named tensors, and nothing else, from a ``safetensors`` or ``npz`` file.

    Returns float32 arrays by name, of half, bfloat16, single or double precision. InputError if the file
    cannot be read, is damaged or of another format, or a tensor is missing, has another shape or type, or
    holds values that are not finite.

    The first bytes of the file decide which format it has, not its name. ``shapes`` are by name; further
    tensors in the file are not looked at. Messages say ``what`` the tensors are, "VGG16", and the ``source``
    where a user gets them.
    """
    # ---- Read, by the format that the first bytes show
    name = os.fsdecode(file)
    try:
        if not os.path.isfile(name):  # opening a pipe would wait for ever
            raise InputError(f"{name}: no such file. It should hold the weights of {what}: {source}")
        with open(name, "rb") as stream:
            head = stream.read(16)
            if head[:4] == b"PK\x03\x04":
                tensors = _read_npz(name, stream, shapes, what, source)
            elif head[8:9] == b"{":
                tensors = _read_safetensors(name, stream, shapes, what, source)
            elif head[:1] == b"\x80":
                raise _pickled(name)
            else:
                raise InputError(f"{name}: neither safetensors nor npz; convert the weights to one of them.")
    except EnveditError:
        raise
    except MemoryError:
        raise InputError(f"{name}: not enough memory to read the weights of {what}.") from None
    except Exception as e:  # what parsers make of damaged files has many names
        raise _damaged(name, getattr(e, "strerror", None) or e) from None

    # ---- Refuse numbers that are not finite
    for tensor, values in tensors.items():
        if not np.isfinite(values).all():
            place = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
            raise InputError(f"{name}: '{tensor}' holds {values[place]} at {place}; download it again.")
    return tensors


def _read_safetensors(name, stream, shapes, what, source):
    """Read the format: header length (8 bytes, little-endian), header (JSON), data."""
    size = os.fstat(stream.fileno()).st_size
    stream.seek(0)
    length = int.from_bytes(stream.read(8), "little")
    if length > min(MOST_HEADER, size - 8):
        raise _damaged(name, f"its header should have {length} bytes")
    header = json.loads(stream.read(length).decode("utf-8"), object_pairs_hook=_without_repetition)
    start = 8 + length
    tensors = {}
    _check_names(name, header, shapes, what, source)
    for tensor, shape in shapes.items():
        entry = header[tensor] if isinstance(header[tensor], dict) else {}
        kind, declared = entry.get("dtype"), entry.get("shape")
        place: Any = entry.get("data_offsets")
        if not (_are_sizes(declared) and _are_sizes(place) and len(place) == 2):
            raise _damaged(name, f"the entry of '{tensor}' in its header")
        if not isinstance(kind, str) or kind not in _SAFETENSORS:
            raise _wrong_type(name, tensor, kind)
        _check_shape(name, tensor, declared, shape, what)
        count = math.prod(shape)
        dtype = _SAFETENSORS[kind]
        if place[1] - place[0] != count * dtype.itemsize:
            raise _damaged(name, f"'{tensor}' lies at bytes {place[0]} to {place[1]} of the data")
        stream.seek(start + place[0])
        values = np.frombuffer(_exactly(stream, count * dtype.itemsize), dtype)
        if kind == "BF16":  # the upper half of a float32
            values = (values.astype(np.uint32) << 16).view(np.float32)
        tensors[tensor] = _single(values, shape)
    return tensors


def _read_npz(name, stream, shapes, what, source):
    """Read the members ``TENSOR.npy`` of a zip archive, headers first."""
    stream.seek(0)
    with zipfile.ZipFile(stream) as archive:
        members = archive.namelist()
        if any(member.endswith("/data.pkl") for member in members):
            raise _pickled(name)
        _check_names(name, [member.removesuffix(".npy") for member in members], shapes, what, source)
        tensors = {}
        for tensor, shape in shapes.items():
            # LZMA, which numpy does not write, takes the memory that its header asks for.
            if archive.getinfo(tensor + ".npy").compress_type not in _NPZ_COMPRESSION:
                raise _damaged(name, f"'{tensor}' is compressed in a way that numpy does not use")
            with archive.open(tensor + ".npy") as member:
                version = np.lib.format.read_magic(member)
                if version not in _NPY_HEADERS:
                    raise _damaged(name, f"'{tensor}' has an unknown version {version}")
                declared, columns_first, dtype = _NPY_HEADERS[version](member)
                if dtype.kind != "f" or dtype.itemsize > 8:
                    raise _wrong_type(name, tensor, dtype)
                _check_shape(name, tensor, declared, shape, what)
                values = np.frombuffer(_exactly(member, math.prod(shape) * dtype.itemsize), dtype)
                tensors[tensor] = _single(values, shape, "F" if columns_first else "C")
    return tensors


def _single(values, shape, order="C"):
    # What a double cannot give a single is infinite, and then refused; a signalling NaN is NaN, and refused.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values.astype(np.float32).reshape(shape, order=order))


def _exactly(stream, size):
    data = stream.read(size)
    if len(data) != size:
        raise EOFError(f"it ends {size - len(data)} bytes too early")
    return data


def _are_sizes(value):
    # bool is an int to Python, and JSON has both.
    return isinstance(value, list) and all(type(v) is int and 0 <= v < 2**48 for v in value)


def _without_repetition(pairs):
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a name occurs twice in its header")
    return table


def _check_names(name, present, shapes, what, source):
    if not isinstance(present, (dict, list)):
        raise _damaged(name, "its header is no table")
    present = set(present)
    missing = [tensor for tensor in shapes if tensor not in present]
    if missing:
        count = "" if len(missing) == 1 else f" and {len(missing) - 1} more of {len(shapes)} tensors"
        raise InputError(
            f"{name}: does not hold the weights of {what}: no '{missing[0]}'{count}.\n"
            f"Names must be as in {source}"
        )


def _check_shape(name, tensor, declared, shape, what):
    if tuple(declared) != tuple(shape):
        raise InputError(
            f"{name}: '{tensor}' has the shape {show(tuple(declared))}, in {what} it is {tuple(shape)}; "
            "the file belongs to another network."
        )


def _wrong_type(name, tensor, kind):
    return InputError(f"{name}: '{tensor}' has the type {str(kind)[:40]}; save it as float32.")


def _damaged(name, reason):
    reason = " ".join(str(reason).split())[:160] or "no reason given"
    return InputError(f"{name}: damaged or truncated ({reason}); download or convert it again.")


def _pickled(name):
    return InputError(
        f"{name}: a PyTorch file; reading one can run code, so convert it once, where PyTorch is installed:\n"
        f"np.savez('weights.npz', **{{k: v.numpy() for k, v in torch.load({Path(name).name!r}, "
        "map_location='cpu', weights_only=True).items()})"
    )
