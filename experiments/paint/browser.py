"""``envedit paint`` in a real browser: started, opened, waited for.

Chromium is the file that the environment variable CHROMIUM names, one of the search path, or Playwright's.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from envedit.core.errors import InputError
from envedit.sweep.process import CONFIG

STATE = "document.querySelector('[data-testid=status]').dataset.state"


def prepared(folder: Path) -> Path:
    """Make the empty folder that the command works in, ``edit.toml`` being the case's configuration."""
    work = folder / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    shutil.copy(folder / CONFIG, work / "edit.toml")
    return work


@contextlib.contextmanager
def browsing():
    """Start Chromium."""
    from playwright.sync_api import sync_playwright

    file = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    gl = ["--no-sandbox", "--enable-unsafe-swiftshader"]  # WebGL by software
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=file, args=gl) as browser,
    ):
        yield browser


@contextlib.contextmanager
def opened(browser, work: Path):
    """Start the command in a folder of :func:`prepared` and open its page.

    Yields
    ------
    page, process, seconds, errors
        Seconds from the command to the first picture, with strokes taken; errors of the page, as they come.
    """
    command = [sys.executable, "-m", "envedit", "paint", "edit.toml", "--no-browser", "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    began, errors = time.perf_counter(), []
    with (
        open(work / "server.log", "a") as log,
        subprocess.Popen(
            command, cwd=work, env=environment, stdout=subprocess.PIPE, stderr=log, text=True
        ) as process,
    ):
        try:
            line = process.stdout.readline()
            if "http" not in line:
                raise InputError(f"the server did not start: see {work / 'server.log'}")
            with browser.new_page(viewport={"width": 1280, "height": 720}) as page:
                page.on("pageerror", lambda error: errors.append(str(error)))
                page.goto(line.split()[-1])
                page.wait_for_function(
                    "() => Number(document.querySelector('[data-testid=status]').dataset.frame) > 0 "
                    f"&& ['done', 'rendering', 'solving'].includes({STATE})",
                    timeout=300_000,
                )
                yield page, process, time.perf_counter() - began, errors
        finally:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(90)
            process.kill()


def converged(page):
    """Wait until the solver has ended."""
    page.wait_for_function(f"() => {STATE} === 'done'", timeout=300_000)


def place(page, selector, x, y):
    """Return where a place of an element, in fractions of its size, lies on the page."""
    box = page.locator(selector).bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def moved(page, path, seconds):
    """Move the pointer along places for some time, about 60 times a second."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        page.mouse.move(*path(1 - (end - time.perf_counter()) / seconds))
        time.sleep(1 / 60)
