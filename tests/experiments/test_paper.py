"""The paper's tables: which runs they consist of, and what is shown of those that are done."""

import json
import math
from argparse import Namespace

import numpy as np
import pytest

from envedit import config
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from envedit.losses.perceptual.installed import DISTS_WEIGHT
from experiments import harness, puresky
from experiments.interiors import experiment as interiors
from experiments.paper.experiment import DEFAULT, EXPERIMENT, published, seconds

OTHER = "autumn_field"
PAPER_ROWS = ["pixels", "pixels-reg", "log-pixels", "log-pixels-reg", "siren-no-hdr"]
PAPER_ROWS += ["siren", "siren-reg", "r-siren", "r-siren-reg"]


@pytest.fixture
def maps(tmp_path, monkeypatch):
    """The folder of maps that ENVEDIT_DATA names, of four whose content no test here reads."""
    folder = tmp_path / "data" / "puresky"
    folder.mkdir(parents=True)
    for name in ("cloudy", "clear", "dusk"):
        (folder / f"{name}_puresky_1k.hdr").write_text(name)
    sky = np.random.default_rng(0).random((8, 16, 3), np.float32)
    images.write_exr(folder / f"{OTHER}_puresky_1k.exr", sky)
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path / "data"))
    return folder


@pytest.fixture
def build():
    """Cases of a table with their jobs, of those whose names have one of some parts."""

    def made(name, *only, sets=(), all_maps=False):
        given = Namespace(name=name, all_maps=all_maps)
        cases = [c for c in EXPERIMENT.cases(given) if not only or any(text in c.name for text in only)]
        return [(case, case.job(sets)) for case in cases]

    return made


def settings_of(job):
    return config.loads(job.toml)


def settings_by_row(made):
    return {(case.about["settings"], case.about["row"]): settings_of(job) for case, job in made}


def text(out, made):
    return harness.table(EXPERIMENT, harness.rows_of(EXPERIMENT, harness.done_of(made, out)))


# ---- the paper's numbers -----------------------------------------------------------------------------------
def test_the_paper_s_numbers_are_complete_and_agree_with_each_other():
    counts = {
        "table1": {None: 6}, "table2": {None: 4}, "table3": {0.0: 4, 0.5: 4, 1.0: 4}, "figure8": {0.0: 0},
    }  # fmt: skip
    for name, parts in counts.items():
        for roughness, count in parts.items():
            rows = published(name, roughness)
            assert len(rows) == count
            for which in (row[image] for row in rows for image in ("envmap", "render")):
                mse, psnr = which["mse"], which["psnr"]
                least, most = (-10 * math.log10(mse + d) for d in (5.1e-6, -5.1e-6))
                # A mean of PSNRs is at least the PSNR of the mean.
                assert psnr > least - 1e-4 and (name == "table3" or psnr < most + 1e-4)


# ---- jobs --------------------------------------------------------------------------------------------------
def test_the_paper_s_settings_are_its_own_and_ours_the_standard_preset(maps, build):
    made = settings_by_row(build("table1"))
    assert [row for s, row in made if s == "paper"] == PAPER_ROWS
    assert [row for s, row in made if s == "ours"] == [*PAPER_ROWS, "r-siren-own", "layers"]
    for (setting, row), found in made.items():
        paper, loss = setting == "paper", found.loss
        assert found.preset == ("paper" if paper else "standard")
        assert found.input.envmap.endswith(f"{OTHER}_puresky_1k.exr")  # the first of those that are there
        own = row.removesuffix("-reg")
        kind = own if own in ("pixels", "log-pixels", "layers") else "siren"
        assert found.representation.kind == kind
        dists = DISTS_WEIGHT if row == "r-siren-own" else 0
        expected = ((1e-4, 1e-8), (1e-4, 1e-8), 0.6) if row.endswith("-reg") else (0, 0, dists)
        assert (loss.luminance, loss.l1, loss.dists) == expected
        if kind == "siren":
            assert found.fit.hdr == (0 if row == "siren-no-hdr" else 0.01)
            assert found.fit.awp_gamma == (0.01 if row.startswith("r-siren") else 0)
        rates = {"pixels": 2e-4, "log-pixels": 1e-4}
        assert found.optimizer.lr == (rates.get(kind, 5e-6) if paper else "auto")
        assert (loss.image_l1, loss.image_l2) == (0, 0) if paper else loss.image_l1 == 1


@pytest.mark.slow
def test_a_table_of_one_map_has_all_of_them_where_asked(maps, build):
    (maps / f"{DEFAULT}_puresky_1k.hdr").write_text("default")
    assert {case.about["map"] for case, _ in build("table1")} == {DEFAULT}
    everything = {DEFAULT, OTHER, "clear", "cloudy", "dusk"}
    assert {case.about["map"] for case, _ in build("table1", all_maps=True)} == everything
    assert {case.about["map"] for case, _ in build("table3")} == everything


def test_roughness_and_overrides_reach_the_runs(maps, build):
    sets = ["scene.file=sphere", "target.rotate_degrees=140", "fit.epochs=7", "scene.parameters.turn=3"]
    found = [settings_of(job) for _, job in build("table3", "ours-r-siren-dusk", sets=sets)]
    assert [one.scene.parameters for one in found] == [{"roughness": r, "turn": 3} for r in (0, 0.5, 1)]
    asked = {(one.scene.file, one.target.rotate_degrees, one.fit.epochs) for one in found}
    assert asked == {("sphere", 140, 7)}
    assert settings_of(build("table2", "ours-siren-autumn")[0][1]).scene.file == "mirror"
    (_, job), *_ = build("table1", sets=["target.file=other.exr"])
    assert settings_of(job).target.file.endswith("other.exr")


# ---- maps --------------------------------------------------------------------------------------------------
def test_maps_are_found_by_name(tmp_path, monkeypatch):
    folder = tmp_path / "puresky"
    folder.mkdir()
    for name in ("b_puresky_1k.hdr", "a_b_puresky_1k.exr", "MANIFEST.tsv", "d_puresky_1k.hdr.part"):
        (folder / name).touch()
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    assert {name: path.name for name, path in puresky.find().items()} == {
        "a_b": "a_b_puresky_1k.exr",
        "b": "b_puresky_1k.hdr",
    }
    assert puresky.file("b") == str(folder / "b_puresky_1k.hdr")
    with pytest.raises(ConfigError, match="^no map a_bb; did you mean a_b"):
        puresky.file("a_bb")


def test_without_maps_an_error_says_where_they_come_from(build, tmp_path, monkeypatch):
    monkeypatch.delenv("ENVEDIT_DATA", raising=False)
    with pytest.raises(ConfigError, match="^no maps: set ENVEDIT_DATA .* experiments.download_puresky"):
        puresky.find()
    with pytest.raises(ConfigError, match="^no maps: set ENVEDIT_DATA"):
        build("table1")
    with pytest.raises(ConfigError, match="^no maps: set ENVEDIT_DATA .* hdri/NAME_1k.hdr"):
        interiors.EXPERIMENT.cases(Namespace(out=tmp_path))
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    with pytest.raises(InputError, match="no map NAME_puresky_1k"):
        puresky.find()


# ---- tables and pictures of what is done -------------------------------------------------------------------

SOME = {"psnr": 20.0, "ssim": 0.5, "mse": 0.01, "lpips": None}


def finish(out, made, part="", *, numbers=SOME, fit_s=None, cached=False, resumed=False):
    """Make up what the edits leave that have a part in their names, as far as tables read it."""
    chosen = [job for case, job in made if part in case.name]
    for job in chosen:
        folder = job.folder(out)
        folder.mkdir(parents=True, exist_ok=True)
        timing_fit = 0.2 if cached else fit_s or 0.0
        about = {
            "envmap": numbers,
            "render": {**numbers, "psnr": numbers["psnr"] + 20},
            "initial": {**SOME, "psnr": 12.0},
            "initial_envmap": {**SOME, "psnr": 9.0},
            "ceiling": {**SOME, "psnr": 48.0} if numbers["lpips"] else None,
            "fit": None if fit_s is None else {"cached": cached, "seconds": 840.0},
            "timing": {"fit_s": timing_fit, "total_s": timing_fit + 30},
        }
        (folder / "metrics.json").write_text(json.dumps(about))
        (folder / "done.json").write_text(json.dumps({"resumed": resumed}))
    return len(chosen)


def row_of(text, title):
    lines = [line for line in text.splitlines() if line.startswith(f"| {title} |")]
    return [[part.strip() for part in line.strip("|").split("|")][1:] for line in lines]


def test_a_table_has_a_row_for_each_method_that_is_done(maps, build, tmp_path):
    made = build("table1", "paper-")
    finish(tmp_path, made, "-r-siren-autumn", numbers={**SOME, "psnr": 14.125, "lpips": 0.4})
    finish(tmp_path, made, "paper-pixels-autumn")
    shown = text(tmp_path, made)
    assert shown.splitlines()[0] == f"The paper's settings, {OTHER}:"
    siren = ["14.12", "0.400", "0.01000", "0.500", "34.12", "0.400", "0.01000", "0.500", "-", "30", "1"]
    assert row_of(shown, "R-SIREN HDR") == [siren]
    (unedited,), (true,) = (row_of(shown, title) for title in ("unedited", "the true map"))
    assert (unedited[0], unedited[4]) == ("9.00", "12.00") and true[:5] == [*"----", "48.00"]
    theirs = "14.56", "0.621", "0.03496", "0.345", "46.38", "0.053", "0.00002", "0.993"
    assert row_of(shown, "SIREN HDR, published") == [[*theirs, "-", "-", "1"]]
    assert not row_of(shown, "SIREN HDR")


def test_averages_are_over_maps_that_are_done_in_every_row(maps, build, tmp_path):
    made = build("table3", "ours-")
    for sky, psnr in (("clear", 10.0), ("cloudy", 30.0)):
        finish(tmp_path, made, f"layers-{sky}-0.5", numbers={**SOME, "psnr": psnr})
    for sky in ("clear", "cloudy", "dusk"):
        some = {**SOME, "psnr": 17.0 if sky == "dusk" else 11.0}
        finish(tmp_path, made, f"ours-siren-{sky}-0.5", numbers=some)
        finish(tmp_path, made, f"ours-pixels-{sky}-0.5", numbers=SOME)
    shown = text(tmp_path, made)
    assert shown.startswith("Our settings, roughness 0.5, 2 maps:")
    (layers,) = row_of(shown, "Layers (ours)")
    assert (layers[0], layers[-1]) == ("20.00", "2")
    (siren,) = row_of(shown, "SIREN HDR")
    assert (siren[0], siren[-1]) == ("11.00", "2")  # dusk is not among them
    without = [one for one in made if one[0].about["row"] != "layers"]
    assert row_of(text(tmp_path, without), "SIREN HDR")[0][0] == "13.00"
    finish(tmp_path, made, "ours-pixels-clear-1.0")
    finish(tmp_path, made, "layers-dusk-1.0")
    assert "roughness 1, 0 maps:" in text(tmp_path, made)


def test_a_painted_edit_has_no_true_map_to_be_compared_with(tmp_path):
    cases = EXPERIMENT.cases(Namespace(name="figure9", all_maps=False))
    made = [(case, case.job(())) for case in cases if case.name.startswith("ours-lum-l1-sunsky")]
    assert finish(tmp_path, made) == 1
    file = made[0][1].folder(tmp_path) / "metrics.json"
    about = json.loads(file.read_text()) | {"painted": {"towards": 0.5, "elsewhere": 0.01}}
    del about["initial_envmap"]
    file.write_text(json.dumps(about))
    assert row_of(text(tmp_path, made), "+ L_lum + L_l1") == [["0.50", "0.010", "30"]]


def test_the_seconds_of_a_fit_are_those_of_the_run_that_made_it(maps, build, tmp_path):
    made = build("table3", *(f"paper-{row}-dusk" for row in ("r-siren", "r-siren-reg", "pixels")))
    finish(tmp_path, made, "r-siren-dusk-0.0", fit_s=840.0)
    finish(tmp_path, made, "r-siren-reg-dusk-1.0", fit_s=1.0, cached=True)
    finish(tmp_path, made, "pixels-dusk-1.0", resumed=True)
    found = {one.case.about["row"]: seconds(one) for one in harness.done_of(made, tmp_path)}
    assert found["r-siren"] == {"fit_s": 840, "rest_s": 30}
    assert found["r-siren-reg"] == {"fit_s": 840, "rest_s": 30}
    assert found["pixels"] == {"fit_s": None, "rest_s": None}, "a part of its time is not known"
    shown = text(tmp_path, made)
    assert row_of(shown, "R-SIREN HDR + L_reg")[0][-3:] == ["840", "30", "1"]
    assert row_of(shown, "Pixels")[0][-3:] == ["-", "-", "1"]
