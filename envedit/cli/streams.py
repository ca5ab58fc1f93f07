"""Standard output and standard error that may be closed, full, or unable to show a letter.

What a command prints reports its work and is not its work: a result is written, and the exit code says how
it went, whether or not anybody could read along.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable


class _Steady:
    """A text stream whose writes do not fail; what it cannot encode is written as an escape."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or not."""
        with contextlib.suppress(OSError, ValueError):  # ValueError: closed
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                encoding = self._stream.encoding
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Flush, or let what cannot be written go: the interpreter would try, and fail, when it ends."""
        try:
            self._stream.flush()
        except OSError:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                if (descriptor := self._stream.fileno()) in (1, 2):
                    _to_nowhere(descriptor)
                    self._stream.flush()
        except ValueError:
            pass

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        try:
            return self._stream.isatty()
        except ValueError:
            return False

    def __getattr__(self, name):
        return getattr(self._stream, name)


def steady(main: Callable[..., int]) -> Callable[..., int]:
    """Let a command line's ``main`` run with streams that do not fail."""

    @functools.wraps(main)
    def run(*arguments, **keys):
        streams = sys.stdout, sys.stderr
        if isinstance(streams[0], _Steady):
            return main(*arguments, **keys)
        _open_closed_descriptors()
        nowhere = open(os.devnull, "w") if None in streams else None  # noqa: SIM115 (as long as the streams)
        sys.stdout, sys.stderr = (_Steady(stream or nowhere) for stream in streams)
        try:
            return main(*arguments, **keys)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            sys.stdout, sys.stderr = streams
            if nowhere is not None:
                nowhere.close()

    return run


def _open_closed_descriptors():
    """Open the standard descriptors that are closed: a file of results would get their numbers."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            _to_nowhere(descriptor)


def _to_nowhere(descriptor):
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != descriptor:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)
