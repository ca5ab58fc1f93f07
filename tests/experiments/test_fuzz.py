"""Damaged files of every kind end well; and the harness sees each way in which they could end badly."""

import argparse
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from envedit.config import Config
from experiments.fuzz import documents, drive, experiment, headers, kinds, mutate, pictures
from experiments.harness import table
from tests.oracles.tiers import slow_but

linux = pytest.mark.skipif(sys.platform != "linux", reason="memory of a process is read from /proc")

# ---- the package -------------------------------------------------------------------------------------------


@pytest.mark.slow
@linux
@pytest.mark.parametrize(
    ("what", "cases"),
    slow_but(
        [
            ("exr", 90),
            ("hdr", 90),
            ("toml", 90),
            ("painted", 60),
            ("weights", 60),
            ("checkpoint", 40),
            ("scene", 60),
            ("mesh", 60),
            ("texture", 60),
            ("entry", 40),
            ("state", 60),
        ],
        "exr",
        "toml",
    ),
)
def test_damaged_files_are_read_or_refused(what, cases, tmp_path):
    found = drive.piece(Config(), tmp_path, what, 0, cases)
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


@pytest.mark.slow
@linux
@pytest.mark.parametrize("name", ["ours.exr", "flat.hdr", "rgb8.png"])
def test_a_whole_image_takes_no_more_than_the_stated_multiple(tmp_path, name):
    """Here without the room that small files have, so that the multiple itself is tested."""
    shape = (512, 1024)
    if name == "ours.exr":
        from envedit.images import images

        images.write_exr(tmp_path / name, np.tile(pictures.radiance(), (32, 32, 1)))
    elif name == "flat.hdr":
        pixels = np.tile(pictures.shared_exponent(), (32, 32, 1))
        (tmp_path / name).write_bytes(b"#?RADIANCE\n\n-Y 512 +X 1024\n" + pixels.tobytes())
    else:
        (tmp_path / name).write_bytes(pictures.png(np.tile(pictures.codes(), (32, 32, 1)), 2))
    data = (tmp_path / name).read_bytes()
    declared = headers.declared(data)
    assert declared >= 12 * shape[0] * shape[1]
    small = {"ours.exr": "exr", "flat.hdr": "hdr", "rgb8.png": "painted"}[name]
    with drive.Worker("hdr") as process:
        for warm, raw in kinds.seeds(small):
            if warm == name:
                (tmp_path / f"small-{name}").write_bytes(raw)
                process.read(tmp_path / f"small-{name}", 0, len(raw), limited=False)
        answer = process.read(tmp_path / name, 0, declared)
    assert answer["outcome"] == "read", answer
    assert declared / 2 < answer["peak"] < 8 * declared


@pytest.mark.slow
@linux
@pytest.mark.parametrize("field", ["dataWindow", "displayWindow", "both"])
def test_an_image_two_billion_texels_wide_takes_no_memory(tmp_path, field):
    raw = bytearray(dict(kinds.seeds("exr"))["ours.exr"])
    for name in ("dataWindow", "displayWindow"):
        if field in (name, "both"):
            at = raw.index(name.encode() + b"\0box2i\0") + len(name) + 11
            struct.pack_into("<4i", raw, at, 0, 0, 2**31 - 2, 15)
    (tmp_path / "wide.exr").write_bytes(raw)
    with drive.Worker("exr") as process:
        answer = process.read(tmp_path / "wide.exr", 0, 0)
    assert answer["outcome"] == "refused" and answer["peak"] < 8 << 20, answer


# ---- the harness -------------------------------------------------------------------------------------------

BAD = """
import ctypes, os, sys, time, warnings
from envedit.core.errors import InputError
from experiments.fuzz.readers import WrongError

def read(path, index):
    kind = path.read_text()
    if kind == "crashed":
        ctypes.string_at(0)
    elif kind == "hung":
        while True:
            pass
    elif kind == "stuck":
        time.sleep(60)
    elif kind == "traceback":
        {}["key"]
    elif kind == "nameless":
        raise InputError("cannot be read")
    elif kind == "control":
        raise InputError(f"{path}: \\x1b[31m")
    elif kind == "lengthy":
        raise InputError(f"{path}: " + 1000 * "a")
    elif kind == "wrong":
        raise WrongError("not finite")
    elif kind == "memory":
        bytearray(b"1") * (100 << 20)
    elif kind == "address":
        try:
            bytearray(1 << 30)
        except MemoryError:
            raise InputError(f"{path}: not enough memory")
    elif kind == "printed":
        os.write(1, b"from C")
    elif kind == "warned":
        warnings.warn("from Python")
    elif kind == "refused":
        raise InputError(f"{path}: damaged")
"""


@pytest.mark.slow
@linux
@pytest.mark.parametrize(
    ("kind", "outcome", "words"),
    slow_but(
        [
            ("crashed", "crashed", "SIGSEGV"),
            ("hung", "hung", "of processor time"),
            ("stuck", "hung", "of wall time"),
            ("traceback", "traceback", "KeyError"),
            ("nameless", "unclear", "does not name the file"),
            ("control", "unclear", "control characters"),
            ("lengthy", "unclear", "1 lines, "),
            ("wrong", "wrong", "not finite"),
            ("memory", "memory", "MiB for 0 bytes"),
            ("address", "memory", "not enough memory"),
            ("printed", "printed", "from C"),
            ("warned", "printed", "from Python"),
        ],
        "crashed",
        "memory",
        "printed",
    ),
)
def test_every_fault_is_seen(tmp_path, monkeypatch, kind, outcome, words):
    (tmp_path / "bad.py").write_text(BAD)
    (tmp_path / "case").write_text(kind)
    (tmp_path / "good").write_text("refused")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    # A new process is to be up within the patience, on a busy machine too.
    with drive.Worker("bad:read", seconds=0.5, patience=12 if kind == "stuck" else 40) as process:
        answer = process.read(tmp_path / "case", 0, 0)
        assert answer["outcome"] == outcome and words in answer["error"]
        assert process.read(tmp_path / "good", 1, 0)["outcome"] == "refused"  # and the next one is read


@pytest.mark.slow
@linux
def test_failing_cases_are_kept_and_counted(tmp_path, monkeypatch):
    (tmp_path / "bad.py").write_text(
        "def read(path, index):\n    if index == 1:\n        raise KeyError('a')\n    if index == 2:\n"
        "        import os\n        os.abort()\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (kept := tmp_path / "kept").mkdir()
    found = drive.piece(Config(), kept, "hdr", 0, 4, reader="bad:read")
    assert [(i, o) for i, o, _ in found["faults"]] == [(1, "traceback"), (2, "crashed")]
    assert dict(found["counts"]) == {"read": 2, "traceback": 1, "crashed": 1}
    name, data = kinds.case("hdr", kinds.seeds("hdr"), 0, 2)
    assert len(list(kept.iterdir())) == 4
    assert (kept / f"2-crashed-{name}").read_bytes() == data
    assert "SIGABRT" in (kept / f"2-crashed-{name}.txt").read_text()


@pytest.mark.slow
@linux
def test_a_whole_file_that_is_not_read_is_a_fault(tmp_path, monkeypatch):
    (tmp_path / "bad.py").write_text(
        f"def read(path, index):\n    if index == {drive.WHOLE} and path.name == 'new.hdr':\n"
        "        raise KeyError('a')\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = drive.piece(Config(), tmp_path, "hdr", 0, 2, reader="bad:read")
    assert [(name, outcome) for name, outcome, _ in found["faults"]] == [("new.hdr", "traceback")]
    assert dict(found["counts"]) == {"read": 2}


def test_a_case_is_the_same_file_every_time():
    for what in ("hdr", "toml", "weights"):
        whole = kinds.seeds(what)
        one, again = (
            [kinds.case(what, whole, 0, i) for i in order] for order in (range(30), range(29, -1, -1))
        )
        assert one == again[::-1]
        other = [kinds.case(what, whole, 1, i) for i in range(30)]
        assert sum(a == b for a, b in zip(one, other, strict=True)) < 3
        assert sum(data == dict(whole)[name] for name, data in one) < 6  # nearly all are damaged


def test_pieces_of_a_kind_add_up_and_faults_are_named():
    common = {"what": "exr", "errors": {"InputError": 2}, "folder": Path("kept")}
    hung = common | {"counts": {"refused": 2, "hung": 1}, "beyond": 3 << 20, "faults": [[7, "hung", "5 s"]]}
    whole = common | {"counts": {"read": 1, "refused": 2}, "beyond": 1 << 20, "faults": []}
    rows = [hung, whole, whole | {"what": "hdr"}]
    exr, hdr = experiment.combine(rows)
    assert exr["counts"] == {"read": 1, "refused": 4, "hung": 1} and exr["beyond"] == 3 << 20
    lines = table(experiment.EXPERIMENT, rows).splitlines()
    row = [cell.strip() for cell in lines[2].split("|")]
    assert row[1:7] == ["exr", "6", "1", "4 InputError", "0", "1"] and row[-2] == "3.0 MiB"
    assert hdr["counts"].total() == 3 and len(lines) == 4
    assert experiment.failures(rows) == ["exr 7: hung: 5 s (kept in kept)"]


def test_the_pieces_of_a_kind_are_all_its_files():
    asked = experiment.cases(argparse.Namespace(count=6000, heap_check=""))
    names = [case.name for case in asked if case.about["what"] == "hdr"]
    assert names == ["hdr 0-2499", "hdr 2500-4999", "hdr 5000-5999"]
    assert len(asked) == 3 * len(kinds.KINDS)


def test_headers_are_understood_apart_from_the_readers():
    files = dict(kinds.seeds("exr")) | dict(kinds.seeds("hdr")) | dict(kinds.seeds("painted"))
    texels = 16 * 32
    for name, data in files.items():
        found = headers.declared(data)
        assert 12 * texels <= found <= (6 * 4 + 16) * texels * 2, name
        assert len(headers.sites(data)) > 5, name
    hdr = files["new.hdr"].replace(b"+X 32", b"+X 2147483647")
    assert headers.declared(hdr) == headers.declared(hdr.replace(b"2147483647", b"0")) == 0
    raw = files["ours.exr"]
    window = raw.index(b"dataWindow\0box2i\0") + 17
    assert {window + i for i in range(0, 20, 4)} <= {site.offset for site in headers.sites(raw)}
    for data in (b"", b"#?", b"\x76\x2f\x31\x01", b"\x89PNG", b"\xff\xd8", b"PK\x03\x04", b"\0" * 8 + b"{"):
        headers.sites(data), headers.declared(data)


def test_damage_never_fails_and_stays_small():
    rng = np.random.default_rng(0)
    for data in (b"", b"a", b"[a]\n", documents.WRITTEN.encode()):
        for _ in range(100):
            for damage in (mutate.mutated, documents.mutated):
                assert len(damage(data, rng)) <= mutate.MOST_BYTES
