"""What the experiments with the page of ``envedit paint`` ask of it and report, without a browser."""

import json

from experiments import harness
from experiments.paint import figure10
from experiments.summary import values


def test_the_command_gets_the_configuration_of_the_case_in_an_empty_folder(tmp_path):
    (tmp_path / "job.toml").write_text("seed = 3\n")
    (figure10.prepared(tmp_path) / "edit_out").mkdir()
    work = figure10.prepared(tmp_path)
    assert [path.name for path in work.iterdir()] == ["edit.toml"]
    assert (work / "edit.toml").read_text() == "seed = 3\n"


def test_the_six_edits(tmp_path, monkeypatch):
    (tmp_path / "puresky").mkdir()
    (tmp_path / "puresky" / f"{figure10.MAP}_puresky_1k.hdr").write_text("a map")
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    cases = {case.name: case for case in figure10.cases(None)}
    assert list(cases) == list(figure10.painted_edits.EDITS)
    strokes = json.loads(cases["add_reflection"].command[-1])["strokes"]
    row = {"edit": "E", "strokes": [*strokes, {"type": "temperature"}]}
    row |= {"painted_s": 6.1, "solved_s": 5.9, "settled_s": 4.8, "differs": 0.0001, "saved_s": 9.0}
    row |= {"towards": 0.93, "reachable": 0.941, "elsewhere": None}
    line = harness.table(figure10.EXPERIMENT, [values(row)]).splitlines()[-1]
    assert line == "| E | light (ellipse), temperature (all) | 6 + 5 | 9 | 93 % | 94 % | - | 0.0001 |"
    assert figure10.encoded([0.0, 1.0, 0.2140]) == "#00ff7f"
