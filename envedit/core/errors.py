"""What can go wrong for a user, and the exit code each kind carries.

Every message is one or two lines: what, where (file, key, row and column), what to do.
Modules raise these; only the command lines turn them into text on stderr and an exit code.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class EnveditError(ValueError):
    """Base of every error whose cause a user can fix."""

    exit_code = 5


class ConfigError(EnveditError):
    """The configuration or the command line cannot be understood (exit code 2)."""

    exit_code = 2


class InputError(EnveditError):
    """An image or scene file is missing, damaged or unsuitable, or cannot be written (exit code 3)."""

    exit_code = 3


class MachineError(EnveditError):
    """The machine lacks what is needed: an LLVM, or a package of an extra (exit code 4)."""

    exit_code = 4


class NumericalError(EnveditError):
    """The optimisation could not proceed: non-finite and not recoverable (exit code 5)."""

    exit_code = 5


def place_of(bad: np.ndarray, first_row: int = 0) -> str:
    """Name the first True of a mask (H, W) or (H, W, C), whose row 0 is ``first_row``: "row 3, column 7"."""
    texels = bad.reshape(*bad.shape[:2], -1).any(axis=2)
    row, column = divmod(int(texels.argmax()), texels.shape[1])
    return f"row {first_row + row}, column {column}"


def counted(count: int, one: str, many: str) -> str:
    """Return a number with what it counts.

    >>> counted(1, "texel is", "texels are")
    '1 texel is'
    """
    return f"{count} {one if count == 1 else many}"


def texels_are(bad: np.ndarray, what: str, first_row: int = 0, unit: str = "texel") -> str:
    """Say how many texels of a mask, as of :func:`place_of`, are what they should not be, and which is first.

    For example "2 texels are negative, the first at row 3, column 7".
    """
    count = int(bad.reshape(*bad.shape[:2], -1).any(axis=2).sum())
    return f"{counted(count, f'{unit} is', f'{unit}s are')} {what}, the first at {place_of(bad, first_row)}"


@contextlib.contextmanager
def unwrapped() -> Iterator[None]:
    """Raise errors that a user should see, and Ctrl-C, as they are; also a decorator.

    Dr.Jit raises RuntimeError from whatever is raised inside its operations and loops.
    """
    try:
        yield
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause and not isinstance(cause, (EnveditError, KeyboardInterrupt)):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None
