"""Draw what was measured: means over cells against time, and one knob at a time."""

from __future__ import annotations

from pathlib import Path

from experiments.harness import figure

from .analyse import by, everywhere, front, means

TIMES = {"time": "whole run", "again": "run again, T and fit at hand"}
"""Kinds of time: of a run from nothing but compiled kernels; of one that finds T and fit on disk."""
STYLES = {  # group: colour, marker, its size, label
    "knob": ("tab:blue", "o", 16, "one knob"),
    "joint": ("tab:gray", "s", 16, "several"),
    "siren": ("tab:green", "^", 16, "SIREN"),
    "preset": ("tab:red", "*", 90, None),
    "standard": ("tab:red", "*", 90, "preset"),
}
WORTH = {"psnr": ("rendering, dB", "tab:blue"), "map_psnr": ("map, dB", "tab:orange")}
TICKS = (0.25, 0.35, 0.5, 0.75, 1, 1.5, 2)


def points(panel, rows: list[dict], kind: str, key: str) -> None:
    """Draw changes of settings against time ratios, the presets by name, and the front of them all.

    Parameters
    ----------
    panel : matplotlib.axes.Axes
        Where to.
    rows : list of dict
        As :func:`.analyse.means`.
    kind, key : str
        What is shown: a key of :data:`TIMES`, and of :data:`WORTH`.
    """
    at = [(row["ratio"][kind], row["change"][key]) for row in rows]
    for some in by(rows, "group"):
        colour, marker, size, label = STYLES[some[0]["group"]]
        places = [(row["ratio"][kind], row["change"][key]) for row in some]
        panel.scatter(*zip(*places, strict=True), s=size, c=colour, marker=marker, label=label, zorder=3)
        for row, place in zip(some, places, strict=True):
            if marker == "*":
                panel.annotate(f" {row['setting']}", place, fontsize="small", va="bottom")
    panel.step(*zip(*front(at), strict=True), where="post", color="black", lw=0.8, zorder=2)
    panel.set_xscale("log")
    panel.set_xticks(TICKS, TICKS)
    panel.minorticks_off()
    panel.axhline(0, color="grey", lw=0.6)
    panel.set_ylabel(WORTH[key][0])
    panel.set_xlabel(f"time over the standard preset's: {TIMES[kind]}")


def fronts(averages: list[dict], file: Path) -> None:
    """Draw both kinds of time and of worth, of the settings that ran in most cells."""
    rows = everywhere(averages)
    with figure(file, 2, 2, (11, 8)) as panels:
        for row, key in zip(panels, WORTH, strict=True):
            for panel, kind in zip(row, TIMES, strict=True):
                points(panel, rows, kind, key)
        cells = rows[0]["cells"]
        panels[0, 0].set_title(f"mean change over {cells} cells; the line: nothing is better and quicker")
        panels[0, 0].legend(fontsize="small", loc="lower right")


def by_knob(averages: list[dict], file: Path) -> None:
    """Draw a panel for each knob: rendering and map against time, a label for each level, no lines.

    Neither time nor worth need follow a knob.
    """
    levels = [
        row | dict(zip(("knob", "level"), row["setting"].split(": "), strict=True))
        for row in averages
        if row["group"] == "knob"
    ]
    knobs = by(levels, "knob")
    with figure(file, 2, len(knobs) // 2, (1.8 * len(knobs), 6)) as panels:
        for panel, some in zip(panels.ravel(), knobs, strict=True):
            for key, (label, colour) in WORTH.items():
                # The star, the level that is not changed, is the standard preset: ratio 1, change 0.
                at = [*((row["ratio"]["time"], row["change"][key]) for row in some), (1.0, 0.0)]
                panel.plot(*zip(*at, strict=True), "o", color=colour, ms=4, label=label)
            for row in some:
                place = row["ratio"]["time"], row["change"]["psnr"]
                panel.annotate(f" {row['level']}", place, fontsize="x-small")
            panel.plot(1.0, 0.0, "*", color="tab:red", ms=9)
            panel.set_title(some[0]["knob"], fontsize="small")
        panels[0, 0].legend(fontsize="x-small")
        panels[0, 0].figure.supxlabel("time over the standard preset's (star: the level that is not changed)")
        panels[0, 0].figure.supylabel("change, dB")


def draw(runs: list[dict], folder: Path) -> list[Path]:
    """Draw the figures of the runs of :func:`.analyse.compared`, if there are knobs; returns the files."""
    if not any(run["group"] == "knob" for run in runs):
        return []
    files = [folder / "front.png", folder / "knobs.png"]
    for file, picture in zip(files, (fronts, by_knob), strict=True):
        picture(means(runs), file)
    return files
