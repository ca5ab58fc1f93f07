"""The files a run leaves: read back with other readers, damaged on purpose, and looked at in numbers."""

import ast
import csv
import hashlib
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envedit import report
from envedit.errors import InputError

BAD = [np.nan, np.inf, -np.inf]


def grey(value, height=8, width=16):
    return np.full((height, width, 3), value, np.float32)


def read_png(path):
    return np.array(mi.Bitmap(str(path)))


# ------------------------------------------------------------------------------------------------ files


def test_history_reads_back_with_holes_for_what_is_not_finite(tmp_path):
    rows = [
        {"iteration": 0, "loss": np.float32(0.1), "ssim": 1e-30},
        {"iteration": np.int64(1), "loss": np.nan, "l1": None},
        {"iteration": 2, "loss": np.inf, "ssim": 65504.0},
    ]
    lost = report.write_history(tmp_path / "history.csv", rows)
    assert lost == ["[1].loss", "[2].loss"]
    with open(tmp_path / "history.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ["iteration", "loss", "ssim", "l1"]
    assert [row["loss"] for row in read] == ["0.1", "", ""]
    assert [row["ssim"] for row in read] == ["1e-30", "", "65504.0"]
    assert [row["l1"] for row in read] == ["", "", ""]


def test_empty_history_is_a_header(tmp_path):
    assert report.write_history(tmp_path / "history.csv", []) == []
    assert (tmp_path / "history.csv").read_text() == "iteration\n"


def test_metrics_are_finite_or_null(tmp_path):
    metrics = {
        "render": {"psnr": np.float32(38.7), "ssim": np.nan, "lpips": None},
        "iterations": np.int32(7),
        "cached": np.bool_(True),
        "active_rows": (0, np.uint8(63)),
        "trace": np.array([1.0, np.inf], np.float32),
        "file": Path("a") / "ö.exr",
    }
    lost = report.write_metrics(tmp_path / "metrics.json", metrics)
    assert lost == ["render.ssim", "trace[1]"]

    def refuse(name):
        raise AssertionError(f"{name} in metrics.json")

    read = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=refuse)
    assert read["render"] == {"psnr": 38.7, "ssim": None, "lpips": None}
    assert read["iterations"] == 7 and read["cached"] is True and read["active_rows"] == [0, 63]
    assert read["trace"] == [1.0, None] and read["file"] == str(Path("a") / "ö.exr")
    assert list(read) == list(metrics)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "metrics.json"
    report.write_metrics(path, {"a": 1})
    with pytest.raises(TypeError, match=r"b\[1\].c: object cannot be written"):
        report.write_metrics(path, {"b": [0, {"c": object()}]})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]


def test_interrupted_move_leaves_no_partial_file(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report.os, "replace", full)
    with pytest.raises(InputError, match=r"metrics.json: cannot be written \(No space left on device\)"):
        report.write_metrics(tmp_path / "metrics.json", {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("folder", ["missing", "file"])
def test_unwritable_place_is_named(tmp_path, folder):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(InputError, match=rf"{folder}.*history.csv: cannot be written"):
        report.write_history(tmp_path / folder / "history.csv", [])


# --------------------------------------------------------------------------------------------- pictures


def test_shrinking_averages_areas_and_enlarging_repeats_texels(rng):
    image = rng.random((12, 18, 3), np.float32)
    blocks = image.reshape(4, 3, 6, 3, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(report._fit(image, 4, 6), blocks, rtol=1e-6)
    np.testing.assert_array_equal(report._fit(image, 24, 54), image.repeat(2, axis=0).repeat(3, axis=1))
    # 5 to 3: the first output covers texel 0 and two thirds of texel 1.
    ramp = np.arange(5, dtype=np.float32).reshape(1, 5, 1)
    np.testing.assert_allclose(report._fit(ramp, 1, 3)[0, :, 0], [0.4, 2.0, 3.6], rtol=1e-6)


def test_preview_places_tonemapped_renderings_above_their_maps(tmp_path):
    renders = {"initial": grey(0.25, 320, 320), "target": grey(0.5, 320, 320), "edited": grey(7.0, 320, 320)}
    maps = {"initial": grey(1e-30), "target": None, "edited": grey(0.125)}
    report.preview(tmp_path / "preview.png", renders, maps, exposure=1.0)
    png, gap = read_png(tmp_path / "preview.png"), report.GAP
    top = gap + 14 + gap  # a margin and the label, 7 dots at scale 2
    assert png.shape == (top + 320 + gap + 160 + gap, gap + 3 * (320 + gap), 3)
    centres = [gap + 160 + i * (320 + gap) for i in range(3)]
    # round(255 * E^(1/2.2)): 0.25 -> 135.8, 0.5 -> 186.1, the map 0.125 exposed by a stop as 0.25
    assert [png[top + 160, x].tolist() for x in centres] == [[136] * 3, [186] * 3, [255] * 3]
    maps_row = [png[top + 320 + gap + 80, x].tolist() for x in centres]
    assert maps_row == [[0] * 3, list(report.PLACEHOLDER), [136] * 3]
    assert (png[gap : gap + 14, gap : gap + 320] == report.INK).all(axis=2).any(), "label"
    report.preview(tmp_path / "bare.png", renders, maps, labels=False)
    assert read_png(tmp_path / "bare.png").shape[0] == png.shape[0] - 14 - gap


@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (4096, 1), (3, 5), (64, 64), (100, 1500)])
def test_preview_takes_any_size(tmp_path, shape):
    report.preview(tmp_path / "p.png", {"a": np.ones((*shape, 3), np.float32)}, {"a": grey(0.0, 1, 1)})
    height, width, _ = read_png(tmp_path / "p.png").shape
    assert 214 <= width <= 800 and height <= 4 * 800


def test_preview_shows_what_is_not_finite(tmp_path):
    image = grey(1.0, 64, 64)
    image[10, 20, 1], image[30, 40] = np.nan, -np.inf
    for widest in (64, 700):  # shown larger, and shrunk so that the texel shares its pixel with others
        image = image if widest == 64 else np.pad(image, ((0, 1500), (0, 1500), (0, 0)))
        report.preview(tmp_path / "p.png", {"a": image}, {})
        png = read_png(tmp_path / "p.png")
        assert (png == report.NOT_FINITE).all(axis=2).sum() >= 2


def test_preview_with_labels_of_any_text(tmp_path):
    names = ["x" * 500, "zażółć ☀ \n\0 \udcff", "", "edited"]
    report.preview(tmp_path / "p.png", {name: grey(0.5) for name in names}, {})
    assert read_png(tmp_path / "p.png").ndim == 3


def test_label_is_drawn_dot_by_dot_and_cut_to_its_width():
    drawn = ["".join(".#"[int(dot)] for dot in row) for row in report._text("il", 12, 1)]
    assert drawn == [
        ".###..#.....",
        "..#...#.....",
        "..#...#.....",
        "..#...#.....",
        "..#...#.....",
        "..#...#.....",
        ".###..#####.",
    ]
    doubled = report._text("il", 24, 2)
    np.testing.assert_array_equal(doubled[::2, ::2], report._text("il", 12, 1))
    np.testing.assert_array_equal(report._text("illusion", 24, 1), report._text("il..", 24, 1))


def test_wrong_pictures_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"'a' has shape \(4, 4\), wanted \(H, W, 3\)"):
        report.preview(tmp_path / "p.png", {"a": np.zeros((4, 4))}, {})
    with pytest.raises(InputError, match="no picture"):
        report.preview(tmp_path / "p.png", {}, {"a": None})
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------ differences


def test_difference_is_red_where_brighter_blue_where_darker_white_where_equal():
    b = grey(0.5, 3, 4)
    a = b.copy()
    a[0], a[1] = 1.0, 0.0
    pixels, scale = report.difference_image(a, b)
    assert scale == 1.0  # 0.5^(1/2.2) = 0.73, rounded up
    assert pixels[2, 0].tolist() == [247, 247, 247]
    assert pixels[0, 0, 0] > pixels[0, 0, 2] and pixels[1, 0, 2] > pixels[1, 0, 0]


def test_stops_read_the_ratio_even_of_a_sun():
    b = grey(1.0, 8, 8)
    b[0, 0] = 65504.0
    a = b * 2
    pixels, scale = report.difference_image(a, b, "stops", scale=1.0)
    assert scale == 1.0
    # log2((2 + 1e-3) / (1 + 1e-3)) = 0.9993 stops: full red to a unit in the last place
    assert np.abs(pixels.astype(int) - [178, 24, 43]).max() <= 1
    assert report.difference_image(a, b, "stops")[1] == 1.0


@pytest.mark.parametrize("kind", ["tonemapped", "stops"])
@pytest.mark.parametrize("value", [0.0, 1e-30, 1.0, 65504.0, 1e6, 3e38])
def test_equal_pictures_have_no_difference(kind, value):
    pixels, scale = report.difference_image(grey(value), grey(value), kind)
    assert (pixels == 247).all() and 0 < scale <= 0.1


@pytest.mark.parametrize("bad", BAD)
def test_difference_marks_what_is_not_finite(bad):
    a, b = grey(1.0), grey(1.0)
    a[1, 2, 0] = bad
    for kind in ("tonemapped", "stops"):
        pixels, _ = report.difference_image(a, b, kind)
        assert np.argwhere((pixels == report.NOT_FINITE).all(axis=2)).tolist() == [[1, 2]]
    pixels, _ = report.difference_image(grey(bad), b)
    assert (pixels == report.NOT_FINITE).all()


def test_difference_refuses_other_shapes_and_kinds():
    with pytest.raises(InputError, match=r"\(8, 16, 3\) from one of \(1, 1, 3\)"):
        report.difference_image(grey(1, 1, 1), grey(1))
    with pytest.raises(ValueError, match="'ratio' is neither"):
        report.difference_image(grey(1), grey(1), "ratio")


@pytest.mark.parametrize("value, rounded", [(0.01, 0.01), (0.011, 0.02), (3, 5), (5.1, 10), (1e-20, 1e-20)])
def test_scales_are_round(value, rounded):
    assert report._round_up(value) == pytest.approx(rounded, rel=1e-12)


# ----------------------------------------------------------------------------------------------- curves


def points_of(svg, name):
    """Pen moves (M or L, x, y) of a curve, found by the colour that the legend gives its name."""
    children = list(ElementTree.fromstring(svg))
    legend = {
        text.text.rsplit(" ", 1)[0]: mark.get("fill")
        for mark, text in zip(children, children[1:], strict=False)
        if mark.tag == "rect"
    }
    path = next(e.get("d") for e in children if e.tag == "path" and e.get("stroke") == legend[name])
    pen = path.replace("h0", "").replace("L", " L").replace("M", " M").split()
    return [(p[0], float(p[1:]), float(y)) for p, y in zip(pen[::2], pen[1::2], strict=True)]


def test_curve_is_straight_for_a_geometric_series():
    rows = [{"iteration": 10 * i, "loss": 0.5**i, "ssim": 0.25 * 0.5**i, "lr": 1e-4} for i in range(9)]
    points = points_of(report.curves_svg(rows), "loss")
    steps = np.diff([(x, y) for _, x, y in points], axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps.mean(axis=0), steps.shape), atol=0.11)
    assert (steps > 0).all(), "to the right, and down the page"
    lower = points_of(report.curves_svg(rows), "ssim")
    assert lower[0][2] == pytest.approx(points[2][2], abs=0.11), "0.25 stands where 0.5^2 does"
    assert "lr" not in report.curves_svg(rows)


def test_curve_is_interrupted_where_there_is_no_value():
    values = [1.0, 0.5, np.nan, 0.25, None, 0.0, -1.0, 0.2, np.inf, "text", 0.1]
    svg = report.curves_svg([{"iteration": i, "loss": v} for i, v in enumerate(values)])
    assert [move for move, _, _ in points_of(svg, "loss")] == ["M", "L", "M", "M", "M"]


@pytest.mark.parametrize("row", [{}, {"loss": None}, {"loss": np.nan}, {"loss": 0.0}, {"lr": 1.0}])
def test_nothing_to_draw_is_an_empty_string(row):
    assert report.curves_svg([row]) == "" == report.curves_svg([])


def test_long_history_stays_small_and_keeps_its_spike():
    rows = [{"iteration": i, "loss": 1.0} for i in range(100_000)]
    rows[54_321]["loss"] = 100.0
    svg = report.curves_svg(rows)
    assert len(svg) < 60_000
    points = points_of(svg, "loss")
    assert min(y for _, _, y in points) < points[0][2] - 200


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.dictionaries(
            st.sampled_from(["loss", "a<b>&\"'", "\0\x1b", "long" * 9, "lr"]),
            st.one_of(st.none(), st.floats(), st.integers(), st.text(max_size=3), st.booleans()),
        ),
        max_size=8,
    )
)
def test_any_history_makes_a_well_formed_drawing(rows):
    svg = report.curves_svg(rows)
    if svg:
        root = ElementTree.fromstring(svg)
        drawn = " ".join(" ".join(element.attrib.values()) for element in root.iter())
        assert not re.search(r"\d?(nan|inf)\b", drawn)


@pytest.mark.parametrize(
    "low, high, labels",
    [
        (-3, 0, ["0.001", "0.01", "0.1", "1"]),
        (-5.2, -3.9, ["1e-5", "1e-4"]),
        (np.log10(0.39), np.log10(0.41), ["0.39", "0.395", "0.4", "0.405", "0.41"]),
        (-30.0, -18.0, [f"1e{d}" for d in range(-30, -17, 2)]),
    ],
)
def test_log_axis_has_readable_ticks(low, high, labels):
    ticks = report._log_ticks(low, high)
    assert [label for _, label in ticks] == labels
    positions = [position for position, _ in ticks]
    np.testing.assert_allclose(positions, np.log10([float(label) for label in labels]), atol=1e-9)


# --------------------------------------------------------------------------------------------- manifest


def test_manifest_names_what_explains_a_run(tmp_path):
    (tmp_path / "abc.exr").write_bytes(b"abc")
    inputs = {"envmap": "abc.exr", "mask": None, "scene": "gone.xml", "folder": "."}
    inputs = {role: name and tmp_path / name for role, name in inputs.items()}
    found = report.manifest({"seed": 3, "preset": "draft"}, inputs, "llvm_ad_rgb")
    # FIPS 180-2, appendix B.1
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert found["inputs"]["envmap"] == {"path": str(tmp_path / "abc.exr"), "bytes": 3, "sha256": digest}
    assert "mask" not in found["inputs"]
    assert found["inputs"]["scene"]["sha256"] is None and "gone.xml" in found["inputs"]["scene"]["error"]
    assert found["inputs"]["folder"]["sha256"] is None
    assert found["seeds"] == {"seed": 3} and found["config"]["preset"] == "draft"
    assert found["versions"]["mitsuba"] == mi.__version__ and found["versions"]["numpy"] == np.__version__
    assert found["time_utc"].endswith("+00:00") and found["cores"]["usable"] >= 1
    assert int(found["llvm"]["version"].split(".")[0]) >= 17
    assert report.write_manifest(tmp_path / "manifest.json", found) == []
    assert json.loads((tmp_path / "manifest.json").read_text()) == found


def test_commit_is_that_of_the_packages_own_checkout(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    assert report._commit(tmp_path) is None, "no checkout"
    git("init", "-q")
    assert report._commit(tmp_path) is None, "no commit yet"
    (tmp_path / "file").write_text("1")
    git("add", "file")
    git("commit", "-q", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert report._commit(tmp_path) == head
    (tmp_path / "file").write_text("2")
    assert report._commit(tmp_path) == f"{head}-dirty"
    (tmp_path / "inside").mkdir()
    assert report._commit(tmp_path / "inside") is None, "installed inside somebody else's repository"
    monkeypatch.setenv("PATH", "")
    assert report._commit(tmp_path) is None, "no git"


# ----------------------------------------------------------------------------------------------- report


class Page(HTMLParser):
    """Collects text and attributes, and checks that elements close in order."""

    VOID = {"meta", "img"}

    def __init__(self, path):
        super().__init__()
        self.open, self.tags, self.links, self.words, self.classes = [], [], [], [], []
        self.feed(Path(path).read_text(encoding="utf-8"))
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "data")]
        self.classes += [value for name, value in attrs if name == "class"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words.append(data)


def write(path, **changes):
    settings = {
        "title": "sphere",
        "config_toml": 'preset = "standard"\n',
        "metrics": {
            "render": {"psnr": 38.71, "ssim": 0.98, "mse": 1e-4, "lpips": None},
            "initial": {"psnr": 19.2, "ssim": 0.7, "mse": 1e-2, "lpips": None},
            "envmap": None,
            "fit": {"log_psnr": 45.7, "peak_ratio": 0.88, "epochs": 400, "cached": False},
            "timing": {"edit_s": 21.4, "total_s": 47.3, "per_iteration_ms": 53.5},
            "iterations": 2,
            "non_finite_steps": 0,
            "tonemap": "gamma",
            "active_rows": [0, 7],
        },
        "manifest": {"variant": "llvm_ad_rgb"},
        "history": [{"iteration": 0, "loss": 1.0}, {"iteration": 1, "loss": 0.1}],
        "renders": {"initial": grey(0.1), "target": grey(0.5), "edited": grey(0.4)},
        "maps": {"initial": grey(1.0), "target": None, "edited": grey(2.0)},
        "warnings": [],
        "notes": ["renderer.spp = 64"],
    }
    assert not set(changes) - set(settings)
    report.write_report(path, **{**settings, **changes})
    return Page(path)


def test_report_is_one_file_that_says_the_verdict(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = write(tmp_path / "report.html")
    assert "19.2 dB → 38.7 dB PSNR · 47.3 s in total" in page.text
    assert "map against the true one" not in page.text and "target, environment map: not known" in page.text
    assert page.tags.count("img") == 5 + 2
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert "http" not in (tmp_path / "report.html").read_text()
    assert "further from the target" not in page.text and "Warnings" not in page.text
    assert "−0.1 0 +0.1" in page.text, "0.66 - 0.73, rounded up"
    assert "+1 stops" in page.text


def test_report_of_a_known_map_and_a_failed_edit(tmp_path):
    truth = grey(1.0)
    truth[3, 5] = 1e6
    metrics = {"initial": {"psnr": 20.0}, "render": {"psnr": 15.0}, "envmap": {"psnr": 12.34}}
    page = write(tmp_path / "r.html", metrics=metrics, maps={"target": truth, "edited": grey(1.0)})
    assert "map against the true one: 12.3 dB" in page.text
    assert "The edited rendering is further from the target than the unedited one." in page.text
    assert "target 16 × 8 1e+06 3, 5" in page.text


def test_report_escapes_all_text(tmp_path):
    nasty = "<script>alert('&')</script> Gemälde/заря \udcff \0"
    page = write(
        tmp_path / "r.html",
        title=nasty,
        config_toml=nasty,
        manifest={nasty: nasty},
        metrics={nasty: nasty, "tonemap": nasty, "fit": {nasty: 1}, "timing": {nasty: 1.0}},
        history=[{nasty: 1.0}],
        renders={nasty: grey(0.5), "y" * 3000: grey(0.5)},
        warnings=[nasty],
        notes=[nasty],
    )
    assert "script" not in page.tags
    assert page.text.count("<script>alert('&')</script> Gemälde/заря") >= 9


@pytest.mark.parametrize("bad", [np.nan, np.inf, None])
def test_report_of_a_run_that_went_wrong(tmp_path, bad):
    picture = grey(0.0 if bad is None else bad, 1, 1)
    page = write(
        tmp_path / "r.html",
        metrics={"render": {"psnr": bad}, "timing": {"edit_s": bad}, "initial": None, "iterations": bad},
        history=[{"iteration": 0, "loss": bad}],
        renders={"initial": picture, "target": grey(0.0, 1, 1), "edited": picture},
        maps={"initial": picture, "target": picture, "edited": grey(0.0, 2, 4)},
    )
    assert "unknown → unknown PSNR" in page.text
    assert "No loss to draw in 1 rows of history." in page.text
    assert "maps edited and initial differ in size, (2, 4) and (1, 1)" in page.text
    words = {word.strip(".,:()").lower() for word in page.text.split()}
    assert not {"nan", "inf"} & words
    if bad is not None:
        assert "history[0].loss" in page.text and "rendering edited: 1 pixels are not finite" in page.text


def test_report_of_nothing(tmp_path):
    page = write(tmp_path / "r.html", metrics={}, manifest={}, history=[], renders={}, maps={}, notes=[])
    assert "No loss to draw in 0 rows" in page.text and "img" not in page.tags


def test_map_statistics_weight_the_mean_by_solid_angle():
    image = grey(0.0, 33, 64)
    image[:8] = 2.0
    cells = report._map_statistics(image)
    # Eight of 33 rows aligned to the corners are a cap of angle pi * 7.5 / 32 around the pole.
    mean = 2.0 * (1 - np.cos(np.pi * 7.5 / 32)) / 2
    assert cells[:4] == ["64 × 33", "2", "0, 0", f"{mean:.4g}"]
    assert cells[4:] == ["0", "0", "0"]


def test_map_statistics_of_a_real_map(data):
    source = next((data / "puresky").glob("kloofendal*.hdr"))
    image = np.array(mi.Bitmap(str(source)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
    light = image.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    row, column = np.unravel_index(light.argmax(), light.shape)
    cells = report._map_statistics(image)
    assert float(cells[1]) == pytest.approx(light.max(), rel=1e-3) and cells[2] == f"{row}, {column}"


def test_only_the_command_line_imports_the_report():
    for source in Path(report.__file__).parent.glob("*.py"):
        if source.name not in ("run.py", "report.py"):
            tree = ast.parse(source.read_text(encoding="utf-8"))
            nodes = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
            assert not [node for node in nodes if re.search(r"\breport\b", ast.unparse(node))], source.name


def test_digest_reads_files_larger_than_a_block(tmp_path):
    content = bytes(range(256)) * 20_000
    (tmp_path / "big").write_bytes(content)
    assert report._digest(tmp_path / "big")["sha256"] == hashlib.sha256(content).hexdigest()
