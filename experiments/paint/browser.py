"""The command in a real browser: started, opened, waited for; and tables put into documents."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
GL = ["--no-sandbox", "--enable-unsafe-swiftshader"]  # WebGL by software; the page as Chromium likes
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
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        page.mouse.move(*path(1 - (end - time.perf_counter()) / seconds))
        time.sleep(1 / 60)


def put(file, name, text):
    """Put a text between the marks of a name in a document."""
    marks = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, after = file.read_text().split(marks[0])[0], file.read_text().split(marks[1])[1]
    file.write_text(f"{before}{marks[0]}\n{text.strip()}\n{marks[1]}{after}")
