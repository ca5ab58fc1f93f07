"""What the experiments with the page of ``envedit paint`` ask of it and report, without a browser."""

import argparse
import json
import subprocess

import numpy as np
import pytest

from envedit import config
from envedit.images import images
from experiments import harness
from experiments.harness import Done, calling
from experiments.paint import browser, figure10, rates, soak

GOOD = {
    "seed": 3, "minutes": 1.0, "actions": {"stroke": 2, "light": 1}, "half_mb": 100.0, "last_mb": 101.4,
    "page_errors": [], "alive": True, "exit_code": 0, "server_log": "", "files_outside": [],
    "memory_grew": False,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"page_errors": ["a", "b"]}, "errors of the page: a; b"),
        ({"alive": False}, "the server ended before its time"),
        ({"exit_code": 1}, "exit code 1 of the server"),
        ({"server_log": "Traceback"}, "the server wrote to its log: Traceback"),
        ({"files_outside": ["x"]}, "files where there must be none: x"),
        ({"memory_grew": True}, "memory at rest is above 1.1 times that of half time and 20 MB"),
    ],
)
def test_random_use_fails_by_each_thing_that_must_not_happen(changed, said):
    assert soak.failures([GOOD]) == []
    assert soak.failures([GOOD, GOOD | changed]) == [f"seed 3: {said}"]


def test_memory_is_taken_when_a_process_rests(monkeypatch):
    """Processor time as of one that works until its third look."""
    process, times = subprocess.Popen(["sleep", "60"]), iter([0.0, 2.0, 4.0, 4.1, 9.0])
    monkeypatch.setattr(soak, "QUIET", 0.01)
    monkeypatch.setattr(soak, "RESTING", 20.0)
    try:
        assert 0 <= soak.processor_time(process) < 1
        monkeypatch.setattr(soak, "processor_time", lambda _: next(times))
        assert 0 < soak.memory_at_rest(process) < 100
        assert next(times) == 9.0
    finally:
        process.kill()
        process.wait()


def test_random_use_is_listed():
    line = harness.table(soak.EXPERIMENT, [GOOD]).splitlines()[-1]
    assert line == "| 3 | 1 | 3 | 1 light, 2 stroke | 100 | 101 |"


def test_rates_without_an_answer_are_dashes():
    row = dict.fromkeys(rates.FIGURES.values(), 12.345) | {"pixels": 128, "map": 256, "cores": 2}
    line = harness.table(rates.EXPERIMENT, [row | {"pointer_to_picture_ms": None}]).splitlines()[-1]
    assert line == "| 128x128 | 256 wide | 2 | 12.3 | 12.3 | 12.3 | 12.3 | - | 12.3 | 12.3 | 12.3 |"
    sizes = [config.loads(case.job(["input.width=64"]).toml) for case in rates.cases(None)]
    assert [(one.scene.width, one.input.width) for one in sizes] == [(128, 64), (256, 64)]


def test_the_command_gets_the_configuration_of_the_case_in_an_empty_folder(tmp_path):
    (tmp_path / "job.toml").write_text("seed = 3\n")
    (browser.prepared(tmp_path) / "edit_out").mkdir()
    work = browser.prepared(tmp_path)
    assert [path.name for path in work.iterdir()] == ["edit.toml"]
    assert (work / "edit.toml").read_text() == "seed = 3\n"


def test_the_six_edits_and_the_picture_of_the_page(tmp_path, monkeypatch):
    (tmp_path / "puresky").mkdir()
    (tmp_path / "puresky" / f"{figure10.MAP}_puresky_1k.hdr").write_text("a map")
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    cases = {case.name: case for case in figure10.cases(None)}
    assert list(cases) == [*figure10.TITLES, "page"]
    assert cases["page"].command[-1] == cases["move_shadow"].command[-1]
    strokes = json.loads(cases["add_reflection"].command[-1])["strokes"]
    row = {"edit": "E", "strokes": [*strokes, {"type": "temperature"}]}
    row |= {"painted_s": 6.1, "solved_s": 5.9, "saved_s": 9.0}
    row |= {"towards": 0.93, "reachable": 0.941, "elsewhere": None}
    line = harness.table(figure10.EXPERIMENT, [row]).splitlines()[-1]
    assert line == "| E | light (ellipse), temperature (all) | 6 + 6 | 9 | 93 % | 94 % | - |"
    assert figure10.EXPERIMENT.measure(Done(cases["page"], tmp_path)) == []
    assert figure10.encoded([0.0, 1.0, 0.2140]) == "#00ff7f"


def test_the_picture_of_the_page_is_a_sheet_of_its_own(tmp_path):
    done = Done(calling("page", "experiments.paint.figure10:picture", {}), tmp_path)
    images.write_png(tmp_path / "page.png", np.full((4, 6, 3), 0.5, np.float32))
    (panel,) = figure10.panels(done)
    assert panel.shape == (4, 6, 3) and figure10.EXPERIMENT.sheet(done.case) == "page"


def test_the_length_of_random_use_is_part_of_its_case():
    keys = {soak.cases(argparse.Namespace(minutes=m))[0].job().key for m in (1.0, 60.0)}
    assert len(keys) == 2
