"""C libraries that print about the files they read, kept off the terminal."""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import sys
import tempfile
import threading
from collections.abc import Iterator

_ALONE = threading.RLock()
"""Held while the descriptors lead elsewhere: they are the process's, so that threads take turns."""
if hasattr(os, "register_at_fork"):  # a child that is forked has the descriptors and no holder of the lock
    os.register_at_fork(before=_ALONE.acquire, after_in_parent=_ALONE.release, after_in_child=_ALONE.release)


@contextlib.contextmanager
def quiet_libraries() -> Iterator[list[str]]:
    """Keep what C libraries print about a file off the user's terminal; yields a list that receives the text.

    OpenEXR and libjpeg write to file descriptor 2 and to ``sys.stdout``, OpenEXR's decoder of JPEG 2000 to
    file descriptor 1, and carry on. Threads take turns; what others print meanwhile is in the text too.
    """
    printed: list[str] = []
    text = io.StringIO()
    with _ALONE, contextlib.ExitStack() as stack:
        _flush_c()
        kept = {}
        for descriptor, stream in ((1, sys.stdout), (2, sys.stderr)):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # nothing there to protect
                stream.flush()
                kept[descriptor] = os.dup(descriptor)
        sink = stack.enter_context(tempfile.TemporaryFile())
        stack.enter_context(contextlib.redirect_stdout(text))
        for descriptor in kept:
            os.dup2(sink.fileno(), descriptor)
        try:
            yield printed
        finally:
            _flush_c()
            for descriptor, copy in kept.items():
                os.dup2(copy, descriptor)
                os.close(copy)
            sink.seek(0)
            printed.append(text.getvalue() + sink.read().decode(errors="replace"))


def _flush_c():
    """Have C's own streams written: what lies in their buffers belongs to what was open when it was said."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).fflush(None)
