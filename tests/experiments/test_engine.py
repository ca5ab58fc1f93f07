"""The engine's measurements: tables for every marker of the page, what must hold, figures, pairs of runs."""

import re

import pytest

import experiments.__main__ as command
from experiments.engine import check, cost_of_checks, plot, tables
from tests.oracles import ROOT

SIREN = {
    "layout": "rows",
    "step": {"median_s": 2.0},
    "forward": {"min_s": 1.0},
    "kernels": {"calls": 5, "launched": 10, "compiled": 0},
}
TRANSPORT = {
    "kernels": SIREN["kernels"],
    "adjointness": 1e-7,
    "columns": 1,
    "bytes": {"apply": 1},
    "floor_s": 1e-3,
    "load_s": 0.1,
}
QUALITY = {"quick": True, "prb_rmse": 0.1, "rmse": 0.02, "corrected": 0.02, "noise": 0.01}
FITS = {"noisy_worst": 30.0, "noisy_mean": 31.0, "log_psnr": 40.0}


def rows(section, table, row):
    """Return rows of all tables of a section, one of them as given."""
    others = [
        {"table": name}
        for name in check.TABLES[section]
        if name != table and name not in check.CHECKS
        for _ in range(check.ROWS.get(name, 1))
    ]
    common = {"case": "x", "section": section, "quick": False, "not_finite": []}
    return [common | one for one in [*others, {"table": table} | row]]


def test_there_is_a_table_for_every_marker_of_the_page():
    text = (ROOT / "docs" / "engine.md").read_text()
    assert set(re.findall(r"<!-- table: ([\w-]+) -->", text)) == set(tables.COLUMNS)
    assert {name for some in check.TABLES.values() for name in some} < set(tables.COLUMNS)


@pytest.mark.parametrize(
    ("section", "table", "row", "changes", "says"),
    [
        ("siren", "siren", SIREN, {"layout": "heaps"}, "unknown layout heaps"),
        ("siren", "siren", SIREN, {"step": {"median_s": 0.5}}, "takes no time"),
        ("siren", "siren", SIREN, {"kernels": {"calls": 5, "launched": 4, "compiled": 0}}, "only 4 kernels"),
        ("transport", "transport", TRANSPORT, {"kernels": SIREN["kernels"] | {"compiled": 1}}, "1 of 10"),
        ("transport", "transport", TRANSPORT, {"adjointness": 1e-4}, "adjoint off by 0.0001"),
        ("transport", "transport", TRANSPORT, {"columns": 0}, "no exact column"),
        ("transport", "transport", TRANSPORT, {"floor_s": 0.0}, "nothing is read"),
        ("transport", "transport", TRANSPORT, {"load_s": None}, "not found on disk"),
        ("quality", "quality", QUALITY, {"prb_rmse": 0.01}, "better than T"),
        ("quality", "quality", QUALITY, {"corrected": 0.06}, "T's picture is off by 6 %"),
        ("quality", "quality", QUALITY, {"noise": 0.06}, "the reference is off by 6 %"),
        ("fits", "fits", FITS, {"noisy_mean": 42.0}, "noise makes the fit better"),
        ("fits", "fits", FITS, {"not_finite": ["fits[0].peak"]}, "fits[0].peak is not finite"),
        ("fits", "fits", FITS, {"table": "other"}, "0 rows of table fits, expected 1"),
    ],
)
def test_what_does_not_hold_is_named(section, table, row, changes, says):
    assert check.failures(rows(section, table, row)) == []
    wrong = check.failures(rows(section, table, row | changes))
    assert len(wrong) == 1 and wrong[0].startswith("x: ") and says in wrong[0]


def test_a_rate_of_nothing_is_named():
    found = [r for name in ("bandwidth", *["rays"] * 3) for r in rows("floors", name, {"rate": 1.0})]
    assert check.failures(found) == []
    found[-1]["rate"] = 0.0
    assert check.failures(found) == ["x: a rate of 0.0"]


def test_numbers_have_three_digits():
    assert [tables.si(v, "B") for v in (None, 0, 999, 1.234e9)] == ["-", "0 B", "999 B", "1.23 GB"]
    assert [tables.seconds(v) for v in (None, 0.0123, 1200)] == ["-", "12.3 ms", "1200 s"]
    assert [tables.times(v) for v in (1234.5, 14.06)] == ["1,234", "14.1"]


@pytest.mark.slow
def test_figures_are_drawn_of_what_there_is(tmp_path):
    size = {"table": "scaling", "pixels": 16, "texels": [8, 16], "spp": 16, "trace_s": 1.0, "apply_s": 0.1}
    size |= {"adjoint_s": 0.2, "bytes": 1e6}
    error = {"table": "error-time", "samples": 16, "step_s": 0.1, "rmse": 0.01, "noise": 0.001}
    found = [size | {"variable": name} for name in plot.GROWTH] + [error | {"kind": k} for k in ("prb", "T")]
    files = plot.draw(found, tmp_path)
    assert [file.name for file in files] == ["engine_scaling.png", "engine_error_time.png"]
    assert all(file.stat().st_size > 1000 for file in files)
    assert all(f"]({file.name})" in (ROOT / "docs" / "engine.md").read_text() for file in files)
    assert plot.draw([], tmp_path) == []


def test_cases_with_data_and_without(tmp_path, monkeypatch, capsys):
    def count(*options):
        assert command.main(["engine", "run", "--dry-run", "--out", str(tmp_path / "out"), *options]) == 0
        said = capsys.readouterr()
        return int(re.search(r"(\d+) jobs?: ", said.out)[1]), said.err

    monkeypatch.delenv("ENVEDIT_DATA", raising=False)
    assert count("--quick") == (12, "")
    without, said = count()
    assert "ENVEDIT_DATA is not set" in said
    for name in ("puresky/a_puresky_1k.hdr", "meshes/bunny_watertight.ply"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(name)
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    assert count() == (without + 5, "")  # the mesh once in transport and under three suns, and a fit
    assert count("--only", "fits", "--set", "preset=paper") == (1, "")


def test_runs_with_checks_and_without_alternate(monkeypatch):
    called = []

    def seconds(off, options, caches, out):
        called.append((off, caches.name))
        return 2.0 if off else 3.0

    monkeypatch.setattr(cost_of_checks, "seconds", seconds)
    found = cost_of_checks.compare(None, None, "film", [], True, 2)
    one, other = ("", "with"), ("film", "without")
    assert called == [one, other, one, other, other, one]
    assert found["seconds"] == [(3.0, 2.0)] * 2 and found["medians"] == [3.0, 2.0]
    assert found["quotient"] == 1.5 and found["quartiles"] == (1.5, 1.5)
    assert "1.500 of the time, expected at most 1.03" in cost_of_checks.failures([{"name": "x"} | found])[0]
    assert cost_of_checks.failures([{"name": "x", "quotient": 1.03}, {"name": "path"}]) == []
