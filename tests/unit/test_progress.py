"""Progress: lines in a log, a bar on a terminal, nothing when asked to be quiet."""

import contextlib
import io
import re

import pytest
from tqdm import tqdm

from envedit.cli import progress
from envedit.cli.progress import Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until it is moved."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_log_gets_a_line_a_stage_and_one_now_and_then(clock):
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.stage("fitting")
        for done in range(1, 101):
            clock[0] += 0.25
            shown.update(done, 100, f"loss {done}")
        shown.stage("editing")
        shown.update(1, 10)
    # 25 seconds are five times five.
    lines = [f"fitting: {done}/100 loss {done}" for done in (20, 40, 60, 80, 100)]
    assert stream.getvalue().splitlines() == ["fitting", *lines, "editing"]


def test_a_bar_of_what_goes_on_begins_where_it_was(clock, monkeypatch):
    stream, begun = Terminal(), []
    monkeypatch.setattr(progress, "tqdm", lambda **given: begun.append(given) or tqdm(**given))
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.stage("fitting")
        shown.update(500, 1000)
    assert begun[0]["initial"] == 500 and "500/1000" in stream.getvalue()


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_quiet_says_nothing(kind, clock):
    stream = kind()
    with contextlib.redirect_stderr(stream), Progress(quiet=True) as shown:
        for text in ("fitting", "editing"):
            shown.stage(text)
            for done in range(10):
                clock[0] += 10
                shown.update(done, 10, "loss 1")
    assert stream.getvalue() == ""


def test_a_terminal_gets_a_bar_for_each_stage():
    stream = Terminal()
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.stage("fitting")
        shown.update(1, 4, "loss 0.5")
        shown.update(4, 4, "loss 0.25")
        shown.stage("editing")
        shown.update(2, 9)
    text = stream.getvalue()
    assert "fitting" in text and "editing" in text and "\r" in text
    assert re.search(r"/4\b", text) and re.search(r"/9\b", text)
    last = re.split(r"[\r\n]", text.rstrip("\r\n"))[-1]
    assert not last.strip()  # the bar is wiped away at the end


def test_a_bar_is_closed_when_the_run_fails():
    with pytest.raises(KeyError), contextlib.redirect_stderr(Terminal()), Progress() as shown:
        shown.stage("fitting")
        shown.update(1, 4)
        raise KeyError
    assert shown._bar is None
