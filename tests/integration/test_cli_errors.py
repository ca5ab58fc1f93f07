"""What a user can get wrong: each mistake has its exit code and one or two lines that say what to do."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from envedit.cli import run
from envedit.images import images
from tests.oracles import ROOT
from tests.oracles.builders import exr, sky
from tests.oracles.runs import call, changed, names, pixels, world

pytestmark = pytest.mark.usefixtures("isolated")

PIXELS = {"representation__kind": "pixels"}
"""What is edited quickest."""


@pytest.fixture
def path(tmp_path, rng):
    return world(tmp_path, rng)


def fails(code, capsys, path, *arguments):
    """Run the command line, which fails with ``code``; return its message.

    Nothing else is printed, and no result is left that could be taken for one.
    """
    assert call(path, "--quiet", *arguments) == code
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err
    lines = err.splitlines()
    assert 1 <= len(lines) <= 2 and lines[0].startswith("envedit: ") and len(err) < 600, err
    folder = Path(path).parent / "c_out"
    assert not folder.is_dir() or not names(folder) & {"edited.exr", "metrics.json", "checkpoint.npz"}
    return err


# ---- configuration and usage: 2 --------------------------------------------------------------------------


def test_a_configuration_that_cannot_be_understood_or_is_not_there(tmp_path, capsys):
    file = tmp_path / "c.toml"
    for text, says in (("[fit]\nepoch = 3", "did you mean epochs"), ("a = 3\na = 4", "not TOML")):
        file.write_text(text)
        assert says in fails(2, capsys, file)
    assert "none.toml: no such configuration file" in fails(2, capsys, tmp_path / "none.toml")
    assert "a folder" in fails(2, capsys, tmp_path)


@pytest.mark.parametrize(("arguments", "says"), [
    ([], "CONFIG.toml"),
    (["c.toml", "--preset", "best"], "best"),
    (["c.toml", "--resume", "--export-initial", "a.png"], "not allowed with"),
    (["c.toml", "--budget", "30", "--resume"], "not allowed with"),
])  # fmt: skip
def test_a_bad_command_line(arguments, says, capsys):
    with pytest.raises(SystemExit) as stop:
        run.main(arguments)
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and out == ""
    assert "usage:" in err and says in err.splitlines()[-1] and "Traceback" not in err


def test_an_export_is_a_picture_that_is_not_there(path, capsys, tmp_path):
    export = "--export-initial"
    assert ".exr or .png" in fails(2, capsys, path, export, tmp_path / "a.jpg")
    assert not (tmp_path / "a.jpg").exists()
    before = (tmp_path / "map.exr").read_bytes()
    said = fails(3, capsys, path, export, tmp_path / "map.exr")
    assert str(tmp_path / "map.exr") in said and (tmp_path / "map.exr").read_bytes() == before
    (tmp_path / "link.png").symlink_to(tmp_path / "nowhere.png")
    assert "link.png" in fails(3, capsys, path, export, tmp_path / "link.png")
    assert not (tmp_path / "nowhere.png").exists()
    assert "folder" in fails(3, capsys, path, export, tmp_path / "none" / "a.png")


# ---- files: 3 --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_png_as_map_is_taken_with_a_warning(path, capsys, tmp_path, rng):
    images.write_png(tmp_path / "map.png", sky(rng) / 3)
    assert call(path, "--quiet", *changed(input__envmap="map.png", **PIXELS)) == 0
    out, err = capsys.readouterr()
    (said,) = [line for line in err.splitlines() if "no effect: needs" not in line]
    assert out == "" and said.startswith("envedit: warning: ") and "not HDR" in said
    assert "not HDR" in (tmp_path / "c_out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_texels_that_are_not_finite(path, capsys, tmp_path, rng):
    picture = sky(rng) + 0.1
    picture[3, 7, 1] = picture[6, 2, 0] = np.nan
    exr(tmp_path / "map.exr", **{c: picture[..., i].copy() for i, c in enumerate("RGB")})
    said = fails(3, capsys, path)
    assert "map.exr" in said and "row 3, column 7" in said and "2 texels" in said and "repair" in said
    # What the message asks for works.
    assert call(path, "--quiet", *changed(input__repair=True, **PIXELS)) == 0
    assert "row 3, column 7" in capsys.readouterr().err
    edited, good = pixels(tmp_path / "c_out" / "edited.exr"), np.ones((8, 16), bool)
    assert np.isfinite(edited).all()
    good[6, 2] = False
    assert edited[4:][good[4:]].tobytes() == picture[4:][good[4:]].tobytes()


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ({"file": "none.exr"}, ["none.exr"]),
        ({"kind": "image", "file": "map.exr"}, ["map.exr", "16x8", "24x18"]),
        ({"kind": "image", "file": "good.exr", "mask": "black.png"}, ["black.png"]),
        ({"kind": "image", "file": "good.exr", "mask": "none.png"}, ["none.png"]),
    ],
)
def test_a_target_that_cannot_be_used(target, says, path, capsys, tmp_path):
    good = np.full((18, 24, 3), 0.5, np.float32)
    images.write_exr(tmp_path / "good.exr", good)
    images.write_png(tmp_path / "black.png", 0 * good)
    said = fails(3, capsys, path, *changed(**{f"target__{key}": value for key, value in target.items()}))
    assert all(words in said for words in says), said


def test_an_output_folder_that_cannot_be_made_or_written_to(path, capsys, tmp_path):
    (tmp_path / "c_out").write_text("mine")
    (tmp_path / "locked").mkdir(mode=0o555)
    folders = [tmp_path / "c_out", tmp_path / "c_out" / "results", Path("/proc/results")]
    folders += [tmp_path / "locked"] * (getattr(os, "geteuid", int)() != 0)  # permissions do not bind root
    for folder in folders:
        said = fails(3, capsys, path, "--out", str(folder))
        assert str(folder) in said and "another folder" in said and "--out" not in said
    assert (tmp_path / "c_out").read_text() == "mine"


def test_a_map_that_is_not_there_is_told_and_no_empty_folder_is_left(path, capsys, tmp_path):
    out = tmp_path / "new" / "folder"
    said = fails(3, capsys, path, *changed(input__envmap="none.exr"), "--out", str(out))
    assert str(path.parent / "none.exr") in said  # relative to the configuration
    assert not out.parent.exists()
    out.mkdir(parents=True)
    fails(3, capsys, path, *changed(input__envmap="none.exr"), "--out", str(out))
    assert out.is_dir()  # it was there before


# ---- the machine: 4 --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_machine_without_llvm(path, tmp_path):
    environment = os.environ | {
        "DRJIT_LIBLLVM_PATH": "/nonexistent",
        "XDG_CACHE_HOME": str(tmp_path / "fresh"),
    }
    command = [sys.executable, "-m", "envedit.run", str(path)]
    found = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    lines = found.stderr.splitlines()
    assert found.returncode == 4 and found.stdout == "" and "Traceback" not in found.stderr
    assert len(lines) <= 2 and lines[0].startswith("envedit: ")
    assert "DRJIT_LIBLLVM_PATH=/nonexistent" in lines[0] and "libllvm19" in found.stderr
    assert not names(tmp_path / "c_out")
