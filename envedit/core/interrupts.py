"""Ctrl-C as an event, for work that must not be cut in half."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def ctrl_c() -> Iterator[threading.Event]:
    """Turn Ctrl-C into an event, so that a step is never cut in half; a second Ctrl-C is not waited for."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def handle(number, frame):
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


def import_mitsuba(variant: str | None = None) -> None:
    """Import Mitsuba, and select a variant; Ctrl-C waits: it would leave modules half initialised."""
    with ctrl_c() as interrupt:
        import mitsuba as mi

        if variant is not None:
            mi.set_variant(variant)
    if interrupt.is_set():
        raise KeyboardInterrupt
