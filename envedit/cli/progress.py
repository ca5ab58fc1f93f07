"""Progress of a long run: a bar on a terminal, plain or JSON lines now and then elsewhere."""

from __future__ import annotations

import json
import sys
import time

from tqdm import tqdm

LINE_SECONDS = 5.0  # between lines of text
JSON_SECONDS = 0.5  # between lines of JSON


class Progress:
    """Show stages and how far each has come, on stderr unless ``quiet``: as a bar if that is a terminal."""

    def __init__(self, quiet: bool = False):
        self.quiet = quiet
        self.stream = sys.stderr
        self._terminal = self.stream.isatty()
        self._bar: tqdm | None = None
        self._stage = ""
        self._last_line = 0.0

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception: object) -> None:
        self._close()

    def stage(self, text: str) -> None:
        """Begin a stage."""
        self._close()
        self._stage = text
        self._last_line = time.monotonic()
        if not self.quiet and not self._terminal:
            print(text, file=self.stream, flush=True)

    def update(self, done: int, total: int, text: str = "") -> None:
        """Report that ``done`` of ``total`` parts of the stage are done."""
        if self.quiet:
            return
        if self._terminal:
            if self._bar is None:
                self._bar = tqdm(
                    total=total,
                    initial=done,
                    desc=self._stage,
                    file=self.stream,
                    leave=False,
                    dynamic_ncols=True,
                )
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update(done - self._bar.n)
            return
        now = time.monotonic()
        if now - self._last_line >= LINE_SECONDS:
            self._last_line = now
            print(f"{self._stage}: {done}/{total} {text}".rstrip(), file=self.stream, flush=True)

    def _close(self):
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class JsonProgress(Progress):
    """Report stages and progress as JSON lines on stderr.

    A stage begins with ``{"event": "stage", "stage": text}``; then, at most every :data:`JSON_SECONDS` and
    when it is done, come ``{"event": "progress", "stage":, "done":, "total":, "text":}``.
    """

    def tell(self, event: str, **facts: object) -> None:
        """Write one line."""
        print(json.dumps({"event": event, **facts}), file=sys.stderr, flush=True)

    def stage(self, text: str) -> None:
        """Begin a stage."""
        self._stage = text
        self._last_line = time.monotonic()
        self.tell("stage", stage=text)

    def update(self, done: int, total: int, text: str = "") -> None:
        """Report that ``done`` of ``total`` parts of the stage are done."""
        now = time.monotonic()
        if now - self._last_line >= JSON_SECONDS or done == total:
            self._last_line = now
            self.tell("progress", stage=self._stage, done=done, total=total, text=text)
