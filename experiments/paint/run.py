"""The page of ``envedit paint`` in a real browser: how fast it is, and an hour of random use.

    python -m experiments.paint.run rates [--pixels 128 256] [--width 256] [--write]
    python -m experiments.paint.run soak [--minutes 60] [--seed 0]
    ENVEDIT_DATA=... python -m experiments.paint.run figure10 [--map NAME] [--edits NAME ...] [--write]
    ENVEDIT_DATA=... python -m experiments.paint.run picture [--map NAME] [--write]

All take --chromium FILE and --out runs/paint. ``rates`` traces T first (it is then on disk), and writes
rates.json; ``soak`` writes soak.json and exits with 1 where the server or the page fails, memory grows, or a
file appears outside the folder. ``figure10`` is figure10.py; an edit that is done is not painted again.
``picture`` takes the picture of the page that the documents show. With --write tables and pictures go into
README.md here and into docs.
"""

import argparse
import json
import os
import random
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from experiments.paint import figure10
from experiments.paint.browser import HERE, browsing, converged, moved, place, put, ready, started

CONFIG = """
[input]
envmap = "sunsky"
width = {width}
[scene]
file = "sphere"
width = {pixels}
"""
DRAG_S, STROKE_S, SOON_S = 6.0, 5.0, 0.5


def drag(page):
    """Drag the sun; returns frames a second, and milliseconds from pointer to picture."""
    box = page.get_by_test_id("handle-1").bounding_box()
    x, y = box["x"] + 13, box["y"] + 13
    page.evaluate("() => { envedit.log.length = 0; }")
    page.mouse.move(x, y)
    page.mouse.down()
    moved(page, lambda t: (x + 110 * np.sin(3 * t), y - 20 * np.sin(5 * t)), DRAG_S)
    log = page.evaluate("() => envedit.log")
    page.mouse.up()
    frames = [e for e in log if "frame" in e]
    sent = {e["edit"]: e["since"] for e in log if "edit" in e}
    waits = []
    for one in (e for e in log if "status" in e and e["status"] in sent):
        shown = [e["at"] for e in frames if e["frame"] >= one["of"]]
        if shown:
            waits.append(shown[0] - sent[one["status"]])
    median, most = np.quantile(waits, (0.5, 0.95)) if waits else (np.nan, np.nan)
    return len({e["frame"] for e in frames}) / DRAG_S, float(median), float(most)


def paint(page):
    """Paint a shadow; returns solved frames a second, the residual 0.5 s after the end, and the last one."""
    page.get_by_test_id("tool-shadow").click()
    x, y = place(page, "#overlay", 0.2, 0.8)
    width = page.locator("#overlay").bounding_box()["width"]
    page.evaluate("() => { envedit.log.length = 0; }")
    page.mouse.move(x, y)
    page.mouse.down()
    moved(page, lambda t: (x + 0.5 * width * t, y + 0.03 * width * np.sin(6 * t)), STROKE_S)
    log = page.evaluate("() => envedit.log")
    page.mouse.up()
    time.sleep(SOON_S)
    soon = residual(page)
    steps = {e["steps"] for e in log if "status" in e}  # that of the first is of before
    converged(page)
    return max(0, len(steps) - 1) / STROKE_S, soon, residual(page)


def residual(page):
    """Return what the solver lowers: RMS of display values, weighted by paint and rest, at the last step."""
    found = page.evaluate("() => envedit.log.filter((e) => e.residual !== undefined).at(-1)?.residual")
    return float("nan") if found is None else found


def rates(arguments, folder):
    found = [rate(arguments, folder, pixels) for pixels in arguments.pixels]
    (folder / "rates.json").write_text(json.dumps(found, indent=1) + "\n")
    table = rates_table(found)
    print(table)
    if arguments.write:
        put(HERE / "README.md", "rates", table)
    return 0


def rate(arguments, folder, pixels):
    """Measure one size of the rendering."""
    config = CONFIG.format(pixels=pixels, width=arguments.width)
    shutil.rmtree(folder / "edit_out", ignore_errors=True)
    with browsing(arguments.chromium) as browser:
        with started(folder, config) as (_, url, _):  # T goes to the disk
            ready(browser.new_page(), url)
        with started(folder, config) as (_, url, began):
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            found = {"pixels": pixels, "map": arguments.width, "cores": os.cpu_count()}
            found["ready_s"] = ready(page, url) - began
            converged(page)
            time.sleep(3)
            drag(page)  # kernels are compiled
            time.sleep(3)
            names = "drag_frames_s", "pointer_to_picture_ms", "pointer_to_picture_95_ms"
            found |= dict(zip(names, drag(page), strict=True))
            time.sleep(3)
            page.get_by_test_id("clear").click()
            converged(page)
            found["solved_frames_s"], soon, last = paint(page)
            found["db_to_converged"] = float(20 * np.log10(soon / last))
            page.screenshot(path=folder / f"rates_{pixels}.png")
    found |= alone(folder, pixels, arguments.width)
    print(json.dumps(found, indent=1), flush=True)
    return found


def alone(folder, pixels, width):
    """Return milliseconds of a dragged and of a solved frame in a session, without server and browser."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from envedit.cli.paint import project, protocol, session

    class Silent(session.Tell):
        pass

    (folder / "edit.toml").write_text(CONFIG.format(pixels=pixels, width=width))
    work = session.Session(project.opened(str(folder / "edit.toml")), Silent())
    while work.advance():
        pass

    def timed(document, phase, count=40):
        times = []
        for i in range(count):
            began = time.perf_counter()
            work.update(protocol.Edit(protocol.document(document(i / count)), phase))
            if phase == "drawing":
                work.advance()
            times.append(1000 * (time.perf_counter() - began))
        return float(np.median(times[count // 4 :]))

    def light(t):
        place = {"azimuth": 90 + 60 * t, "elevation": 35 + 10 * t}
        return {"lights": [{"light": 1, "flux": [1.0] * 3, "size": 1.0} | place]}

    def shadow(t):
        points = [[0.2 + 0.5 * t * k / 20, 0.8] for k in range(21)]
        return {"strokes": [{"type": "shadow", "amount": 0.6, "points": points, "width": 0.1}]}

    found = {"drag_ms": timed(light, "dragging")}
    work.update(protocol.Edit(protocol.Document()))
    return found | {"solved_ms": timed(shadow, "drawing")}


def rates_table(found):
    """Return the figures as a table, beside what is asked at 128 x 128 pixels; at 256 x 256 half of it."""
    rows = (
        ("page ready after the command, s", "ready_s", "at most 5"),
        ("session without a browser: a dragged frame, ms", "drag_ms", "-"),
        ("the same: a solved frame, ms", "solved_ms", "-"),
        ("light dragged: new frames a second", "drag_frames_s", "at least 15"),
        ("from pointer to picture, median, ms", "pointer_to_picture_ms", "at most 100"),
        ("the same, 95 %, ms", "pointer_to_picture_95_ms", "-"),
        ("painting: solved frames a second", "solved_frames_s", "at least 5"),
        (f"{SOON_S} s after the stroke: dB above the converged residual", "db_to_converged", "at most 0.5"),
    )
    sizes = [f"{one['pixels']}x{one['pixels']}" for one in found]
    lines = [
        f"| map {found[0]['map']} wide, {found[0]['cores']} cores | asked at 128x128 | {' | '.join(sizes)} |"
    ]
    lines.append("|---" * (2 + len(sizes)) + "|")
    for text, name, asked in rows:
        lines.append(f"| {text} | {asked} | {' | '.join(f'{one[name]:.3g}' for one in found)} |")
    return "\n".join(lines)


def memory(process):
    """Return the resident memory of a process, MB."""
    for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def act(page, chance):
    """Do something at random; returns what."""
    what = chance.choice(
        ["stroke"] * 6 + ["light"] * 3 + ["undo", "redo", "button", "turn", "wheel", "key", "reload"]
    )
    spot = lambda name: place(page, name, chance.random(), chance.random())  # noqa: E731
    if what == "stroke":
        tools = page.locator("[data-tool]")
        tools.nth(chance.randrange(tools.count())).click()
        shapes = page.locator("[data-shape]:visible")
        if shapes.count():
            shapes.nth(chance.randrange(shapes.count())).click()
        page.mouse.move(*spot("#overlay"))
        page.mouse.down()
        for _ in range(chance.randrange(1, 12)):
            page.mouse.move(*spot("#overlay"))
            time.sleep(0.03 * chance.random())
        page.mouse.up()
    elif what == "light":
        handles = page.locator(".handle")
        if handles.count():
            handles.nth(chance.randrange(handles.count())).hover(force=True)
            page.mouse.down()
            for _ in range(chance.randrange(1, 12)):
                page.mouse.move(*spot("#map-stack"))
            page.mouse.up()
    elif what in ("undo", "redo"):
        page.get_by_test_id(what).click(force=True)
    elif what == "button":
        name = chance.choice(["add-light", "light-mute", "light-delete", "clear", "shape-polygon"])
        if page.get_by_test_id(name).is_enabled() and page.get_by_test_id(name).is_visible():
            page.get_by_test_id(name).click()
    elif what == "turn":
        page.get_by_test_id("degrees").fill(str(chance.randrange(-400, 400)))
        page.keyboard.press("Enter")
    elif what == "wheel":
        page.mouse.move(*spot("#map-stack"))
        page.mouse.wheel(0, chance.choice([-100, 100]))
    elif what == "key":
        page.keyboard.press(
            chance.choice(["b", "1", "5", "[", "]", "Escape", "Enter", "Control+z", "ArrowLeft"])
        )
    else:
        page.reload()
        page.wait_for_selector("#work:not([hidden])", timeout=120_000)
    return what


def soak(arguments, folder):
    chance, faults, done, grown = random.Random(arguments.seed), [], {}, []
    outside = set(folder.parent.iterdir())
    with (
        started(folder, CONFIG.format(pixels=64, width=128)) as (process, url, _),
        browsing(arguments.chromium) as browser,
    ):
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.on("pageerror", lambda error: faults.append(str(error)))
        ready(page, url)
        end, told = time.monotonic() + 60 * arguments.minutes, 0.0
        while time.monotonic() < end and process.poll() is None:
            what = act(page, chance)
            done[what] = done.get(what, 0) + 1
            if time.monotonic() > told + 10:
                told = time.monotonic()
                grown.append(memory(process))
        alive = process.poll() is None
        if alive:
            page.get_by_test_id("clear").click(force=True)
            converged(page)
    code = process.returncode
    third = max(1, len(grown) // 3)
    first, last = float(np.median(grown[third : 2 * third] or grown)), float(np.median(grown[-third:]))
    strange = sorted(str(p) for p in set(folder.parent.iterdir()) - outside)
    own = {"edit.toml", "edit_out", "server.log", "soak.json", "rates.json"}
    strange += sorted(p.name for p in folder.iterdir() if p.name not in own)
    log = (folder / "server.log").read_text()
    found = {
        "minutes": arguments.minutes,
        "actions": done,
        "memory_mb": {"middle third": first, "last third": last, "most": max(grown)},
        "page_errors": faults,
        "alive": alive,
        "exit_code": code,
        "server_log": log[-2000:],
        "files_outside": strange,
    }
    (folder / "soak.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))
    return int(bool(faults or not alive or code or strange or log or last > 1.1 * first + 20))


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("rates", "soak", "figure10", "picture"))
    parser.add_argument("--pixels", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--map", default="kloofendal_48d_partly_cloudy", help="of ENVEDIT_DATA, or sunsky")
    parser.add_argument("--edits", nargs="+", default=list(figure10.EDITS), choices=figure10.EDITS)
    parser.add_argument("--write", action="store_true", help="put tables and pictures into the documents")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("google-chrome"))
    parser.add_argument("--out", type=Path, default=Path("runs/paint"))
    arguments = parser.parse_args(argv)
    if arguments.chromium is None:
        parser.error("got no chromium on this machine, expected one: name it with --chromium")
    folder = arguments.out.absolute() / arguments.what
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "server.log").unlink(missing_ok=True)
    shutil.rmtree(folder / "edit_out", ignore_errors=True)
    done = {"rates": rates, "soak": soak, "figure10": figure10.main, "picture": figure10.picture}
    return done[arguments.what](arguments, folder)


if __name__ == "__main__":
    sys.exit(main())
