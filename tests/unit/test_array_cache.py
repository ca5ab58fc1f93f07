"""Arrays on disk: what comes back, what does not, and what a full folder loses."""

import io
import json
import os
import time
import zipfile

import numpy as np
import pytest

from envedit.core import array_cache
from envedit.core.array_cache import DiskCache
from tests.oracles.matrix_renderer import same_bits

KEY = {"scene": "abc", "seed": 3, "grid": [8, 16]}


def some(rng, size=3000):
    return {
        "packed": rng.standard_normal((size, 4)).astype(np.float32),
        "start": rng.integers(0, 2**32, 7, dtype=np.uint32),
        "one": np.array(-5, np.int64),
        "nothing": np.zeros((0, 3), np.float32),
        "mask": rng.random(5) < 0.5,
        "odd": np.array([np.nan, -0.0, np.inf, 1e-310]),
    }


def only_file(folder):
    (path,) = folder.iterdir()
    return path


def test_the_same_bits_come_back_of_any_layout(tmp_path, rng):
    cache, arrays = DiskCache(tmp_path / "a" / "b"), some(rng)
    assert cache.load(KEY) is None
    cache.store(KEY, arrays)
    assert same_bits(cache.load(KEY), arrays)
    assert same_bits(DiskCache(tmp_path / "a" / "b").load(dict(reversed(KEY.items()))), arrays)
    image = rng.random((6, 5, 4))
    DiskCache(tmp_path).store(KEY, {"a": image[::2, :, 1:3].T})
    np.testing.assert_array_equal(DiskCache(tmp_path).load(KEY)["a"], image[::2, :, 1:3].T)


def test_another_key_finds_nothing_and_a_new_entry_takes_the_place_of_the_old(tmp_path, rng):
    cache = DiskCache(tmp_path)
    cache.store(KEY, some(rng))
    assert cache.load(KEY | {"seed": 4}) is None and cache.load({}) is None
    newer = some(rng, 10)
    cache.store(KEY, newer)
    assert same_bits(cache.load(KEY), newer) and len(list(tmp_path.iterdir())) == 1


# ---- files that are no good ------------------------------------------------------------------------------
@pytest.mark.slow
def test_no_damage_to_a_single_byte_goes_unseen(tmp_path, rng):
    """Every byte of a small file is changed in turn: nothing, or the same arrays where it was padding."""
    cache, arrays = DiskCache(tmp_path), some(rng, 5)
    cache.store(KEY, arrays)
    path = only_file(tmp_path)
    whole, seen = path.read_bytes(), 0
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        found = cache.load(KEY)
        assert found is None or same_bits(found, arrays)
        seen += found is None
    assert seen > sum(array.nbytes for array in arrays.values())


def test_files_that_are_cut_short_foreign_or_of_another_key_are_none(tmp_path, rng):
    cache = DiskCache(tmp_path)
    cache.store(KEY, some(rng, 50))
    path = only_file(tmp_path)
    whole = path.read_bytes()
    cache.store(KEY | {"seed": 4}, some(rng))
    (other,) = set(tmp_path.iterdir()) - {path}
    cut = [whole[:length] for length in (0, 1, 8, 15, 16, 300, len(whole) // 2, len(whole) - 1)]
    foreign = [b"not arrays at all", b"\x93NUMPY" + bytes(200), bytes(4096), other.read_bytes()]
    for content in cut + foreign:
        path.write_bytes(content)
        assert cache.load(KEY) is None
    path.unlink()
    path.mkdir()
    assert cache.load(KEY) is None
    cache.store(KEY, some(rng))  # cannot be written: costs time, not the run
    assert cache.load(KEY) is None and path.is_dir()


def test_a_folder_that_cannot_be_is_no_error(tmp_path, rng):
    (tmp_path / "file").write_text("mine")
    cache = DiskCache(tmp_path / "file" / "cache")
    cache.store(KEY, some(rng))
    assert cache.load(KEY) is None and (tmp_path / "file").read_text() == "mine"


def test_a_folder_of_somebody_else_is_read(tmp_path, rng, monkeypatch):
    DiskCache(tmp_path).store(KEY, some(rng))

    def denied(path):
        raise PermissionError(path)

    monkeypatch.setattr(os, "utime", denied)
    assert DiskCache(tmp_path).load(KEY) is not None


def test_a_full_disk_leaves_what_was_there(tmp_path, rng, monkeypatch):
    cache, arrays = DiskCache(tmp_path), some(rng)
    cache.store(KEY, arrays)

    def full(source, target):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(array_cache.os, "replace", full)
        cache.store(KEY, some(rng, 10))
        cache.store({}, some(rng, 10))
    assert same_bits(cache.load(KEY), arrays) and len(list(tmp_path.iterdir())) == 1


# ---- the bound -------------------------------------------------------------------------------------------
def filled(folder, count, used):
    """Store entries of 10 kB and say when each was used last, in seconds; returns cache and paths."""
    cache, paths = DiskCache(folder, most_bytes=35_000), []
    for i in range(count):
        before = set(folder.iterdir()) if folder.exists() else set()
        cache.store({"i": i}, {"a": np.full(2500, i, np.float32)})
        (path,) = set(folder.iterdir()) - before
        os.utime(path, (used[i], used[i]))
        paths.append(path)
    return cache, paths


@pytest.mark.parametrize(("looked_at", "size", "kept"), [
    ((), 2500, [0, 2, 3]), ((1,), 2500, [1, 2, 3]), ((), 10_000, [0, 1, 2]),
])  # fmt: skip
def test_what_was_not_used_for_longest_makes_room_for_what_is_no_larger_than_the_bound(
    looked_at, size, kept, tmp_path
):
    cache, _ = filled(tmp_path, 3, used=[200, 100, 300])
    assert all(cache.load({"i": i}) is not None for i in looked_at)  # a look is a use
    cache.store({"i": 3}, {"a": np.full(size, 3, np.float32)})
    assert [i for i in range(4) if cache.load({"i": i}) is not None] == kept
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 35_000


def test_nothing_but_its_own_files_is_deleted(tmp_path):
    cache, _ = filled(tmp_path, 3, used=[200, 100, 300])
    outside = tmp_path.parent / "outside"
    outside.write_bytes(bytes(50_000))
    mine = [tmp_path / "notes.txt", tmp_path / "map.arrays", tmp_path / f"{'0' * 32}.npz",
            tmp_path / f"x{'0' * 32}.arrays"]  # fmt: skip
    for path in mine:
        path.write_bytes(bytes(50_000))
        os.utime(path, (1, 1))
    link, inside = tmp_path / f"{'1' * 32}.arrays", tmp_path / f"{'2' * 32}.arrays"
    link.symlink_to(outside)
    inside.mkdir()
    for i in range(3, 9):
        cache.store({"i": i}, {"a": np.full(2500, i, np.float32)})
    assert all(path.stat().st_size == 50_000 for path in [*mine, outside])
    assert link.is_symlink() and inside.is_dir()
    assert sum(cache.load({"i": i}) is not None for i in range(9)) == 3


def test_what_a_killed_writer_left_is_deleted_but_not_what_is_being_written(tmp_path):
    cache, _ = filled(tmp_path, 1, used=[100])
    left, current = tmp_path / f".{'3' * 32}.arrays.123", tmp_path / f".{'4' * 32}.arrays.124"
    for path, age in ((left, 7200), (current, 60)):
        path.write_bytes(bytes(30_000))
        os.utime(path, (time.time() - age,) * 2)
    cache.store({"i": 1}, {"a": np.full(2500, 1, np.float32)})
    assert not left.exists() and current.exists()
    assert cache.load({"i": 0}) is None and cache.load({"i": 1}) is not None  # both count


# ---- entries and folders of others -------------------------------------------------------------------------
@pytest.mark.parametrize("header", [
    "{'descr': '|O', 'fortran_order': False, 'shape': (8,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-8,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (2**62,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4611686018427387904,)}",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000,)}",
    "[]",
])  # fmt: skip
def test_a_header_is_not_believed(header, tmp_path):
    """Also where the CRC of the array is right."""
    cache = DiskCache(tmp_path)
    body = header.encode().ljust(118) + bytes(64)
    key = io.BytesIO()
    np.save(key, np.array(json.dumps(KEY, sort_keys=True).encode()))
    with zipfile.ZipFile(cache._path(KEY), "w") as archive:
        archive.writestr(f"{array_cache.KEY}.npy", key.getvalue())
        archive.writestr("a.npy", b"\x93NUMPY\1\0\x76\0" + body)
    assert cache.load(KEY) is None


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_pipes_and_devices_do_not_wait(tmp_path):
    cache = DiskCache(tmp_path)
    os.mkfifo(cache._path(KEY))
    assert cache.load(KEY) is None
    os.unlink(cache._path(KEY))
    os.symlink("/dev/zero", cache._path(KEY))
    assert cache.load(KEY) is None
    cache.store(KEY, {"a": np.ones(3)})  # in its place, and not into it
    assert cache.load(KEY)["a"].tolist() == [1, 1, 1] and not cache._path(KEY).is_symlink()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no owners here")
def test_a_folder_that_others_own_or_write_to_is_not_used(tmp_path, rng, monkeypatch):
    cache, arrays = DiskCache(tmp_path / "kept"), some(rng)
    cache.store(KEY, arrays)
    assert (tmp_path / "kept").stat().st_mode & 0o777 == 0o700
    (tmp_path / "kept").chmod(0o777)
    assert cache.load(KEY) is None
    cache.store(KEY | {"seed": 4}, arrays)
    assert len(cache.files()) == 1
    (tmp_path / "kept").chmod(0o755)
    assert same_bits(cache.load(KEY), arrays)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    if os.getuid() != 0:  # what the system's user made is trusted
        assert cache.load(KEY) is None


def test_without_a_home_nothing_is_kept(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    assert array_cache.cache_home() is None and array_cache.cache_folder("fits") is None
    cache = DiskCache(array_cache.cache_folder("fits"))
    cache.store(KEY, {"a": np.ones(3)})
    assert cache.load(KEY) is None and cache.files() == []
