"""What the decoders share: a file's first bytes, the sizes that a header may declare, errors of damage.

Each decoder (:mod:`.exr`, :mod:`.rgbe`, :mod:`.ldr`) has a function ``read`` that takes the file's name, its
first bytes, the ``info`` of :func:`.images.read`, which it fills, and whether the pixels are wanted as stored
(:func:`.images.read_stored`). Damage is reported as ``InputError`` or left to the caller as the library's own
exception.
"""

from __future__ import annotations

import numpy as np

from envedit.core.atomic_files import opened
from envedit.core.errors import InputError, NumericalError, texels_are
from envedit.core.types import ArrayLike

MAX_SIDE = 32768
MAX_TEXELS = 2**27
"""16384 x 8192 texels: 1.6 GB as float32. A header that declares more is refused before allocation."""


def head_of(name: str) -> bytes:
    """Return the first bytes of a regular file."""
    try:
        with opened(name) as file:
            head = file.read(1 << 16)
    except IsADirectoryError:
        raise InputError(f"{name}: is a folder; name an image file") from None
    except FileNotFoundError:
        raise InputError(f"{name}: no such file; check the path") from None
    except (OSError, ValueError) as e:
        raise InputError(f"{name}: cannot be read ({getattr(e, 'strerror', None) or e})") from None
    if not head:
        raise InputError(f"{name}: the file is empty; export or download it again")
    return head


def check_declared(name: str, width: int, height: int) -> None:
    """Refuse a size before memory is asked for."""
    if width < 1 or height < 1:
        raise InputError(f"{name}: the header declares {width} x {height} texels; the file is damaged")
    if max(width, height) > MAX_SIDE or width * height > MAX_TEXELS:
        raise InputError(
            f"{name}: the header declares {width} x {height} texels, more than {MAX_SIDE} on a side or "
            f"{MAX_TEXELS} in all; the file is damaged, or has to be made smaller"
        )


def damaged(name: str, reason: object) -> InputError:
    """Return the error for a file that starts well and cannot be decoded."""
    without_name = str(reason).replace(str(name), "the file")  # which a cut would leave in part
    reason = shown(" ".join(without_name.split()), 160) or "no reason given"
    return InputError(f"{name}: damaged or truncated ({reason}); export or download it again")


def shown(text: str, most: int = 60) -> str:
    """Return text of a file for a message: cut to ``most`` characters, without control codes."""
    text = text[:most]
    return text if text.isprintable() else ascii(text)[1:-1][:most]


def finite(name: str, values: ArrayLike, layer: str = "") -> np.ndarray:
    """Return an image (H, W, C) or (H, W) as float32, to be written; NumericalError if it is not finite."""
    with np.errstate(over="ignore"):  # caught below, as an infinity
        values = np.asarray(values).astype(np.float32, copy=False)
    if (bad := ~np.isfinite(values)).any():
        place = f"{name}, layer '{layer}'" if layer else name
        raise NumericalError(f"{place}: not written: {texels_are(bad, 'not finite')}")
    return values
