"""How far a sweep has come and when it will end: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TextIO

from tqdm import tqdm

from .process import LOG, Outcome


class Board:
    """Report jobs as they end.

    Parameters
    ----------
    total : int
        Jobs that are to run.
    slots : int or None
        How many run at a time; None: nobody knows, and the end is estimated from the rate so far.
    stream : file or None
        Where to; None: nowhere.
    """

    def __init__(self, total: int, slots: int | None, stream: TextIO | None):
        self._total, self._slots, self._stream = total, slots, stream
        self._done, self._failed = 0, 0
        self._seconds: list[float] = []
        self._begun, self._refreshed = time.monotonic(), 0.0
        self._bar: tqdm | None = None
        self._said: set[str] = set()

    def begin(self, line: str) -> None:
        """Say what is going to happen."""
        self._say(line)
        if self._stream is not None and self._stream.isatty():
            form = "{n_fmt}/{total_fmt} |{bar}| {elapsed}{postfix}"
            self._bar = tqdm(total=self._total, file=self._stream, bar_format=form, dynamic_ncols=True)

    def tell(self, outcome: Outcome, out: Path) -> None:
        """Say what became of a job."""
        self._done += 1
        if outcome.state == "lost":  # and so is all the rest
            self.once(f"{outcome.error}: run again to complete the table")
            return
        self._failed += outcome.state == "failed"
        line = f"[{self._done}/{self._total}] {outcome.job.name}: {outcome.state}"
        if outcome.state in ("done", "failed"):
            self._seconds.append(outcome.seconds)
            line += f", {outcome.seconds:.0f} s"
        if outcome.error:
            line += f": {outcome.error}"
        if outcome.state == "failed":
            line += f" ({outcome.job.folder(out) / LOG})"
        if self._bar is None:
            self._say("; ".join(filter(None, (line, self._end()))))
            return
        if outcome.state == "failed":
            self._say(line)
        self._bar.set_postfix_str(self._end(), refresh=False)
        self._bar.update()

    def once(self, line: str) -> None:
        """Say what was not said before."""
        if line not in self._said:
            self._said.add(line)
            self._say(line)

    def refresh(self) -> None:
        """Let the bar's clock move, once a second."""
        if self._bar is not None and time.monotonic() - self._refreshed >= 1:
            self._refreshed = time.monotonic()
            self._bar.refresh()

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def _end(self):
        """Words for failures and the estimated end."""
        parts = [f"{self._failed} failed"] if self._failed else []
        if (left := self._total - self._done) and self._seconds:
            if self._slots:
                rest = left / min(self._slots, left) * sum(self._seconds) / len(self._seconds)
            else:
                rest = left * (time.monotonic() - self._begun) / self._done
            until = time.strftime("%H:%M", time.localtime(time.time() + rest))
            parts.append(f"about {_duration(rest)} left, until {until}")
        return ", ".join(parts)

    def _say(self, line):
        if self._stream is not None:
            tqdm.write(line, file=self._stream)
            self._stream.flush()


def _duration(seconds):
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
