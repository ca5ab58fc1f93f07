"""Runs that are killed, run out of disk or lose their folder: what is left is whole, and --resume ends them.

A kill is simulated in this process where it is to come at a certain file: nothing that follows it is done,
not even what would clean up. ``tests/integration/test_run.py`` kills a process for good.
"""

import contextlib
import errno
import json
import os
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest

from envedit.cli.progress import Progress
from envedit.core import atomic_files
from envedit.core.errors import InputError
from envedit.images import images
from envedit.report import output_folder, preview
from envedit.solve import adam_loop, checkpoint
from tests.oracles.runs import FILES, INFLUENCE, call, differing, names, pictures, small_world, world

pytestmark = pytest.mark.usefixtures("isolated")

COMPLETE = FILES | INFLUENCE
TABLES = {
    "representation": {"kind": "siren", "hidden": 16, "depth": 1},  # it keeps a fit
    "optimizer": {"iterations": 3, "checkpoint_s": 0.0},  # a checkpoint a step
}


class Killed(BaseException):
    """Nothing catches it."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the configuration of a run and the folder of an undisturbed one."""
    folder = tmp_path_factory.mktemp("whole")
    path = world(folder, np.random.default_rng(0), **TABLES)
    with small_world(folder / "cache"):
        assert call(path, "--quiet") == 0
    assert names(folder / "c_out") == COMPLETE
    return path, folder / "c_out"


def check_visible(folder, reference):
    """What can be seen in a folder of results is whole, whatever happened."""
    for name in names(folder) if folder.exists() else ():
        file = folder / name
        if name.startswith("."):
            continue
        if name.endswith(".json"):
            json.loads(file.read_text())
        elif name == checkpoint.NAME:
            with np.load(file) as stored:
                assert all(stored[key] is not None for key in stored.files)
        elif name in pictures(reference):
            assert file.read_bytes() == (reference / name).read_bytes(), name
        elif name == "report.html":
            assert file.read_text().rstrip().endswith("</html>")
        elif name in ("config.toml", "history.csv"):
            lines = [(one / name).read_text().splitlines() for one in (folder, reference)]
            assert len(lines[0]) == len(lines[1]) and lines[0][0] == lines[1][0], name


def check_resumed(path, folder, reference):
    """Resuming ends the run with the same pictures, and leaves nothing else."""
    assert call(path, "--quiet", "--resume", "--out", folder) == 0
    assert names(folder) == names(reference) == COMPLETE
    assert differing(folder, reference) == set()
    mine, theirs = (json.loads((f / "metrics.json").read_text()) for f in (folder, reference))
    assert mine["render"] == theirs["render"] and mine["iterations"] == theirs["iterations"]


# ---- killed at a file ------------------------------------------------------------------------------------
@contextlib.contextmanager
def killed_at(patch, number):
    """Kill at the n-th renaming of a temporary file, which is cut in half; yields what was renamed."""
    seen, replace, unlink = [], os.replace, Path.unlink

    def cut(source, target):
        seen.append(Path(target).name)
        if len(seen) - 1 == number:
            os.truncate(source, os.path.getsize(source) // 2)
            patch.setattr(Path, "unlink", lambda *a, **k: None)  # the dead do not clean up
            raise Killed
        replace(source, target)

    with patch.context() as inner:
        inner.setattr(atomic_files.os, "replace", cut)
        try:
            yield seen
        finally:
            patch.setattr(Path, "unlink", unlink)


@pytest.mark.slow
def test_a_run_killed_while_it_writes_a_file_is_resumed_to_the_same_bytes(tmp_path, whole, monkeypatch):
    path, reference = whole
    killed, number = [], 0
    while True:
        folder = tmp_path / f"out-{number}"
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / f"cache-{number}"))
        try:
            with killed_at(monkeypatch, number) as seen:
                assert call(path, "--quiet", "--out", folder) == 0
            break  # no file is left to be killed at
        except Killed:
            killed.append(seen[-1])
        check_visible(folder, reference)
        assert sum(name.startswith(".") for name in names(folder)) == (killed[-1] in output_folder.RESULTS)
        if number % 8 == 0:  # a run takes long
            check_resumed(path, folder, reference)
        number += 4
    assert len(set(killed) & COMPLETE) > 0.2 * len(COMPLETE) and checkpoint.NAME in killed
    assert any(name.endswith(".arrays") for name in killed)  # the fit, the transport


@pytest.mark.slow
def test_a_run_without_a_step_is_resumed_where_it_was_killed_as_it_wrote(tmp_path, monkeypatch):
    """No step is allowed: nothing is optimised, and what was written is no earlier run's."""
    path = world(tmp_path, np.random.default_rng(0), optimizer={"iterations": 0})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with killed_at(monkeypatch, 10**9) as seen:
        assert call(path, "--quiet", "--out", tmp_path / "whole") == 0
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other cache"))
    folder = tmp_path / "out"
    with pytest.raises(Killed), killed_at(monkeypatch, seen.index("render_target.exr")):
        call(path, "--quiet", "--out", folder)
    assert {"edited.exr", checkpoint.NAME} < names(folder)
    assert call(path, "--quiet", "--resume", "--out", folder) == 0
    assert names(folder) == names(tmp_path / "whole")
    assert differing(folder, tmp_path / "whole") == set()


@pytest.mark.slow
def test_a_run_killed_after_its_last_file_is_resumed_too(tmp_path, whole, monkeypatch):
    path, reference = whole

    def kill(folder):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "remove", kill)
        with pytest.raises(Killed):
            call(path, "--quiet", "--out", tmp_path / "out")
    assert names(tmp_path / "out") == COMPLETE | {checkpoint.NAME}
    check_resumed(path, tmp_path / "out", reference)


@pytest.mark.slow
@pytest.mark.parametrize("moved", [0, 5])
def test_a_run_killed_while_it_moves_earlier_results_loses_none(moved, tmp_path, whole, monkeypatch):
    path, reference = whole
    folder = tmp_path / "out"
    shutil.copytree(reference, folder)
    # As its configuration says, so that it is the same run.
    text = (folder / "config.toml").read_text().replace(str(reference), str(folder))
    (folder / "config.toml").write_text(text)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    rename, count = Path.rename, []

    def kill(self, target):
        count.append(self)
        if len(count) > moved:
            raise Killed
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", kill)
        with pytest.raises(Killed):
            call(path, "--quiet", "--out", folder)
    kept = {file.name: file.read_bytes() for file in (folder / "earlier-1").iterdir()}
    assert len(kept) == moved and kept | {f.name: f.read_bytes() for f in folder.glob("*.*")} == before
    assert call(path, "--quiet", "--resume", "--out", folder) == 0
    moved_on = [f"earlier-{n}" for n in (1, 2)][: 1 + (moved > 0)]
    assert names(folder) == COMPLETE | set(moved_on)
    kept = {file.name: file.read_bytes() for name in moved_on for file in (folder / name).iterdir()}
    assert kept == (before if moved else {})
    assert all((folder / name).read_bytes() == data for name, data in pictures(reference).items())


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path):
    left = {".edited.exr.7.exr", ".metrics.json.7", ".checkpoint.npz.99999999999999999999"}
    others = {".mine.exr.7.exr", ".edited.exr.note", "edited.exr"}
    for name in left | others:
        (tmp_path / name).write_bytes(b"half")
    output_folder.tidy(tmp_path)
    assert names(tmp_path) == others
    output_folder.tidy(tmp_path / "nowhere")


# ---- no space, no folder ---------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"),
    [
        (checkpoint.NAME, errno.ENOSPC),
        ("edited.exr", errno.ENOSPC),
        ("config.toml", errno.ENOSPC),
        ("metrics.json", errno.EROFS),
    ],
)
def test_a_disk_that_is_full_at_a_file_is_told_and_costs_no_work(
    name, number, tmp_path, whole, monkeypatch, capsys
):
    """The run goes on from its checkpoint as soon as there is room."""
    path, reference = whole
    folder, replace = tmp_path / "out", os.replace
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def full(source, target):
        if Path(target).name == name:
            raise OSError(number, os.strerror(number))
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(atomic_files.os, "replace", full)
        assert call(path, "--quiet", "--out", folder) == 3
    said = capsys.readouterr().err
    assert len(said.splitlines()) <= 2 and "Traceback" not in said
    assert str(folder / name) in said and os.strerror(number) in said and "free space" in said
    left = names(folder)
    assert not any(found.startswith(".") for found in left)
    assert (checkpoint.NAME in left) == (name != checkpoint.NAME) and "metrics.json" not in left
    assert name not in left and (left or name == checkpoint.NAME)
    check_visible(folder, reference)
    check_resumed(path, folder, reference)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["editing", "writing"])
def test_a_folder_that_is_gone_is_told(stage, tmp_path, whole, monkeypatch, capsys):
    path, _ = whole
    folder, begin = tmp_path / "out", Progress.stage

    def remove(self, text):
        begin(self, text)
        if text == stage:
            shutil.rmtree(folder)

    monkeypatch.setattr(Progress, "stage", remove)
    assert call(path, "--quiet", "--out", folder) == 3
    said, name = capsys.readouterr().err, {"editing": checkpoint.NAME, "writing": "edited.exr"}[stage]
    assert str(folder / name) in said and "its folder does not exist" in said and len(said.splitlines()) == 1


@contextlib.contextmanager
def largest_file(size):
    """Let no file of this process grow beyond a size: the library's write comes short, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


PICTURE = np.random.default_rng(0).random((16, 32, 3)).astype(np.float32)
ROWS = [{"iteration": i, "loss": 1 / (i + 1)} for i in range(50)]
STATE = adam_loop.State(3, history=ROWS)
WRITERS = {
    "edited.exr": lambda path: images.write_exr(path, PICTURE),
    "edited_layers.exr": lambda path: images.write_layers(path, {"edited": PICTURE, "grey": PICTURE[..., 0]}),
    "influence.png": lambda path: preview.influence(path, PICTURE[..., 0], None),
    "config.toml": lambda path: atomic_files.write_atomically(path, b"# a comment\n" * 100),
    "checkpoint.npz": lambda path: checkpoint.save(path.parent, "what", STATE, {"p": PICTURE}, {}, PICTURE),
    "unreachable.png": lambda path: images.write_png(path, PICTURE[:8, :16]),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_write_that_comes_short_leaves_no_file(name, tmp_path):
    """However little is missing; libraries that swallow the error would leave a half file for a whole one."""
    path = tmp_path / name
    WRITERS[name](path)
    data = path.read_bytes()
    path.unlink()
    for size in (0, 100, len(data) // 2, len(data) - 100, len(data) - 1):
        said = f"{name}: cannot be written .File too large."
        with pytest.raises(InputError, match=said), largest_file(size):
            WRITERS[name](path)
        assert names(tmp_path) == set()
    with largest_file(len(data)):
        WRITERS[name](path)
    assert len(path.read_bytes()) == len(data)
