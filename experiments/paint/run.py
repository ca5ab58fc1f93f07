"""The page of ``envedit paint`` in a real browser: how fast it is, and an hour of random use.

    python -m experiments.paint.run rates [--pixels 128] [--width 256] [--chromium FILE] [--out runs/paint]
    python -m experiments.paint.run soak [--minutes 60] [--seed 0] [--chromium FILE] [--out runs/paint]

``rates`` traces T first (it is then on disk), and writes rates.json; ``soak`` writes soak.json and exits with
1 where the server or the page fails, memory grows, or a file appears outside the folder.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

CONFIG = """
[input]
envmap = "sunsky"
width = {width}
[scene]
file = "sphere"
width = {pixels}
"""
GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
DRAG_S, STROKE_S = 6.0, 5.0
SETTLED = "document.querySelector('[data-testid=status]').dataset.state"


@contextlib.contextmanager
def started(folder, config):
    """Start the command; yields the process, its address and when it was started."""
    (folder / "edit.toml").write_text(config)
    command = [sys.executable, "-m", "envedit", "paint", "edit.toml", "--no-browser", "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    began = time.perf_counter()
    with open(folder / "server.log", "a") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=log, text=True
        )
        try:
            line = process.stdout.readline()
            if "http" not in line:
                raise SystemExit(f"the server did not start: see {folder / 'server.log'}")
            yield process, line.split()[-1], began
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(90)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            process.stdout.close()


@contextlib.contextmanager
def browsing(chromium):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=GL)
        try:
            yield browser
        finally:
            browser.close()


def ready(page, url):
    """Open the page; returns when the first picture is shown and strokes are taken."""
    page.goto(url)
    page.wait_for_function(
        "() => Number(document.querySelector('[data-testid=status]').dataset.frame) > 0 "
        f"&& ['done', 'solving'].includes({SETTLED})",
        timeout=300_000,
    )
    return time.perf_counter()


def converged(page):
    page.wait_for_function(f"() => {SETTLED} === 'done'", timeout=300_000)


def place(page, selector, x, y):
    box = page.locator(selector).bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def moved(page, path, seconds):
    """Move the pointer along places for some time, about 60 times a second."""
    end, i = time.perf_counter() + seconds, 0
    while time.perf_counter() < end:
        page.mouse.move(*path(1 - (end - time.perf_counter()) / seconds))
        time.sleep(1 / 60)
        i += 1
    return i


def residual(page):
    """Return the RMS of target less solution, display values, of what the page shows."""
    bits = page.evaluate("() => Array.from(envedit.displays.difference.now.pixels)")
    return float(np.sqrt(np.square(np.array(bits, np.uint16).view(np.float16).astype(np.float64)).mean()))


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
    return (
        len({e["frame"] for e in frames}) / DRAG_S,
        float(np.median(waits)),
        float(np.quantile(waits, 0.95)),
    )


def paint(page):
    """Paint a shadow; returns solved frames a second, RMS 0.5 s after the end and at the end."""
    page.get_by_test_id("tool-shadow").click()
    x, y = place(page, "#overlay", 0.2, 0.8)
    width = page.locator("#overlay").bounding_box()["width"]
    page.evaluate("() => { envedit.log.length = 0; }")
    page.mouse.move(x, y)
    page.mouse.down()
    moved(page, lambda t: (x + 0.5 * width * t, y + 0.03 * width * np.sin(6 * t)), STROKE_S)
    log = page.evaluate("() => envedit.log")
    page.mouse.up()
    time.sleep(0.5)
    soon = residual(page)
    solved = {e["of"] for e in log if "status" in e and e.get("iterations")}
    converged(page)
    return len(solved) / STROKE_S, soon, residual(page)


def rates(arguments, folder):
    config = CONFIG.format(pixels=arguments.pixels, width=arguments.width)
    with browsing(arguments.chromium) as browser:
        with started(folder, config) as (_, url, _):  # T goes to the disk
            ready(browser.new_page(), url)
        with started(folder, config) as (_, url, began):
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            found = {"pixels": arguments.pixels, "map": arguments.width, "cores": os.cpu_count()}
            found["ready_s"] = ready(page, url) - began
            converged(page)
            time.sleep(3)
            drag(page)  # kernels are compiled
            time.sleep(3)
            found["drag_frames_s"], found["pointer_to_picture_ms"], found["pointer_to_picture_95_ms"] = drag(
                page
            )
            time.sleep(3)
            page.get_by_test_id("clear").click()
            converged(page)
            found["solved_frames_s"], soon, last = paint(page)
            found["db_to_converged"] = float(20 * np.log10(soon / last))
            page.screenshot(path=folder / "rates.png")
    (folder / "rates.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))
    return 0


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
    own = {"edit.toml", "edit_out", "server.log", "soak.json", "rates.json", "rates.png"}
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
    parser.add_argument("what", choices=("rates", "soak"))
    parser.add_argument("--pixels", type=int, default=128)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("google-chrome"))
    parser.add_argument("--out", type=Path, default=Path("runs/paint"))
    arguments = parser.parse_args(argv)
    if arguments.chromium is None:
        parser.error("got no chromium on this machine, expected one: name it with --chromium")
    folder = arguments.out.absolute() / arguments.what
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "server.log").unlink(missing_ok=True)
    shutil.rmtree(folder / "edit_out", ignore_errors=True)
    return {"rates": rates, "soak": soak}[arguments.what](arguments, folder)


if __name__ == "__main__":
    sys.exit(main())
