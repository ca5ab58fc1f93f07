"""Experiments: cases that are run once, tables and sheets of what is done, the shared command line."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import experiments.__main__ as command
from envedit.core.errors import ConfigError, InputError
from experiments import harness
from experiments.download_puresky import MAPS
from experiments.harness import Case, Done, Experiment, markdown, montage

STUB = (
    "import json, pathlib, sys, tomllib; folder = pathlib.Path(sys.argv[1]);"
    "seed = tomllib.loads((folder / 'job.toml').read_text())['seed'];"
    "seed == 13 and sys.exit('unlucky');"
    "(folder / 'metrics.json').write_text(json.dumps({'twice': 2 * seed}))"
)
COMMAND = ("{python}", "-S", "-c", STUB, "{folder}")


def experiment(seeds=(3, 4), version=""):
    def panels(done):
        return [np.full((2, 3, 3), 0.5), np.ones((4, 4, 3))]

    return Experiment(
        lambda given: [Case(f"seed-{s}", {"seed": s}, {"seed": s}, COMMAND, version) for s in seeds],
        lambda done: done.metrics,
        {"seed": "{seed}", "twice": lambda row: f"{row['twice']:.1f}"},
        group=lambda row: "odd" if row["seed"] % 2 else "even",
        summary=lambda rows: f"{len(rows)} rows",
        panels=panels,
        sheet=lambda case: "all",
    )


@pytest.fixture
def run(tmp_path, capsys):
    def call(*words, **made):
        words = [*words, "--out", str(tmp_path / "out"), "--workers", "1"]
        code = harness.main("twice", "Double seeds.", experiment(**made), words)
        return code, capsys.readouterr()

    return call


def test_cases_are_run_once_and_shown(run, tmp_path):
    assert run("run", "--dry-run")[1].out.endswith("2 jobs: 2 missing\n") and not (tmp_path / "out").exists()
    code, said = run("run")
    assert code == 0 and "2 jobs, 0 done before, 2 to run" in said.err
    expected = "2 rows\n\nodd:\n\n| seed | twice |\n| --- | --- |\n| 3 | 6.0 |\n\neven:\n\n"
    assert said.out == expected + "| seed | twice |\n| --- | --- |\n| 4 | 8.0 |\n"
    code, again = run("run")
    assert again == (said.out, "") and run("table")[1].out == said.out
    code, sheet = run("sheet", "--to", str(tmp_path / "sheets"))
    assert sheet.out == f"{tmp_path / 'sheets' / 'all.png'}\n" and (tmp_path / "sheets" / "all.png").exists()


def test_results_of_another_configuration_or_version_are_not_reused(run, monkeypatch):
    run("run", "--only", "seed-3")
    assert "| 3 | 6.0 |" in run("table")[1].out
    assert "no case is done" in run("table", "--set", "fit.epochs=7")[1].out
    code, said = run("sheet", "--set", "fit.epochs=7")
    assert code == 3 and "no case is done" in said.err
    assert "no case is done" in run("table", version="of the command")[1].out
    monkeypatch.setattr("envedit.sweep.jobs.program", lambda: "another")
    assert "no case is done" in run("table")[1].out


def test_a_case_that_fails_does_not_stop_the_others(run):
    code, said = run("run", seeds=(13, 4))
    assert code == 1 and "| 4 | 8.0 |" in said.out
    assert "seed-13  failed" in said.err and "exit code 1: unlucky" in said.err


def seeds_of(settings, folder, times):
    return {"seeds": [{"seed": settings.seed, "n": n} for n in range(times)], "odd": math.nan}


def calling(times=2, tables=None):
    return harness.calling("call", seeds_of, tables or {"seed": 5}, {"what": "x"}, times=times)


@pytest.mark.slow
def test_a_case_may_be_a_function(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    made = Experiment(
        lambda given: [calling()],
        lambda done: done.metrics["seeds"],
        {"x": {"seed": "{seed}", "n": "{n}"}},
        group=lambda row: row["what"],
        failures=lambda rows: [f"n is {row['n']}" for row in rows if row["n"] > 0],
        alone=True,
    )
    asked = ["--out", str(tmp_path), "--set", "seed=9"]
    assert harness.main("calls", "Call a function.", made, ["run", *asked]) == 1
    assert harness.main("calls", "Call a function.", made, ["sheet", *asked]) == 2
    said = capsys.readouterr()
    assert said.out == "x:\n\n| seed | n |\n| --- | --- |\n| 9 | 0 |\n| 9 | 1 |\n"
    assert said.err.endswith("FAILED: n is 1\ncalls: there is no sheet of calls; give run or table\n")
    folder = calling().job(["seed=9"]).folder(tmp_path)
    assert json.loads((folder / "result.json").read_text())["odd"] is None
    keys = {calling(n).job().key for n in (2, 3)} | {calling(tables={"seed": 6}).job().key}
    assert len(keys) == 3


def test_rows_are_combined_into_tables_and_panels_into_montages(tmp_path):
    made = Experiment(
        lambda given: [],
        columns={"kind": "{kind}", "sum": "{n}"},
        combine=lambda rows: [{"kind": "both", "n": sum(row["n"] for row in rows)}],
    )
    assert harness.table(made, [{"n": 1}, {"n": 2}]).endswith("| both | 3 |")
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    gap = harness.GAP
    made = montage([[np.full((2, 3, 3), 0.5), np.ones((4, 4, 3))], [np.full((4, 1, 3), 2.0)]])
    assert made.shape == (2 * (4 + gap), 6 + 4 + 2 * gap, 3) and made.dtype == np.uint8
    assert (made[:4, :6] == 128).all() and (made[:4, 6 + gap : 10 + gap] == 255).all()
    assert (made[4 + gap : 8 + gap, :1] == 255).all() and not made[4 + gap :, 1:].any()


def test_user_errors_are_one_line(run, tmp_path):
    code, said = run("run", "--only", "nothing")
    assert code == 2 and said.err == "twice: --only nothing: no case of twice is left; give other options\n"
    (tmp_path / "file").touch()
    run("run")
    code, said = run("sheet", "--to", str(tmp_path / "file" / "x"))
    assert code == 3 and "cannot be made" in said.err
    with pytest.raises(InputError, match="remove its folder and run again"):
        Done(Case("x", {}), tmp_path).metrics  # noqa: B018
    with pytest.raises(ConfigError):
        Case("x", {}).job(["seed"])


@pytest.fixture
def data(tmp_path, monkeypatch):
    for kind in ("puresky", "hdri"):
        (tmp_path / kind).mkdir()
    for name in MAPS:
        (tmp_path / "puresky" / f"{name}_puresky_1k.hdr").write_text(name)
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("name", command.modules())
def test_every_experiment_makes_its_cases(name, data, tmp_path, capsys):
    asked = [*name.split(), "run", "--dry-run", "--out", str(tmp_path / "out")]
    if name == "paper":
        asked.append("table3")
    assert command.main(asked) == 0
    assert re.search(r"\n([1-9]\d*) jobs?: \1 missing\n$", capsys.readouterr().out)


def test_experiments_are_listed_and_an_unknown_one_is_named(capsys):
    assert command.main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split()[0] for line in lines] == list(command.modules())
    assert command.main(["layer"]) == 2
    assert re.search("got layer, expected one of .*interiors, layers", capsys.readouterr().err)
