"""Streams that are closed, full or ASCII: no traceback, no half result, the right exit code."""

import os
import subprocess
import sys

import pytest

from envedit.cli import run
from tests.oracles import ROOT
from tests.oracles.runs import FILES, differing, names, world

REDIRECTED = [">&-", "2>&-", ">&- 2>&- <&-", ">/dev/full", "2>/dev/full", ">/dev/full 2>&1"]
WORDS = ("Traceback", "Error", "Exception")


def shell(folder, arguments, redirected="", **environment):
    """Run ``envedit`` in a shell; returns the exit code, and what reached stdout and stderr."""
    command = f'exec "{sys.executable}" -m envedit {arguments} {redirected}'
    given = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder / "cache")} | environment
    done = subprocess.run(["sh", "-c", command], cwd=folder, env=given, capture_output=True, timeout=250)
    return done.returncode, done.stdout.decode("utf-8", "replace"), done.stderr.decode("utf-8", "replace")


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
@pytest.mark.parametrize("redirected", [*REDIRECTED, "| true"])
def test_a_command_does_its_work_when_nobody_can_read_along(tmp_path, redirected):
    code, out, err = shell(tmp_path, "init sphere --out edit.toml", redirected)
    assert code == 0 and not any(word in out + err for word in WORDS), err
    assert (tmp_path / "edit.toml").read_text().rstrip() != ""
    # What is wrong has its code all the same.
    if "|" not in redirected:
        code, out, err = shell(tmp_path, "run nothing.toml", redirected)
        assert code == 2 and "Traceback" not in out + err


@pytest.mark.slow
def test_letters_that_a_terminal_cannot_show_are_escaped(tmp_path):
    code, out, err = shell(
        tmp_path, "init sphere --out größe.toml", PYTHONIOENCODING="ascii", LC_ALL="C.UTF-8"
    )
    assert code == 0 and "Traceback" not in err
    assert r"gr\xf6\xdfe.toml" in out and (tmp_path / "größe.toml").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_as_configuration_is_refused(tmp_path, capsys):
    os.mkfifo(tmp_path / "edit.toml")
    assert run.main([str(tmp_path / "edit.toml")]) == 2
    assert "edit.toml': cannot be read: is no regular file" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_with_closed_streams_leaves_whole_results(tmp_path, rng):
    """With another order of sets and dicts of strings, too; the second run finds what the first one kept."""
    path = world(tmp_path, rng, optimizer={"iterations": 2})
    for out, redirected, seed in (("open", "", "1"), ("closed", ">&- 2>&- <&-", "2")):
        assert shell(tmp_path, f"run '{path}' --out {out}", redirected, PYTHONHASHSEED=seed)[0] == 0
    assert names(tmp_path / "closed") == names(tmp_path / "open") >= FILES
    assert differing(tmp_path / "closed", tmp_path / "open") == set()
