"""The HTML report: parsed, and read for what it says about good, failed and empty runs."""

import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from envedit import config
from envedit.report import html_report
from envedit.report.curves import normalised
from envedit.results import Result
from envedit.solve.feasibility import Reach
from tests.oracles.builders import grey


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


SCORES = {"ssim": 0.98, "mse": 1e-4, "lpips": None, "log_rmse": 0.2, "beyond_display": 0.0}
METRICS = {"render": {"psnr": 38.71, **SCORES}, "initial": {"psnr": 19.2, **SCORES}}
METRICS |= dict.fromkeys(("ceiling", "envmap", "painted", "camera"))
METRICS |= {
    "fit": {"log_psnr": 45.7, "peak_ratio": 0.88, "epochs": 400, "cached": False},
    "timing": {"edit_s": 21.4, "total_s": 47.3, "report_s": None, "per_iteration_ms": 53.5},
}
METRICS |= {"iterations": 2, "non_finite_steps": 0, "tonemap": "gamma", "active_rows": [0, 7]}


def write(path, settings=None, manifest=None, metrics=None, **changes):
    found = {
        "history": [{"iteration": 0, "loss": 1.0}, {"iteration": 1, "loss": 0.1}],
        "renders": {"initial": grey(0.1), "target": grey(0.5), "edited": grey(0.4)},
        "maps": {"initial": grey(1.0), "target": None, "edited": grey(2.0)},
    }
    found |= {"envmap": grey(2.0), "core": grey(0.0), "metrics": METRICS | (metrics or {})}
    found |= {"lights": {}, "views": (), "warnings": [], "notes": ["renderer.spp = 64"]}
    found["settings"] = settings or config.Config()
    manifest = {"variant": "llvm_ad_rgb"} if manifest is None else manifest
    html_report.write_report(path, Result(**found | changes), manifest)
    return Page(path)


def test_report_is_one_file_that_says_the_verdict(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = write(tmp_path / "report.html")
    assert "rendering 19.2 -> 38.7 dB, 47.3 s" in page.text
    assert "target, environment map: not known" in page.text
    assert page.tags.count("img") == 5 + 2
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert "http" not in (tmp_path / "report.html").read_text()
    assert "Warnings" not in page.text
    assert "−0.1 0 +0.1" in page.text, "0.66 - 0.73, rounded up"
    assert "+1 stops" in page.text


def light(which, azimuth, elevation, **more):
    return {"id": which, "azimuth": azimuth, "elevation": elevation, **more}


def test_report_draws_which_lights_moved_stayed_came_and_went(tmp_path):
    assert "numbered as in lights.json" not in write(tmp_path / "a.html").text
    before = [light(1, 350, 40, removed=False), light(2, 90, 10, removed=True)]
    after = [light(1, 20, 30, added=False), light(3, 180, 60, added=True)]
    page = write(tmp_path / "b.html", lights={"before": before, "after": after})
    source = (tmp_path / "b.html").read_text()
    assert "numbered as in lights.json" in page.text and page.tags.count("circle") == 4
    # Over the edge of the map, from both sides of it.
    assert 'x1="350.0" x2="380.0" y1="50.0" y2="60.0"' in source
    assert 'x1="-10.0" x2="20.0" y1="50.0" y2="60.0"' in source
    assert source.count("stroke-dasharray") == 1 and 'cx="90.0" cy="80.0" r="3"' in source
    assert 'cx="180.0" cy="30.0" r="4.5" stroke="#ffb000"' in source


def test_report_shows_what_the_view_determines(tmp_path):
    assert "What this view determines" not in write(tmp_path / "a.html").text
    influence, frozen = np.ones((8, 16), np.float32), np.zeros((8, 16), bool)
    page = write(tmp_path / "b.html", influence=influence, frozen=frozen)
    assert "0.001 10 influence" in page.text
    assert "keep their original value" not in page.text and page.tags.count("img") == 5 + 2 + 1
    frozen[3] = True
    assert "keep their original value" in write(tmp_path / "c.html", influence=influence, frozen=frozen).text


def test_report_of_paint_says_how_far_it_was_followed(tmp_path):
    painted = {"towards": 0.81, "elsewhere": 0.0123, "reachable": 0.9}
    reach = Reach(share=0.9, picture=grey(0.5), residual=grey(0.1), envmap=grey(1.0))
    page = write(tmp_path / "r.html", metrics={"painted": painted}, reach=reach)
    assert "81 % of the painted change reached (90 % feasible), mean change elsewhere 0.012" in page.text
    assert "What was painted" in page.text and "90 % of the painted change is feasible" in page.text
    faint = write(tmp_path / "f.html", metrics={"painted": painted | {"towards": None}})
    assert "painted change is below the noise" in faint.text


def test_report_of_a_known_map_and_a_failed_edit(tmp_path):
    truth = grey(1.0)
    truth[3, 5] = 1e6
    scores = {"initial": 20.0, "render": 15.0, "initial_envmap": 9.87, "envmap": 12.34}
    metrics = {name: {"psnr": psnr, **SCORES} for name, psnr in scores.items()}
    maps = {"initial": grey(1.0), "target": truth, "edited": grey(1.0)}
    page = write(tmp_path / "r.html", metrics=metrics, maps=maps)
    assert "rendering 20.0 -> 15.0 dB, map 9.9 -> 12.3 dB, 47.3 s" in page.text
    assert "unedited map edited map PSNR (dB) 20 15 9.87 12.34" in page.text
    assert "target 16 × 8 1e+06 3, 5" in page.text


def test_report_escapes_all_text(tmp_path):
    nasty = "<script>alert('&')</script> Gemälde/заря \udcff"
    file = "<script>alert('&') Gemälde"
    changes = {
        "metrics": {nasty: nasty, "tonemap": nasty, "fit": {nasty: 1}},
        "history": [{"iteration": 0, nasty: 1.0}],
    }
    changes |= {"lights": {"before": [], "after": [light(1, 20, 30)]}, "warnings": [nasty], "notes": [nasty]}
    settings = config.Config(scene=config.Scene(file=file))
    page = write(tmp_path / "r.html", settings, {nasty: nasty}, **changes)
    assert "script" not in page.tags and page.text.count("<script>alert('&')</script> Gemälde/заря") == 8
    assert page.text.count(file) == 3  # title, heading and configuration


@pytest.mark.parametrize("bad", [np.nan, np.inf, None])
def test_report_of_numbers_that_are_not_finite(tmp_path, bad):
    """Pictures are finite, or they could not have been written before the report."""
    rendered = {"psnr": 30.0, **SCORES, "ssim": bad}
    page = write(
        tmp_path / "r.html",
        metrics={"render": rendered, "iterations": bad},
        history=[{"iteration": 0, "loss": bad}],
        renders={name: grey(0.0) for name in ("initial", "target", "edited")},
    )
    assert "No loss to draw" in page.text and "SSIM 0.98 –" in page.text
    words = {word.strip(".,:()").lower() for word in page.text.split()}
    assert not {"nan", "inf"} & words


def test_losses_are_drawn_with_their_last_weights():
    """A ramp from 1 to 100 over three iterations: 1, 10, 100."""
    rows = [{"iteration": i, "loss": 2.0 + w * e, "ssim": 2.0, "image_l2": w * e} for i, (w, e) in
            enumerate([(1, 0.5), (10, 0.2), (100, 0.1)])]  # fmt: skip
    drawn, about = normalised(rows, {"ssim": (1, 1), "image_l2": (1, 100)}, 3)
    np.testing.assert_allclose([row["image_l2"] for row in drawn], [50, 20, 10])
    np.testing.assert_allclose([row["loss"] for row in drawn], [52, 22, 12])  # falls; as stored it rises
    assert "image_l2 (from 1 to 100)" in about and rows[0]["loss"] == 2.5
    assert normalised([], {}, 1)[0] == []


def test_map_statistics_weight_the_mean_by_solid_angle():
    image = grey(0.0, 33, 64)
    image[:8] = 2.0
    cells = html_report.map_statistics(image)
    # Eight of 33 rows aligned to the corners are a cap of angle pi * 7.5 / 32 around the pole.
    mean = 2.0 * (1 - np.cos(np.pi * 7.5 / 32)) / 2
    assert cells[:4] == ["64 × 33", "2", "0, 0", f"{mean:.4g}"] and cells[4:] == ["0", "0"]
