"""Edits of a scene without a configuration, and runs that programs read."""

import json
import re

import numpy as np
import pytest

from envedit import config
from envedit.images import images
from envedit.targets import initial_rendering
from tests.oracles import users_scenes
from tests.oracles.builders import BALL, SENSOR, sky, write_scene
from tests.oracles.runs import TINY, call, changed, no_constant, pixels, world
from tests.oracles.users_scenes import PATH, light

pytestmark = pytest.mark.usefixtures("isolated")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a scene that has a map, and another map."""
    users_scenes.write(tmp_path, (PATH, SENSOR, BALL, light(2)))
    images.write_exr(tmp_path / "other.exr", sky(np.random.default_rng(1)) + 0.1)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def small():
    """Return the options of a small and quick edit."""
    keys = {f"{table}__{key}": value for table, keys in TINY.items() for key, value in keys.items()}
    quick = {"scene__width": 16, "optimizer__iterations": 1, "representation__kind": "pixels"}
    return changed(**keys | quick)


@pytest.mark.slow
@pytest.mark.parametrize("option", [["--rotate", "90"], ["--target", "other.exr"], ["--paint", "paint.exr"]])
def test_a_scene_and_an_option_are_an_edit(option, here, capsys):
    if option[0] == "--paint":
        assert call("scene.xml", *small(), "--export-initial", "paint.exr", "--quiet") == 0
        picture = pixels(here / "paint.exr")
        picture[:4] *= 0.5
        images.write_exr(here / "paint.exr", picture, panorama=False)
    assert call("scene.xml", *option, *small(), "--json", "--progress", "json") == 0
    out, err = capsys.readouterr()
    found = json.loads(out, parse_constant=no_constant)
    assert found["ok"] and found["exit_code"] == 0 and found["folder"] == str(here / "scene_out")
    assert found["metrics"]["render"]["psnr"] > 0 and found["files"]["edited.exr"].endswith("edited.exr")
    lines = [json.loads(line) for line in err.splitlines()]
    assert {"stage", "progress"} <= {line["event"] for line in lines} <= {"stage", "progress", "warning"}
    assert any(line["event"] == "stage" and line["stage"] == "rendering the result" for line in lines)
    # The configuration that was run lies beside the results, and runs to the same end.
    ran = config.load(here / "scene_out" / "config.toml")
    assert ran.scene.file == str(here / "scene.xml") and ran.input.envmap == "auto"
    kind = "image" if option[0] == "--paint" else "envmap"
    assert ran.target.kind == kind and (option[0] != "--rotate" or ran.target.rotate_degrees == 90)
    before = pixels(here / "scene_out" / "edited.exr")
    assert call(here / "scene_out" / "config.toml", "--quiet", "--out", "again") == 0
    assert pixels(here / "again" / "edited.exr").tobytes() == before.tobytes()


def test_an_export_names_the_map_as_the_run_that_reads_it_does(here):
    """Or that run would say of a picture that is painted all over that another map had made it."""
    assert call("scene.xml", *small(), "--export-initial", "paint.exr", "--quiet") == 0
    facts = json.loads((here / "paint.exr.envedit.json").read_text())
    of_run = config.from_dict({"scene": {"file": "scene.xml"}})
    assert facts["envmap"] == initial_rendering.origin(of_run, (1, 1, 3), "linear")["envmap"]


@pytest.mark.slow
def test_a_target_that_is_no_panorama_is_a_picture_of_the_scene(here, capsys):
    """Which the record of the run says; it is solved as a rendering, and nothing of it is paint."""
    export = "--export-initial", "wanted.exr", "--quiet"
    assert call("scene.xml", "--envmap", "other.exr", *small(), *export) == 0
    assert call("scene.xml", "--target", "wanted.exr", *small(), "--json", "--progress", "json") == 0
    found = json.loads(capsys.readouterr().out, parse_constant=no_constant)
    assert found["ok"] and found["metrics"]["painted"] is None and found["metrics"]["ceiling"] is None
    assert found["metrics"]["envmap"] is None and found["metrics"]["render"]["psnr"] > 0
    assert "not 2:1" in json.dumps(found) or "not 2:1" in (here / "scene_out" / "report.html").read_text()
    # A file that is neither is refused by its size.
    wide = np.full((12, 40, 3), 0.5, np.float32)
    images.write_exr(here / "wide.exr", wide, panorama=False)
    assert call("scene.xml", "--target", "wide.exr", *small(), "--json") == 3
    assert "wide.exr" in json.loads(capsys.readouterr().out)["error"]


@pytest.mark.parametrize("named", ["own map", "texture", "include"])
def test_what_the_scene_names_is_not_moved_out_of_the_folder_of_results(named, here, capsys):
    """Two of the files that a run leaves are what this scene reads."""
    (here / "out").mkdir()
    file = here / "out" / {"own map": "edited.exr", "texture": "preview.png", "include": "edited.xml"}[named]
    image = '<texture type="bitmap" name="reflectance"><string name="filename" value="$folder/preview.png"/>'
    ball = BALL.replace('<rgb name="reflectance" value="0.2, 0.4, 0.6"/>', f"{image}</texture>")
    if named == "own map":
        parts = '<default name="folder" value="out"/>', SENSOR, BALL, light(name="$folder/edited.exr")
        images.write_exr(file, sky(np.random.default_rng(1)) + 0.1)
    elif named == "texture":
        parts = '<default name="folder" value="gone"/>', SENSOR, ball, light()
        images.write_png(file, np.ones((4, 4, 3)))
    else:
        parts = SENSOR, '<include filename="out/edited.xml"/>', light()
        write_scene(here / "out", BALL, name="edited.xml")
    write_scene(here, PATH, *parts, name="own.xml")
    before, values = file.read_bytes(), ["--set", "scene.parameters.folder=out"] if named == "texture" else []
    assert call("own.xml", "--out", "out", *values, *small(), "--quiet") == 3
    assert f"{file}: this input lies where its own results would go" in capsys.readouterr().err
    assert file.read_bytes() == before and [path.name for path in (here / "out").iterdir()] == [file.name]


@pytest.mark.slow
def test_a_scene_without_an_environment_is_edited_by_a_map_beside_its_lamps(here, capsys):
    write_scene(here, PATH, SENSOR, BALL, users_scenes.LAMP, name="lamps.xml")
    assert call("lamps.xml", "--envmap", "other.exr", "--rotate", "90", *small()) == 0
    said = capsys.readouterr().out
    assert "the map lights the scene beside any lamps of its own" in said
    assert re.search(r"the map gives \d\d(\.\d)? % of the picture's light", said)
    assert 'type="envmap"' in (here / "lamps_out" / "edited.xml").read_text()
    assert call("lamps_out/edited.xml", "--rotate", "90", "--out", "again", *small(), "--quiet") == 0


@pytest.mark.slow
def test_a_shipped_scene_by_its_name_and_another_map(here):
    assert call("matte", "--envmap", "other.exr", "--rotate", "90", *small(), "--quiet") == 0
    ran = config.load(here / "matte_out" / "config.toml")
    assert ran.scene.file == "matte" and ran.input.envmap == str(here / "other.exr")


@pytest.mark.parametrize(
    "arguments, code, says",
    [
        (["scene.xml", "--envmap", "none.exr"], 3, "none.exr"),
        (["c.toml", "--rotate", "9"], 2, "--rotate: got it beside a configuration"),
        (["matte", "--envmap", "scene"], 2, 'got "scene", but'),
        (["dark.xml"], 3, "no environment emitter: add"),
    ],
)
def test_what_goes_wrong_is_an_object_too(arguments, code, says, here, rng, capsys):
    world(here, rng)
    write_scene(here, SENSOR, BALL, name="dark.xml")
    assert call(*arguments, "--json", "--progress", "json", "--quiet") == code
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert not found["ok"] and found["exit_code"] == code and says in found["error"]
    last = json.loads(err.splitlines()[-1])
    assert last == {"event": "error", "text": found["error"]}
