"""``envedit paint`` in a real browser: paint, drag, undo, save, reopen.

That is this machine's Chromium, or, with ENVEDIT_BROWSER=firefox, the Firefox that Playwright has installed.
"""

import contextlib
import os
import re
import shutil
import threading
import time

import numpy as np
import pytest

from envedit import config
from envedit.core.color import luminance
from envedit.core.rotations import Orientation
from envedit.core.tone_curves import TONE_CURVES
from envedit.images import analytic_sky, images
from envedit.maps import looks
from envedit.representations.layers.placed_lights import angles, direction
from envedit.targets.strokes import gains
from tests.oracles.builders import LIGHT, write_scene
from tests.oracles.painting import OF_TWO, SMALL, TWO_VIEWS, photographed, served, until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FIREFOX = os.environ.get("ENVEDIT_BROWSER") == "firefox"


@pytest.fixture(scope="module")
def browser():
    if not FIREFOX and CHROMIUM is None:
        pytest.skip("no chromium on this machine")
    sync_api.expect.set_options(timeout=120_000)  # a busy machine answers late
    with sync_api.sync_playwright() as playwright:
        chromium = {"executable_path": CHROMIUM, "args": ["--no-sandbox"]}
        found = playwright.firefox.launch() if FIREFOX else playwright.chromium.launch(**chromium)
        yield found
        found.close()


UNNAMED = """() => [...document.querySelectorAll("button, input, select, canvas[tabindex]")]
  .filter((e) => e.checkVisibility() && !(e.getAttribute("aria-label")
    || [...(e.labels ?? [])].some((l) => l.textContent.trim())
    || (!e.labels?.length && e.textContent.trim())))
  .map((e) => e.id || e.outerHTML)"""
FAINT = """() => {
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
  const luminance = (c) => [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => {
    const v = c[i] / 255;
    return sum + w * (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  }, 0);
  const ground = (e) => {
    const c = rgb(getComputedStyle(e).backgroundColor);
    return c.length === 3 || !e.parentElement ? c : ground(e.parentElement);
  };
  return [...document.querySelectorAll("body *")].filter((e) => e.checkVisibility() && !e.closest("#handles")
    && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim())).map((e) => {
      const [a, b] = [luminance(rgb(getComputedStyle(e).color)), luminance(ground(e))].sort((x, y) => y - x);
      return [(a + 0.05) / (b + 0.05), e.id || e.outerHTML.slice(0, 80)];
    }).filter(([ratio]) => ratio < 4.5);
}"""
"""What has no name for assistive tools, and text with less contrast than WCAG 2.2 AA asks (1.4.3)."""


SOLVED = """() => {
  const last = envedit.log.findLast((e) => e.edit && e.phase === "done");
  return !last || envedit.log.some((e) => e.status >= last.edit && e.state === "done");
}"""
"""Whether the server's answer to the last edit has come: the state shown may be that of before."""


class Page:
    """The page and what a user does there; ``made`` is one in a window of another kind."""

    def __init__(self, browser, url, made=None):
        self.page = made or browser.new_page(viewport={"width": 1280, "height": 720})
        self.page.set_default_timeout(120_000)
        self.faults, self.asked = [], []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", lambda m: self.faults.append(m.text) if m.type == "error" else None)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(url)
        self.status = self.get("status")

    def get(self, name):
        return self.page.locator(f"#{name}")

    def settled(self, rendered=True):
        """Wait for the solution of the last edit and the rendering that follows it."""
        self.page.wait_for_function(SOLVED)
        sync_api.expect(self.status).to_have_attribute("data-state", "done")
        if rendered:
            done = re.compile(r"path traced with (64|80|128)")  # by a busy machine not each is seen
            sync_api.expect(self.status).to_contain_text(done)

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
        return self.get(name).screenshot()

    def named_and_legible(self):
        assert not self.page.evaluate(UNNAMED) and not self.page.evaluate(FAINT)


@pytest.fixture
def file(tmp_path):
    (tmp_path / "edit.toml").write_text(SMALL)
    return tmp_path / "edit.toml"


@contextlib.contextmanager
def opened(browser, file, made=None):
    """Open the page of a painting, which has no fault by the end; yields page, server and what is kept."""
    with served(file) as server:
        page = Page(browser, server.url, made)
        page.page.wait_for_function("() => envedit.log.some((e) => e.frame)")
        sync_api.expect(page.get("handle-1")).to_be_visible()
        yield page, server, file.parent / "edit_out" / "painted.toml"
        assert not page.faults, page.faults


def test_paint_drag_undo_save_and_reopen(browser, file):
    with opened(browser, file) as (page, server, kept):
        page.settled()
        white = np.quantile(luminance(server.worker.session.before), 0.95)
        assert abs(float(page.get("exposure").input_value()) + np.log2(white)) <= 0.125
        begun = page.picture("map")
        page.get("tool-shadow").click()
        page.drag(*(page.at("#overlay", 0.2 + 0.1 * k, 0.82) for k in range(5)))
        page.page.wait_for_function("() => envedit.log.some((e) => e.phase === 'done')")
        page.settled(False)
        assert page.picture("map") != begun, "the map did not follow the stroke"
        assert 'type = "shadow"' in kept.read_text(), "the stroke was not kept"
        page.page.locator("#details summary").click()
        sync_api.expect(page.get("unreachable")).to_be_visible()
        page.get("undo").click()
        until(lambda: "[[target.strokes]]" not in kept.read_text())
        page.settled(False)
        assert page.picture("map") == begun, "undo did not give the map back"
        sync_api.expect(page.get("unreachable")).to_be_hidden()
        page.get("redo").click()
        page.settled(False)
        x, y = page.at("#handle-1", 0.5, 0.5)
        painted = page.picture("map")
        page.drag((x, y), (x - 30, y + 5), (x - 60, y + 5))
        until(lambda: "[[input.lights]]" in kept.read_text())
        page.settled(False)
        assert page.picture("map") != painted, "the map did not follow the light"
        page.get("save").click()
        sync_api.expect(page.get("message")).to_contain_text("Saved in", timeout=240_000)
        sync_api.expect(page.get("message")).to_contain_text("differs from the one shown")
        assert all(url.startswith((server.url, "data:")) for url in page.asked), "the page asks elsewhere"

    with served(kept) as server:
        page = Page(browser, server.url)
        page.settled(False)
        sync_api.expect(page.get("undo")).to_be_enabled()
        assert "elevation" in page.get("handle-1").get_attribute("aria-label")
        assert not page.faults, page.faults


def test_what_is_changed_after_a_save_has_begun_is_not_said_to_be_saved(browser, file):
    with opened(browser, file) as (page, server, _):
        session, changed, message = server.worker.session, threading.Event(), page.get("message")
        carried_out = session._carried_out
        session._carried_out = lambda *run: (changed.wait(60), carried_out(*run))[1]
        page.settled(False)
        page.get("save").click()
        sync_api.expect(page.status).to_have_text(re.compile("^(Saving: |saving)"))
        page.get("map-exposure").fill("1")
        page.get("map-exposure").press("Enter")
        page.page.wait_for_function("() => envedit.log.some((e) => e.edit && e.phase === 'done')")
        changed.set()
        sync_api.expect(message).to_contain_text(", without what was changed meanwhile: ", timeout=240_000)
        page.settled(False)
        page.get("save").click()
        sync_api.expect(message).to_contain_text("Saved in edit_out: ", timeout=240_000)
        page.get("map-exposure").fill("2")
        page.get("map-exposure").press("Enter")
        sync_api.expect(message).to_have_text("")


def test_another_explanation_is_chosen(browser, file):
    with opened(browser, file) as (page, *_):
        holder = page.get("explanations")
        sync_api.expect(holder).to_be_hidden()
        page.get("tool-erase-shadow").click()
        page.drag(*(page.at("#overlay", 0.52 + 0.04 * k, 0.3) for k in range(5)))
        sync_api.expect(page.get("explanation-1")).to_contain_text("%")
        page.settled(False)
        before = page.picture("map")
        page.get("explanation-1").click()
        sync_api.expect(page.get("explanation-1")).to_have_attribute("aria-pressed", "true")
        sync_api.expect(page.status).to_have_attribute("data-state", "done")
        assert page.picture("map") != before
        page.get("undo").click()
        sync_api.expect(holder).to_be_hidden(timeout=120_000)


def test_a_shadow_is_dragged_and_what_goes_along_is_chosen(browser, file):
    with opened(browser, file) as (page, server, kept):
        # ---- A shadow, by its tip; and where there is none; a drag is one step, however late answers come
        answered = server.worker.session.pick
        server.worker.session.pick = lambda asked: (time.sleep(0.4), answered(asked))
        page.page.keyboard.press("9")
        message = page.get("message")
        page.drag(page.at("#overlay", 0.96, 0.96), page.at("#overlay", 0.9, 0.9))
        sync_api.expect(message).to_contain_text("in no shadow of the light")
        x, y = page.at("#overlay", 10.5 / 48, 33.5 / 48)
        page.page.mouse.move(x, y)
        page.page.mouse.down()
        until(lambda: page.get("light").get_attribute("disabled") is None)
        page.page.mouse.move(*page.at("#overlay", 10.5 / 48, 40.5 / 48), steps=4)
        page.page.mouse.up()
        until(lambda: kept.exists() and "[[input.lights]]" in kept.read_text())
        (light,) = config.load(kept).input.lights
        assert abs((light["azimuth"] - 90 + 180) % 360 - 180) > 20, light  # where its light stood
        page.get("undo").click()
        until(lambda: "[[input.lights]]" not in kept.read_text())
        server.worker.session.pick = answered
        # ---- A stroke, with the sky and the rest as chosen
        page.get("tool-shadow").click()
        page.drag(*(page.at("#overlay", 0.6 + 0.1 * k, 0.8) for k in range(4)))
        sync_api.expect(page.status).to_contain_text("% of the paint reached")
        page.get("freedom").fill("0.6")
        page.get("rest").select_option("keep")
        until(lambda: "freedom = 0.6" in kept.read_text() and 'rest = "keep"' in kept.read_text())
        page.get("undo").click()
        until(lambda: "rest" not in kept.read_text())
        assert page.get("rest").input_value() == "follow"
        # ---- What is done where little is reached
        light = {"light": 1, "flux": [0.5] * 3, "size": 1.0, "azimuth": 200, "elevation": 30}
        action = {"label": "Drag light 1 there", "change": {"lights": [light], "strokes": []}}
        advice = {"text": "", "actions": [action]}
        # In one go: the session's own advice may come at any time.
        button = "document.querySelector('#advice-0')"
        page.page.evaluate(f"(advice) => {{ envedit.advise(advice); {button}.click(); }}", advice)
        until(lambda: "azimuth = 200" in kept.read_text() and "[[target.strokes]]" not in kept.read_text())
        assert config.load(kept).input.lights[0]["flux"] == [0.5, 0.5, 0.5]


def size_and_flux_are_dragged(page, lights):
    """By drags of its handle with a key: it stays where it is."""
    stays = {key: lights()[0][key] for key in ("azimuth", "elevation")}
    handle = page.get("handle-2").bounding_box()
    x, y = handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2
    for key, name, factor in (("Shift", "size", 2), ("Control", "flux", 0.5)):
        before = np.array(lights()[0][name])
        page.page.keyboard.down(key)
        page.drag((x, y), (x, y + (50 if factor < 1 else -50)))
        page.page.keyboard.up(key)
        until(lambda name=name, wanted=factor * before: np.allclose(lights()[0][name], wanted, rtol=0.05))
    assert {key: lights()[0][key] for key in stays} == stays


def a_highlight_is_dragged(page, lights):
    """The light that makes it follows: whichever of them adds most there."""
    before = [light.get("azimuth") for light in lights()]
    page.page.keyboard.press("8")
    page.page.mouse.move(*page.at("#overlay", 0.4, 0.45))
    page.page.mouse.down()
    page.page.mouse.move(*page.at("#overlay", 0.55, 0.4))
    page.page.keyboard.press("2")  # another tool is chosen before it is known whose highlight it is
    page.page.mouse.up()
    until(lambda: [light.get("azimuth") for light in lights()] != before)


def each_kind_of_stroke_is_painted(page, kept):
    """By its button, with a slider of its own where it has one."""
    sliders = {"light": "amount", "contrast": "amount", "temperature": "kelvin", "blur": "radius"}
    tools = ["light", "shadow", "erase-shadow", "temperature", "contrast", "blur", "hold"]
    for count, tool in enumerate(tools, 1):
        page.get(f"tool-{tool}").click()
        page.get("shape-rectangle").click()
        if tool in sliders:
            page.get(sliders[tool]).press("ArrowRight")
        page.drag(page.at("#overlay", 0.2, 0.2), page.at("#overlay", 0.3, 0.3))
        until(lambda count=count: kept.read_text().count("[[target.strokes]]") == count)
        stroke = config.load(kept).target.strokes[-1]
        assert stroke["type"] == tool and stroke["rectangle"] == pytest.approx([0.2, 0.2, 0.3, 0.3], abs=0.01)
        assert tool not in sliders or stroke[sliders[tool]] > 0


def an_image_is_put_on_the_light(page, lights, folder):
    """The file goes to a folder of the working folder, and the light has the image's sides."""
    softbox = folder / "softbox.png"
    images.write_png(softbox, np.linspace(0, 1, 24).reshape(2, 4, 3))
    page.get("light-image-file").set_input_files(softbox)
    until(lambda: lights()[0]["shape"] == "image" and "aspect" not in lights()[0])
    taken = folder / "images" / "softbox.png"
    assert lights()[0]["image"] == str(taken) and taken.read_bytes() == softbox.read_bytes()
    page.get("undo").click()
    until(lambda: lights()[0]["shape"] == "strip")


def test_lights_are_placed_by_clicks_and_shaped(browser, file, tmp_path, here):
    with opened(browser, file) as (page, _, kept):

        def lights():
            return config.load(kept).input.lights if kept.exists() else ()

        message = page.get("message")
        # ---- One new light by a drag, which is chosen then; why it cannot move; the same behind the ball
        page.page.keyboard.press("i")
        page.drag(page.at("#overlay", 0.45, 0.5), page.at("#overlay", 0.6, 0.4))
        sync_api.expect(message).to_contain_text("Light 2 illuminates this place")
        until(lambda: len(lights()) == 1 and "light" not in lights()[0])
        in_front = lights()[0]
        page.page.keyboard.press("r")
        page.page.mouse.click(*page.at("#overlay", 0.5, 0.45))
        sync_api.expect(message).to_contain_text("faces the camera")
        page.page.mouse.click(*page.at("#overlay", 0.68, 0.4))
        sync_api.expect(message).to_contain_text("Light 2 lights the rim")
        until(lambda: abs(lights()[0]["azimuth"] - in_front["azimuth"]) > 60)
        # ---- Its shape, one step of history each
        for key, value in (("shape", "strip"), ("rotation", "30"), ("softness", "0.5"), ("aspect", "0.3")):
            control = page.get(f"light-{key}")
            control.select_option(value) if key == "shape" else control.fill(value)
            until(lambda key=key, value=value: str(lights()[0].get(key)) in (value, f"{value}.0"))
        an_image_is_put_on_the_light(page, lights, tmp_path)
        page.get("undo").click()
        until(lambda: lights()[0]["aspect"] == 0.1)
        size_and_flux_are_dragged(page, lights)
        # ---- Without a chosen light, the sun casts the shadow
        page.page.keyboard.press("Escape")
        sync_api.expect(page.get("light")).to_contain_text("No light chosen")
        page.get("tool-cast").click()
        page.page.mouse.click(*page.at("#overlay", 0.25, 0.85))
        sync_api.expect(message).to_contain_text("Light 1 casts a shadow here")
        until(lambda: any(one.get("light") == 1 for one in lights()))
        # ---- Whose light a place has
        page.page.keyboard.press("w")
        page.page.mouse.click(*page.at("#overlay", 0.3, 0.8))
        sync_api.expect(message).to_contain_text(re.compile("Light of this place: .*rest of the map"))
        a_highlight_is_dragged(page, lights)
        page.settled(False)
        each_kind_of_stroke_is_painted(page, kept)


def lights_are_listed(page, kept):
    """The list: name, flux, size, colour, lock, mute; solo is not kept."""
    get = page.get

    def write(name, value):
        get(name).fill(str(value))
        page.page.keyboard.press("Enter")

    get("add").click()
    write("list-name-1", "key")
    write("list-stops-1", -1)
    write("list-kelvin-2", 3000)
    write("list-radius-2", 8)
    get("list-lock-2").click()
    get("list-mute-1").click()
    until(lambda: kept.exists() and "muted" in kept.read_text())
    added, key = sorted(config.load(kept).input.lights, key=lambda light: "light" in light)
    assert (key["name"], key["flux"]) == ("key", pytest.approx([0.5] * 3, rel=1e-3))
    color = np.divide(added["flux"], luminance(np.array(added["flux"])))
    assert added["size"] == 8 and added["locked"] and np.allclose(color, gains(3000), rtol=0.02)
    assert get("list-kelvin-2").input_value() == "3000"
    write("list-radius-2", -3)  # cannot be: what was there comes back
    assert get("list-radius-2").input_value() == "8"
    page.settled(False)
    get("list-solo-1").click()
    sync_api.expect(page.status).to_have_attribute("data-state", "moving")
    get("list-solo-1").click()
    page.settled()
    assert "muted" in kept.read_text(), "solo was kept"
    get("list-choose-2").click()
    sync_api.expect(get("handle-2")).to_have_attribute("aria-pressed", "true")


def states_are_compared(page, kept):
    """A state A beside another; the steps as pictures."""
    get = page.get
    first = page.picture("render")
    get("keep-a").click()
    get("list-mute-1").click()
    page.settled()
    assert page.picture("render") != first
    get("split").fill("1")
    assert page.picture("render") == first, "A is not what is shown before"
    get("reference").select_option("0")
    assert page.picture("render") != first
    get("split").fill("0")
    get("past").click()
    steps = get("steps").locator("button")
    assert steps.count() == 9 and steps.nth(8).locator("canvas").count() == 1
    get("back-a").click()
    until(lambda: "muted" in kept.read_text())
    get("step-0").click()
    until(lambda: "lights" not in kept.read_text())
    get("map-exposure-slide").fill("1.5")
    get("map-temperature-slide").fill("4000")
    until(lambda: "exposure = 1.5" in kept.read_text() and "temperature = 4000" in kept.read_text())
    assert get("map-exposure").input_value() == "1.5"
    get("map-temperature-slide").fill("6500")
    until(lambda: "temperature" not in kept.read_text())


TONES = """async (colour) => {
  const { Display } = await import(new URL("display.js", location.href).href);
  const shown = {};
  for (const curve of [3, 4]) {
    const display = new Display(document.createElement("canvas"));
    Object.assign(display.settings, { curve });
    display.canvas.style = "width: 8px; height: 8px";
    document.body.append(display.canvas);
    display.show({ width: 1, height: 1, pixels: new Uint16Array(colour) });
    await new Promise((done) => requestAnimationFrame(() => {
      const copy = document.createElement("canvas").getContext("2d");
      copy.drawImage(display.canvas, 0, 0);
      shown[curve] = [...copy.getImageData(0, 0, 1, 1).data].slice(0, 3);
      done();
    }));
    display.canvas.remove();
  }
  return shown;
}"""


def tones_are_those_of_the_package(page):
    """AgX; false colour is grey at middle grey, and red and white far above it."""
    for colour, band in (([0.9, 0.3, 0.02], "6cbf3b"), ([0.18] * 3, "808080"), ([40.0] * 3, "ffffff")):
        half = np.array(colour, np.float16)
        shown = page.page.evaluate(TONES, half.view(np.uint16).tolist())
        wanted = 255 * TONE_CURVES["agx"].shown(half.astype(float))
        np.testing.assert_allclose(shown["3"], wanted, atol=1.5)
        np.testing.assert_allclose(shown["4"], list(bytes.fromhex(band)), atol=1)


def map_is_large_and_rendering_zoomed(page):
    """The map beside the original; wheel and keys zoom the rendering."""
    page.settled(False)
    page.page.locator("#overlay").focus()
    page.page.keyboard.press("m")
    sync_api.expect(page.page.locator("#sky-size")).to_have_text("64 x 32 texels")
    page.get("sky-split").fill("0.5")
    page.named_and_legible()
    page.get("sky-close").click()
    rendering = page.page.locator("#overlay")
    before = rendering.bounding_box()
    page.page.mouse.move(*page.at("#render-stack", 0.25, 0.25))
    page.page.mouse.wheel(0, -100)
    until(lambda: rendering.bounding_box()["width"] > 1.1 * before["width"])
    page.page.keyboard.press("0")
    assert rendering.bounding_box() == before


def test_lights_listed_states_compared_the_map_large_and_zoom(browser, file):
    with opened(browser, file) as (page, _, kept):
        page.settled(False)
        lights_are_listed(page, kept)
        states_are_compared(page, kept)
        map_is_large_and_rendering_zoomed(page)
        tones_are_those_of_the_package(page)


def map_is_levelled(page, kept, session):
    """The horizon by the line's grips, keys and numbers: the handle of a light goes along."""
    get = page.get

    def orientation():
        return tuple(config.load(kept).input.orientation) if kept.exists() else None

    page.page.keyboard.press("l")
    grip = get("grip-tilt").bounding_box()
    x, y = grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2
    height = page.page.locator("#map-stack").bounding_box()["height"]
    page.drag((x, y), (x, y - height / 10))
    until(lambda: orientation() == (0, pytest.approx(-18, abs=0.5), 0))
    get("grip-horizon").press("Shift+ArrowUp")
    get("tilt").fill("12")
    get("tilt").press("Enter")
    get("degrees").fill("100")
    get("degrees").press("Enter")
    until(lambda: orientation() == (100, 12, 5))
    toward = Orientation(100, 12, 5).matrix @ session.placed.lights[0].direction
    azimuth, elevation = angles(toward)
    box, at = (page.page.locator(name).bounding_box() for name in ("#map-stack", "#handle-1"))
    seen = at["x"] + at["width"] / 2 - box["x"], at["y"] + at["height"] / 2 - box["y"]
    expected = azimuth / 360 * box["width"], (90 - elevation) / 180 * box["height"]
    assert seen == pytest.approx(expected, abs=1)
    # ---- A key moves a light on the map as it is seen
    get("handle-1").press("ArrowRight")
    until(lambda: config.load(kept).input.lights)
    (light,) = config.load(kept).input.lights
    moved = angles(Orientation(100, 12, 5).matrix @ direction(light["azimuth"], light["elevation"]))
    assert moved == pytest.approx((azimuth + 1, elevation), abs=0.05)
    page.named_and_legible()
    get("undo").click()
    get("undo").click()
    until(lambda: orientation() == (0, 12, 5))


def a_light_has_a_role(page, kept):
    """A role is kept in its table."""

    def lights():
        return [(one.get("light"), one.get("role")) for one in config.load(kept).input.lights]

    page.get("add").click()
    page.get("list-role-2").select_option("rim")
    until(lambda: lights() == [(None, "rim")])


def regions_are_painted(page, kept, session):
    """A brush on the rotated map, its settings, keys, and a region that is taken away."""
    get = page.get

    def regions():
        return config.load(kept).input.regions

    page.page.keyboard.press("g")
    dragged = page.at("#handles", 0.3, 0.3), page.at("#handles", 0.4, 0.3)
    page.drag(*dragged)
    until(lambda: len(regions()) == 1)
    region = regions()[0]
    assert region["action"] == "keep" and region["radius"] == 12 and region["softness"] == 6
    orientation = Orientation(0, 12, 5)
    start = angles(orientation.matrix @ direction(*region["points"][0]))
    assert start == pytest.approx((108, 36), abs=0.5), "the brush is not where the pointer was"
    until(lambda: session.solution.kept is not None and session.solution.kept.max() == 1)
    get("region-action").select_option("scale")
    get("region-stops").fill("-2")
    get("region-stops").press("Enter")
    until(lambda: regions()[0].get("factor") == [0.25] * 3 and session.solution.kept is None)
    get("region-1").click()  # none is chosen: what comes next is another one
    get("region-action").select_option("keep")
    get("region-radius").fill("0")
    get("region-radius").press("Enter")
    get("region-radius").fill("5")
    get("regions").press("ArrowLeft")
    get("regions").press("Space")
    get("regions").press("Shift+ArrowLeft")
    get("regions").press("Space")
    until(lambda: [one["action"] for one in regions()] == ["scale", "keep"])
    assert len(regions()[1]["points"]) == 2 and regions()[1]["radius"] == 5
    page.named_and_legible()
    get("region-remove").click()
    until(lambda: len(regions()) == 1)
    page.page.keyboard.press("g")
    sync_api.expect(get("region-panel")).to_be_hidden()
    get("undo").click()
    get("undo").click()
    until(lambda: [one["action"] for one in regions()] == ["scale"])


def test_a_map_is_chosen_levelled_and_painted_on(browser, file, tmp_path, here):
    images.write_exr("sky.exr", analytic_sky.sunsky(64, 200, 30, 3), {})
    images.write_exr("picture.exr", np.ones((30, 40, 3)), panorama=False)
    kept = tmp_path / "edit_out" / "painted.toml"
    with served(None) as server:
        page = Page(browser, server.url)
        tile = page.page.get_by_role("button", name="sky.exr")
        sync_api.expect(tile.locator("img")).to_have_attribute("src", re.compile("^data:image/png"))
        sync_api.expect(page.page.get_by_role("button", name="picture.exr")).to_be_hidden()
        shown = "() => [...document.querySelectorAll('.tiles img[src]')].every((e) => e.naturalWidth > 0)"
        page.page.wait_for_function(shown)
        tile.click()
        sync_api.expect(tile).to_have_attribute("aria-pressed", "true")
        page.named_and_legible()
        page.get("open-name").fill("edit.toml")
        page.get("open").click()
        page.page.wait_for_function("() => envedit.log.some((e) => e.frame)")
        map_is_levelled(page, kept, server.worker.session)
        assert config.load(kept).input.envmap == str(tmp_path / "sky.exr")
        regions_are_painted(page, kept, server.worker.session)
        a_light_has_a_role(page, kept)
        # ---- The light of another edit
        look = looks.to_toml(
            looks.Look(lights={"key": looks.RoleLight(90.0, 30.0, 2.0, 0.0, (1.0, 1.0, 1.0))})
        )
        file = {"name": "noon.toml", "mimeType": "", "buffer": look.encode()}
        page.get("look-file").set_input_files(file)
        sync_api.expect(page.get("message")).to_contain_text("maps/sky_noon.exr")
        until(
            lambda: np.allclose(server.worker.session.placed.lights[0].direction, direction(90, 30), atol=0.1)
        )
        assert not page.faults, page.faults


def test_views_as_tabs_names_focus_order_and_contrast(browser, tmp_path):
    write_scene(tmp_path, *TWO_VIEWS, LIGHT, name="scene.xml")
    (tmp_path / "edit.toml").write_text(OF_TWO)
    with opened(browser, tmp_path / "edit.toml") as (page, _, kept):
        tabs = page.page.get_by_role("tab")
        assert tabs.all_inner_texts() == ["front", "behind"]
        ratio = "() => document.querySelector('#render').getBoundingClientRect()"
        first = page.page.evaluate(ratio)
        tabs.nth(0).focus()
        page.page.keyboard.press("ArrowRight")
        assert tabs.nth(1).get_attribute("aria-selected") == "true"
        second = page.page.evaluate(ratio)
        assert first["width"] / first["height"] == pytest.approx(32 / 20, rel=0.02)
        assert second["width"] / second["height"] == pytest.approx(32 / 28, rel=0.02)
        page.get("tool-light").click()
        page.get("shape-rectangle").click()
        stops = float(page.get("exposure").input_value())
        page.drag(page.at("#overlay", 0.3, 0.3), page.at("#overlay", 0.7, 0.7))
        until(lambda: kept.exists() and "view = 1" in kept.read_text())
        (stroke,) = config.load(kept).target.strokes
        assert stroke["amount"] == pytest.approx(0.6 / 2**stops, rel=1e-3), "not of what is shown as white"

        page.named_and_legible()
        page.get("undo").focus()
        reached = []
        while len(reached) < 60 and "map-exposure" not in reached:
            page.page.keyboard.press("Tab")
            reached.append(page.page.evaluate(
                "() => { const e = document.activeElement;"
                " return e.id || e.tagName.toLowerCase(); }"
            ))  # fmt: skip
        order = ["save", "tool-light", "shape-brush", "softness", "view-1", "overlay", "handle-1",
                 "turn", "map-exposure"]  # fmt: skip
        assert [name for name in reached if name in order] == order, reached


def test_a_photograph_is_compared_with_the_rendering(browser, tmp_path):
    with opened(browser, photographed(tmp_path)) as (page, *_):
        get = page.get
        sync_api.expect(get("reference")).to_have_value("2")
        page.settled(False)
        matched = page.picture("render")
        get("split").fill("0.5")
        get("split").fill("1")
        photograph = page.picture("render")
        assert photograph != matched
        get("list-mute-1").click()
        page.settled(False)
        assert page.picture("render") == photograph, "the photograph follows the edit"
        get("reference").select_option("0")
        assert page.picture("render") != photograph


def slid_out_and_back(page, name):
    """Drag a slider from where it is and back there, with the pointer."""
    slider = page.get(name)
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    x, y, value = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, slider.input_value()
    page.drag((x, y), (x + 20, y), (x, y))
    assert slider.input_value() == value, "the slider was not dragged back"


def test_what_is_given_up_is_undone_and_keys_work_beside_sliders(browser, file):
    with opened(browser, file) as (page, server, kept):
        session = server.worker.session
        # ---- A slider that is dragged out and back has changed nothing, and its drag is over
        page.get("handle-1").click()
        for name in ("map-exposure-slide", "light-flux"):
            slid_out_and_back(page, name)
            page.page.wait_for_function("() => envedit.log.findLast((e) => e.edit)?.phase === 'done'")
            until(lambda: session.phase == "done")
        # ---- The drag of a highlight that Escape ends is given up, also by a click on its handle
        page.page.keyboard.press("8")
        before = session.finished
        page.drag(page.at("#overlay", 0.45, 0.3), page.at("#overlay", 0.5, 0.4))
        until(lambda: session.finished != before)
        moved = session.finished
        page.page.mouse.move(*page.at("#overlay", 0.5, 0.4))
        page.page.mouse.down()
        page.page.mouse.move(*page.at("#overlay", 0.55, 0.45), steps=3)
        until(lambda: session.document != moved)
        page.page.keyboard.press("Escape")
        page.page.mouse.up()
        until(lambda: session.phase == "done")
        page.get("handle-1").click()
        page.settled(False)
        assert session.document == session.finished == moved
        # ---- Keys where a slider or a number has the focus: what was typed is saved
        page.get("freedom").focus()
        page.page.keyboard.press("Control+z")
        until(lambda: session.finished == before)
        page.page.keyboard.press("2")
        sync_api.expect(page.get("tool-shadow")).to_have_attribute("aria-pressed", "true")
        page.get("map-exposure").focus()
        page.page.keyboard.press("Control+a")
        page.page.keyboard.type("1")
        page.page.keyboard.press("Control+s")
        sync_api.expect(page.get("message")).to_contain_text("Saved in", timeout=240_000)
        assert config.load(kept).output.exposure == 1
        # ---- B is released in another window
        page.get("overlay").focus()
        shown = page.picture("render")
        page.page.keyboard.down("b")
        until(lambda: page.picture("render") != shown)
        page.page.evaluate("() => window.dispatchEvent(new Event('blur'))")
        until(lambda: page.picture("render") == shown)


DROP = """([target, name]) => {
  const data = new DataTransfer();
  data.items.add(new File(["no image"], name));
  document.querySelector(target).dispatchEvent(
    new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
}"""
"""Drop a file somewhere on the page."""


def test_files_that_are_not_taken_are_told(browser, file, tmp_path, here):
    with opened(browser, file) as (page, *_):
        said = sync_api.expect(page.get("message"))
        page.page.evaluate(DROP, ["#render", "sky.png"])
        said.to_contain_text("sky.png was not taken")
        (tmp_path / "look.toml").write_bytes(b"#" * (1 << 19))
        page.get("look-file").set_input_files(tmp_path / "look.toml")
        said.to_contain_text("look.toml is no look")
        page.get("add").click()
        said.to_be_empty()  # what went wrong before
    with served(None) as server:
        page = Page(browser, server.url)
        sync_api.expect(page.status).to_contain_text("Choose")
        page.page.evaluate(DROP, ["body", "sky.exr"])
        sync_api.expect(page.get("open-map")).to_have_value("maps/sky.exr")
        page.page.route("**/map/*", lambda route: route.abort())  # as where the server has gone
        page.page.evaluate(DROP, ["#drop", "other.exr"])
        sync_api.expect(page.get("message")).to_contain_text("other.exr was not taken")
        sync_api.expect(page.status).to_contain_text("Choose")


@pytest.mark.skipif(FIREFOX, reason="touches are sent by Chromium's protocol")
def test_fingers_paint_and_zoom_on_a_tablet(browser, file):
    context = browser.new_context(viewport={"width": 820, "height": 1180}, has_touch=True)
    with opened(browser, file, context.new_page()) as (page, _, kept):
        touch = context.new_cdp_session(page.page)

        def fingers(kind, *places):
            points = [dict(zip("xy", page.at("#overlay", *place), strict=True)) for place in places]
            touch.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})

        # ---- One paints
        fingers("Start", (0.2, 0.8))
        for k in range(6):
            fingers("Move", (0.2 + 0.08 * k, 0.8))
        fingers("End")
        until(lambda: kept.exists() and kept.read_text().count("[[target.strokes]]") == 1)
        # ---- Two zoom, and paint nothing; nothing is cut off, held upright or level
        fingers("Start", (0.4, 0.5))
        fingers("Start", (0.4, 0.5), (0.6, 0.5))
        for k in range(6):
            fingers("Move", (0.4 - 0.02 * k, 0.5), (0.6 + 0.02 * k, 0.5))
        fingers("End")
        page.page.wait_for_function(
            "() => document.querySelector('.zoomed').style.transform.includes('scale')"
        )
        assert kept.read_text().count("[[target.strokes]]") == 1
        for width, height in ((820, 1180), (1024, 768), (420, 800), (360, 640)):
            page.page.set_viewport_size({"width": width, "height": height})
            assert page.page.evaluate("document.documentElement.scrollWidth") == width
    context.close()
