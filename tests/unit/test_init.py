"""``envedit init``: the file that it writes loads, names its inputs from where it lies, and replaces none."""

import re
import tomllib
from pathlib import Path

import pytest

from envedit import config
from envedit.cli import init
from envedit.core import shipped

pytestmark = pytest.mark.usefixtures("here")


def test_the_file_loads_to_the_defaults_that_it_spells_out(here, capsys):
    assert init.main([]) == 0
    assert capsys.readouterr().out == "edit.toml: written; edit it, then: envedit run edit.toml\n"
    written = config.load("edit.toml")
    assert written == config.from_dict({"target": {"rotate_degrees": 60}}, here, "edit.toml")
    assert written.target.degrees == config.Target().degrees


def test_the_command_that_it_names_can_be_pasted(here, capsys):
    assert init.main(["--out", "my edit.toml"]) == 0
    assert capsys.readouterr().out.endswith("envedit run 'my edit.toml'\n")


@pytest.mark.parametrize("name", shipped.scenes())
def test_every_shipped_scene_is_taken_by_its_name(name):
    assert init.main([name]) == 0
    assert config.load("edit.toml").scene.file == name


def test_paths_are_relative_to_the_file_that_is_written(here):
    for folder in ("maps", "scenes", "jobs/first"):
        (here / folder).mkdir(parents=True)
    (here / "maps" / "a sky.hdr").touch()
    (here / "scenes" / "mine.xml").touch()
    arguments = ["scenes/mine.xml", "--envmap", str(here / "maps" / "a sky.hdr")]
    assert init.main([*arguments, "--out", "jobs/first/edit.toml"]) == 0
    text = (here / "jobs/first/edit.toml").read_text()
    assert str(here) not in text
    assert tomllib.loads(text)["input"]["envmap"] == "../../maps/a sky.hdr"
    settings = config.load("jobs/first/edit.toml")
    assert (here / "maps/a sky.hdr").samefile(settings.input.envmap)
    assert (here / "scenes/mine.xml").samefile(settings.scene.file)


@pytest.mark.parametrize("kind", ["file", "folder", "dangling link"])
def test_nothing_is_overwritten(kind, here, capsys):
    out = here / "edit.toml"
    if kind == "file":
        out.write_text("mine")
    elif kind == "folder":
        out.mkdir()
    else:
        out.symlink_to("nowhere")
    assert init.main([]) == 2
    assert "edit.toml: exists already; delete it, or give another name with --out" in capsys.readouterr().err
    assert [p.name for p in here.iterdir()] == ["edit.toml"]
    assert kind != "file" or out.read_text() == "mine"


@pytest.mark.parametrize(("arguments", "says"), [
    (["sphre"], ["SCENE: got sphre: no such file", "sphere, statue", "did you mean sphere?"]),
    (["my.xml"], ["SCENE: got my.xml: no such file", "sphere, statue", "check the path"]),
    (["--envmap", "sky.hdr"], ["--envmap: got sky.hdr: no such file", "scene, sunsky"]),
    (["--envmap", "sunski"], ["did you mean sunsky?"]),
    (["--out", "none/edit.toml"], ["none/edit.toml: cannot be written", "folder does not exist"]),
])  # fmt: skip
def test_what_is_not_there(arguments, says, here, capsys):
    assert init.main(arguments) == 3
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("envedit: ") and err.count("\n") == 1
    assert all(words in err for words in says), err
    assert not list(here.iterdir())


def uncommented(text, *keys):
    """Activate commented settings, each the first of its kind, in place of the active one."""
    for key, value in keys:
        text = re.sub(rf"(?m)^{key} = .*\n", "", text)
        text, found = re.subn(rf"(?m)^# ({key} = {re.escape(value)})", r"\1", text, count=1)
        assert found == 1, (key, value)
    return text


@pytest.mark.parametrize("keys", [
    [("kind", '"image"'), ("file", '"paint_me.png"')],
    [("kind", '"strokes"'), ("strokes", "[{")],
    [("azimuth", "90.0"), ("elevation", "35.0")],
    [("parameters", "{ roughness")],
])  # fmt: skip
def test_what_stands_in_comments_loads_too(keys):
    assert init.main([]) == 0
    before, after = Path("edit.toml").read_text().split("[target]")
    target, rest = after.split("[representation]")
    if keys[0][0] == "kind":
        target = uncommented(target, *keys)
    else:
        before = uncommented(before, *keys)
    settings = config.loads(f"{before}[target]{target}[representation]{rest}")
    if keys[0][0] == "kind":
        assert settings.target.kind == keys[0][1].strip('"')
