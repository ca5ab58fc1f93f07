"""The command ``envedit``: help that shows what there is, names of shipped configurations, usage errors."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import envedit
from envedit import config
from envedit.cli import main as cli
from envedit.cli import run
from envedit.core import shipped

PYTHON = [sys.executable, "-m", "envedit"]


def help_of(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        cli.main([*arguments, "--help"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0 and err == ""
    return out


def test_every_command_has_an_example_and_examples_name_things_that_exist(capsys):
    first, said = help_of(capsys), {name: help_of(capsys, name) for name in cli.COMMANDS}
    assert all(f"  {name} " in first for name in cli.COMMANDS)
    assert all(", ".join(names) in first for names in (shipped.configurations(), shipped.scenes()))
    assert all(re.search(rf"(?m)^(example: |  )envedit {name}\b", text) for name, text in said.items())
    examples = re.findall(r"(?m)^(?:example: |  )(envedit .+)", "".join([first, *said.values()]))
    calls = [call.split() for line in examples for call in line.split(" && ")]
    assert len(calls) >= 8 and all(call[1] in cli.COMMANDS for call in calls)
    own = "edit.toml", "scene.xml"  # files of the reader's
    named = [call[2] for call in calls if call[1] == "run" and call[2] not in own]
    assert named and all(name in shipped.configurations() for name in named)


@pytest.mark.parametrize(
    ("wrong", "says"), [("rn", "did you mean run?"), ("inti", "did you mean init?"), ("x", "envedit --help")]
)
def test_an_unknown_command(wrong, says, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main([wrong])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and out == ""
    known = ", ".join(cli.COMMANDS)
    assert f"got command '{wrong}', expected one of {known}; " in err and says in err


def test_an_interrupted_command_has_no_traceback(capsys, monkeypatch):
    from envedit.cli import doctor

    def stop(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "main", stop)
    assert cli.main(["doctor"]) == 130 and capsys.readouterr().err == "envedit: interrupted\n"


@pytest.mark.parametrize(("arguments", "code"), [(["--version"], 0), (["nonsense"], 2), ([], 2)])
def test_python_m_envedit_is_the_command(arguments, code):
    done = subprocess.run([*PYTHON, *arguments], capture_output=True, text=True)
    assert done.returncode == code and "Traceback" not in done.stderr
    assert done.stdout == (f"envedit {envedit.__version__}\n" if code == 0 else "")
    assert code == 0 or "envedit" in done.stderr


@pytest.mark.parametrize("name", shipped.configurations())
def test_a_shipped_configuration_by_name(name, here):
    settings, file, base = run.load(name, None, [])
    assert file == shipped.folder() / f"{name}.toml" and base == here
    stem = name.split("/")[-1]
    assert settings.output.dir == str(here / "runs" / stem)
    assert settings == config.load(file, None, [f"output.dir={here}/runs/{stem}"])


def test_paths_and_results_beside_a_shipped_configuration_lie_in_the_working_folder(here):
    overrides = ["input.envmap=sky.hdr", "scene.file=my/scene.xml", "output.dir=elsewhere"]
    settings, _, _ = run.load("quickstart", "paper", overrides)
    found = settings.input.envmap, settings.scene.file, settings.output.dir
    assert found == tuple(str(here / name) for name in ("sky.hdr", "my/scene.xml", "elsewhere"))
    assert settings.preset == "paper"
    file = shipped.folder() / "edits" / "warmer.toml"
    settings, _, base = run.load(str(file), None, [])
    assert settings.output.dir == str(here / "runs" / "warmer") and base == file.parent


def test_a_file_goes_before_a_shipped_name_and_a_folder_does_not(here):
    (here / "quickstart").mkdir()
    assert run.load("quickstart", None, [])[1] == shipped.folder() / "quickstart.toml"
    (here / "quickstart").rmdir()
    (here / "quickstart").write_text("seed = 7")
    settings, file, base = run.load("quickstart", None, [])
    assert settings.seed == 7 and file == Path("quickstart") and base == here
    assert settings.output.dir == str(here / "quickstart_out")


@pytest.mark.parametrize(("wrong", "says"), [
    ("quikstart", "did you mean the shipped quickstart?"),
    ("quickstart.toml", "did you mean the shipped quickstart?"),
    ("edits/move_shadows", "did you mean the shipped edits/move_shadow?"),
    ("mate", "did you mean the shipped matte?"),
    ("my.toml", "to write one: envedit init"),
])  # fmt: skip
@pytest.mark.parametrize("options", [[], ["--rotate", "9"]])
def test_a_configuration_that_is_not_there(wrong, says, options, here, capsys):
    assert run.main([wrong, *options]) == 2
    assert capsys.readouterr().err == f"envedit: {wrong}: no such configuration file; {says}\n"


def test_each_scene_xml_has_a_folder_of_results_with_its_own_folders_name(tmp_path, here):
    names = {"kitchen/scene.xml": "kitchen_scene_out", "hall/scene.xml": "hall_scene_out"}
    names |= {"scene.xml": "scene_out", "hall/lamp.xml": "lamp_out"}
    for scene, folder in names.items():
        settings, _, _ = run.load(scene, None, [])
        assert settings.output.dir == str(tmp_path / folder)
