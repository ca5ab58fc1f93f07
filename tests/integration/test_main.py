"""The command ``envedit``: its sub-commands, a configuration to start from, what is kept between runs."""

import os
from pathlib import Path

import numpy as np
import pytest

from envedit import config
from envedit.cli import cache, init, main, run
from envedit.core import array_cache, shipped
from tests.oracles import ROOT


def test_results_of_a_shipped_configuration_lie_where_the_command_was_called(tmp_path, monkeypatch):
    asked = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "_edit", lambda settings, *_: asked.append(Path(settings.output.dir)) or 0)
    assert main.main(["run", "quickstart"]) == main.main(["run", "edits/warmer"]) == 0
    assert main.main(["run", "quickstart", "--out", "mine"]) == 0
    assert asked == [tmp_path / name for name in ("runs/quickstart", "runs/warmer", "mine")]


def test_every_shipped_configuration_loads():
    assert {"quickstart", "edits/move_shadow"} <= set(shipped.configurations())
    for name in shipped.configurations():
        assert shipped.holds(shipped.configuration(name))
        assert config.load(shipped.configuration(name)).scene.file
    assert shipped.configuration("nothing") is None and not shipped.holds(ROOT / "pyproject.toml")


# ---- a configuration to start from -------------------------------------------------------------------------


@pytest.mark.parametrize("scene", shipped.scenes())
def test_a_written_configuration_loads(scene, tmp_path, capsys):
    file = tmp_path / "edit.toml"
    assert init.main([scene, "--out", str(file)]) == 0 and str(file) in capsys.readouterr().out
    settings = config.load(file)
    assert settings.scene.file == scene and settings.input.envmap == "auto"


def test_files_of_a_written_configuration_are_relative_to_it(tmp_path, monkeypatch, capsys):
    for name in ("a.xml", "b c.exr"):
        (tmp_path / name).touch()
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path)
    assert init.main(["a.xml", "--envmap", "b c.exr", "--out", "sub/edit.toml"]) == 0
    text = (tmp_path / "sub" / "edit.toml").read_text()
    assert '"../a.xml"' in text.replace("\\\\", "/") and "b c.exr" in text
    settings = config.load(tmp_path / "sub" / "edit.toml")
    assert os.path.samefile(settings.scene.file, "a.xml")
    assert os.path.samefile(settings.input.envmap, "b c.exr")


def test_init_writes_over_nothing_and_names_no_file_that_is_not_there(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "edit.toml").write_text("mine")
    assert init.main([]) == 2 and "edit.toml" in capsys.readouterr().err
    assert (tmp_path / "edit.toml").read_text() == "mine"
    for given in (["spere"], ["sphere", "--envmap", "sky.hdr"]):
        assert init.main([*given, "--out", "new.toml"]) == 3
        said = capsys.readouterr().err
        assert given[-1] in said and len(said.splitlines()) <= 2
    assert {path.name for path in tmp_path.iterdir()} == {"edit.toml"}


# ---- what is kept ------------------------------------------------------------------------------------------


def test_what_is_kept_is_told_and_emptied(own_cache, capsys):
    assert cache.main([]) == 0
    assert capsys.readouterr().out.count("0 entries") == len(cache.KINDS)
    kinds = {kind: array_cache.DiskCache(array_cache.cache_folder(kind)) for kind in cache.KINDS}
    for kept in kinds.values():
        kept.store({"a": 1}, {"x": np.zeros(3_000_000 // 8)})
        (kept.folder / "mine.txt").touch()
    assert cache.main([]) == 0
    said = capsys.readouterr().out
    assert said.count("1 entry") == len(kinds) and said.count("3.0 MB") == len(kinds)
    assert all(str(kept.folder) in said and len(kept.files()) == 1 for kept in kinds.values())
    assert cache.main(["--empty"]) == 0
    assert all(not kept.files() and (kept.folder / "mine.txt").exists() for kept in kinds.values())
