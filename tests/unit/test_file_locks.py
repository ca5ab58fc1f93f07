"""Locks that end with the processes that hold them."""

import os
import socket
import subprocess
import sys

import pytest

from envedit.core import file_locks
from envedit.core.errors import InputError

pytestmark = pytest.mark.skipif(file_locks.fcntl is None, reason="no locks here")

HOLD = (
    "import sys, time; from pathlib import Path; from envedit.core import file_locks\n"
    "with file_locks.locked(Path(sys.argv[1])):\n"
    "    print('locked', flush=True)\n"
    "    sys.stdin.read()"
)


@pytest.fixture
def holder(tmp_path):
    """A process that holds the lock until its standard input is closed."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def busy(path):
    """Who holds a lock; "" if nobody."""
    try:
        with file_locks.locked(path):
            return ""
    except file_locks.Busy as who:
        return str(who)


def test_a_lock_is_held_until_it_is_given_back(tmp_path):
    path = tmp_path / "lock"
    with file_locks.locked(path):
        assert busy(path) == f"process {os.getpid()} on {socket.gethostname()}"
        assert path.exists()
    assert not path.exists()
    assert busy(path) == ""


def test_another_process_holds_it_until_it_ends(tmp_path, holder):
    path = tmp_path / "lock"
    assert busy(path).startswith(f"process {holder.pid} on ")
    holder.kill()
    holder.wait()
    assert path.exists()
    assert busy(path) == ""


def test_a_child_that_inherits_the_file_holds_the_lock_as_well(tmp_path):
    path = tmp_path / "lock"
    with file_locks.locked(path) as file:
        child = subprocess.Popen(["cat"], stdin=subprocess.PIPE, pass_fds=[file.fileno()])
        kept = tmp_path / "kept"
        os.link(path, kept)  # as where the holder was killed before it could remove it
    assert busy(kept).startswith("process ")
    child.communicate()
    assert busy(kept) == ""


def test_a_file_that_was_removed_in_between_locks_nothing(tmp_path, monkeypatch):
    path = tmp_path / "lock"
    taken = file_locks.lock

    def remove_first(descriptor):
        path.unlink()
        return taken(descriptor)

    monkeypatch.setattr(file_locks, "lock", remove_first)
    assert busy(path) == "another process"


def test_a_file_system_without_locks_does_without(tmp_path, monkeypatch):
    def missing(descriptor, how):
        raise OSError("no locks")

    monkeypatch.setattr(file_locks.fcntl, "flock", missing)
    with file_locks.locked(tmp_path / "lock"):
        assert busy(tmp_path / "lock") == ""


def test_a_lock_file_that_cannot_be_made_is_an_error(tmp_path):
    with pytest.raises(InputError, match="none/lock: cannot be written"):
        busy(tmp_path / "none/lock")
