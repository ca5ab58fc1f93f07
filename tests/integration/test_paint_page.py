"""``envedit paint`` in a real browser: paint, drag, undo, save, reopen."""

import os
import shutil

import numpy as np
import pytest

from envedit import config, pipeline
from envedit.images import images
from tests.oracles.painting import SMALL, served, until

pytestmark = pytest.mark.slow
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("starlette", reason="the extra envedit[paint] is not installed")
pytest.importorskip("uvicorn", reason="the extra envedit[paint] is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SHOTS = os.environ.get("ENVEDIT_SHOTS")  # folder for pictures of the page, to be looked at


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    gl = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *gl])
        yield found
        found.close()


class Page:
    """The page and what a user does there."""

    def __init__(self, browser, url):
        self.page = browser.new_page(viewport={"width": 1280, "height": 720})
        self.faults, self.asked = [], []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", lambda m: self.faults.append(m.text) if m.type == "error" else None)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(url)
        self.status = self.page.get_by_test_id("status")

    def settled(self, samples=64):
        """Wait for a solution and the rendering that follows it."""
        sync_api.expect(self.status).to_have_attribute("data-state", "done", timeout=120_000)
        if samples:
            sync_api.expect(self.status).to_contain_text(f"path traced with {samples}", timeout=120_000)

    def at(self, name, x, y):
        box = self.page.locator(name).bounding_box()
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    def drag(self, *places):
        self.page.mouse.move(*places[0])
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*place, steps=3)
        self.page.mouse.up()

    def picture(self, name):
        return self.page.get_by_test_id(name).screenshot()

    def shot(self, name):
        if SHOTS:
            self.page.screenshot(path=f"{SHOTS}/{name}.png")


def test_paint_drag_undo_save_and_reopen(browser, tmp_path):
    file = tmp_path / "edit.toml"
    file.write_text(SMALL)
    folder = tmp_path / "edit_out"
    with served(file) as server:
        page = Page(browser, server.url)
        page.settled()
        begun = page.picture("map")
        page.page.get_by_test_id("tool-shadow").click()
        page.drag(*(page.at("#overlay", 0.2 + 0.1 * k, 0.82) for k in range(5)))
        page.page.wait_for_function("() => envedit.log.some((e) => e.phase === 'done')")
        page.settled()
        page.shot("painted")
        assert page.picture("map") != begun, "the map did not follow the stroke"
        assert 'type = "shadow"' in (folder / "painted.toml").read_text(), "the stroke was not kept"
        page.page.get_by_test_id("undo").click()
        until(lambda: "[[target.strokes]]" not in (folder / "painted.toml").read_text())
        page.settled()
        assert page.picture("map") == begun, "undo did not give the map back"
        page.page.get_by_test_id("redo").click()
        handle = page.page.get_by_test_id("handle-1").bounding_box()
        x, y = handle["x"] + 13, handle["y"] + 13
        frames = int(page.status.get_attribute("data-frame"))
        page.drag((x, y), (x - 30, y + 5), (x - 60, y + 5))
        until(lambda: "[[input.lights]]" in (folder / "painted.toml").read_text())
        page.settled()
        assert int(page.status.get_attribute("data-frame")) > frames + 2
        page.page.get_by_test_id("save").click()
        sync_api.expect(page.page.get_by_test_id("message")).to_contain_text("Saved in", timeout=240_000)
        page.shot("saved")
        assert not page.faults, page.faults
        assert all(url.startswith((server.url, "data:")) for url in page.asked), "the page asks elsewhere"

    saved, _ = images.load_envmap(str(folder / "edited.exr"), 64)
    found = pipeline.run(config.load(folder / "painted.toml"), folder=None)
    assert np.abs(found.envmap - saved).max() <= 1e-3 * saved.mean(), "envedit run makes another map"

    with served(folder / "painted.toml") as server:
        page = Page(browser, server.url + "?canvas=2d")
        page.settled(0)
        sync_api.expect(page.page.get_by_test_id("undo")).to_be_enabled()
        assert "elevation" in page.page.get_by_test_id("handle-1").get_attribute("aria-label")
        page.shot("reopened")
        assert not page.faults, page.faults
