"""Files are written whole or not at all, and libraries are kept quiet."""

import hashlib
import os
import sys

import pytest

from envedit.core import array_cache, atomic_files
from envedit.core.errors import InputError, NumericalError
from envedit.core.quiet_libraries import quiet_libraries
from envedit.report import output_folder


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "zażółć.txt"
    for data in (b"old", b"", b"new" * 100_000):
        atomic_files.write_atomically(path, data)
        assert path.read_bytes() == data
    with atomic_files.replacing(path, ".txt") as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt"
        temporary.write_bytes(b"newer")
        assert path.read_bytes() == b"new" * 100_000, "not before the end"
    assert path.read_bytes() == b"newer" and os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("raised, seen, says", [
    (
        RuntimeError("Cannot open x.tmp: Too many links."),
        InputError,
        r"a: cannot be written \(Too many links\)",
    ),
    (ValueError("bad header"), InputError, r"a: cannot be written \(bad header\)"),
    (NumericalError("texel 3 is NaN"), NumericalError, "^texel 3 is NaN$"),
    (KeyboardInterrupt(), KeyboardInterrupt, "^$"),
])  # fmt: skip
def test_a_failure_keeps_the_old_file(tmp_path, raised, seen, says):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with pytest.raises(seen, match=says), atomic_files.replacing(path) as temporary:
        temporary.write_bytes(b"half")
        raise raised
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a"]


def test_a_block_that_writes_nothing_is_told(tmp_path):
    with pytest.raises(InputError, match="No such file"), atomic_files.replacing(tmp_path / "a"):
        pass


def test_a_digest_follows_the_content(tmp_path):
    path = tmp_path / "a"
    for data in (b"old", b"newer"):
        path.write_bytes(data)
        assert atomic_files.digest(path) == hashlib.sha256(data).digest()
    path.unlink()
    with pytest.raises(InputError, match="a: cannot be read"):
        atomic_files.digest(path)


@pytest.mark.parametrize("name", ["gone/a", "file/a", "a\0b", "folder"])
def test_an_impossible_place_is_an_input_error(tmp_path, name):
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        atomic_files.write_atomically(tmp_path / name, b"data")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_caches_follow_the_desktop_standard(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert array_cache.cache_folder("fits") == tmp_path / "envedit" / "fits"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert array_cache.cache_folder("transport") == tmp_path / ".cache" / "envedit" / "transport"


def test_libraries_are_heard_and_kept_quiet(capfd):
    with quiet_libraries() as said:
        os.write(2, b"from C, ")
        print("from Python")
    assert said == ["from Python\nfrom C, "] and capfd.readouterr() == ("", "")
    print("after", file=sys.stderr)
    assert capfd.readouterr() == ("", "after\n")


def test_a_folder_is_worked_in_by_one_at_a_time(tmp_path):
    folder = tmp_path / "new" / "results"
    with output_folder.alone(folder):
        with pytest.raises(InputError, match="another run works in it"), output_folder.alone(folder):
            pass
        with output_folder.alone(tmp_path):
            pass
    with output_folder.alone(folder):
        assert list(folder.iterdir()) == []


def test_an_input_in_a_folder_of_results_is_not_moved_away(tmp_path):
    start = tmp_path / "variants" / "1.npz"
    start.parent.mkdir()
    start.write_text("a solution")
    moved = output_folder.results_in(tmp_path, output_folder.RESULTS, [start])
    with pytest.raises(InputError, match="variants: this input lies where its own results would go"), moved:
        pass
    assert start.exists() and list(tmp_path.iterdir()) == [start.parent]


def test_what_no_checkpoint_protects_is_kept_even_by_a_resumed_run(tmp_path):
    names = ("metrics.json", "edited.exr", "config.toml", "checkpoint.npz")

    def prepare():
        with output_folder.results_in(tmp_path, names, keep=True, spare=[tmp_path / "config.toml"]):
            pass
        return sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())

    (tmp_path / "config.toml").write_text("mine")
    assert prepare() == prepare() == ["config.toml", "earlier-1/config.toml"]
    (tmp_path / "edited.exr").write_text("of a run whose metrics.json was moved already")
    earlier = ["earlier-1/config.toml", "earlier-2/config.toml", "earlier-2/edited.exr"]
    assert prepare() == ["config.toml", *earlier]
    for name in ("checkpoint.npz", "metrics.json"):
        (tmp_path / "config.toml").write_text(f"resolved {name}")
        (tmp_path / name).write_text("")
        (tmp_path / "edited.exr").write_text("so far")
        before = len(list(tmp_path.rglob("*")))
        prepare()
        assert len(list(tmp_path.rglob("*"))) == before and (tmp_path / "edited.exr").exists()
        (tmp_path / name).unlink()


@pytest.mark.parametrize("written", [False, True])
def test_a_run_that_fails_before_its_first_result_leaves_those_of_an_earlier_one(tmp_path, written):
    names = ("metrics.json", "edited.exr", "config.toml", "checkpoint.npz")
    for name in names[:3]:
        (tmp_path / name).write_text("earlier")
    run = output_folder.results_in(tmp_path, names, spare=[tmp_path / "config.toml"])
    with pytest.raises(InputError, match="no such picture"), run:
        assert not (tmp_path / "metrics.json").exists()
        if written:
            (tmp_path / "checkpoint.npz").write_text("new")
        raise InputError("no such picture")
    assert (tmp_path / "metrics.json").exists() != written
    assert (tmp_path / "earlier-1").exists() == written
