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


# ---- help --------------------------------------------------------------------------------------------------


def test_the_help_names_commands_scenes_and_configurations(capsys):
    said = help_of(capsys)
    assert all(f"  {name} " in said and about in said for name, about in cli.COMMANDS.items())
    assert ", ".join(shipped.configurations()) in said and "quickstart" in shipped.configurations()
    assert ", ".join(shipped.scenes()) in said and "sphere" in shipped.scenes()


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_help_of_a_command_has_an_example(command, capsys):
    said = help_of(capsys, command)
    assert said.startswith(f"usage: envedit {command} ")
    assert re.search(rf"(?m)^(example: |  )envedit {command}\b", said)


def test_every_example_names_a_command_and_things_that_exist(capsys):
    said = "".join(help_of(capsys, *command) for command in ([], *([name] for name in cli.COMMANDS)))
    examples = re.findall(r"(?m)^(?:example: |  )(envedit .+)", said)
    calls = [call.split() for line in examples for call in line.split(" && ")]
    assert len(calls) >= 8 and all(call[1] in cli.COMMANDS for call in calls)
    own = "edit.toml", "scene.xml"  # files of the reader's
    named = [call[2] for call in calls if call[1] == "run" and call[2] not in own]
    assert named and all(name in shipped.configurations() for name in named)


def test_the_version(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out == f"envedit {envedit.__version__}\n"


# ---- usage errors ------------------------------------------------------------------------------------------


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


def test_no_command_shows_the_help(capsys):
    assert cli.main([]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "examples:" in err and "quickstart" in err


def test_run_without_a_configuration_says_what_to_give(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["run"])
    said = capsys.readouterr().err.splitlines()[-1]
    assert stop.value.code == 2
    assert "got no CONFIG" in said and all(name in said for name in shipped.configurations())


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
    assert "envedit" in (done.stdout if code == 0 else done.stderr)


# ---- configurations by name --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", shipped.configurations())
def test_a_shipped_configuration_by_name(name, here):
    settings, file, base = run.load(name, None, [])
    assert file == shipped.folder() / f"{name}.toml" and base == here
    stem = name.split("/")[-1]
    assert settings.output.dir == str(here / "runs" / stem)
    assert settings == config.load(file, None, [f"output.dir={here}/runs/{stem}"])


def test_paths_given_beside_a_name_start_from_the_working_folder(here):
    overrides = ["input.envmap=sky.hdr", "scene.file=my/scene.xml", "output.dir=elsewhere"]
    settings, _, _ = run.load("quickstart", "paper", overrides)
    assert settings.input.envmap == str(here / "sky.hdr") and settings.scene.file == str(
        here / "my/scene.xml"
    )
    assert settings.output.dir == str(here / "elsewhere") and settings.preset == "paper"


def test_a_shipped_configuration_by_its_path_keeps_the_results_out_of_its_folder(here):
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


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("quikstart", "did you mean the shipped quickstart?"),
        ("quickstart.toml", "did you mean the shipped quickstart?"),
        ("edits/move_shadows", "did you mean the shipped edits/move_shadow?"),
        ("my.toml", "to write one: envedit init"),
    ],
)
def test_a_configuration_that_is_not_there(wrong, says, here, capsys):
    assert run.main([wrong]) == 2
    assert capsys.readouterr().err == f"envedit: {wrong}: no such configuration file; {says}\n"


def test_each_scene_xml_has_a_folder_of_results_with_its_own_folders_name(tmp_path, here):
    names = {"kitchen/scene.xml": "kitchen_scene_out", "hall/scene.xml": "hall_scene_out"}
    names |= {"scene.xml": "scene_out", "hall/lamp.xml": "lamp_out"}
    for scene, folder in names.items():
        settings, _, _ = run.load(scene, None, [])
        assert settings.output.dir == str(tmp_path / folder)
