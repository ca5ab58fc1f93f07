"""Progress of a long run: a bar on a terminal, plain or JSON lines now and then elsewhere."""

from __future__ import annotations

import json
import sys
import time

from tqdm import tqdm

LINE_SECONDS = 5.0  # between lines of text
JSON_SECONDS = 0.5  # between lines of JSON


def tell(event: str, **facts: object) -> None:
    """Write a line of JSON to stderr."""
    print(json.dumps({"event": event, **facts}), file=sys.stderr, flush=True)


class Progress:
    """Show stages and how far each has come, on stderr unless ``quiet``: as a bar if that is a terminal.

    With ``json_lines`` a stage begins with ``{"event": "stage", "stage": text}``; then, at most every
    :data:`JSON_SECONDS` and when it is done, come ``{"event": "progress", "stage":, "done":, "total":,
    "text":}``.
    """

    def __init__(self, quiet: bool = False, json_lines: bool = False):
        self.quiet = quiet
        self.stream = sys.stderr
        self._json = json_lines
        self._terminal = self.stream.isatty() and not json_lines
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
        if self._json and not self.quiet:
            tell("stage", stage=text)
        elif not self.quiet and not self._terminal:
            print(text, file=self.stream, flush=True)

    def update(self, done: int, total: int, text: str = "") -> None:
        """Report that ``done`` of ``total`` parts of the stage are done."""
        if self.quiet:
            return
        if self._terminal:
            self._show_bar(done, total, text)
            return
        now = time.monotonic()
        if self._json and (now - self._last_line >= JSON_SECONDS or done == total):
            self._last_line = now
            tell("progress", stage=self._stage, done=done, total=total, text=text)
        elif not self._json and now - self._last_line >= LINE_SECONDS:
            self._last_line = now
            print(f"{self._stage}: {done}/{total} {text}".rstrip(), file=self.stream, flush=True)

    def _show_bar(self, done, total, text):
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

    def _close(self):
        if self._bar is not None:
            self._bar.close()
            self._bar = None
