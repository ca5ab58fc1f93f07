"""Random use of the page of ``envedit paint``, in a real browser."""

import os
import random
import re
import time
from collections import Counter
from pathlib import Path

from experiments.harness import Experiment, calling, number
from experiments.paint.browser import browsing, converged, opened, place, prepared

OWN = {"edit.toml", "edit_out", "server.log"}
"""What may lie in the folder that the command works in."""


RESTING, QUIET = 0.1, 3.0
"""Share of a processor below which a process rests, over so many seconds."""
LONGEST_REST = 300.0
"""Seconds in which it must come to rest."""


def memory_at_rest(process) -> float:
    """Wait until a process rests; return its resident memory, MB."""
    end, used = time.monotonic() + LONGEST_REST, processor_time(process)
    while time.monotonic() < end:
        time.sleep(QUIET)
        before, used = used, processor_time(process)
        if used - before < RESTING * QUIET:
            break
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{process.pid}/status").read_text())
    return int(found[1]) / 1024 if found else float("nan")


def processor_time(process) -> float:
    """Return the seconds that a process has computed, of its own and in the system."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return sum(int(ticks) for ticks in fields[11:13]) / os.sysconf("SC_CLK_TCK")


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
    chance, done, at_rest, work = random.Random(settings.seed), Counter(), [], prepared(folder)
    before = set(folder.iterdir())
    with browsing() as browser, opened(browser, work) as (page, process, _, errors):
        for _ in ("first half", "second half"):
            end = time.monotonic() + 30 * minutes
            while time.monotonic() < end and process.poll() is None:
                done[act(page, chance)] += 1
            if process.poll() is None:
                page.get_by_test_id("clear").click(force=True)
                converged(page)
                at_rest.append(memory_at_rest(process))
        alive = process.poll() is None
    half, last = [*at_rest, float("nan"), float("nan")][:2]
    outside = sorted(map(str, set(folder.iterdir()) - before))
    return {
        "seed": settings.seed,
        "minutes": minutes,
        "actions": done,
        "half_mb": half,
        "last_mb": last,
        "page_errors": errors,
        "alive": alive,
        "exit_code": process.returncode,
        "server_log": (work / "server.log").read_text()[-2000:],
        "files_outside": outside + sorted(p.name for p in work.iterdir() if p.name not in OWN),
        "memory_grew": last > 1.1 * half + 20,
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
            "memory at rest is above 1.1 times that of half time and 20 MB": row["memory_grew"],
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
        "memory at rest, half time, MB": lambda row: number(row["half_mb"], ".0f"),
        "at the end": lambda row: number(row["last_mb"], ".0f"),
    },
    failures=failures,
    options=lambda parser: parser.add_argument("--minutes", type=float, default=60.0, metavar="N"),
)
