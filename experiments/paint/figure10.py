"""The six edits of the paper's Figure 10, each painted in the page, and a contact sheet of what was saved.

The strokes are those of scenes/edits, drawn with the pointer and set with the page's sliders, so that they
are as the page has them: ellipses lie straight, a tint is at most 1 (the rest of it goes into the amount),
and corners beyond the picture lie on its border. A hand's pace: :data:`CORNER_S` a corner,
:data:`SETTING_S` a tool, a shape or a slider. ``page.png`` in the folder of an edit is a picture of the page,
with the outlines of strokes. Chromium is the file that the environment variable CHROMIUM names, one of the
search path, or Playwright's.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np

from envedit.core.color import tonemap
from envedit.core.errors import InputError
from envedit.sweep.process import CONFIG
from experiments import puresky
from experiments.harness import Done, Experiment, calling
from experiments.painted_edits import experiment as painted_edits

MAP = "kloofendal_48d_partly_cloudy"
CORNER_S, SETTING_S = 0.4, 1.0
TEXT = "document.querySelector('#status').textContent"
STATUS = f"() => {TEXT}.includes"
DRAWN = (
    "() => { const of = document.querySelector('#status').dataset;"
    " return Number(of.frame) > 0 && ['done', 'rendering', 'solving'].includes(of.state); }"
)
FEASIBLE, RENDERED = f"{STATUS}('% feasible')", f"{STATUS}('with 256 samples')"
# What is feasible is asked when no step and no light leads further.
SETTLED = f"() => /how much of the target|% feasible/.test({TEXT})"
DIFFERS = re.compile(r"differs from the one shown before by (\S+) of a display value")
SAVED = "() => document.querySelector('#message').textContent.includes('Saved in')"


def prepared(folder: Path) -> Path:
    """Make the empty folder that the command works in, ``edit.toml`` being the case's configuration."""
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    shutil.copy(folder / CONFIG, work / "edit.toml")
    return work


@contextlib.contextmanager
def opened(work: Path):
    """Start ``envedit paint`` in a folder of :func:`prepared`; yields page and process."""
    from playwright.sync_api import sync_playwright

    file = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    command = [sys.executable, "-m", "envedit", "paint", "edit.toml", "--no-browser", "--port", "0"]
    own = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    pipe = subprocess.PIPE
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=file, args=["--no-sandbox"]) as browser,
        open(work / "server.log", "a") as log,
        subprocess.Popen(command, cwd=work, env=own, stdout=pipe, stderr=log, text=True) as process,
    ):
        try:
            line = process.stdout.readline()
            if "http" not in line:
                raise InputError(f"the server did not start: see {work / 'server.log'}")
            with browser.new_page(viewport={"width": 1280, "height": 720}) as page:
                page.goto(line.split()[-1])
                page.wait_for_function(DRAWN, timeout=300_000)
                yield page, process
        finally:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(90)
            process.kill()


def place(page, selector, x, y):
    """Return where a place of an element, in fractions of its size, lies on the page."""
    box = page.locator(selector).bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def drag(page, places, pause, steps=1):
    """Drag the pointer from the first over the other places of the page, with a pause at each, seconds."""
    page.mouse.move(*places[0])
    page.mouse.down()
    for spot in places[1:]:
        page.mouse.move(*spot, steps=steps)
        time.sleep(pause)
    page.mouse.up()


def choose(page, name):
    """Press a button."""
    page.locator(f"#{name}").click()
    time.sleep(SETTING_S)


def set_to(page, name, value):
    """Set a slider, or a colour."""
    page.locator(f"#{name}").fill(str(value))
    time.sleep(SETTING_S)


def encoded(color):
    """Return linear values in [0, 1] as a colour input has them."""
    codes = np.round(255 * tonemap(np.array(color, np.float32), "srgb")).astype(int)
    return "#" + "".join(f"{code:02x}" for code in codes)


def shape_of(stroke):
    """Return the key with the shape of a stroke, None where it covers the whole picture."""
    return next((key for key in ("polygon", "points", "ellipse", "rectangle") if key in stroke), None)


def paint(page, stroke):
    """Paint a stroke with the pointer, after its tool, shape and sliders."""
    at = lambda corner: place(page, "#overlay", *np.clip(corner, 0.001, 0.999))  # noqa: E731
    kind = stroke["type"]
    amount = stroke.get("amount")
    color = stroke.get("color", [1.0, 1.0, 1.0])
    most = max(1.0, *color)
    if kind == "shadow":
        amount = 1 - (1 - amount) * most
    elif kind == "light":
        amount *= most
    choose(page, f"tool-{kind}")
    shape = {"points": "brush", "polygon": "polygon", "ellipse": "ellipse"}.get(shape_of(stroke), "rectangle")
    choose(page, f"shape-{shape}")
    set_to(page, "softness", round(stroke.get("softness", 0), 2))
    if amount is not None:
        set_to(page, "amount", round(amount / 0.05) * 0.05)
    if color != [1.0, 1.0, 1.0]:
        set_to(page, "color", encoded([v / most for v in color]))
    for key, name in (("kelvin", "kelvin"), ("radius", "radius"), ("width", "size")):
        if key in stroke:
            set_to(page, name, stroke[key])
    if shape == "polygon":
        for corner in stroke["polygon"]:
            page.mouse.click(*at(corner))
            time.sleep(CORNER_S)
        page.keyboard.press("Enter")
        return
    if shape == "ellipse":
        x, y, rx, ry = stroke["ellipse"][:4]
        corners = [(x - rx, y - ry), (x + rx, y + ry)]
    elif "rectangle" in stroke:
        corners = [stroke["rectangle"][:2], stroke["rectangle"][2:]]
    else:
        corners = stroke.get("points", [(0, 0), (1, 1)])
    drag(page, [at(corner) for corner in corners], CORNER_S, steps=8)


def edit(settings, folder, strokes) -> dict:
    """Paint an edit in the page and save it; returns seconds, the edit's figures and the strokes as saved."""
    work = prepared(folder)
    with opened(work) as (page, _):
        # ---- Paint, and wait for what follows
        set_to(page, "exposure", 0)  # amounts of light are of what is shown as white
        began = time.perf_counter()
        for stroke in strokes:
            paint(page, stroke)
        painted = time.perf_counter()
        page.wait_for_function(SETTLED, timeout=300_000)
        settled = time.perf_counter()
        page.wait_for_function(FEASIBLE, timeout=300_000)
        solved = time.perf_counter()

        # ---- The picture of the page, path traced
        page.wait_for_function(RENDERED, timeout=300_000)
        choose(page, "outlines")
        page.screenshot(path=folder / "page.png")

        # ---- Save
        clicked = time.perf_counter()
        page.locator("#save").click()
        page.wait_for_function(SAVED, timeout=600_000)
        saved = time.perf_counter()
        message = page.locator("#message").inner_text()
    found = json.loads((work / "edit_out/metrics.json").read_text())["painted"]
    differs = DIFFERS.search(message)
    return found | {
        "differs": float(differs[1]) if differs else None,
        "strokes": tomllib.loads((work / "edit_out/painted.toml").read_text())["target"]["strokes"],
        "painted_s": painted - began,
        "settled_s": settled - painted,
        "solved_s": solved - painted,
        "saved_s": saved - clicked,
    }


def cases(given):
    sky = puresky.file(MAP)
    found = []
    for name in painted_edits.EDITS:
        asked = tomllib.loads((painted_edits.FOLDER / f"{name}.toml").read_text())
        tables = {"input": {"envmap": sky}, "scene": asked["scene"]}
        found.append(calling(name, edit, tables, {"edit": name}, strokes=asked["target"]["strokes"]))
    return found


def panels(done: Done) -> list[np.ndarray]:
    """Return rendering before, painted and saved, and the map before and after."""
    saved = Done(done.case, done.folder / "work/edit_out")
    maps = [tonemap(one, "gamma") for one in saved.maps[:2]]
    return saved.shown("render_initial", "render_target", "render_edited") + maps


FIGURES = {
    "saving, s": "{saved_s:.0f}",
    "painted change reached": "{towards:.0%}",
    "feasible": "{reachable:.0%}",
    "mean change elsewhere": "{elsewhere:.3f}",
    "saved from shown": "{differs:.4f}",
}
"""Columns of every edit that is painted in the page."""

EXPERIMENT = Experiment(
    cases,
    columns={
        "edit": "{edit}",
        "strokes": lambda row: ", ".join(f"{s['type']} ({shape_of(s) or 'all'})" for s in row["strokes"]),
        "painting + settling, s": "{painted_s:.0f} + {settled_s:.0f}",
        **FIGURES,
    },
    panels=panels,
    sheet=lambda case: "figure10",
    alone=True,
)
