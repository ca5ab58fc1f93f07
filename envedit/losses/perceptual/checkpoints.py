"""Arrays from pickled checkpoints, of numpy and of PyTorch before 1.6, without running what they ask for.

A pickle names functions that its reader calls. Here six names are known, which stand for functions and
classes of this module, and for a dict; any other is refused before it is looked up.
"""

from __future__ import annotations

import io
import math
import pickle
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np

from envedit.core.errors import InputError

_TORCH = pickle.dumps(0x1950A86A20F9469CFC6C, 2)
"""The first bytes of a PyTorch file: its magic number, a pickle of its own."""


def read(data: bytes, name: str) -> dict[str, Any]:
    """Read a checkpoint: nested dicts of float32 arrays.

    ``data`` is a pickle of nested dicts of numpy arrays, or a state dict as ``torch.save`` wrote it before
    1.6; ``name`` is what errors call it. InputError if it is damaged, or asks for anything but arrays of
    float32.
    """
    stream = io.BytesIO(data)
    try:
        if data.startswith(_TORCH):
            for _ in range(3):  # magic number, version, sizes of types
                _Arrays(stream).load()
            reader = _Arrays(stream)
            table = reader.load()
            for key in _Arrays(stream).load():
                reader.fill(key, stream)
        else:
            table = _Arrays(stream).load()
        if not isinstance(table, Mapping):
            raise pickle.UnpicklingError(f"it holds {type(table).__name__}, no table of arrays")
        return _plain(table)
    except Exception as error:  # what a damaged pickle raises has many names
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"{name}: no checkpoint of float32 arrays ({reason})") from None


class _Arrays(pickle.Unpickler):
    """Makes dicts, lists, numbers and texts, as any pickle does, and placeholders of arrays."""

    def __init__(self, stream: io.BytesIO):
        super().__init__(stream, encoding="latin1")
        self._storages: dict[str, np.ndarray] = {}
        self._most = len(stream.getbuffer()) // 4

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _KNOWN:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return _KNOWN[module, name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        """Return the numbers that PyTorch tensors share; they are at the end of the file (:meth:`fill`)."""
        kind, _, key, _, count, *_ = pid
        if kind != "storage" or not 0 <= count <= self._most:
            raise pickle.UnpicklingError(f"a {kind} of {count} numbers")
        return self._storages.setdefault(key, np.zeros(count, "<f4"))

    def fill(self, key: str, stream: io.BytesIO) -> None:
        """Read the numbers of a storage: their count in 8 bytes, then float32."""
        storage = self._storages[key]
        count = int.from_bytes(stream.read(8), "little")
        data = stream.read(storage.nbytes)
        if count != len(storage) or len(data) != storage.nbytes:
            raise pickle.UnpicklingError("a storage has another size than its tensor")
        storage[:] = np.frombuffer(data, "<f4")


class _Array:
    """Stands for an array while a pickle is read."""

    values: np.ndarray

    def __setstate__(self, state: Any) -> None:
        """Take what ``ndarray.__reduce__`` gives: version, shape, type, order, data."""
        _, shape, kind, columns_first, data = state
        values = np.frombuffer(data, kind.order + "f4")
        self.values = values.reshape(shape[::-1]).T if columns_first else values.reshape(shape)


class _Float32:
    """Stands for a numpy type: float32 in either order of bytes."""

    order = "<"

    def __init__(self, name: str, *_: Any):
        if name != "f4":
            raise pickle.UnpicklingError(f"an array of {name}")

    def __setstate__(self, state: Any) -> None:
        self.order = ">" if state[1] == ">" else "<"


def _torch_tensor(storage: np.ndarray, offset: int, shape: tuple, stride: tuple, *_: Any) -> _Array:
    expected = tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))
    if tuple(stride) != expected:
        raise pickle.UnpicklingError(f"a tensor with the strides {stride}")
    tensor = _Array()
    tensor.values = storage[offset : offset + math.prod(shape)].reshape(shape)
    return tensor


_KNOWN: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): lambda *_: _Array(),
    ("numpy", "ndarray"): None,  # an argument of the former
    ("numpy", "dtype"): _Float32,
    ("torch._utils", "_rebuild_tensor_v2"): _torch_tensor,
    ("torch", "FloatStorage"): None,  # an argument of the storage
    ("collections", "OrderedDict"): OrderedDict,
}


def _plain(table: Mapping) -> dict[str, Any]:
    """Put arrays in the place of their placeholders, and refuse anything else."""
    plain: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping):
            plain[str(key)] = _plain(value)
        elif isinstance(value, _Array):
            plain[str(key)] = value.values
        else:
            raise pickle.UnpicklingError(f"'{str(key)[:40]}' is {type(value).__name__}, no array")
    return plain
