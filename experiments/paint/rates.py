"""How fast the page of ``envedit paint`` is, in a real browser."""

import os
import time

import numpy as np

from envedit.cli.paint import project, protocol, session
from experiments.harness import Experiment, calling, number
from experiments.paint.browser import browsing, converged, moved, opened, place, prepared

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


def alone(work):
    """Return milliseconds of a dragged and of a solved frame in a session, without server and browser."""
    solver = session.Session(project.opened(str(work / "edit.toml")), session.Tell())
    while solver.advance():
        pass

    def timed(document, phase, count=40):
        times = []
        for i in range(count):
            began = time.perf_counter()
            solver.update(protocol.Edit(protocol.document(document(i / count)), phase))
            if phase == "drawing":
                solver.advance()
            times.append(1000 * (time.perf_counter() - began))
        return float(np.median(times[count // 4 :]))

    def light(t):
        place = {"azimuth": 90 + 60 * t, "elevation": 35 + 10 * t}
        return {"lights": [{"light": 1, "flux": [1.0] * 3, "size": 1.0} | place]}

    def shadow(t):
        points = [[0.2 + 0.5 * t * k / 20, 0.8] for k in range(21)]
        return {"strokes": [{"type": "shadow", "amount": 0.6, "points": points, "width": 0.1}]}

    found = {"drag_ms": timed(light, "dragging")}
    solver.update(protocol.Edit(protocol.Document()))
    return found | {"solved_ms": timed(shadow, "drawing")}


def rates(settings, folder) -> dict:
    """Measure one configuration, with T on disk and kernels compiled."""
    work = prepared(folder)
    found = {"pixels": settings.scene.width, "map": settings.input.width, "cores": os.cpu_count()}
    with browsing() as browser:
        with opened(browser, work):  # T goes to the disk
            pass
        with opened(browser, work) as (page, _, found["ready_s"], _):
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
    return found | alone(work)


def cases(given):
    sizes = {pixels: {"file": "sphere", "width": pixels} for pixels in (128, 256)}
    sky = {"envmap": "sunsky", "width": 256}
    return [
        calling(f"{pixels}x{pixels}", "experiments.paint.rates:rates", {"input": sky, "scene": scene})
        for pixels, scene in sizes.items()
    ]


FIGURES = {
    "page ready after the command, s (at most 5)": "ready_s",
    "session without a browser: a dragged frame, ms": "drag_ms",
    "the same: a solved frame, ms": "solved_ms",
    "light dragged: new frames a second (at least 15)": "drag_frames_s",
    "from pointer to picture, median, ms (at most 100)": "pointer_to_picture_ms",
    "the same, 95 %, ms": "pointer_to_picture_95_ms",
    "painting: solved frames a second (at least 5)": "solved_frames_s",
    f"{SOON_S} s after the stroke: dB above the converged residual (at most 0.5)": "db_to_converged",
}
EXPERIMENT = Experiment(
    "paint.rates",
    "How fast the page of envedit paint is, in a real browser.",
    cases,
    columns={"pixels": "{pixels}x{pixels}", "map": "{map} wide", "cores": "{cores}"}
    | {heading: lambda row, key=key: number(row[key], ".3g") for heading, key in FIGURES.items()},
    alone=True,
)
