"""Random use of the page of ``envedit paint`` in a real browser, and the memory of its server meanwhile."""

import random
import re
import time
from collections import Counter
from pathlib import Path

import numpy as np

from experiments.harness import Experiment, calling, figure
from experiments.paint.figure10 import RENDERED, drag, opened, place, prepared

BUTTONS = "button:visible:enabled:not(#save, #look, #light-image, .grip)"
"""All but those that write or ask for a file, and those that are dragged."""
KEYS = ("b", "1", "5", "[", "]", "Escape", "Enter", "Control+z", "ArrowLeft")
LIGHTS = 0.75
"""Share of the drags over the map that begin at a light."""
MOVE_S = 0.03
LONGEST_PAUSE_S = 2.0
"""Between two actions, so that some of them are solved for and others are superseded."""
SEEN_HANDLES = """() => {
  document.querySelector("#right").scrollTo(0, 0);
  return [...document.querySelectorAll(".handle")].map((handle) => [handle, handle.getBoundingClientRect()])
    .map(([handle, box]) => [handle, box.x + box.width / 2, box.y + box.height / 2])
    .filter(([handle, x, y]) => document.elementFromPoint(x, y) === handle).map(([, x, y]) => [x, y]);
}"""
"""Middles of the handles that a pointer can reach, in pixels of the page."""
OWN = {"edit.toml", "edit_out", "server.log"}
"""What may lie in the folder that the command works in."""


def resident_mb(process) -> float:
    """Return the resident memory of a process, MB; NaN once it has ended."""
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{process.pid}/status").read_text())
    return int(found[1]) / 1024 if found else float("nan")


def paint(page, chance):
    """Drag over the picture, by the tool and shape that were chosen."""
    drag(page, spots(page, chance, "#overlay", chance.randrange(2, 12)), MOVE_S)


def over_map(page, chance):
    """Drag a light over the map, or from a place of it: then a region is painted, or the sky turned."""
    seen = page.evaluate(SEEN_HANDLES) if chance.random() < LIGHTS else []  # the map may be zoomed
    there = spots(page, chance, "#map-stack", chance.randrange(2, 12))
    drag(page, [chance.choice(seen), *there] if seen else there, MOVE_S)


def button(page, chance):
    """Press a button."""
    buttons = page.locator(BUTTONS)
    buttons.nth(chance.randrange(buttons.count())).click(force=True)


def turn(page, chance):
    """Turn the sky."""
    page.locator("#degrees").fill(str(chance.randrange(-400, 400)))
    page.keyboard.press("Enter")


def wheel(page, chance):
    """Zoom into the map, or out of it."""
    page.mouse.move(*spots(page, chance, "#map-stack", 1)[0])
    page.mouse.wheel(0, chance.choice([-100, 100]))


def key(page, chance):
    """Press a key."""
    page.keyboard.press(chance.choice(KEYS))


def reload(page, chance):
    """Open the page again."""
    page.reload()
    page.wait_for_selector("#work:not([hidden])", timeout=120_000)
    page.wait_for_selector(".handle", state="attached", timeout=120_000)


ACTIONS = [paint] * 6 + [over_map] * 4 + [button] * 6 + [turn, wheel, key, reload]


def spots(page, chance, name, count) -> list:
    """Return places at random in an element of the page."""
    return [place(page, name, chance.random(), chance.random()) for _ in range(count)]


def at_rest_mb(page, process) -> float:
    """Take everything back, wait until nothing is left to do, and return the memory."""
    page.keyboard.press("Escape")
    page.locator("#clear").click(force=True)
    time.sleep(LONGEST_PAUSE_S)
    page.wait_for_function(RENDERED, timeout=600_000)
    time.sleep(LONGEST_PAUSE_S)
    return resident_mb(process)


def soak(settings, folder, minutes) -> dict:
    """Use the page for some minutes; the configuration's seed is that of the actions."""
    chance = random.Random(settings.seed)
    done = Counter()
    errors = []
    memory = []
    rest = []
    work = prepared(folder)
    with opened(work) as (page, process):
        page.on("pageerror", lambda error: errors.append(str(error)))
        began = time.monotonic()
        for half in (1, 2):
            while time.monotonic() < began + 30 * half * minutes and process.poll() is None:
                action = chance.choice(ACTIONS)
                action(page, chance)
                time.sleep(LONGEST_PAUSE_S * chance.random())
                done[action.__name__] += 1
                memory.append([time.monotonic() - began, resident_mb(process)])
            rest.append(at_rest_mb(page, process))
        alive = process.poll() is None
    return {
        "minutes": minutes,
        "actions": done,
        "memory": memory,
        "rest": rest,
        "page_errors": errors,
        "alive": alive,
        "server_log": (work / "server.log").read_text()[-2000:],
        "files_outside": sorted(path.name for path in work.iterdir() if path.name not in OWN),
    }


def measure(done) -> dict:
    """Return what was done, and the mean memory of the three thirds of the time."""
    memory = np.array(done.metrics["memory"])[:, 1]
    return done.metrics | {"thirds": [float(np.mean(third)) for third in np.array_split(memory, 3)]}


def failures(rows) -> list[str]:
    """Say what the page or the server did that they must not do."""
    found = []
    for row in rows:
        rest = row["rest"]
        wrong = {
            f"errors of the page: {'; '.join(row['page_errors'])}": row["page_errors"],
            "the server ended before its time": not row["alive"],
            f"the server wrote to its log: {row['server_log']}": row["server_log"],
            f"files where there must be none: {', '.join(row['files_outside'])}": row["files_outside"],
            "at the end it rests with 5 % more memory than at half time": rest[1] > 1.05 * rest[0],
        }
        found += [sentence for sentence, holds in wrong.items() if holds]
    return found


def draw(done, to):
    """Draw the server's memory over time: ``memory.png``."""
    with figure(to / "memory.png", 1, 1, (7, 2.8), squeeze=False) as panels:
        for one in done:
            seconds, memory = np.array(one.metrics["memory"]).T
            panels[0, 0].plot(seconds / 60, memory, linewidth=0.8)
        panels[0, 0].set(xlabel="minutes of random use", ylabel="memory of the server, MB", ylim=(0, None))
    return [to / "memory.png"]


def cases(given):
    tables = {"input": {"envmap": "sunsky"}, "scene": {"file": "sphere", "width": 128}}
    return [calling("soak", soak, tables, minutes=given.minutes)]


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "minutes": "{minutes:g}",
        "actions": lambda row: str(sum(row["actions"].values())),
        "of them": lambda row: ", ".join(f"{row['actions'][what]} {what}" for what in sorted(row["actions"])),
        "memory in the first, second, last third, MB": "{thirds[0]:.0f}, {thirds[1]:.0f}, {thirds[2]:.0f}",
        "at rest at half time, at the end": "{rest[0]:.0f}, {rest[1]:.0f}",
    },
    failures=failures,
    options=lambda parser: parser.add_argument("--minutes", type=float, default=15.0, metavar="N"),
    draw=draw,
    alone=True,
)
