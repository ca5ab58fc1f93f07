"""How fast the page of ``envedit paint`` is in a browser: it opens, a light is dragged, a shadow painted.

The map is the analytic sky, written at the width of the case; 4k is a file of 4096 x 2048 texels.
"""

import re
import time

import numpy as np

from envedit.images import analytic_sky, images
from experiments.harness import Experiment, calling
from experiments.paint.figure10 import opened, place, prepared

DRAG_S = 6.0
SIZES = {"128": (128, 1024), "512": (512, 1024), "4k map": (128, 4096)}
"""Name -> pixels across, and texels across of the map's file."""
HANDLE = "#handle-1"


def dragged(page, start, path) -> list[dict]:
    """Drag the pointer from a place along ``path`` of (0, 1), 60 times a second; returns the page's log."""
    page.mouse.move(*start)
    page.mouse.down()
    page.evaluate("() => { envedit.log.length = 0; }")
    end = time.perf_counter() + DRAG_S
    while (left := end - time.perf_counter()) > 0:
        page.mouse.move(*path(1 - left / DRAG_S))
        time.sleep(1 / 60)
    log = page.evaluate("() => envedit.log")
    page.mouse.up()
    return log


def frames(log) -> float:
    """Return the new frames a second of a log."""
    return len({entry["frame"] for entry in log if "frame" in entry}) / DRAG_S


def delay_ms(log) -> float:
    """Return the median time from a move of the pointer to the first picture that has it."""
    sent = {entry["edit"]: entry["since"] for entry in log if "edit" in entry}
    shown = [(entry["frame"], entry["at"]) for entry in log if "frame" in entry]
    delays = []
    for status in log:
        if status.get("status") in sent:
            times = [at for frame, at in shown if frame >= status["of"]]
            delays += [times[0] - sent[status["status"]]] if times else []
    return float(np.median(delays)) if delays else float("nan")


def rates(settings, folder, texels) -> dict:
    """Measure one size, with T on disk and kernels compiled."""
    work = prepared(folder)
    edit = work / "edit.toml"
    edit.write_text(re.sub("^envmap = .*$", 'envmap = "sky.exr"', edit.read_text(), flags=re.M))
    images.write_exr(work / "sky.exr", analytic_sky.sunsky(texels, azimuth=90.0, elevation=35.0))
    with opened(work):  # T goes to the disk
        pass
    began = time.perf_counter()
    with opened(work) as (page, _):
        ready_s = time.perf_counter() - began
        width = page.locator("#overlay").bounding_box()["width"]

        # ---- A light is dragged; the first time, kernels are compiled
        for _ in range(2):
            page.wait_for_selector(HANDLE, timeout=60_000)
            x, y = place(page, HANDLE, 0.5, 0.5)
            light = dragged(
                page, (x, y), lambda t, x=x, y=y: (x + 110 * np.sin(18 * t), y - 20 * np.sin(30 * t))
            )
            time.sleep(3)

        # ---- A shadow is painted
        page.locator("#tool-shadow").click()
        x, y = place(page, "#overlay", 0.2, 0.8)
        stroke = dragged(page, (x, y), lambda t: (x + 0.5 * width * t, y + 0.03 * width * np.sin(30 * t)))
    solved = {entry["steps"] for entry in stroke if "status" in entry}
    return {
        "pixels": settings.scene.width,
        "texels": texels,
        "shown": width,
        "ready_s": ready_s,
        "light_frames": frames(light),
        "light_ms": delay_ms(light),
        "stroke_frames": frames(stroke),
        "stroke_ms": delay_ms(stroke),
        "solved_frames": max(0, len(solved) - 1) / DRAG_S,
    }


def cases(given):
    return [
        calling(
            name,
            rates,
            {"input": {"envmap": "sunsky"}, "scene": {"file": "sphere", "width": pixels}},
            texels=texels,
        )
        for name, (pixels, texels) in SIZES.items()
    ]


EXPERIMENT = Experiment(
    cases,
    columns={
        "picture": "{pixels}x{pixels}",
        "shown at, pixels": "{shown:.0f}",
        "map, texels": "{texels}",
        "page ready after the command, s": "{ready_s:.1f}",
        "a light dragged: frames a second": "{light_frames:.3g}",
        "from pointer to picture, ms": "{light_ms:.0f}",
        "painting: frames a second": "{stroke_frames:.3g}",
        "pointer to picture, ms": "{stroke_ms:.0f}",
        "of them solved": "{solved_frames:.3g}",
    },
    alone=True,
)
