"""The six edits of the paper's Figure 10, each painted in the page, and a contact sheet of what was saved.

The strokes are those of scenes/edits, drawn with the pointer and set with the page's sliders, so that they
are as the page has them: ellipses lie straight, a tint is at most 1 (the rest of it goes into the amount),
and corners beyond the picture lie on its border. A hand's pace: :data:`CORNER_S` a corner,
:data:`SETTING_S` a tool, a shape or a slider.
"""

import json
import shutil
import time
import tomllib

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.color import tonemap
from envedit.images import images
from experiments.harness import layer, own_folder
from experiments.paint import browser
from experiments.painted_edits.experiment import EDITS, FOLDER, file_of

CORNER_S, SETTING_S = 0.4, 1.0
REACHED = "() => document.querySelector('[data-testid=status]').textContent.includes('is feasible')"
RENDERED = "() => document.querySelector('[data-testid=status]').textContent.includes('with 256 samples')"
SAVED = "() => document.querySelector('[data-testid=message]').textContent.includes('Saved in')"
TITLES = dict(zip(EDITS, (
    "Moving the shadow", "Adding a reflection", "Adding a shadow", "Colour temperature",
    "Enhancing the shadow", "Blurring the shadow"), strict=True))  # fmt: skip


def configuration(edit, envmap):
    """Return an edit of scenes/edits without its target, and its strokes."""
    given = tomllib.loads((FOLDER / f"{edit}.toml").read_text())
    keys = given["input"] if envmap == "sunsky" else {}  # what says where its sun is
    lines = ["[input]", f"envmap = {config.quote(envmap)}"]
    lines += [f"{key} = {config.quote(value)}" for key, value in keys.items()]
    lines += ["[scene]", *(f"{key} = {config.quote(value)}" for key, value in given["scene"].items())]
    return "\n".join(lines) + "\n", given["target"]["strokes"]


def chosen(page, name):
    """Press a button."""
    page.get_by_test_id(name).click()
    time.sleep(SETTING_S)


def set_to(page, name, value):
    """Set a slider, or a colour."""
    page.get_by_test_id(name).fill(str(value))
    time.sleep(SETTING_S)


def encoded(color):
    """Return linear values in [0, 1] as a colour input has them."""
    codes = np.round(255 * tonemap(np.array(color, np.float32), "srgb")).astype(int)
    return "#" + "".join(f"{code:02x}" for code in codes)


def paint(page, stroke):
    """Paint a stroke with the pointer, after its tool, shape and sliders."""
    at = lambda place: browser.place(page, "#overlay", *np.clip(place, 0.001, 0.999))  # noqa: E731
    kind, amount, color = stroke["type"], stroke.get("amount"), stroke.get("color", [1.0, 1.0, 1.0])
    most = max(1.0, *color)
    if kind == "shadow":
        amount = 1 - (1 - amount) * most
    elif kind == "light":
        amount *= most
    chosen(page, f"tool-{kind}")
    shape = {"points": "brush", "polygon": "polygon", "ellipse": "ellipse"}
    shape = next((name for key, name in shape.items() if key in stroke), "rectangle")
    chosen(page, f"shape-{shape}")
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
        places = [(x - rx, y - ry), (x + rx, y + ry)]
    else:
        places = stroke.get("points", [(0, 0), (1, 1)])
    page.mouse.move(*at(places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*at(place), steps=8)
        time.sleep(CORNER_S)
    page.mouse.up()


def carry_out(folder, edit, envmap, chromium):
    """Paint an edit in the page and save it; returns seconds and the edit's figures."""
    text, strokes = configuration(edit, envmap)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with browser.browsing(chromium) as opened, browser.started(folder, text) as (_, url, _):
        page = opened.new_page(viewport={"width": 1280, "height": 720})
        browser.ready(page, url)
        began = time.perf_counter()
        for stroke in strokes:
            paint(page, stroke)
        painted = time.perf_counter()
        page.wait_for_function(REACHED, timeout=300_000)
        solved = time.perf_counter()
        page.screenshot(path=folder / "page.png")
        page.get_by_test_id("save").click()
        page.wait_for_function(SAVED, timeout=600_000)
        saved = time.perf_counter()
    found = json.loads((folder / "edit_out/metrics.json").read_text())["painted"]
    found |= {"painted_s": painted - began, "solved_s": solved - painted, "saved_s": saved - solved}
    (folder / "figure10.json").write_text(json.dumps(found, indent=1) + "\n")
    return found


def row(folder):
    """Pictures of one edit, display values: rendering and map before and after."""
    shown = [tonemap(images.read(str(folder / f"render_{n}.exr"))[0], "gamma")
             for n in ("initial", "target", "edited")]  # fmt: skip
    edited, original = images.read(str(folder / "edited.exr"))[0], layer(folder, "initial")
    half = original.shape[0] // 2
    maps = [tonemap(m[:half], "gamma") for m in (original, edited)]
    side = shown[0].shape[0]
    maps = [np.concatenate(maps)[:side]] if 2 * half == side else maps
    return np.concatenate([np.pad(p, ((0, 4), (0, 4), (0, 0))) for p in [*shown, *maps]], axis=1)


def line(edit, found, strokes):
    """One row of the table."""
    kinds = ", ".join(
        f"{s['type']} ({next((k for k in ('polygon', 'points', 'ellipse', 'rectangle') if k in s), 'all')})"
        for s in strokes
    )
    elsewhere = "-" if found["elsewhere"] is None else f"{found['elsewhere']:.3f}"
    return (
        f"| {TITLES[edit]} | {kinds} | {found['painted_s']:.0f} + {found['solved_s']:.0f} "
        f"| {found['saved_s']:.0f} | {100 * found['towards']:.0f} % | {100 * found['reachable']:.0f} % "
        f"| {elsewhere} |"
    )


def main(arguments, folder):
    """Carry the edits out that have not been, draw the sheet, and write the docs' table."""
    mi.set_variant("llvm_ad_rgb")
    if (file := file_of(arguments.map)) is None:
        raise SystemExit(f"{arguments.map}: ENVEDIT_DATA has no puresky/{arguments.map}_puresky_1k.hdr")
    lines = ["| edit | strokes | painting + solving, s | saving, s | painted change reached | feasible "
             "| mean change elsewhere |", "|---" * 7 + "|"]  # fmt: skip
    listed, rows, folder = [], [], own_folder(folder, arguments.map)
    for edit in arguments.edits:
        done = folder / edit / "figure10.json"
        if not done.exists():
            print(edit, flush=True)
            carry_out(folder / edit, edit, file, arguments.chromium)
        found = json.loads(done.read_text())
        kept = (folder / edit / "edit_out/painted.toml").read_text()
        lines.append(line(edit, found, tomllib.loads(kept)["target"]["strokes"]))
        listed.append(f"# {TITLES[edit]}, {edit}\n" + kept[kept.index("[[target.strokes]]") :].strip())
        rows.append(row(folder / edit / "edit_out"))
    pixels = (np.clip(np.concatenate(rows), 0, 1) * 255 + 0.5).astype(np.uint8)
    table, strokes = "\n".join(lines), "\n\n".join(listed)
    (folder / "table.md").write_text(table + "\n")
    print(table)
    if arguments.write:
        (browser.HERE / "figure10.toml").write_text("# Strokes as the page wrote them.\n\n" + strokes + "\n")
        (FOLDER.parents[1] / "docs/painting_figure10.png").write_bytes(images.png(pixels))
        browser.put(FOLDER.parents[1] / "docs/painting_in_the_browser.md", "figure10", table)
    else:
        (folder / "sheet.png").write_bytes(images.png(pixels))
    return 0


def picture(arguments, folder):
    """Take the picture of the page: a shadow that is drawn anew on the other side, and its strokes."""
    file = file_of(arguments.map)
    if file is None:
        raise SystemExit(f"{arguments.map}: ENVEDIT_DATA has no puresky/{arguments.map}_puresky_1k.hdr")
    text, strokes = configuration("move_shadow", file)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with browser.browsing(arguments.chromium) as opened, browser.started(folder, text) as (_, url, _):
        page = opened.new_page(viewport={"width": 1280, "height": 720})
        browser.ready(page, url)
        for stroke in strokes:
            paint(page, stroke)
        page.wait_for_function(REACHED, timeout=300_000)
        page.wait_for_function(RENDERED, timeout=300_000)
        page.get_by_test_id("outlines").click()
        time.sleep(SETTING_S)
        page.screenshot(path=folder / "page.png")
    if arguments.write:
        shutil.copy(folder / "page.png", FOLDER.parents[1] / "docs/painting_in_the_browser.png")
    return 0
