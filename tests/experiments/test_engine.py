"""The engine's measurements: tables for every marker of the page, what must hold, figures, pairs of runs."""

import re

import pytest

import experiments.__main__ as command
from experiments.engine import tables
from experiments.summary import values
from tests.oracles import ROOT

KERNELS = {"kernels": {"calls": 5, "launched": 10, "compiled": 0}}
TRANSPORT = KERNELS | {"adjointness": 1e-7, "columns": 1, "load_s": 0.1}
QUALITY = {"quick": True, "prb_rmse": 0.1, "rmse": 0.02, "corrected": 0.02, "noise": 0.01}


def rows(table, row):
    common = {"case": "x", "table": table, "quick": False, "not_finite": []}
    return [values(common | row)]


def test_there_is_a_table_for_every_marker_of_the_page():
    text = (ROOT / "docs" / "engine.md").read_text()
    assert set(re.findall(r"<!-- table: ([\w-]+) -->", text)) == set(tables.COLUMNS)
    assert {*tables.CHECKS, *(name for some in tables.SHOWN.values() for name in some)} < set(tables.COLUMNS)


@pytest.mark.parametrize(("table", "row", "changes", "says"), [
    ("siren", KERNELS, {"kernels": {"calls": 5, "launched": 4, "compiled": 0}}, "only 4 kernels"),
    ("transport", TRANSPORT, {"kernels": KERNELS["kernels"] | {"compiled": 1}}, "1 of 10"),
    ("transport", TRANSPORT, {"adjointness": 1e-4}, "adjoint off by 0.0001"),
    ("transport", TRANSPORT, {"columns": 0}, "no exact column"),
    ("transport", TRANSPORT, {"load_s": None}, "not found on disk"),
    ("quality", QUALITY, {"prb_rmse": 0.01}, "better than T"),
    ("quality", QUALITY, {"corrected": 0.06}, "T's picture is off by 6.0 %"),
    ("quality", QUALITY, {"noise": 0.06}, "the reference is off by 6.0 %"),
    ("fits", {}, {"not_finite": ["fits[0].peak"]}, "fits[0].peak is not finite"),
])  # fmt: skip
def test_what_does_not_hold_is_named(table, row, changes, says):
    assert tables.failures(rows(table, row)) == []
    wrong = tables.failures(rows(table, row | changes))
    assert len(wrong) == 1 and wrong[0].startswith("x: ") and says in wrong[0]


@pytest.mark.slow
def test_figures_are_drawn_of_what_there_is(tmp_path):
    size = {"table": "scaling", "pixels": 16, "texels": [8, 16], "spp": 16, "again_s": 1.0, "apply_s": 0.1}
    size |= {"adjoint_s": 0.2, "read": 1e6}
    error = {"table": "error-time", "prb_samples": 16, "step_s": 0.1, "corrected": 0.01, "noise": 0.001}
    error |= {"prb_step_s": 0.2, "prb_rmse": 0.1}
    found = [size | {"variable": name} for name in tables.GROWTH] + [error, error]
    files = tables.draw(found, tmp_path)
    assert [file.name for file in files] == ["engine_scaling.png", "engine_error_time.png"]
    assert all(file.stat().st_size > 1000 for file in files)
    assert all(f"]({file.name})" in (ROOT / "docs" / "engine.md").read_text() for file in files)
    assert tables.draw([], tmp_path) == []


def test_cases_with_data_and_without(tmp_path, monkeypatch, capsys):
    def count(*options):
        assert command.main(["engine", "run", "--dry-run", "--out", str(tmp_path / "out"), *options]) == 0
        said = capsys.readouterr()
        return int(re.search(r"(\d+) jobs?: ", said.out)[1]), said.err

    monkeypatch.delenv("ENVEDIT_DATA", raising=False)
    assert count("--quick") == (13, "")
    without, said = count()
    assert "ENVEDIT_DATA is not set" in said
    for name in ("puresky/a_puresky_1k.hdr", "meshes/bunny_watertight.ply"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(name)
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    assert count() == (without + 5, "")  # the mesh once in transport and under three suns, and a fit
    assert count("--only", "fits", "--set", "preset=paper") == (1, "")
