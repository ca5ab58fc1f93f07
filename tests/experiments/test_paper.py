"""The paper's tables and figures: which runs they consist of, and what is drawn of those that are done."""

import hashlib
import json
import math
from argparse import Namespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit import config, representations
from envedit.core import latlong
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import ConfigError, InputError
from envedit.images import images, layered_exr
from envedit.inputs import load_map
from envedit.representations.siren import fit
from envedit.representations.siren import network as siren
from experiments import puresky
from experiments.__main__ import main
from experiments.interiors import experiment as interiors
from experiments.paper import ceiling, measured, network, plan, sheets, skies, tables
from experiments.paper.kinds import KINDS
from experiments.paper.methods import METHODS
from experiments.paper.plan import Question
from experiments.paper.published import COLUMNS, PUBLISHED

PAPER_ROWS = ["pixels", "log-pixels", "siren-no-hdr", "siren", "r-siren", "r-siren-reg"]


@pytest.fixture
def maps(tmp_path):
    """A folder of three maps, whose content nobody reads here."""
    folder = tmp_path / "maps"
    folder.mkdir()
    for name in ("cloudy", "clear", "dusk"):
        (folder / f"{name}_puresky_1k.hdr").write_text(name)
    return folder


def build(name, question, *given, **named):
    """Cells of a table or figure, and their jobs."""
    made = [(case, case.job(question.sets)) for case in plan.build(name, question, *given, **named)]
    return [(plan.cell(*one), one[1]) for one in made]


def settings_of(job):
    return config.loads(job.toml)


def cells_of(made):
    return [cell for cell, _ in made]


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
        ("table1", 6 * 1, 7 * 1),
        ("table2", 7 * 1, 8 * 1),
        ("table3", 7 * 3 * 3, 8 * 3 * 3),
        ("figure4", 4, 5),
        ("figure5", 2, 3),
        ("figure8", 1 * 3, 2 * 3),
        ("figure9", 2, 3),
    ],
)
def test_a_table_is_rows_by_maps_by_roughness(maps, name, paper, ours):
    made = build(name, Question(), maps=maps)
    cells = cells_of(made)
    assert [sum(cell.settings == s for cell in cells) for s in ("paper", "ours")] == [paper, ours]
    assert len({cell.key for cell in cells}) == len(made)  # no two ask the same
    assert (
        len({(c.settings, c.row, c.map, c.roughness) for c in cells})
        == len({job.name for _, job in made})
        == len(made)
    )
    assert all(cell.key == job.key for cell, job in made)


def test_the_paper_s_settings_are_its_own_and_ours_the_standard_preset(maps):
    made = {(c.settings, c.row): settings_of(job) for c, job in build("table1", Question(), maps=maps)}
    assert [row for s, row in made if s == "paper"] == PAPER_ROWS
    assert [row for s, row in made if s == "ours"] == [*PAPER_ROWS, "layers"]
    for (setting, row), found in made.items():
        paper = setting == "paper"
        assert (found.preset, found.renderer.kind) == (
            ("paper", "path") if paper else ("standard", "transport")
        )
        assert found.scene.file == "statue" and found.target.rotate_degrees == 60
        assert found.input.envmap.endswith("cloudy_puresky_1k.hdr") or found.input.envmap.endswith(
            "clear_puresky_1k.hdr"
        )
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


def test_tables_share_the_runs_they_have_in_common(maps):
    def keys(name, *rows, scene=""):
        made = build(name, Question(scene=scene), maps=maps, only=["dusk"], rows=rows)
        return [cell.key for cell in cells_of(made)]

    assert len(keys("table1", "siren", scene="mirror")) == 2
    assert keys("table1", "siren", scene="mirror") == keys("table2", "siren")
    figure4 = build("figure4", Question(), maps=maps, only=["dusk"], rows=["siren"])
    figure5 = build("figure5", Question(), maps=maps, only=["dusk"], rows=["siren"])
    assert cells_of(figure4) == cells_of(figure5)
    # A fit does not depend on the regulariser of its edit, and is found on disk by it: jobs of a map that
    # share one do not stand side by side.
    rows = [cell.row for cell in cells_of(build("table3", Question(), ("paper",), maps))][:6]
    assert rows == ["pixels"] * 3 + ["log-pixels"] * 3


def test_scene_roughness_angle_and_overrides_reach_the_runs(maps, tmp_path):
    question = Question(scene="sphere", angle=140, sets=("fit.epochs=7", "scene.parameters.turn=3"))
    made = build("table3", question, ("ours",), maps, ["dusk"], ["r-siren"])
    found = [settings_of(job) for _, job in made]
    assert [one.scene.parameters for one in found] == [{"roughness": r, "turn": 3} for r in (0, 0.5, 1)]
    assert [cell.roughness for cell in cells_of(made)] == [0, 0.5, 1]
    assert {(one.scene.file, one.target.rotate_degrees, one.fit.epochs) for one in found} == {
        ("sphere", 140, 7)
    }
    assert build("table2", Question(), maps=maps, rows=["siren"])[0][1].toml.count('file = "mirror"') == 1
    (tmp_path / "own.xml").write_text('<scene version="3.0.0"><default name="roughness" value="1"/></scene>')
    (cell, job), *_ = build("table3", Question(scene=str(tmp_path / "own.xml")), maps=maps)
    assert settings_of(job).scene.file == str(tmp_path / "own.xml")
    (_, job), *_ = build("table1", Question(sets=("target.file=other.exr",)), maps=maps)
    assert settings_of(job).target.file.endswith("other.exr")


def test_stock_networks_are_kept_apart_from_recipes(maps):
    cases = plan.build("figure4", Question(), ("ours",), maps)
    kinds = ["stock", "stock-scaled", "fits", "fits", "fits"]
    assert [case.command for case in cases] == [network.command(kind) for kind in kinds]
    assert [case.version for case in cases] == [network.version(kind) for kind in kinds]
    assert {cell.fitted for cell in cells_of(build("figure4", Question(), ("ours",), maps))} == {True}
    made = {cell.row: settings_of(job).fit for cell, job in build("figure4", Question(), ("ours",), maps)}
    assert made["siren"].polish == "never" and made["siren-polished"].polish == "always"
    assert made["siren"].awp_gamma == 0 and made["siren-no-hdr"].hdr == 0
    assert network.command("stock")[-3:] == ("stock", "{folder}", "{threads}")


def content_of(folder):
    """A function of a map's name: what tells its file's content."""
    return lambda name: hashlib.sha256((folder / f"{name}_puresky_1k.exr").read_bytes()).hexdigest()[:8]


def test_figure_8_has_another_map_for_its_target_turned_where_there_is_one(maps, tmp_path):
    def target(**question):
        made = build("figure8", Question(**question), maps=maps, only=["dusk"], out=tmp_path)
        return settings_of(made[0][1]).target

    assert target().file == "" and target().rotate_degrees == 60
    sky, content = np.random.default_rng(0).random((8, 16, 3), np.float32), content_of(maps)
    for name in ("dawn", skies.OTHER):
        images.write_exr(maps / f"{name}_puresky_1k.exr", sky)
    assert target().file == str(
        tmp_path / "maps" / f"{skies.OTHER}_puresky_1k-turned-60-{content(skies.OTHER)}.exr"
    )
    assert plan.resolved("figure8", Question(), maps, ["dusk"]).target == skies.OTHER
    assert plan.resolved("figure8", Question(), maps, [skies.OTHER]).target == ""
    assert plan.resolved("table1", Question(), maps) == Question()
    found = target(target="dawn", angle=90)
    assert found.file == str(tmp_path / "maps" / f"dawn_puresky_1k-turned-90-{content('dawn')}.exr")
    assert found.rotate_degrees == "auto"
    np.testing.assert_array_equal(images.read(found.file)[0], np.roll(sky, -4, axis=1))
    with pytest.raises(ConfigError, match="--target: no map dusky; did you mean dusk"):
        target(target="dusky")
    with pytest.raises(ConfigError, match="--angle"):
        build("table1", Question(target="dusk"), maps=maps)


def test_figure_9_is_a_shipped_edit_and_has_dists_where_weights_are_named(maps):
    weights = ("perceptual.vgg=vgg.npz", "perceptual.dists=dists.npz")
    made = {(c.settings, c.row): settings_of(j) for c, j in build("figure9", Question(sets=weights))}
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
    assert "lum-l1-dists" not in {cell.row for cell in cells_of(build("figure9", Question()))}
    (_, job), *_ = build("figure9", Question(edit="warmer"), maps=maps, only=["dusk"])
    assert "temperature" in job.toml and settings_of(job).input.envmap.endswith("dusk_puresky_1k.hdr")
    with pytest.raises(ConfigError, match="--edit: no edit colder; there are add_reflection"):
        build("figure9", Question(edit="colder"))


@pytest.mark.parametrize(
    ("name", "question", "given", "words"),
    [
        ("table3", {"scene": "mirror"}, {}, r'scene mirror: no <default name="roughness"'),
        ("table3", {"scene": "statu"}, {}, "did you mean statue"),
        ("figure4", {"scene": "statue"}, {}, "figure4 has none"),
        ("table1", {}, {"rows": ["siren-reg"]}, "table1 has no row siren-reg; it has pixels,"),
        ("table1", {}, {"only": ["dawn"]}, "--maps: no map dawn; there are clear, cloudy, dusk"),
        ("table1", {}, {"only": ["claer"]}, "did you mean clear"),
        ("table1", {"sets": ("fit.epocs=3",)}, {}, "did you mean epochs"),
    ],
)
def test_what_cannot_be_asked_is_an_error_on_one_line(maps, name, question, given, words):
    with pytest.raises((ConfigError, InputError), match=words) as info:
        build(name, Question(**question), maps=maps, **given)
    assert len(str(info.value).splitlines()) == 1


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
    assert list(skies.choose(found, None, True)) == ["a_b", "b"]
    assert list(skies.choose(found, None, False)) == ["a_b"]
    assert list(skies.choose({"z": 1, skies.DEFAULT: 2}, None, False)) == [skies.DEFAULT]
    assert list(skies.choose(found, ["b", "a_b", "b"], False)) == ["b", "a_b"]
    assert list(skies.choose(found, ["all"], False)) == ["a_b", "b"]


def test_without_maps_an_error_says_where_they_come_from(tmp_path, monkeypatch):
    monkeypatch.delenv("ENVEDIT_DATA", raising=False)
    with pytest.raises(ConfigError, match="^no maps: set ENVEDIT_DATA .* experiments.download_puresky"):
        puresky.find()
    with pytest.raises(ConfigError, match="^no maps: give --folder DIR, or set ENVEDIT_DATA"):
        build("table1", Question())
    with pytest.raises(SystemExit, match="^envedit: no maps: set ENVEDIT_DATA"):
        puresky.of_script()
    with pytest.raises(ConfigError, match="^no maps: set ENVEDIT_DATA .* hdri/NAME_1k.hdr"):
        interiors.EXPERIMENT.cases(Namespace(out=tmp_path))
    with pytest.raises(InputError, match="nowhere: no such folder of maps"):
        puresky.find(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no map NAME_puresky_1k"):
        puresky.find(tmp_path)
    assert build("figure9", Question())  # needs none


# ---- the command line --------------------------------------------------------------------------------------


def test_usage(maps, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    ask = ["paper", "run", "table1", "--folder", str(maps), "--settings", "ours", *out]
    assert main([*ask, "--rows", "pixels", "layers", "--dry-run"]) == 0 and not (tmp_path / "out").exists()
    assert "2 jobs: 2 missing" in capsys.readouterr().out
    assert main(["paper", "table", *ask[2:]]) == 0
    kept = (tmp_path / "out" / "table1.md").read_text()
    assert capsys.readouterr().out == kept and kept.startswith("## Table 1") and "0/1" in kept
    (tmp_path / "file").touch()
    for wrong, code in (
        (["--folder", str(tmp_path / "no")], 3),
        (["--set", "fit.epochs"], 2),
        (["--maps", "dsk"], 2),
        (["--out", str(tmp_path / "file" / "out")], 3),
    ):
        assert main([*ask, *wrong]) == code
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1 and said[0].startswith("paper: ")
    for wrong in (
        ["table4"],
        ["table1", "--workers", "0"],
        ["table1", "--workers", "2", "--scheduler", "a:1"],
    ):
        with pytest.raises(SystemExit) as info:
            main(["paper", "run", *wrong])
        assert info.value.code == 2


# ---- tables and pictures of what is done -------------------------------------------------------------------

RED, GREEN, BLUE, YELLOW = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)
SOME = {"psnr": 20.0, "ssim": 0.5, "mse": 0.01, "lpips": None}


def finish(out, made, row, sky=None, *, color=RED, numbers=SOME, fit_s=None, cached=False, roughness=None,
           seconds=840.0, resumed=False):  # fmt: skip
    """Make up what a run of the command line leaves, as far as tables and sheets read it."""
    places = [
        (cell, job)
        for cell, job in made
        if cell.row == row and sky in (None, cell.map) and cell.roughness == roughness
    ]
    for cell, job in places:
        folder = cell.folder(out)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / "config.toml", job.toml.encode())
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
            "natural": {"colours_outside": 0.25, "seam": 1.0, "high_frequency": 0.9},
        }
        write_atomically(folder / "metrics.json", json.dumps(about).encode())
        write_atomically(folder / "done.json", json.dumps({"resumed": resumed}).encode())
    return len(places)


def row_of(text, title):
    lines = [line for line in text.splitlines() if line.startswith(f"| {title} |")]
    return [[part.strip() for part in line.strip("|").split("|")][1:] for line in lines]


def test_a_table_has_a_row_for_each_method_also_for_those_that_are_missing(maps, tmp_path):
    made = build("table1", Question(), ("paper",), maps)
    assert finish(tmp_path, made, "r-siren", numbers={**SOME, "psnr": 14.125, "lpips": 0.4}) == 1
    finish(tmp_path, made, "pixels", numbers={**SOME, "psnr": 13.0, "mse": 0.002})
    text = tables.text("table1", tmp_path, cells_of(made))
    assert text.splitlines()[2] == "The paper's settings, clear:"
    assert [len(line.split("|")) for line in text.splitlines()[4:]] == [14] * 9
    assert row_of(text, "R-SIREN HDR") == [
        ["**14.12** (14.59)", "0.400 (0.557)", "0.01000 (0.03478)", "**0.500** (0.554)"]
        + ["**34.12** (39.96)", "0.400 (0.058)", "0.01000 (0.00010)", "**0.500** (0.991)"]
        + ["-", "30", "1/1"]
    ]
    (pixels,) = row_of(text, "Pixels")
    assert pixels[:3] == ["13.00 (8.92)", "- (0.638)", "**0.00200** (0.12825)"]
    (siren,) = row_of(text, "SIREN HDR")
    assert siren == [
        f"- ({v})" for v in ("14.56", "0.621", "0.03496", "0.345", "46.38", "0.053", "0.00002", "0.993")
    ] + [
        "-",
        "-",
        "0/1",
    ]
    (unedited,) = row_of(text, "unedited")
    assert unedited == ["9.00", "-", "0.01000", "0.500", "12.00", "-", "0.01000", "0.500", "-", "-", "1/1"]


def test_averages_are_over_maps_and_say_how_many(maps, tmp_path):
    made = build("table3", Question(), ("ours",), maps)
    for sky, psnr in (("clear", 10.0), ("cloudy", 30.0)):
        finish(tmp_path, made, "layers", sky, numbers={**SOME, "psnr": psnr}, roughness=0.5)
    for sky in ("clear", "cloudy", "dusk"):
        some = {**SOME, "psnr": 11.0, "lpips": None if sky == "dusk" else 0.1}
        finish(tmp_path, made, "siren", sky, numbers=some, roughness=0.5)
        finish(tmp_path, made, "pixels", sky, numbers=SOME, roughness=0.5)
    text = tables.text("table3", tmp_path, cells_of(made))
    heads = [line for line in text.splitlines() if line.startswith("Our settings")]
    ends = ("0, 3 maps:", "0.5, 3 maps, averages over 2 of them:", "1, 3 maps:")
    assert heads == [f"Our settings, roughness {end}" for end in ends]
    layers = row_of(text, "Layers (ours)")
    assert [row[-1] for row in layers] == ["0/3", "2/3", "0/3"]
    assert layers[1][0] == "**20.00**" and layers[0][0] == "-"
    assert row_of(text, "Pixels")[1][0] == "**20.00** (9.51)"
    assert row_of(text, "SIREN HDR")[1][:2] == ["11.00", "0.100"]  # dusk is not among them
    assert row_of(text, "unedited")[1][-1] == "2/3"
    made = [one for one in made if one[0].row != "layers"]
    text = tables.text("table3", tmp_path, cells_of(made))
    assert row_of(text, "SIREN HDR")[1][:2] == ["11.00", "-"]  # an LPIPS of two maps of three is none
    assert row_of(text, "unedited")[1][-1] == "3/3"


def test_the_seconds_of_a_fit_are_those_of_the_run_that_made_it(maps, tmp_path):
    made = build("table3", Question(), ("paper",), maps, ["dusk"])
    finish(tmp_path, made, "r-siren", fit_s=840.0, roughness=0.0)
    finish(tmp_path, made, "r-siren-reg", fit_s=1.0, cached=True, roughness=1.0)
    finish(tmp_path, made, "pixels", roughness=1.0, resumed=True)
    found = {cell.row: times for cell, times in measured.seconds(tmp_path, cells_of(made)).items()}
    assert found["r-siren"] == (840, 30)
    assert found["r-siren-reg"][0] == 840 and abs(found["r-siren-reg"][1] - 30) < 1e-9
    assert found["pixels"][0] is None and math.isnan(found["pixels"][1]), "a part of its time is not known"
    text = tables.text("table3", tmp_path, cells_of(made))
    assert row_of(text, "R-SIREN HDR + L_reg")[2][-3:] == ["840", "30", "1/1"]
    assert row_of(text, "Pixels")[2][-3:] == ["-", "-", "1/1"]


def drawn(file):
    return np.array(mi.Bitmap(str(file)))[..., :3]


def share(picture, color, near=12):
    """Share of a picture's pixels that have a colour."""
    return float((np.abs(picture.astype(int) - np.multiply(color, 255)).max(axis=-1) <= near).mean())


def test_a_sheet_shows_what_is_done_and_leaves_room_for_the_rest(maps, tmp_path):
    made = build("table1", Question(), ("ours",), maps)
    finish(tmp_path, made, "pixels", color=RED)
    finish(tmp_path, made, "layers", color=BLUE)
    (file,) = sheets.draw("table1", tmp_path, cells_of(made), tmp_path)
    assert file.name == "table1-ours.png"
    picture = drawn(file)
    tall, wide = picture.shape[:2]
    columns = np.arange(wide)
    red = columns[(picture == (255, 0, 0)).all(axis=-1).any(axis=0)]
    blue = columns[(picture == (0, 0, 255)).all(axis=-1).any(axis=0)]
    # Nine columns: initial, target, seven methods, of which the first and the last are done.
    assert 2 / 9 - 0.03 < red.min() / wide < red.max() / wide < 3 / 9 + 0.03
    assert blue.min() / wide > 8 / 9 - 0.03
    assert share(picture, (0.93, 0.93, 0.93)) > 0.35  # five of nine
    grey = 0.7 ** (1 / 2.2)
    assert share(picture[:, red.min() : red.max()], (grey,) * 3) > 0.5  # the rendering, under the map


def test_the_true_map_is_the_map_turned_or_the_other_one(maps, tmp_path):
    made = build("table1", Question(angle=90), ("ours",), maps, rows=["layers"])
    finish(tmp_path, made, "layers")
    ((cell, job),) = made
    ramp = np.broadcast_to(np.arange(16, dtype=np.float32)[None, :, None], (8, 16, 3))
    layered_exr.write(cell.folder(tmp_path) / "edited_layers.exr", {"edited": ramp, "initial": ramp.copy()})
    found = measured.pictures(tmp_path, cell)
    assert found["initial_map"].shape == (4, 16, 3)
    np.testing.assert_array_equal(found["true_map"], latlong.rotate(ramp, 90)[:4])
    other = tmp_path / "other.exr"
    images.write_exr(other, np.full((8, 16, 3), 3, np.float32))
    changed = job.toml.replace(
        '[target]\nkind = "envmap"\nfile = ""', f'[target]\nkind = "envmap"\nfile = "{other}"'
    )
    (cell.folder(tmp_path) / "config.toml").write_text(
        changed.replace("rotate_degrees = 90.0", "rotate_degrees = 0.0").replace(
            "width = 256", "width = 16", 1
        )
    )
    assert (measured.pictures(tmp_path, cell)["true_map"] == 3).all()
    other.unlink()
    assert measured.pictures(tmp_path, cell)["true_map"] is None


@pytest.mark.slow
def test_every_table_and_figure_is_drawn_and_printed(maps, tmp_path, capsys):
    out = tmp_path / "out"
    for name in KINDS:
        made = build(name, Question(), ("ours",), maps, None if name == "figure9" else ["dusk"])
        if name in ("figure4", "figure5"):
            for cell, _ in made[:-1]:
                folder = cell.folder(out)
                folder.mkdir(parents=True, exist_ok=True)
                for i, file in enumerate(("original", "fitted", "noisy")):
                    images.write_exr(folder / f"{file}.exr", np.full((4, 16, 3), 10.0**i, np.float32))
                text = {"log_psnr": 40.0, "peak_ratio": None, "mean_ratio": 0.5, "noisy": [30.0, 20.0]}
                (folder / "fit.json").write_text(json.dumps({**text, "seconds": 9.0, "epochs": 3}))
                (folder / "done.json").touch()
        else:
            for cell, _ in made[:-1]:
                finish(out, made, cell.row, roughness=cell.roughness, color=YELLOW)
        capsys.readouterr()
        ask = [
            name,
            "--settings",
            "ours",
            "--folder",
            str(maps),
            "--out",
            str(out),
            "--to",
            str(tmp_path / "to"),
        ]
        ask += [] if name == "figure9" else ["--maps", "dusk"]
        assert main(["paper", "table", *ask]) == 0
        kept = (tmp_path / "to" / f"{name}.md").read_text()
        assert capsys.readouterr().out == kept and kept.startswith(f"## {KINDS[name].title}\n")
        assert "0/1" in kept and "1/1" in kept and "| nan" not in kept
        assert main(["paper", "sheet", *ask]) == 0
        files = [line.rsplit("/", 1)[1] for line in capsys.readouterr().out.splitlines()]
        parts = [f"-roughness{r}" for r in ("0", "0.5", "1")] + ["-bars"] if name == "table3" else [""]
        assert files == [f"{name}-ours{part}.png" for part in parts]
        for file in files[:1]:
            assert drawn(tmp_path / "to" / file).std() > 5
    assert row_of((tmp_path / "to" / "figure4.md").read_text(), "SIREN HDR") == [
        ["40.0", "-", "0.500", "25.0", "9", "1/1"]
    ]
    assert row_of((tmp_path / "to" / "figure9.md").read_text(), "R-SIREN HDR")[0][:3] == ["80 %", "90 %", "-"]


def test_where_nothing_is_done_nothing_is_drawn(maps, tmp_path):
    made = build("figure8", Question(), maps=maps)
    assert sheets.draw("figure8", tmp_path, cells_of(made), tmp_path) == []
    assert row_of(tables.text("figure8", tmp_path, cells_of(made)), "unedited")[0][-1] == "0/1"


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


def test_a_fit_leaves_its_numbers_and_pictures(maps, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sky = tmp_path / "maps" / "dusk_puresky_1k.exr"
    (maps / "dusk_puresky_1k.hdr").unlink()
    images.write_exr(sky, np.random.default_rng(0).random((16, 32, 3), np.float32) + 0.1)
    sets = ("fit.epochs=3", "input.width=32", "representation.hidden=8", "representation.depth=1")
    made = build("figure5", Question(sets=sets), ("ours",), maps, ["dusk"])
    for cell, job in made[:2]:
        folder = cell.folder(tmp_path)
        folder.mkdir(parents=True)
        (folder / "job.toml").write_text(job.toml)
        assert network.main(["fits", str(folder), str(dr.thread_count())]) == 0
        found = json.loads((folder / "fit.json").read_text())
        assert found["epochs"] == 3 and len(found["noisy"]) == network.NOISE_SEEDS
        original, fitted, noisy = (
            images.read(str(folder / f"{name}.exr"))[0] for name in ("original", "fitted", "noisy")
        )
        assert original.shape == fitted.shape == (8, 32, 3)
        assert 0 < np.abs(noisy - fitted).mean() < 0.1
        # An edit of the same row finds the fit on disk.
        (_, edit), *_ = build("table1", Question(sets=sets), ("ours",), maps, ["dusk"], [cell.row])
        siren_of = representations.make(settings_of(edit), fit.default_folder(), None, (0, 16))
        siren_of.encode(load_map(settings_of(edit).input)[0][:8])
        assert siren_of.fitted.cached and siren_of.fitted.seconds == found["seconds"]
    (tmp_path / "bad").mkdir()
    assert network.main(["fits", str(tmp_path / "bad"), str(dr.thread_count())]) == 2


def test_noise_is_the_same_for_every_network_of_one_size():
    one, two = siren.init(0, hidden=32, depth=1), siren.init(1, hidden=32, depth=1)
    moved = [network.perturbed(params, 4) for params in (one, two)]
    for name in one:
        a, b = (m[name].numpy() - p[name].numpy() for m, p in zip(moved, (one, two), strict=True))
        np.testing.assert_allclose(a, b, atol=1e-6)
    steps = moved[0]["1.weight"].numpy() - one["1.weight"].numpy()
    assert abs(steps.std() / network.NOISE - 1) < 0.1  # 1024 draws: 4.5 standard errors
    assert abs(network.perturbed(one, 5)["1.weight"].numpy() - moved[0]["1.weight"].numpy()).max() > 1e-3


def test_titles_are_words():
    assert {METHODS[row].title for row in KINDS["table3"].rows} >= {
        "Pixels",
        "Log(Pixels)",
        "R-SIREN HDR + L_reg",
    }


# ---- what the true map itself scores -----------------------------------------------------------------------


@pytest.mark.slow
def test_the_ceiling_is_the_noise_of_two_renderings(tmp_path, capsys):
    sun = np.full((8, 16, 3), 0.2, np.float32)
    sun[2, 5] = 2000.0
    for name, content in (("clear", sun), ("grey", np.full((8, 16, 3), 0.4, np.float32)), ("night", 0 * sun)):
        images.write_exr(tmp_path / f"{name}_puresky_1k.exr", content)
    few = ["--folder", str(tmp_path), "--width", "16", "--roughness", "0", "1"]
    assert ceiling.main([*few, "--maps", "clear", "grey"]) == 0
    head, _, clear, grey, mean = capsys.readouterr().out.splitlines()
    assert head == "| map | roughness 0 | roughness 1 |" and mean.startswith("| **mean of 2** |")
    psnr = {
        line: [float(cell.split("/")[0]) for cell in line.split("|")[2:4]] for line in (clear, grey, mean)
    }
    assert all(20 < value < 80 for values in psnr.values() for value in values)
    assert psnr[clear][0] < psnr[grey][0]  # caustics of the sun
    np.testing.assert_allclose(psnr[mean], np.mean([psnr[clear], psnr[grey]], axis=0), atol=0.011)
    assert ceiling.main([*few, "--maps", "night"]) == 0
    assert "| night | 200.00 / 1.000 | 200.00 / 1.000 |" in capsys.readouterr().out
    assert ceiling.main([*few, "--maps", "claer"]) == 2
    assert capsys.readouterr().err == "envedit: --maps: no map claer; did you mean clear?\n"
