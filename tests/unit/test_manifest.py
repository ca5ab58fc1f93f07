"""History, metrics and manifest: read back with other readers, with values that are not finite."""

import csv
import json
import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from envedit.report import manifest


def test_history_reads_back_with_holes_for_what_is_not_finite(tmp_path):
    rows = [
        {"iteration": 0, "loss": np.float32(0.1), "ssim": 1e-30},
        {"iteration": np.int64(1), "loss": np.nan, "l1": None},
        {"iteration": 2, "loss": np.inf, "ssim": 65504.0},
    ]
    manifest.write_history(tmp_path / "history.csv", rows)
    with open(tmp_path / "history.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ["iteration", "loss", "ssim", "l1"]
    assert [row["loss"] for row in read] == ["0.1", "", ""]
    assert [row["ssim"] for row in read] == ["1e-30", "", "65504.0"]
    assert [row["l1"] for row in read] == ["", "", ""]
    manifest.write_history(tmp_path / "history.csv", [])
    assert (tmp_path / "history.csv").read_text() == "iteration\n"


def test_metrics_are_finite_or_null(tmp_path):
    metrics = {
        "render": {"psnr": np.float32(38.7), "ssim": np.nan, "lpips": None},
        "iterations": np.int32(7),
        "cached": np.bool_(True),
        "active_rows": (0, np.uint8(63)),
        "trace": np.array([1.0, np.inf], np.float32),
        "file": Path("a") / "ö.exr",
    }
    manifest.write_json(tmp_path / "metrics.json", metrics)
    lost: list[str] = []
    manifest.plain(metrics, "", lost)
    assert lost == ["render.ssim", "trace[1]"]

    def refuse(name):
        raise AssertionError(f"{name} in metrics.json")

    read = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refuse)
    assert read["render"] == {"psnr": 38.7, "ssim": None, "lpips": None}
    assert read["iterations"] == 7 and read["cached"] is True and read["active_rows"] == [0, 63]
    assert read["trace"] == [1.0, None] and read["file"] == str(Path("a") / "ö.exr")
    assert list(read) == list(metrics)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "metrics.json"
    manifest.write_json(path, {"a": 1})
    with pytest.raises(TypeError, match=r"b\[1\].c: object cannot be written"):
        manifest.write_json(path, {"b": [0, {"c": object()}]})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]


def test_manifest_names_what_explains_a_run(tmp_path):
    (tmp_path / "abc.exr").write_bytes(b"abc")
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(60 * 10**9)
    inputs = {"envmap": "abc.exr", "scene": "gone.xml", "folder": ".", "large": "sparse"}
    inputs = {role: tmp_path / name for role, name in inputs.items()}
    found = manifest.manifest({"seed": 3, "preset": "draft"}, inputs, "llvm_ad_rgb")
    # FIPS 180-2, appendix B.1
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert found["inputs"]["envmap"] == {"path": str(tmp_path / "abc.exr"), "bytes": 3, "sha256": digest}
    assert found["inputs"]["scene"]["sha256"] is None and "gone.xml" in found["inputs"]["scene"]["error"]
    assert found["inputs"]["folder"]["sha256"] is None and found["inputs"]["large"]["sha256"] is None
    assert "60000000000 bytes, expected at most 4294967296" in found["inputs"]["large"]["error"]
    assert found["seeds"] == {"seed": 3} and found["config"]["preset"] == "draft"
    assert found["versions"]["mitsuba"] == mi.__version__ and found["versions"]["numpy"] == np.__version__
    assert found["time_utc"].endswith("+00:00") and found["cores"]["usable"] >= 1
    assert int(found["llvm"]["version"].split(".")[0]) >= 17
    manifest.write_json(tmp_path / "manifest.json", found)
    assert json.loads((tmp_path / "manifest.json").read_text()) == found


def test_commit_is_that_of_the_packages_own_checkout(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    assert manifest._commit(tmp_path) is None, "no checkout"
    git("init", "-q")
    assert manifest._commit(tmp_path) is None, "no commit yet"
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-q", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert manifest._commit(tmp_path) == head
    (tmp_path / "file").write_text("2")
    assert manifest._commit(tmp_path) == f"{head}-dirty"
    (tmp_path / "inside").mkdir()
    assert manifest._commit(tmp_path / "inside") is None, "installed inside somebody else's repository"
    monkeypatch.setenv("PATH", "")
    assert manifest._commit(tmp_path) is None, "no git"
