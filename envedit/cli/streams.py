"""Standard output and standard error that may be closed, full, or unable to show a letter.

What a command prints reports its work and is not its work: a result is written, and the exit code says how
it went, whether or not anybody could read along.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator


class _Steady:
    """A text stream whose writes do not fail."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or not."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or let what cannot be written go: the interpreter would try, and fail, when it ends."""
        try:
            self._stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
            self._stream.flush()

    def __getattr__(self, name):
        return getattr(self._stream, name)


@contextlib.contextmanager
def steady() -> Iterator[None]:
    """Let a command line run with streams that do not fail; letters they lack are escaped."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed; a file of results would get its descriptor
            setattr(sys, name, open(os.devnull, "r+"))  # noqa: SIM115 (until the process ends)
    streams = sys.stdout, sys.stderr
    for stream in streams:
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    sys.stdout, sys.stderr = (_Steady(stream) for stream in streams)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = streams
