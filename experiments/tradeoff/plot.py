"""Pictures of what was measured, with matplotlib (``envedit[report]``).

``front.png`` (rendering and map against the time of a run, means over all cells), ``cells.png`` (a panel for
each cell) and ``knobs.png`` (one knob at a time).
"""

from __future__ import annotations

from pathlib import Path

from envedit.core.errors import ConfigError, InputError

from .analyse import TIMES, front, means, ratios

STYLES = {  # group: colour, marker
    "knob": ("tab:blue", "o"),
    "joint": ("tab:gray", "s"),
    "siren": ("tab:green", "^"),
    "preset": ("tab:red", "*"),
    "standard": ("tab:red", "*"),
    "paper": ("tab:red", "*"),
}
LABELS = {"knob": "one knob", "joint": "several", "siren": "SIREN", "standard": "preset"}
WORTH = {"psnr": "rendering, dB", "map_psnr": "map, dB"}


def points(panel, rows: list[dict], key: str, kind: str, worth) -> None:
    """Draw settings as points of time ratio and worth, the presets by name, and the front of them all.

    Parameters
    ----------
    panel : matplotlib.axes.Axes
        Where to.
    rows : list of dict
        With ``setting``, ``group`` and ``ratio``.
    key, kind : str
        What is shown: a key of :data:`WORTH`, and of ``ratio``.
    worth : callable
        A row to its height.
    """
    from matplotlib import ticker

    for group, (colour, marker) in STYLES.items():
        some = [r for r in rows if r["group"] == group]
        if not some:
            continue
        size = 90 if marker == "*" else 16
        at = [r["ratio"][kind] for r in some], [worth(r) for r in some]
        panel.scatter(*at, s=size, c=colour, marker=marker, label=LABELS.get(group), zorder=3)
        if marker == "*":
            names = {r["setting"].split(",")[0]: (x, y) for r, x, y in zip(some, *at, strict=True)}
            for name, place in names.items():
                panel.annotate(f" {name}", place, fontsize="small", va="bottom")
    best = front([(r["ratio"][kind], worth(r)) for r in rows])
    line = [(rows[i]["ratio"][kind], worth(rows[i])) for i in best]
    panel.step(*zip(*line, strict=True), where="post", color="black", lw=0.8, zorder=2)
    panel.set_xscale("log")
    panel.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    panel.xaxis.set_minor_formatter(ticker.NullFormatter())
    panel.grid(alpha=0.3, which="both")
    panel.set_ylabel(WORTH[key])


def fronts(rows: list[dict], file: Path) -> None:
    """Draw means over all cells, as changes from the standard preset: both kinds of time and of worth."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    for row, key in zip(panels, WORTH, strict=True):
        for panel, (kind, words) in zip(row, TIMES.items(), strict=True):
            points(panel, rows, key, kind, lambda r, key=key: r["change"][key])
            panel.axhline(0, color="grey", lw=0.6)
            panel.set_xlabel(f"time over the standard preset's: {words}")
    panels[0, 0].set_title(
        f"mean change over {rows[0]['cells']} cells; the line: nothing is better and quicker"
    )
    panels[0, 0].legend(fontsize="small", loc="lower right")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def by_cell(compared: list[dict], bounds: list[dict], file: Path, kind: str = "time") -> None:
    """Draw a column for each cell: rendering above, map below; dotted: the unedited map."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        2, len(bounds), figsize=(3.6 * len(bounds), 6.4), layout="constrained", squeeze=False
    )
    for column, cell in zip(panels.T, bounds, strict=True):
        rows = [r for r in compared if (r["map"], r["scene"]) == (cell["map"], cell["scene"])]
        for panel, key in zip(column, WORTH, strict=True):
            points(panel, rows, key, kind, lambda r, key=key: r[key])
            part, name = {"psnr": ("render", "psnr_without_noise"), "map_psnr": ("map", "psnr")}[key]
            panel.axhline(cell["unedited"][part][name], color="grey", ls=":", lw=1)
        column[0].set_title(f"{cell['map']}\n{cell['scene']}", fontsize="small")
        column[1].set_xlabel("time over the standard preset's")
    figure.savefig(file, dpi=90)
    plt.close(figure)


def by_knob(rows: list[dict], file: Path, kind: str = "time") -> None:
    """Draw a panel for each knob: rendering and map against time, a label for each level, no lines.

    Neither time nor worth need follow a knob.
    """
    import matplotlib.pyplot as plt

    knobs: dict[str, list[dict]] = {}
    for r in rows:
        if r["group"] == "knob":
            knobs.setdefault(r["setting"].split(": ")[0], []).append(r)
    standard = next(r for r in rows if r["group"] == "standard")
    if not knobs:
        return
    across = 4
    down = -(-len(knobs) // across)
    figure, panels = plt.subplots(
        down, across, figsize=(3.6 * across, 3 * down), layout="constrained", squeeze=False
    )
    for panel in panels.ravel()[len(knobs) :]:
        panel.set_axis_off()
    for panel, (name, some) in zip(panels.ravel(), knobs.items(), strict=False):
        for key, colour in (("psnr", "tab:blue"), ("map_psnr", "tab:orange")):
            at = [(r["ratio"][kind], r["change"][key]) for r in [*some, standard]]
            panel.plot(*zip(*at, strict=True), "o", color=colour, ms=4, label=WORTH[key])
        for r in some:
            level = r["setting"].split(": ")[1]
            panel.annotate(f" {level}", (r["ratio"][kind], r["change"]["psnr"]), fontsize="x-small")
        panel.plot(standard["ratio"][kind], standard["change"]["psnr"], "*", color="tab:red", ms=9)
        panel.set_title(name, fontsize="small")
        panel.grid(alpha=0.3)
    panels[0, 0].legend(fontsize="x-small")
    figure.supxlabel("time over the standard preset's (star: the level that is not changed)")
    figure.supylabel("change, dB")
    figure.savefig(file, dpi=100)
    plt.close(figure)


def draw(results: dict, folder: Path) -> list[Path]:
    """Write the pictures; returns the files.

    Raises
    ------
    InputError
        If nothing can be compared: the standard preset was not measured beside any run.
    """
    compared = ratios(results["runs"])
    if not compared:
        raise InputError("no run of the standard preset to compare with: run the experiment to its end")
    try:
        import matplotlib
    except ImportError:
        raise ConfigError("no pictures: matplotlib is missing: run pip install '.[report]'") from None
    files = []
    matplotlib.use("agg")
    rows = means(compared)
    most = max(r["cells"] for r in rows)
    pictures = {
        "front.png": lambda path: fronts([r for r in rows if r["cells"] == most], path),
        "cells.png": lambda path: by_cell(compared, results["cells"], path),
        "knobs.png": lambda path: by_knob(rows, path),
    }
    for name, picture in pictures.items():
        picture(folder / name)
        if (folder / name).exists():
            files.append(folder / name)
    return files
