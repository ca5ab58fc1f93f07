"""Random use of the page of ``envedit paint``, in a real browser."""

import random
import re
import time
from collections import Counter
from pathlib import Path

import numpy as np

from experiments.harness import Experiment, calling, number
from experiments.paint.browser import browsing, converged, opened, place, prepared

OWN = {"edit.toml", "edit_out", "server.log"}
"""What may lie in the folder that the command works in."""


def memory(process) -> float:
    """Return the resident memory of a process, MB."""
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{process.pid}/status").read_text())
    return int(found[1]) / 1024 if found else float("nan")


def act(page, chance: random.Random) -> str:
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


def soak(settings, folder, minutes) -> dict:
    """Use the page for some minutes; the configuration's seed is that of the actions."""
    chance, done, grown, work = random.Random(settings.seed), Counter(), [], prepared(folder)
    before = set(folder.iterdir())
    with browsing() as browser, opened(browser, work) as (page, process, _, errors):
        end, noted = time.monotonic() + 60 * minutes, 0.0
        while time.monotonic() < end and process.poll() is None:
            done[act(page, chance)] += 1
            if time.monotonic() > noted + 10:
                noted = time.monotonic()
                grown.append(memory(process))
        alive = process.poll() is None
        if alive:
            page.get_by_test_id("clear").click(force=True)
            converged(page)
    third = max(1, len(grown) // 3)
    middle, last = float(np.median(grown[third : 2 * third] or grown)), float(np.median(grown[-third:]))
    outside = sorted(map(str, set(folder.iterdir()) - before))
    return {
        "seed": settings.seed,
        "minutes": minutes,
        "actions": done,
        "middle_mb": middle,
        "last_mb": last,
        "page_errors": errors,
        "alive": alive,
        "exit_code": process.returncode,
        "server_log": (work / "server.log").read_text()[-2000:],
        "files_outside": outside + sorted(p.name for p in work.iterdir() if p.name not in OWN),
        "memory_grew": last > 1.1 * middle + 20,
    }


def failures(rows) -> list[str]:
    """Say what the page or the server did that they must not do."""
    found = []
    for row in rows:
        wrong = {
            f"errors of the page: {'; '.join(row['page_errors'])}": row["page_errors"],
            "the server ended before its time": not row["alive"],
            f"exit code {row['exit_code']} of the server": row["exit_code"],
            f"the server wrote to its log: {row['server_log']}": row["server_log"],
            f"files where there must be none: {', '.join(row['files_outside'])}": row["files_outside"],
            "memory of the last third is above 1.1 times that of the middle one and 20 MB": row[
                "memory_grew"
            ],
        }
        found += [f"seed {row['seed']}: {sentence}" for sentence, holds in wrong.items() if holds]
    return found


def cases(given):
    tables = {"input": {"envmap": "sunsky", "width": 128}, "scene": {"file": "sphere", "width": 64}}
    return [calling("soak", "experiments.paint.soak:soak", tables, minutes=given.minutes)]


EXPERIMENT = Experiment(
    "paint.soak",
    "Random use of the page of envedit paint, in a real browser.",
    cases,
    columns={
        "seed": "{seed}",
        "minutes": "{minutes:g}",
        "actions": lambda row: str(sum(row["actions"].values())),
        "of them": lambda row: ", ".join(f"{row['actions'][what]} {what}" for what in sorted(row["actions"])),
        "memory, middle third, MB": lambda row: number(row["middle_mb"], ".0f"),
        "last third": lambda row: number(row["last_mb"], ".0f"),
    },
    failures=failures,
    options=lambda parser: parser.add_argument("--minutes", type=float, default=60.0, metavar="N"),
)
