"""Scenes of a folder: which are tried, what is measured of each, and how they are counted."""

from types import SimpleNamespace

import pytest

from envedit import config
from envedit.core.errors import InputError
from experiments.harness import Case, Done, rows_of
from experiments.scenes import experiment
from tests.oracles import users_scenes
from tests.oracles.builders import BALL, SENSOR, write_scene
from tests.oracles.users_scenes import CONSTANT, LAMP, MEDIUM, PATH, VOLUME, light

pytestmark = pytest.mark.usefixtures("isolated")


def test_every_scene_of_a_folder_is_a_case_and_other_files_are_none(tmp_path):
    (tmp_path / "deep").mkdir()
    write_scene(tmp_path / "deep", PATH, name="a.xml")
    (tmp_path / "b.xml").write_text('<?xml version="1.0"?>\n<!-- a > b -->\n<scene version="2.0.0"></scene>')
    (tmp_path / "other.xml").write_text("<html><scene></scene></html>")
    found = experiment.cases(SimpleNamespace(folder=tmp_path))
    assert [case.name for case in found] == ["b.xml", "deep/a.xml"]
    assert found[1].tables["scene"]["file"] == str(tmp_path / "deep" / "a.xml")
    with pytest.raises(InputError, match="no Mitsuba scene"):
        experiment.cases(SimpleNamespace(folder=tmp_path / "nowhere"))


@pytest.mark.slow
@pytest.mark.parametrize("parts, lit_by, refused", [
    ((PATH, SENSOR, BALL, CONSTANT), "its own", ""),
    ((PATH, SENSOR, BALL, light(2)), "its own", ""),
    ((PATH, SENSOR, BALL, LAMP), "analytic sky", ""),
    ((VOLUME, SENSOR, BALL, MEDIUM, light()), "its own", "participating medium"),
], ids=["constant", "map", "lamp", "medium"])  # fmt: skip
def test_a_scene_is_compared_with_mitsuba_or_refused(parts, lit_by, refused, tmp_path, monkeypatch):
    numbers = {name: {"psnr": 30.0} for name in ("render", "initial", "envmap", "initial_envmap")}
    monkeypatch.setattr(experiment.pipeline, "run", lambda settings: SimpleNamespace(metrics=numbers))
    path = users_scenes.write(tmp_path, parts)
    tables = {"input": {"width": 64}, "scene": {"file": str(path), "width": 16}}
    found = experiment.tried(config.from_dict(tables, tmp_path), tmp_path)
    assert found["light"] == lit_by and refused in found["refused"]
    assert bool(refused) == bool(found["refused"])
    if not refused:
        assert found["ratio"] == pytest.approx(1, abs=0.02) and found["psnr"] == 30 and not found["plain"]


def test_scenes_are_counted(tmp_path):
    results = [
        {"refused": "", "ratio": 1.001, "noise": 0.0, "psnr": 40.0, "initial": 20.0},
        {"refused": "", "ratio": 1.02, "noise": 0.001, "psnr": 19.0, "initial": 20.0},
        {"refused": "", "ratio": 1.02, "noise": 0.01, "psnr": 19.0, "initial": 20.0},
        {"refused": "", "ratio": None, "noise": None, "psnr": 30.0, "initial": 30.0},
        {"refused": "a.xml (line 3): no film\nmore"}
        | dict.fromkeys(("ratio", "noise", "psnr", "initial"), None),
    ]
    rows = []
    for result in results:
        done = Done(Case("x", {}), tmp_path)
        done.__dict__["metrics"] = result
        rows += rows_of(experiment.EXPERIMENT, [done])
    assert experiment.EXPERIMENT.summary(rows).splitlines()[-1] == "| 5 | 4 | 2 | 3 | 2 |"
