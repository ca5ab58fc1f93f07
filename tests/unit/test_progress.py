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
    # 25 seconds are five times five; 4 parts a second.
    lines = [f"fitting: {done}/100, 4/s loss {done}" for done in (20, 40, 60, 80, 100)]
    assert stream.getvalue().splitlines() == ["fitting", *lines, "editing"]
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.stage("tracing")
        clock[0] += 6
        shown.update(3, 7)
        clock[0] += 8
        shown.update(7, 7)
    assert stream.getvalue() == "tracing\ntracing: 3/7\ntracing: 7/7, 0.5/s\n"


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_what_was_done_before_is_not_taken_for_speed(kind, clock, monkeypatch):
    stream, begun = kind(), []
    monkeypatch.setattr(progress, "tqdm", lambda **given: begun.append(given) or tqdm(**given))
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.stage("fitting")
        shown.update(500, 1000)
        clock[0] += 6
        shown.update(530, 1000)
    if kind is Terminal:
        assert begun[0]["initial"] == 500 and "500/1000" in stream.getvalue()
    else:
        assert stream.getvalue() == "fitting\nfitting: 530/1000, 5/s\n"


def test_a_count_that_begins_again_has_no_speed(clock):
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.stage("editing")
        shown.update(12, 12)
        for done in (9, 12):
            clock[0] += 6
            shown.update(done, done, "trying lights")
    assert stream.getvalue() == "editing\nediting: 9/9 trying lights\nediting: 12/12 trying lights\n"


def test_an_update_at_once_does_not_divide_by_zero(clock, monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream), Progress() as shown:
        shown.update(0, 0)
        shown.stage("editing")
        shown.update(0, 0)
    assert "editing: 0/0" in stream.getvalue()


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
