"""Contact sheets and charts of what is done, with matplotlib (envedit[report]); display values are gamma."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from envedit.core.color import luminance, tonemap

from . import measured, tables
from .kinds import KINDS
from .plan import Cell
from .published import PUBLISHED

COLUMN = 1.7
"""Width of a picture, inches."""
_SETTINGS = {"paper": "paper's settings", "ours": "our settings"}


def draw(name: str, out, cells: list[Cell], folder) -> list[Path]:
    """Draw a table or figure; returns the files, those of nothing that is done left out."""
    files, folder = [], Path(folder)
    for settings in dict.fromkeys(cell.settings for cell in cells):
        some = [cell for cell in cells if cell.settings == settings]
        if not measured.done(out, some):
            continue
        if name == "figure4":
            made = {"": histograms(out, some)}
        elif name == "figure5":
            made = {"": noise(out, some)}
        elif name == "figure8":
            made = {"": by_roughness(out, some)}
        else:
            made = {}
            for roughness in dict.fromkeys(cell.roughness for cell in some):
                at = "" if roughness is None else f"-roughness{roughness:g}"
                made[at] = sheet(name, out, [cell for cell in some if cell.roughness == roughness])
            if name == "table3":
                made["-bars"] = bars(out, some)
        for part, figure in made.items():
            if figure is not None:
                files.append(folder / f"{name}-{settings}{part}.png")
                figure.savefig(files[-1], dpi=110, facecolor="white")
    return files


# ---- pictures ----------------------------------------------------------------------------------------------


def sheet(name: str, out, cells: list[Cell]) -> Figure | None:
    """Draw initial, target and every method side by side, two rows a map: the maps, and the renderings."""
    if not measured.done(out, cells):
        return None
    rows = tables.rows_of(name, cells)
    titles = ["initial", "painted" if name == "figure9" else "target"]
    titles += [KINDS[name].methods[row].title for row in rows]
    skies = [sky for sky in dict.fromkeys(cell.map for cell in cells)]
    strips, heights = [], []
    for sky in skies:
        of = {row: next((c for c in some if c.map == sky), None) for row, some in rows.items()}
        shown = {row: measured.pictures(out, cell) if cell else {} for row, cell in of.items()}
        any_ = next((found for found in shown.values() if found), {})
        maps = [any_.get("initial_map"), any_.get("true_map"), *(s.get("map") for s in shown.values())]
        pictures = [any_.get("initial"), any_.get("target"), *(s.get("render") for s in shown.values())]
        for line in (maps, pictures):
            strips.append(line)
            heights.append(_aspect(line))
    return _grid(strips, heights, titles, [part for sky in skies for part in ("", sky)])


def by_roughness(out, cells: list[Cell]) -> Figure:
    """Draw Figure 8: a column a roughness; target, rendering and map of every method."""
    rough = sorted({cell.roughness for cell in cells})
    strips, labels = [], []
    for sky in dict.fromkeys(cell.map for cell in cells):
        some = [cell for cell in cells if cell.map == sky]
        rows = tables.rows_of("figure8", some)
        shown = {(c.row, c.roughness): measured.pictures(out, c) for c in some}
        first = [next((shown[row, r] for row in rows if shown.get((row, r))), {}) for r in rough]
        for what, label in (("initial_map", "initial map"), ("true_map", "true map")):
            strips.append([one.get(what) for one in first])
            labels.append(label)
        strips.append([one.get("target") for one in first])
        labels.append(f"{sky}: target")
        for row in rows:
            title = KINDS["figure8"].methods[row].title
            for what, label in (("map", ""), ("render", title)):
                strips.append([shown.get((row, r), {}).get(what) for r in rough])
                labels.append(label)
    titles = [f"roughness {r:g}" for r in rough]
    return _grid(strips, [_aspect(line) for line in strips], titles, labels, COLUMN * 1.6)


def noise(out, cells: list[Cell]) -> Figure:
    """Draw Figure 5: original, the networks, and the networks with the same noise on their weights."""
    rows, strips, labels = tables.rows_of("figure5", cells), [], []
    for sky in dict.fromkeys(cell.map for cell in cells):
        shown = {
            row: measured.pictures(out, next(c for c in some if c.map == sky)) if some else {}
            for row, some in ((row, [c for c in some if c.map == sky]) for row, some in rows.items())
        }
        original = next((found["original"] for found in shown.values() if found), None)
        strips.append([original, *(s.get("fitted") for s in shown.values())])
        strips.append([None, *(s.get("noisy") for s in shown.values())])
        labels += [sky, "with noise"]
    titles = ["original", *(KINDS["figure5"].methods[row].title for row in rows)]
    return _grid(strips, [_aspect(line) for line in strips], titles, labels, COLUMN * 2)


def histograms(out, cells: list[Cell]) -> Figure:
    """Draw Figure 4: maps, how much of them has what radiance, and their brightest texels."""
    ready = [cell for cell in cells if cell in measured.done(out, cells)]
    skies = list(dict.fromkeys(cell.map for cell in ready))
    count = len(tables.rows_of("figure4", ready))
    figure = Figure(figsize=(13, len(skies) * (0.75 * count + 1.6)), layout="constrained")
    grid = figure.add_gridspec(len(skies), 3, width_ratios=(3, 3, 3))
    for i, sky in enumerate(skies):
        rows = tables.rows_of("figure4", [cell for cell in ready if cell.map == sky])
        shown = {row: measured.pictures(out, some[0]) for row, some in rows.items()}
        read = {row: measured.numbers(out, some[0]) for row, some in rows.items()}
        original = next(iter(shown.values()))["original"]
        pictures = {f"{sky}: original": original}
        for row, found in shown.items():
            about = read[row]
            psnr = "-" if about["log_psnr"] is None else f"{about['log_psnr']:.1f} dB"
            peak = "-" if about["peak_ratio"] is None else f"{about['peak_ratio']:.3f}"
            pictures[f"{KINDS['figure4'].methods[row].title}: {psnr}, peak {peak}"] = found["fitted"]
        strip = grid[i, 0].subgridspec(len(pictures), 1)
        for line, (title, picture) in enumerate(pictures.items()):
            _show(figure.add_subplot(strip[line]), picture, title)
        histogram, sorted_ = figure.add_subplot(grid[i, 1]), figure.add_subplot(grid[i, 2])
        for (title, picture), style in zip(pictures.items(), _styles(), strict=False):
            light = np.sort(luminance(picture).ravel())[::-1] + 1e-3
            name = title.split(": ")[1] if picture is original else title.split(":")[0]
            counts, edges = np.histogram(np.log10(light), np.linspace(-3, 5, 65))
            histogram.stairs(np.maximum(counts, 0.5), edges, label=name, **style)
            sorted_.loglog(np.arange(1, len(light) + 1), light, label=name, **style)
        histogram.set(yscale="log", ylim=(0.7, None), xlabel="log10 of luminance + 0.001", ylabel="texels")
        sorted_.set(xlabel="texels, the brightest first", ylabel="luminance + 0.001")
        for panel in (histogram, sorted_):
            panel.grid(alpha=0.3)
        sorted_.legend(fontsize=7)
    return figure


# ---- charts ------------------------------------------------------------------------------------------------


def bars(out, cells: list[Cell]) -> Figure:
    """Draw Table 3 as bars: a panel a column, a group a roughness, black ticks for the paper's numbers."""
    rows, rough = tables.rows_of("table3", cells), sorted({cell.roughness for cell in cells})
    shared = tables.common(out, cells)
    found = {
        (row, r): tables.averages(out, [cell for cell in some if cell.roughness == r and cell in shared])[0]
        for row, some in rows.items()
        for r in rough
    }
    settings = _SETTINGS[cells[0].settings]
    maps = len({cell.map for cell in shared})
    figure = Figure(figsize=(15, 6.4), layout="constrained")
    panels = figure.subplots(2, 4).ravel()
    wide = 0.8 / len(rows)
    for panel, column in zip(panels, tables.COLUMNS, strict=True):
        for i, (row, style) in enumerate(zip(rows, _styles(1), strict=False)):
            at = np.arange(len(rough)) + (i - (len(rows) - 1) / 2) * wide
            heights = [found[row, r][column] for r in rough]
            numbers = [np.nan if height is None else height for height in heights]
            panel.bar(at, numbers, wide * 0.9, color=style["color"], label=KINDS["table3"].methods[row].title)
            for x, r in zip(at, rough, strict=True):
                theirs = PUBLISHED["table3"].get(r, {}).get(row, {}).get(column)
                if theirs is not None:
                    panel.plot([x - wide / 2, x + wide / 2], [theirs, theirs], color="black", lw=1.5)
        what = "map" if column[0] == "envmap" else "rendering"
        panel.set_title(f"{what} {column[1].upper()}", fontsize=9)
        panel.set_xticks(range(len(rough)), [f"{r:g}" for r in rough], fontsize=8)
        panel.tick_params(axis="y", labelsize=7)
        panel.grid(axis="y", alpha=0.3)
        if not panel.lines and all(averages[column] is None for averages in found.values()):
            panel.set_yticks([])  # those of a panel without numbers would look like numbers
            panel.text(0.5, 0.5, "not measured", transform=panel.transAxes, ha="center", fontsize=8)
    title = f"Table 3 by roughness, {settings}, {maps} maps; black: the paper's numbers, over 44 maps"
    figure.suptitle(title, fontsize=10)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(rows), fontsize=8, frameon=False)
    return figure


# ---- layout ------------------------------------------------------------------------------------------------


def _grid(strips, heights, titles, labels, width=COLUMN):
    """Lay out rows of pictures under titles; ``heights`` are those of pictures of width 1."""
    columns, gap, top, left = len(titles), 0.06, 0.3, 0.42
    size = left + columns * (width + gap)
    tall = top + sum(width * height + gap for height in heights)
    figure = Figure(figsize=(size, tall))
    y = tall - top
    for strip, height, label in zip(strips, heights, labels, strict=True):
        y -= width * height
        for i, picture in enumerate(strip):
            x = left + i * (width + gap)
            axis = figure.add_axes((x / size, y / tall, width / size, width * height / tall))
            _show(axis, picture)
        figure.text(
            0.08 / size,
            (y + width * height / 2) / tall,
            _wrapped(label, width * height),
            fontsize=6,
            rotation=90,
            va="center",
        )
        y -= gap
    for i, title in enumerate(titles):
        middle = (left + i * (width + gap) + width / 2) / size
        figure.text(middle, 1 - top / 2 / tall, title, fontsize=7.5, ha="center", va="center")
    return figure


def _wrapped(text, inches):
    """Break a label into lines of so many inches, at spaces and underscores."""
    most, lines = max(4, int(inches * 19)), [""]
    for part in text.replace("_", "_ ").split(" "):
        glue = "" if not lines[-1] or lines[-1].endswith("_") else " "
        if lines[-1] and len(lines[-1] + glue + part) > most:
            lines.append(part)
        else:
            lines[-1] += glue + part
    return "\n".join(lines)


def _show(axis, picture, title=""):
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set(color="0.75", linewidth=0.5)  # a white picture is not to vanish on white
    if title:
        axis.set_title(title, fontsize=7.5, loc="left", pad=2)
    if picture is None:
        axis.set_facecolor("0.93")
    else:
        axis.imshow(np.clip(tonemap(picture, "gamma"), 0, 1), aspect="auto", interpolation="nearest")


def _aspect(pictures):
    """Height over width of a row of pictures."""
    return next((p.shape[0] / p.shape[1] for p in pictures if p is not None), 0.25)


def _styles(first=0):
    """Colours that go well together and differ in print (Okabe and Ito), black first."""
    colors = "#000000 #E69F00 #56B4E9 #009E73 #F0E442 #0072B2 #D55E00 #CC79A7 #7F7F7F"
    return [{"color": color} for color in colors.split()[first:]]
