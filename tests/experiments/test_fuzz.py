"""Damaged files of every kind end well; and the harness sees each way in which they could end badly."""

import argparse
import ctypes
import os
import struct
import sys
import time
import warnings

import numpy as np
import pytest

from envedit.config import Config
from envedit.core.errors import InputError
from envedit.images import images
from experiments.fuzz import experiment, kinds, whole
from experiments.fuzz.declared import declared as declared_bytes
from experiments.fuzz.worker import Worker
from experiments.harness import Case, Done, rows_of

linux = pytest.mark.skipif(sys.platform != "linux", reason="memory of a process is read from /proc")


# ---- the package -------------------------------------------------------------------------------------------
@pytest.mark.slow
@linux
@pytest.mark.parametrize(("what", "cases"), [
    ("map", 80), ("toml", 80), ("painted", 30), ("weights", 30), ("scene", 30), ("asset", 8), ("entry", 8),
    ("checkpoint", 40),
])  # fmt: skip
def test_damaged_files_are_read_or_refused(what, cases, tmp_path):
    found = experiment.piece(Config(), tmp_path, what, 0, cases)
    counts, errors = found["counts"], found["errors"]
    assert not found["faults"] and not list(tmp_path.iterdir())
    assert counts["read"] + counts["refused"] == cases
    # Not all of the damage is found at the door, and not all of it is harmless.
    if what == "entry":  # a damaged one is made anew
        assert counts["read"] == cases
        return
    assert counts["read"] > 0 and counts["refused"] > cases / 4
    assert set(errors) <= {"InputError", "ConfigError"}
    assert bool(errors["ConfigError"]) <= (what in ("toml", "scene"))


@pytest.fixture(scope="module")
def reader():
    """A worker that reads maps and painted pictures."""
    with Worker(kinds.read_map) as process:
        yield process


@pytest.mark.slow
@linux
@pytest.mark.parametrize("name", ["ours.exr", "flat.hdr", "rgb8.png"])
def test_a_whole_image_takes_no_more_than_the_stated_multiple(tmp_path, name, reader):
    """Here without the room that small files have, so that the multiple itself is tested."""
    height, width = 512, 1024
    small = tmp_path / f"small-{name}"  # a first file takes memory that later ones do not
    small.write_bytes((whole.stored("map") | whole.stored("painted"))[name])
    if name == "ours.exr":
        images.write_exr(tmp_path / name, np.tile(whole.radiance(), (32, 32, 1)))
    elif name == "flat.hdr":
        texels = np.frombuffer(small.read_bytes()[-16 * 32 * 4 :], np.uint8).reshape(16, 32, 4)
        pixels = np.tile(texels, (32, 32, 1))
        (tmp_path / name).write_bytes(b"#?RADIANCE\n\n-Y 512 +X 1024\n" + pixels.tobytes())
    else:
        images.write_png(tmp_path / name, np.tile(images.read_stored(small)[0] / 255, (32, 32, 1)))
    declared = declared_bytes((tmp_path / name).read_bytes())
    assert declared >= 12 * height * width
    reader.read(small, 0, 0)
    answer = reader.read(tmp_path / name, 0, declared)
    assert answer["outcome"] == "read", answer
    assert declared / 2 < answer["peak"] < 8 * declared


@pytest.mark.slow
@linux
@pytest.mark.parametrize("field", ["dataWindow", "displayWindow", "both"])
def test_an_image_two_billion_texels_wide_takes_no_memory(tmp_path, field, reader):
    raw = bytearray(dict(kinds.seeds("map"))["ours.exr"])
    for name in ("dataWindow", "displayWindow"):
        if field in (name, "both"):
            at = raw.index(name.encode() + b"\0box2i\0") + len(name) + 11
            struct.pack_into("<4i", raw, at, 0, 0, 2**31 - 2, 15)
    (tmp_path / "wide.exr").write_bytes(raw)
    answer = reader.read(tmp_path / "wide.exr", 0, 0)
    assert answer["outcome"] == "refused" and answer["peak"] < 8 << 20, answer


# ---- the harness -------------------------------------------------------------------------------------------


def refusing(text):
    """Return a reader that refuses a file by a message."""

    def reader(path):
        raise InputError(text.format(path=path))

    return reader


def hung(path):
    while True:
        pass


def wrong(path):
    raise kinds.WrongError("not finite")


BAD = {
    "crashed": lambda path: ctypes.string_at(0),
    "hung": hung,
    "stuck": lambda path: time.sleep(60),
    "traceback": lambda path: {}["key"],
    "nameless": refusing("cannot be read"),
    "control": refusing("{path}: \x1b[31m"),
    "lengthy": refusing("{path}: " + 1000 * "a"),
    "wrong": wrong,
    "memory": lambda path: bytearray(b"1") * (100 << 20),
    "printed": lambda path: os.write(1, b"from C"),
    "warned": lambda path: warnings.warn("from Python", stacklevel=1),
    "refused": refusing("{path}: damaged"),
}
"""Readers by what they do."""


def bad(path, index):
    """A reader that does what a file says."""
    BAD[path.read_text()](path)


def bad_by_index(path, index):
    """A reader that fails at two cases and at a whole file."""
    if index == 1 or (index == experiment.WHOLE and path.name == "new.hdr"):
        raise KeyError("a")
    if index == 2:
        os.abort()


@pytest.fixture(scope="module")
def bad_reader():
    """A worker with minutes on the clock."""
    with Worker(bad, seconds=0.5, patience=240) as process:
        yield process


@pytest.mark.slow
@linux
@pytest.mark.parametrize(("kind", "outcome", "words"), [
    ("crashed", "crashed", "SIGSEGV"), ("hung", "hung", "of processor time"),
    ("stuck", "hung", "of wall time"), ("traceback", "traceback", "KeyError"),
    ("nameless", "unclear", "does not name the file"), ("control", "unclear", "control characters"),
    ("lengthy", "unclear", "1 lines, "), ("wrong", "wrong", "not finite"),
    ("memory", "memory", "MiB for 0 bytes"),
    ("printed", "printed", "from C"), ("warned", "printed", "from Python"),
])  # fmt: skip
def test_every_fault_is_seen(tmp_path, monkeypatch, kind, outcome, words, bad_reader):
    (tmp_path / "case").write_text(kind)
    (tmp_path / "good").write_text("refused")
    with monkeypatch.context() as patch:
        if kind == "stuck":
            patch.setattr(bad_reader, "patience", 10)
        answer = bad_reader.read(tmp_path / "case", 0, 0)
    assert answer["outcome"] == outcome and words in answer["error"]
    assert bad_reader.read(tmp_path / "good", 1, 0)["outcome"] == "refused"  # and the next one is read


@pytest.mark.slow
@linux
def test_failing_cases_are_kept_and_counted(tmp_path):
    found = experiment.piece(Config(), tmp_path, "map", 0, 4, reader=bad_by_index)
    unread = ("new.hdr", "traceback")  # before the first case, and by the process that takes the place of one
    faults = [(i, outcome) for i, outcome, _ in found["faults"]]
    assert faults == [unread, (1, "traceback"), (2, "crashed"), unread]
    assert dict(found["counts"]) == {"read": 2, "traceback": 1, "crashed": 1}
    name, data = kinds.case("map", kinds.seeds("map"), 0, 2)
    assert len(list(tmp_path.iterdir())) == 4
    assert (tmp_path / f"2-crashed-{name}").read_bytes() == data
    assert "SIGABRT" in (tmp_path / f"2-crashed-{name}.txt").read_text()


def test_a_case_is_the_same_file_every_time():
    for what in ("map", "toml", "weights"):
        files = kinds.seeds(what)
        one, other = ([kinds.case(what, files, seed, i) for i in range(30)] for seed in (0, 1))
        assert one == [kinds.case(what, files, 0, i) for i in reversed(range(30))][::-1]
        assert sum(a == b for a, b in zip(one, other, strict=True)) < 3
        assert sum(data == dict(files)[name] for name, data in one) < 6  # nearly all are damaged


def test_faults_are_counted_and_named(tmp_path):
    done = Done(Case("map 0-2", {}, {"what": "map"}), tmp_path)
    faults = [[7, "hung", "5 s"]]
    done.__dict__["metrics"] = {"counts": {"refused": 2, "hung": 1}, "beyond": 3 << 20, "faults": faults}
    rows = rows_of(experiment.EXPERIMENT, [done])
    assert [rows[0][name] for name in ("cases", "read", "refused", "hung", "mib")] == [3, 0, 2, 1, 3]
    assert experiment.failures(rows) == [f"map 7: hung: 5 s (kept in {tmp_path})"]


def test_the_pieces_of_a_kind_are_all_its_files():
    asked = experiment.cases(argparse.Namespace(count=6000))
    names = [case.name for case in asked if case.about["what"] == "map"]
    assert names == ["map 0-2499", "map 2500-4999", "map 5000-5999"]
    assert [case.name for case in asked if case.about["what"] == "asset"] == ["asset 0-599"]
    assert len(asked) == 3 * (len(kinds.KINDS) - 1) + 1


def test_images_say_how_large_they_are():
    texels = 16 * 32
    files = dict(kinds.seeds("map")) | dict(kinds.seeds("painted"))
    for name, data in files.items():
        assert 12 * texels <= declared_bytes(data) <= (6 * 4 + 16) * texels * 2, name
    hdr = files["new.hdr"].replace(b"+X 32", b"+X 2147483647")
    assert declared_bytes(hdr) == declared_bytes(hdr.replace(b"2147483647", b"0")) == 0
    for data in (b"", b"#?", b"\x76\x2f\x31\x01", b"\x89PNG", b"\xff\xd8", b"PK\x03\x04"):
        assert declared_bytes(data) in (0, len(data))
