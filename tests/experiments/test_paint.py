"""What the experiments with the page of ``envedit paint`` ask of it and report, without a browser."""

import numpy as np

from envedit.images import images
from experiments.harness import Done, calling
from experiments.paint import figure10


def test_the_command_gets_the_configuration_of_the_case_in_an_empty_folder(tmp_path):
    (tmp_path / "job.toml").write_text("seed = 3\n")
    (figure10.prepared(tmp_path) / "edit_out").mkdir()
    work = figure10.prepared(tmp_path)
    assert [path.name for path in work.iterdir()] == ["edit.toml"]
    assert (work / "edit.toml").read_text() == "seed = 3\n"


def test_the_six_edits_and_the_picture_of_the_page(tmp_path, monkeypatch):
    (tmp_path / "puresky").mkdir()
    (tmp_path / "puresky" / f"{figure10.MAP}_puresky_1k.hdr").write_text("a map")
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    cases = {case.name: case for case in figure10.cases(None)}
    assert list(cases) == [*figure10.TITLES, "page"]
    assert cases["page"].command[-1] == cases["move_shadow"].command[-1]
    assert figure10.EXPERIMENT.measure(Done(cases["page"], tmp_path)) == []
    assert figure10.encoded([0.0, 1.0, 0.2140]) == "#00ff7f"


def test_the_picture_of_the_page_is_a_sheet_of_its_own(tmp_path):
    done = Done(calling("page", figure10.picture, {}), tmp_path)
    images.write_png(tmp_path / "page.png", np.full((4, 6, 3), 0.5, np.float32))
    (panel,) = figure10.panels(done)
    assert panel.shape == (4, 6, 3) and figure10.EXPERIMENT.sheet(done.case) == "page"
