"""Network weights from ``npz`` files; PyTorch's own ``.pth`` is refused, because reading it runs code."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from envedit.config.validators import show
from envedit.core.errors import EnveditError, InputError
from envedit.core.types import FilePath


def read(file: FilePath, shapes: dict[str, tuple[int, ...]], what: str, source: str) -> dict[str, np.ndarray]:
    """Read named tensors of half, single or double precision, and nothing else, as float32.

    ``shapes`` are by name. Messages say ``what`` the tensors are, "VGG16", and the ``source`` where a user
    gets them. InputError if the file cannot be read, is damaged or of another format, or a tensor is missing,
    has another shape or type, or holds values that are not finite.
    """
    name = os.fsdecode(file)
    if not os.path.isfile(name):  # opening a pipe would wait for ever
        raise InputError(f"{name}: no such file. It should hold the weights of {what}: {source}")
    try:
        with open(name, "rb") as stream:
            head = stream.read(4)
            if head[:1] == b"\x80":
                raise _pickled(name)
            if head != b"PK\x03\x04":
                raise InputError(f"{name}: no npz file; convert the weights to one.")
            stream.seek(0)
            archive = np.load(stream, allow_pickle=False)
            if any(member.endswith("/data.pkl") for member in archive.files):
                raise _pickled(name)
            missing = [tensor for tensor in shapes if tensor not in archive.files]
            if missing:
                count = "" if len(missing) == 1 else f" and {len(missing) - 1} more of {len(shapes)} tensors"
                raise InputError(
                    f"{name}: does not hold the weights of {what}: no '{missing[0]}'{count}.\n"
                    f"Names must be as in {source}"
                )
            return {tensor: _tensor(name, archive, tensor, shapes[tensor], what) for tensor in shapes}
    except EnveditError:
        raise
    except Exception as e:  # what parsers make of damaged files has many names
        reason = " ".join(str(getattr(e, "strerror", None) or e).split())[:160] or "no reason given"
        raise InputError(f"{name}: damaged or truncated ({reason}); download or convert it again.") from None


def _tensor(name, archive, tensor, shape, what):
    """Read a tensor as float32."""
    values = archive[tensor]
    if values.dtype.kind != "f":
        raise InputError(f"{name}: '{tensor}' has the type {values.dtype}; save it as float32.")
    if values.shape != tuple(shape):
        raise InputError(
            f"{name}: '{tensor}' has the shape {show(values.shape)}, in {what} it is {tuple(shape)}; "
            "the file belongs to another network."
        )
    with np.errstate(over="ignore", invalid="ignore"):  # what a single cannot hold is refused below
        values = np.ascontiguousarray(values, np.float32)
    if not np.isfinite(values).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise InputError(f"{name}: '{tensor}' holds {values[place]} at {place}; download it again.")
    return values


def _pickled(name):
    return InputError(
        f"{name}: a PyTorch file; reading one can run code, so convert it once, where PyTorch is installed:\n"
        f"np.savez('weights.npz', **{{k: v.numpy() for k, v in torch.load({Path(name).name!r}, "
        "map_location='cpu', weights_only=True).items()})"
    )
