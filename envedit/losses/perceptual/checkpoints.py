"""Arrays from pickled checkpoints, of numpy and of PyTorch before 1.6, without running what they ask for.

A pickle names functions that its reader calls. Here the names of arrays and dicts are known; any other is
refused before it is looked up.
"""

from __future__ import annotations

import io
import math
import pickle
from collections import OrderedDict
from typing import Any

import numpy as np

from envedit.core.errors import InputError

_TORCH = pickle.dumps(0x1950A86A20F9469CFC6C, 2)
"""The first bytes of a PyTorch file: its magic number, a pickle of its own."""


def read(data: bytes, name: str) -> dict[str, Any]:
    """Read a checkpoint: nested dicts of arrays.

    ``data`` is a pickle of nested dicts of numpy arrays, or a state dict of float32 as ``torch.save`` wrote
    it before 1.6; ``name`` is what errors call it. InputError if it is damaged, or asks for anything else.
    """
    stream = io.BytesIO(data)
    try:
        if not data.startswith(_TORCH):
            return _Arrays(stream).load()
        for _ in range(3):  # magic number, version, sizes of types
            _Arrays(stream).load()
        reader = _Arrays(stream)
        table = reader.load()
        for key in _Arrays(stream).load():
            reader.fill(key, stream)
        return table
    except Exception as error:  # what a damaged pickle raises has many names
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"{name}: no checkpoint of arrays ({reason})") from None


class _Arrays(pickle.Unpickler):
    """Makes dicts, lists, numbers and texts, as any pickle does, and arrays."""

    def __init__(self, stream: io.BytesIO):
        super().__init__(stream, encoding="latin1")
        self._storages: dict[str, np.ndarray] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _KNOWN:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return _KNOWN[module, name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        """Return the numbers that PyTorch tensors share; they are at the end of the file (:meth:`fill`)."""
        _, _, key, _, count, *_ = pid
        return self._storages.setdefault(key, np.zeros(count, "<f4"))

    def fill(self, key: str, stream: io.BytesIO) -> None:
        """Read the numbers of a storage: their count in 8 bytes, then float32."""
        storage = self._storages[key]
        stream.read(8)
        storage[:] = np.frombuffer(stream.read(storage.nbytes), "<f4", len(storage))


def _torch_tensor(storage: np.ndarray, offset: int, shape: tuple, *_: Any) -> np.ndarray:
    return storage[offset : offset + math.prod(shape)].reshape(shape)


_KNOWN: dict[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): np.zeros(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("torch._utils", "_rebuild_tensor_v2"): _torch_tensor,
    ("torch", "FloatStorage"): None,  # an argument of the storage
    ("collections", "OrderedDict"): OrderedDict,
}
