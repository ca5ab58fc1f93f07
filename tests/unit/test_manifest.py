"""The manifest of a run."""

import json
import subprocess

import mitsuba as mi
import numpy as np

from envedit.report import manifest, plain_files


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
    plain_files.write_json(tmp_path / "manifest.json", found)
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
