"""The paper's tables and figures: which runs they consist of, and what is drawn of those that are done."""

import json
import math
from argparse import Namespace

import mitsuba as mi
import numpy as np
import pytest

from envedit import config, representations
from envedit.core import latlong
from envedit.core.errors import ConfigError, InputError
from envedit.images import images, layered_exr
from envedit.inputs import load_map
from envedit.representations.siren import fit
from envedit.representations.siren import network as siren
from experiments import harness, puresky
from experiments.__main__ import main
from experiments.interiors import experiment as interiors
from experiments.paper import experiment, network, sheets, tables
from experiments.paper.experiment import DEFAULT, EXPERIMENT, KINDS, OTHER
from experiments.paper.published import COLUMNS, PUBLISHED

PAPER_ROWS = ["pixels", "log-pixels", "siren-no-hdr", "siren", "r-siren", "r-siren-reg"]


@pytest.fixture
def maps(tmp_path, monkeypatch):
    """The folder of maps that ENVEDIT_DATA names, of four whose content no test here reads."""
    folder = tmp_path / "data" / "puresky"
    folder.mkdir(parents=True)
    for name in ("cloudy", "clear", "dusk"):
        (folder / f"{name}_puresky_1k.hdr").write_text(name)
    images.write_exr(
        folder / f"{OTHER}_puresky_1k.exr", np.random.default_rng(0).random((8, 16, 3), np.float32)
    )
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path / "data"))
    return folder


@pytest.fixture
def build(tmp_path):
    """Cases of a table or figure with their jobs, of those whose names have one of some parts."""

    def made(name, *only, sets=(), all_maps=False, edit="move_shadow", out=tmp_path):
        given = Namespace(name=name, sets=list(sets), all_maps=all_maps, edit=edit, out=out)
        cases = [c for c in EXPERIMENT.cases(given) if not only or any(text in c.name for text in only)]
        return [(case, case.job(sets)) for case in cases]

    return made


def settings_of(job):
    return config.loads(job.toml)


def settings_by_row(made):
    return {(case.about["settings"], case.about["row"]): settings_of(job) for case, job in made}


def keys(made):
    return [job.key for _, job in made]


def text(name, out, made):
    return tables.text(name, KINDS[name].title, tables.rows_of(name, made, out))


# ---- the paper's numbers -----------------------------------------------------------------------------------


def test_the_paper_s_numbers_are_complete_and_agree_with_each_other():
    counts = {name: {r: len(rows) for r, rows in parts.items()} for name, parts in PUBLISHED.items()}
    assert counts == {"table1": {None: 6}, "table2": {None: 4}, "table3": {0.0: 4, 0.5: 4, 1.0: 4}}
    for name, parts in PUBLISHED.items():
        for rows in parts.values():
            assert set(rows) <= set(KINDS[name].rows)
            for numbers in rows.values():
                assert tuple(numbers) == COLUMNS
                for which in ("envmap", "render"):
                    mse, psnr = numbers[which, "mse"], numbers[which, "psnr"]
                    least, most = (-10 * math.log10(mse + d) for d in (5.1e-6, -5.1e-6))
                    # A mean of PSNRs is at least the PSNR of the mean.
                    assert psnr > least - 1e-4 and (name == "table3" or psnr < most + 1e-4)
    assert PUBLISHED["table1"][None]["r-siren-reg"]["envmap", "lpips"] == 0.53229
    assert PUBLISHED["table2"][None]["r-siren-reg"]["render", "psnr"] == 35.46278
    assert PUBLISHED["table3"][0.5]["log-pixels"]["render", "ssim"] == 0.69031


# ---- jobs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "paper", "ours"),
    [
        ("table1", 6, 7),
        ("table2", 7, 8),
        ("table3", 7 * 4 * 3, 8 * 4 * 3),
        ("figure4", 4, 5),
        ("figure5", 2, 3),
        ("figure8", 1 * 3, 2 * 3),
        ("figure9", 2, 3),
    ],
)
def test_a_table_is_rows_by_maps_by_roughness(maps, build, name, paper, ours):
    made = build(name)
    abouts = [case.about for case, _ in made]
    assert [sum(a["settings"] == s for a in abouts) for s in ("paper", "ours")] == [paper, ours]
    assert len(set(keys(made))) == len({case.name for case, _ in made}) == len(made)
    assert len({(a["settings"], a["row"], a["map"], a["roughness"]) for a in abouts}) == len(made)


def test_the_paper_s_settings_are_its_own_and_ours_the_standard_preset(maps, build):
    made = settings_by_row(build("table1"))
    assert [row for s, row in made if s == "paper"] == PAPER_ROWS
    assert [row for s, row in made if s == "ours"] == [*PAPER_ROWS, "layers"]
    for (setting, row), found in made.items():
        paper = setting == "paper"
        assert (found.preset, found.renderer.kind) == (
            ("paper", "path") if paper else ("standard", "transport")
        )
        assert found.scene.file == "statue" and found.target.rotate_degrees == 60
        assert found.input.envmap.endswith(f"{OTHER}_puresky_1k.exr")  # the first of those that are there
        kind = {"pixels": "pixels", "log-pixels": "log-pixels", "layers": "layers"}.get(row, "siren")
        assert found.representation.kind == kind
        loss = found.loss
        if row.endswith("-reg"):
            assert (loss.luminance, loss.l1, loss.dists) == ((1e-4, 1e-8), (1e-4, 1e-8), 0.6)
        else:
            assert (loss.luminance, loss.l1, loss.dists) == (0, 0, 0)
        if kind == "siren":
            assert found.fit.hdr == (0 if row == "siren-no-hdr" else 0.01)
            assert found.fit.awp_gamma == (0.01 if row.startswith("r-siren") else 0)
            assert (found.representation.hidden, found.representation.depth) == (
                (256, 6) if paper else (128, 3)
            )
        if paper:
            assert loss.ssim == (1, 1e4) and not loss.image_l1 and not loss.image_l2
            assert found.optimizer.iterations == 400 and found.scene.width == 256
            assert found.optimizer.lr == {"pixels": 2e-4, "log-pixels": 1e-4}.get(kind, 5e-6)
            assert found.optimizer.schedule == "constant"
        else:
            assert loss.image_l1 == 1 and found.optimizer.lr == "auto"


@pytest.mark.slow
def test_a_table_of_one_map_has_all_of_them_where_asked(maps, build):
    (maps / f"{DEFAULT}_puresky_1k.hdr").write_text("default")
    assert {case.about["map"] for case, _ in build("table1")} == {DEFAULT}
    everything = {DEFAULT, OTHER, "clear", "cloudy", "dusk"}
    assert {case.about["map"] for case, _ in build("table1", all_maps=True)} == everything
    assert {case.about["map"] for case, _ in build("table3")} == everything


def test_tables_share_the_runs_they_have_in_common(maps, build):
    siren = "paper-siren-autumn", "ours-siren-autumn"
    mirror = build("table1", *siren, sets=["scene.file=mirror"])
    assert len(mirror) == 2 and keys(mirror) == keys(build("table2", *siren))
    assert keys(build("figure4", *siren)) == keys(build("figure5", *siren))
    # A fit does not depend on the regulariser of its edit, and is found on disk by it: jobs of a map that
    # share one do not stand side by side.
    rows = [case.about["row"] for case, _ in build("table3", "paper-")][:8]
    assert rows == ["pixels"] * 4 + ["log-pixels"] * 4


def test_roughness_and_overrides_reach_the_runs(maps, build):
    sets = ["scene.file=sphere", "target.rotate_degrees=140", "fit.epochs=7", "scene.parameters.turn=3"]
    made = build("table3", "ours-r-siren-dusk", sets=sets)
    found = [settings_of(job) for _, job in made]
    assert [one.scene.parameters for one in found] == [{"roughness": r, "turn": 3} for r in (0, 0.5, 1)]
    assert [case.about["roughness"] for case, _ in made] == [0, 0.5, 1]
    asked = {(one.scene.file, one.target.rotate_degrees, one.fit.epochs) for one in found}
    assert asked == {("sphere", 140, 7)}
    assert settings_of(build("table2", "ours-siren-autumn")[0][1]).scene.file == "mirror"
    (_, job), *_ = build("table1", sets=["target.file=other.exr"])
    assert settings_of(job).target.file.endswith("other.exr")


def test_stock_networks_are_kept_apart_from_recipes(maps, build):
    made = build("figure4", "ours-")
    recipes = [json.loads(case.command[-1])["recipe"] for case, _ in made]
    assert recipes == ["stock", "stock-scaled", "configured", "configured", "configured"]
    fits = {row: found.fit for (_, row), found in settings_by_row(made).items()}
    assert fits["siren"].polish == "never" and fits["siren-polished"].polish == "always"
    assert fits["siren"].awp_gamma == 0 and fits["siren-no-hdr"].hdr == 0


def test_figure_8_has_another_map_for_its_target_turned(maps, build, tmp_path):
    (_, job), *_ = build("figure8")
    found = settings_of(job).target
    assert found.rotate_degrees == "auto"
    assert found.file.startswith(str(tmp_path / "maps" / f"{OTHER}_puresky_1k-turned-60-"))
    file = maps / f"{OTHER}_puresky_1k.exr"
    sky = images.read(str(file))[0]
    np.testing.assert_allclose(images.read(found.file)[0], latlong.rotate(sky, 60), rtol=1e-6)
    images.write_exr(file, 1 + sky)
    assert settings_of(build("figure8")[0][1]).target.file != found.file
    exact = experiment.turned(file, 90, tmp_path / "maps")
    np.testing.assert_array_equal(images.read(str(exact))[0], np.roll(1 + sky, -4, axis=1))
    file.unlink()
    with pytest.raises(ConfigError, match=f"^no map {OTHER}; there are clear, cloudy, dusk"):
        build("figure8")


def test_figure_9_is_a_shipped_edit_and_has_dists_where_weights_are_named(build, monkeypatch):
    monkeypatch.delenv("ENVEDIT_DATA", raising=False)  # it needs no maps
    made = settings_by_row(build("figure9", sets=["perceptual.vgg=vgg.npz", "perceptual.dists=dists.npz"]))
    assert list(made) == [
        *(("paper", row) for row in ("none", "lum-l1", "lum-l1-dists")),
        *(("ours", row) for row in ("none", "lum-l1", "lum-l1-dists", "layers")),
    ]
    for (_, row), found in made.items():
        assert found.input.envmap == "sunsky" and found.input.azimuth == 235 and found.scene.file == "matte"
        assert found.target.kind == "strokes" and len(found.target.strokes) == 2
        if row != "layers":
            wanted = ((1e-5, 1e-9), (1e-4, 1e-8)) if row != "none" else (0, 0)
            assert (found.loss.luminance, found.loss.l1) == wanted
            assert found.loss.dists == (0.6 if row == "lum-l1-dists" else 0) and found.loss.change == 0
            assert found.fit.awp_gamma == 0.01
    assert made["ours", "layers"].loss.change == 0.01
    assert "lum-l1-dists" not in {case.about["row"] for case, _ in build("figure9")}
    (_, job), *_ = build("figure9", edit="warmer")
    assert "temperature" in job.toml


# ---- maps --------------------------------------------------------------------------------------------------


def test_maps_are_found_by_name_the_smallest_file_of_each(tmp_path, monkeypatch):
    names = ["b_puresky_4k.hdr", "b_puresky_1k.exr", "a_b_puresky_16k.hdr", "a_b_puresky_2k.hdr"]
    names += ["b_puresky_1k.hdr", "MANIFEST.tsv", "c_puresky.hdr", "d_puresky_1k.hdr.part"]
    folder = tmp_path / "puresky"
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    found = puresky.find(folder)
    assert {name: path.name for name, path in found.items()} == {
        "a_b": "a_b_puresky_2k.hdr",
        "b": "b_puresky_1k.hdr",
    }
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    assert puresky.find() == found
    assert puresky.file("b") == str(found["b"])
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
    with pytest.raises(InputError, match="nowhere: no such folder of maps"):
        puresky.find(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no map NAME_puresky_1k"):
        puresky.find(tmp_path)


# ---- the command line --------------------------------------------------------------------------------------


def test_usage(maps, tmp_path, capsys):
    ask = ["paper", "run", "table1", "--out", str(tmp_path / "out")]
    only = ["--only", "ours-pixels", "ours-layers", "--dry-run"]
    assert main([*ask, *only]) == 0 and not (tmp_path / "out").exists()
    assert "2 jobs: 2 missing" in capsys.readouterr().out
    assert main(["paper", "table", *ask[2:]]) == 0
    kept = (tmp_path / "out" / "table1.md").read_text()
    assert capsys.readouterr().out == kept and kept.startswith("## Table 1") and "0/1" in kept
    for wrong in (["table4"], ["figure9", "--edit", "colder"]):
        with pytest.raises(SystemExit) as info:
            main(["paper", "run", *wrong])
        assert info.value.code == 2


# ---- tables and pictures of what is done -------------------------------------------------------------------

RED, BLUE, YELLOW = (1, 0, 0), (0, 0, 1), (1, 1, 0)
SOME = {"psnr": 20.0, "ssim": 0.5, "mse": 0.01, "lpips": None}


def finish(
    out, made, part="", *, color=RED, numbers=SOME, fit_s=None, cached=False, seconds=840.0, resumed=False
):
    """Make up what the edits leave that have a part in their names, as far as tables and sheets read it."""
    chosen = [(case, job) for case, job in made if part in case.name]
    for _, job in chosen:
        folder = job.folder(out)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.toml").write_text(job.toml)
        edited = np.ones((8, 16, 3), np.float32) * np.float32(color)
        initial = np.full((8, 16, 3), 0.2, np.float32)
        images.write_exr(folder / "edited.exr", edited)
        layered_exr.write(folder / "edited_layers.exr", {"edited": edited, "initial": initial})
        for name, value in (("initial", 0.1), ("target", 0.4), ("edited", 0.7)):
            images.write_exr(folder / f"render_{name}.exr", np.full((6, 6, 3), value, np.float32))
        about = {
            "envmap": numbers,
            "render": {**numbers, "psnr": numbers["psnr"] + 20},
            "initial": {**SOME, "psnr": 12.0},
            "initial_envmap": {**SOME, "psnr": 9.0},
            "fit": None if fit_s is None else {"cached": cached, "seconds": seconds},
            "timing": {
                "fit_s": 0.2 if cached else fit_s or 0.5,
                "total_s": (0.2 if cached else fit_s or 0) + 30,
            },
            "active_rows": [0, 3],
            "painted": {"towards": 0.8, "elsewhere": None, "reachable": 0.9},
            "natural": {"colours_outside": 0.25, "seam": 1, "high_frequency": 0.9, "white": 0, "patches": 0},
        }
        (folder / "metrics.json").write_text(json.dumps(about))
        (folder / "done.json").write_text(json.dumps({"resumed": resumed}))
    return len(chosen)


def finish_fits(out, made):
    """Make up what fits leave."""
    for _, job in made:
        folder = job.folder(out)
        folder.mkdir(parents=True, exist_ok=True)
        for i, file in enumerate(("original", "fitted", "noisy")):
            images.write_exr(folder / f"{file}.exr", np.full((4, 16, 3), 10.0**i, np.float32))
        found = {
            "log_psnr": 40.0,
            "peak_ratio": None,
            "mean_ratio": 0.5,
            "noisy": [30.0, 20.0],
            "seconds": 9.0,
        }
        (folder / "result.json").write_text(json.dumps(found))
        (folder / "done.json").write_text("{}")


def row_of(text, title):
    lines = [line for line in text.splitlines() if line.startswith(f"| {title} |")]
    return [[part.strip() for part in line.strip("|").split("|")][1:] for line in lines]


def test_a_table_has_a_row_for_each_method_also_for_those_that_are_missing(maps, build, tmp_path):
    made = build("table1", "paper-")
    assert finish(tmp_path, made, "-r-siren-autumn", numbers={**SOME, "psnr": 14.125, "lpips": 0.4}) == 1
    finish(tmp_path, made, "paper-pixels", numbers={**SOME, "psnr": 13.0, "mse": 0.002})
    shown = text("table1", tmp_path, made)
    assert shown.splitlines()[2] == f"The paper's settings, {OTHER}:"
    assert [len(line.split("|")) for line in shown.splitlines()[4:]] == [14] * 9
    assert row_of(shown, "R-SIREN HDR") == [
        ["**14.12** (14.59)", "0.400 (0.557)", "0.01000 (0.03478)", "**0.500** (0.554)"]
        + ["**34.12** (39.96)", "0.400 (0.058)", "0.01000 (0.00010)", "**0.500** (0.991)"]
        + ["-", "30", "1/1"]
    ]
    (pixels,) = row_of(shown, "Pixels")
    assert pixels[:3] == ["13.00 (8.92)", "- (0.638)", "**0.00200** (0.12825)"]
    (missing,) = row_of(shown, "SIREN HDR")
    theirs = "14.56", "0.621", "0.03496", "0.345", "46.38", "0.053", "0.00002", "0.993"
    assert missing == [*(f"- ({v})" for v in theirs), "-", "-", "0/1"]
    (unedited,) = row_of(shown, "unedited")
    assert unedited == ["9.00", "-", "0.01000", "0.500", "12.00", "-", "0.01000", "0.500", "-", "-", "1/1"]


def test_averages_are_over_maps_and_say_how_many(maps, build, tmp_path):
    (maps / f"{OTHER}_puresky_1k.exr").unlink()
    made = build("table3", "ours-")
    for sky, psnr in (("clear", 10.0), ("cloudy", 30.0)):
        finish(tmp_path, made, f"layers-{sky}-0.5", numbers={**SOME, "psnr": psnr})
    for sky in ("clear", "cloudy", "dusk"):
        some = {**SOME, "psnr": 11.0, "lpips": None if sky == "dusk" else 0.1}
        finish(tmp_path, made, f"ours-siren-{sky}-0.5", numbers=some)
        finish(tmp_path, made, f"ours-pixels-{sky}-0.5", numbers=SOME)
    shown = text("table3", tmp_path, made)
    heads = [line for line in shown.splitlines() if line.startswith("Our settings")]
    ends = ("0, 3 maps:", "0.5, 3 maps, averages over 2 of them:", "1, 3 maps:")
    assert heads == [f"Our settings, roughness {end}" for end in ends]
    layers = row_of(shown, "Layers (ours)")
    assert [row[-1] for row in layers] == ["0/3", "2/3", "0/3"]
    assert layers[1][0] == "**20.00**" and layers[0][0] == "-"
    assert row_of(shown, "Pixels")[1][0] == "**20.00** (9.51)"
    assert row_of(shown, "SIREN HDR")[1][:2] == ["11.00", "0.100"]  # dusk is not among them
    assert row_of(shown, "unedited")[1][-1] == "2/3"
    shown = text("table3", tmp_path, [one for one in made if one[0].about["row"] != "layers"])
    assert row_of(shown, "SIREN HDR")[1][:2] == ["11.00", "-"]  # an LPIPS of two maps of three is none
    assert row_of(shown, "unedited")[1][-1] == "3/3"
    finish(tmp_path, made, "ours-pixels-clear-1.0")
    finish(tmp_path, made, "layers-dusk-1.0")
    assert "roughness 1, 3 maps, no map is done in every row:" in text("table3", tmp_path, made)


def test_the_seconds_of_a_fit_are_those_of_the_run_that_made_it(maps, build, tmp_path):
    made = build("table3", *(f"paper-{row}-dusk" for row in ("r-siren", "r-siren-reg", "pixels")))
    finish(tmp_path, made, "r-siren-dusk-0.0", fit_s=840.0)
    finish(tmp_path, made, "r-siren-reg-dusk-1.0", fit_s=1.0, cached=True)
    finish(tmp_path, made, "pixels-dusk-1.0", resumed=True)
    found = {one.case.about["row"]: tables.seconds(one) for one in harness.done_of(made, tmp_path)}
    assert found["r-siren"] == {"fit_s": 840, "rest_s": 30}
    assert found["r-siren-reg"]["fit_s"] == 840 and abs(found["r-siren-reg"]["rest_s"] - 30) < 1e-9
    assert found["pixels"]["fit_s"] is None
    assert math.isnan(found["pixels"]["rest_s"]), "a part of its time is not known"
    shown = text("table3", tmp_path, made)
    assert row_of(shown, "R-SIREN HDR + L_reg")[2][-3:] == ["840", "30", "1/1"]
    assert row_of(shown, "Pixels")[2][-3:] == ["-", "-", "1/1"]
    assert tables.mean([30.0, math.nan]) == 30 and tables.mean([30.0, None]) is None


def drawn(file):
    return np.array(mi.Bitmap(str(file)))[..., :3]


def test_a_sheet_shows_what_is_done_and_leaves_room_for_the_rest(maps, build, tmp_path):
    made = build("table1", "ours-")
    finish(tmp_path, made, "ours-pixels", color=RED)
    finish(tmp_path, made, "layers", color=BLUE)
    (file,) = sheets.draw("table1", made, tmp_path, tmp_path)
    assert file.name == "table1-ours.png"
    picture, gap = drawn(file), harness.GAP
    # Nine columns: initial, target, seven methods, of which the first and the last are done; active rows of
    # the map above the rendering of 6x6 pixels, enlarged by two.
    assert picture.shape == (4 + 12 + 2 * gap, 9 * (16 + gap), 3)
    columns = [picture[:, i * (16 + gap) :][:, :12] for i in range(9)]
    assert (columns[2][:4] == (255, 0, 0)).all() and (columns[8][:4] == (0, 0, 255)).all()
    for column, value in ((0, 0.1), (1, 0.4), (2, 0.7), (8, 0.7)):
        shown = columns[column][4 + gap : 16 + gap]
        np.testing.assert_allclose(shown, 255 * value ** (1 / 2.2), atol=1)
    for column in columns[3:8]:
        assert (column[:4] == round(255 * sheets.GREY)).all()
        assert (column[4 + gap : 16 + gap] == round(255 * sheets.GREY)).all()


def test_figure_8_has_its_roughnesses_side_by_side(maps, build, tmp_path):
    made = build("figure8", "ours-")
    finish(tmp_path, made, "layers-autumn_field-0.5", color=BLUE)
    (file,) = sheets.draw("figure8", made, tmp_path, tmp_path)
    picture, gap = drawn(file), harness.GAP
    # Initial and true map, target; map and rendering of R-SIREN, of which nothing is known, and of layers.
    heights = 4, 4, 12, 4, 4, 4, 12
    assert picture.shape == (sum(heights) + 7 * gap, 3 * (16 + gap), 3)
    blue = np.argwhere((picture == (0, 0, 255)).all(axis=-1))
    top, left = sum(heights[:5]) + 5 * gap, 16 + gap
    assert blue.min(axis=0).tolist() == [top, left] and blue.max(axis=0).tolist() == [top + 3, left + 15]


def test_the_true_map_is_the_map_turned_or_the_other_one(maps, build, tmp_path):
    made = build("table1", "layers", sets=["target.rotate_degrees=90"])
    finish(tmp_path, made)
    folder = made[0][1].folder(tmp_path)
    ramp = np.broadcast_to(np.arange(16, dtype=np.float32)[None, :, None], (8, 16, 3))
    layered_exr.write(folder / "edited_layers.exr", {"edited": ramp, "initial": ramp.copy()})

    def read():
        return sheets.pictures(harness.done_of(made, tmp_path)[0])

    assert read()["initial_map"].shape == (4, 16, 3)
    np.testing.assert_array_equal(read()["true_map"], latlong.rotate(ramp, 90)[:4])
    other = tmp_path / "other.exr"
    images.write_exr(other, np.full((8, 16, 3), 3, np.float32))
    ((_, job),) = build("table1", "layers", sets=[f"target.file={other}", "input.width=16"])
    (folder / "config.toml").write_text(job.toml)
    assert (read()["true_map"] == 3).all()
    other.unlink()
    assert read()["true_map"] is None


@pytest.mark.slow
def test_every_table_and_figure_is_drawn_and_printed(maps, build, tmp_path, capsys):
    out, to = tmp_path / "out", tmp_path / "to"
    for name in KINDS:
        only = ["ours-"] if name == "figure9" else [f"ours-{row}-{OTHER}" for row in KINDS[name].rows]
        made = build(name, *only, out=out)
        (finish_fits if name in ("figure4", "figure5") else finish)(out, made[:-1])
        ask = [name, "--out", str(out), "--to", str(to), "--only", *only]
        assert main(["paper", "table", *ask]) == 0
        kept = (to / f"{name}.md").read_text()
        assert capsys.readouterr().out == kept and kept.startswith(f"## {KINDS[name].title}\n")
        assert "0/1" in kept and "1/1" in kept and "| nan" not in kept
        assert main(["paper", "sheet", *ask]) == 0
        files = [line.rsplit("/", 1)[1] for line in capsys.readouterr().out.splitlines()]
        parts = [f"-roughness{r}" for r in ("0", "0.5", "1")] if name == "table3" else [""]
        parts += ["-histograms"] * (name == "figure4")
        assert files == [f"{name}-ours{part}.png" for part in parts]
        for file in files:
            assert drawn(to / file).std() > 5
    assert row_of((to / "figure4.md").read_text(), "SIREN HDR") == [
        ["40.0", "-", "0.500", "25.0", "9", "1/1"]
    ]
    assert row_of((to / "figure9.md").read_text(), "R-SIREN HDR")[0][:3] == ["80%", "90%", "-"]


def test_where_nothing_is_done_nothing_is_drawn(maps, build, tmp_path):
    made = build("figure8")
    assert sheets.draw("figure8", made, tmp_path, tmp_path) == []
    assert row_of(text("figure8", tmp_path, made), "unedited")[0][-1] == "0/1"


# ---- networks ----------------------------------------------------------------------------------------------


def test_the_stock_network_s_last_layer_is_linear_and_so_is_its_gradient(rng):
    params = siren.init(3, hidden=8, depth=1)
    x = fit.points(config.Representation(), (3, 5))
    weight = rng.normal(size=(15, 3)).astype(np.float32)
    z, tape = network.linear(params, x, 30.0)
    h = tape[-1][0].numpy()
    want = h @ params["2.weight"].numpy().T + params["2.bias"].numpy()
    np.testing.assert_allclose(z.numpy(), want, atol=1e-5)
    got = network.backward(params, tape, mi.TensorXf(weight))
    np.testing.assert_allclose(got["2.weight"].numpy(), weight.T @ h, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(got["2.bias"].numpy(), weight.sum(axis=0), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("scaled", [False, True])
def test_a_stock_network_learns_radiance_beyond_what_a_sigmoid_reaches(scaled):
    r, c = np.mgrid[:6, :12]
    crop = np.repeat((2 + 1.5 * np.sin(0.5 * c) * np.cos(0.4 * r))[..., None], 3, axis=2).astype(np.float32)
    recipe = config.Fit(epochs=400, lr=3e-3)
    size = config.Representation(hidden=32, depth=1)
    params, (low, span) = network.stock(crop, size, recipe, 0, scaled)
    z = network.linear(params, fit.points(size, crop.shape[:2]), size.omega)[0].numpy()
    assert (z.min() > -1.3 and z.max() < 1.3) if scaled else z.max() > 2.5
    assert np.abs(low + span * z.reshape(crop.shape) - crop).mean() < 0.1


@pytest.mark.slow
def test_a_fit_leaves_its_numbers_and_pictures(maps, build, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sets = ["fit.epochs=3", "input.width=16", "representation.hidden=8", "representation.depth=1"]
    for recipe, row in (("configured", "siren"), ("configured", "r-siren"), ("stock", "stock")):
        ((case, job),) = build("figure4" if row == "stock" else "figure5", f"ours-{row}-{OTHER}", sets=sets)
        assert json.loads(case.command[-1]) == {"recipe": recipe}
        folder = tmp_path / row
        folder.mkdir()
        found = network.measure(settings_of(job), folder, recipe)
        assert len(found["noisy"]) == network.NOISE_SEEDS
        original, fitted, noisy = (
            images.read(str(folder / f"{name}.exr"))[0] for name in ("original", "fitted", "noisy")
        )
        assert original.shape == fitted.shape == (4, 16, 3)
        assert 0 < np.abs(noisy - fitted).mean() < 0.1
        if row == "stock":
            continue
        # An edit of the same row finds the fit on disk.
        ((_, edit),) = build("table1", f"ours-{row}-{OTHER}", sets=sets)
        siren_of = representations.make(settings_of(edit), fit.default_folder(), None, (0, 8))
        siren_of.encode(load_map(settings_of(edit).input)[0][:4])
        assert siren_of.fitted.cached and siren_of.fitted.seconds == found["seconds"]


def test_noise_is_the_same_for_every_network_of_one_size():
    one, two = siren.init(0, hidden=32, depth=1), siren.init(1, hidden=32, depth=1)
    moved = [network.perturbed(params, 4) for params in (one, two)]
    for name in one:
        a, b = (m[name].numpy() - p[name].numpy() for m, p in zip(moved, (one, two), strict=True))
        np.testing.assert_allclose(a, b, atol=1e-6)
    steps = moved[0]["1.weight"].numpy() - one["1.weight"].numpy()
    assert abs(steps.std() / network.NOISE - 1) < 0.1  # 1024 draws: 4.5 standard errors
    assert abs(network.perturbed(one, 5)["1.weight"].numpy() - moved[0]["1.weight"].numpy()).max() > 1e-3
