"""Tables of what is done, as Markdown: a row a method, the paper's own numbers in brackets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from experiments.harness import markdown

from . import measured
from .kinds import KINDS
from .plan import Cell
from .published import COLUMNS, PUBLISHED

_DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "mse": 5}
_WORDS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "mse": "MSE"}
_BETTER = {"psnr": max, "ssim": max, "lpips": min, "mse": min}
_SETTINGS = {"paper": "the paper's settings", "ours": "our settings"}


def text(name: str, out, cells: list[Cell]) -> str:
    """Write the tables of one table or figure: one for either settings and every roughness.

    Averages are over the maps that are done in every row that has any, so that rows can be compared; how many
    of a row's own are done stands last. The best of a column is in bold.
    """
    kind = KINDS[name]
    spent = measured.seconds(out, cells)  # of all: a fit may have been made for another roughness
    build = {"figure4": _fits, "figure5": _fits, "figure9": _paint}.get(name, _methods)
    parts = [f"## {kind.title}"]
    for settings in dict.fromkeys(cell.settings for cell in cells):
        some = [cell for cell in cells if cell.settings == settings]
        names = sorted({cell.map for cell in some})
        maps = names[0] if len(names) == 1 else f"{len(names)} maps"
        for roughness in sorted({cell.roughness for cell in some}, key=lambda r: -1 if r is None else r):
            at = "" if roughness is None else f", roughness {roughness:g}"
            here = [c for c in some if c.roughness == roughness and c.row in kind.rows]
            shared = common(out, here)
            count = len({cell.map for cell in shared})
            over = "" if count in (0, len(names)) else f", averages over {count} of them"
            if not count and measured.done(out, here):
                over = ", no map is done in every row"
            parts.append(f"{_SETTINGS[settings][0].upper()}{_SETTINGS[settings][1:]}{at}, {maps}{over}:")
            parts.append(build(name, out, here, shared, spent))
    return "\n\n".join(parts)


def common(out, cells: list[Cell]) -> list[Cell]:
    """Return the cells of the maps that are done in every row, or at every roughness, that has any done."""
    ready: dict[tuple, set[str]] = {}
    for cell in measured.done(out, cells):
        ready.setdefault((cell.row, cell.roughness), set()).add(cell.map)
    shared = set.intersection(*ready.values()) if ready else set()
    return [cell for cell in cells if cell.map in shared]


def rows_of(name: str, cells: list[Cell]) -> dict[str, list[Cell]]:
    """Group cells by row, in the order of the table."""
    return {row: some for row in KINDS[name].rows if (some := [cell for cell in cells if cell.row == row])}


def mean(values: Sequence[float | None]) -> float | None:
    """Average numbers; None where there are none or one is missing: an average is of all maps or of none."""
    if not values or any(value is None for value in values):
        return None
    return float(np.mean(values))


def averages(out, cells: list[Cell], which=("envmap", "render")) -> tuple[dict, int]:
    """Average a row's metrics over its maps.

    Parameters
    ----------
    which : (str, str)
        Tables of metrics.json that hold the numbers of map and rendering.

    Returns
    -------
    found : dict
        Column of :data:`published.COLUMNS` -> number or None.
    count : int
        Maps that are done.
    """
    reads = [measured.numbers(out, cell) for cell in measured.done(out, cells)]
    places = dict(zip(("envmap", "render"), which, strict=True))
    found = {
        (image, column): mean([(read[places[image]] or {}).get(column) for read in reads])
        for image, column in COLUMNS
    }
    return found, len(reads)


def _methods(name, out, cells, shared, spent):
    published = PUBLISHED.get(name, {}).get(cells[0].roughness, {})
    head = [f"{'map' if image == 'envmap' else 'rendering'} {_WORDS[column]}" for image, column in COLUMNS]
    rows = rows_of(name, cells)
    found = {row: averages(out, [cell for cell in some if cell in shared])[0] for row, some in rows.items()}
    best = {}
    for column in COLUMNS:
        numbers = [row[column] for row in found.values() if row[column] is not None]
        best[column] = _BETTER[column[1]](numbers) if len(numbers) > 1 else None
    lines = [_unedited(out, shared, len({cell.map for cell in cells}))]
    for row, some in rows.items():
        numbers, count = found[row], len(measured.done(out, some))
        cells_ = []
        for column in COLUMNS:
            own = _show(numbers[column], column[1])
            bold = numbers[column] is not None and numbers[column] == best[column]
            own = f"**{own}**" if bold else own
            theirs = published.get(row, {}).get(column)
            cells_.append(own if theirs is None else f"{own} ({_show(theirs, column[1])})")
        title, times = KINDS[name].methods[row].title, _times(spent, [c for c in some if c in shared])
        lines.append([title, *cells_, *times, f"{count}/{len(some)}"])
    return markdown(["", *head, "fit, s", "rest, s", "maps"], lines)


def _unedited(out, cells, maps):
    """Return the row before any edit: of every map the numbers of the first run that is done."""
    first = {}
    for cell in measured.done(out, cells):
        first.setdefault(cell.map, cell)
    numbers, count = averages(out, list(first.values()), ("initial_envmap", "initial"))
    shown = [_show(numbers[column], column[1]) for column in COLUMNS]
    return ["unedited", *shown, "-", "-", f"{count}/{maps}"]


def _fits(name, out, cells, shared, spent):
    lines = []
    for row, some in rows_of(name, cells).items():
        ready = measured.done(out, some)
        reads = [measured.numbers(out, cell) for cell in ready if cell in shared]
        values = [mean([read[key] for read in reads]) for key in ("log_psnr", "peak_ratio", "mean_ratio")]
        noisy = [mean(read["noisy"]) for read in reads]
        shown = [
            f"{value:.{d}f}" if value is not None else "-" for value, d in zip(values, (1, 3, 3), strict=True)
        ]
        with_noise = mean(noisy)
        lines.append(
            [
                KINDS[name].methods[row].title,
                *shown,
                "-" if with_noise is None else f"{with_noise:.1f}",
                _seconds([read["seconds"] for read in reads]),
                f"{len(ready)}/{len(some)}",
            ]
        )
    head = ["", "log PSNR, dB", "peak", "mean luminance", "log PSNR with noise, dB", "s", "maps"]
    return markdown(head, lines)


def _paint(name, out, cells, shared, spent):
    lines = []
    for row, some in rows_of(name, cells).items():
        ready = measured.done(out, some)
        told = [cell for cell in ready if cell in shared]
        painted = [measured.numbers(out, cell)["painted"] for cell in told]
        against = [measured.of_paint(out, cell) for cell in told]
        share = [mean([p[key] for p in painted]) for key in ("towards", "reachable")]
        elsewhere = mean([p["elsewhere"] for p in painted])
        ssim, sharp = (mean([a[key] for a in against]) for key in ("ssim", "sharp"))
        lines.append(
            [
                KINDS[name].methods[row].title,
                *("-" if s is None else f"{100 * s:.0f} %" for s in share),
                "-" if elsewhere is None else f"{elsewhere:.4f}",
                "-" if ssim is None else f"{ssim:.3f}",
                "-" if sharp is None or math.isnan(sharp) else f"{sharp:.2f}",
                *_times(spent, told),
                f"{len(ready)}/{len(some)}",
            ]
        )
    head = ["", "towards the paint", "feasible", "change elsewhere", "map SSIM", "high frequencies"]
    return markdown([*head, "fit, s", "rest, s", "maps"], lines)


def _show(value, column):
    return "-" if value is None else f"{value:.{_DIGITS[column]}f}"


def _times(spent, cells):
    """Average the seconds of fits and of the rest, those that are known."""
    taken = [spent[cell] for cell in cells if cell in spent]
    fits = [fit for fit, _ in taken if fit is not None]
    return _seconds(fits), _seconds([rest for _, rest in taken if not math.isnan(rest)])


def _seconds(values):
    return f"{np.mean(values):.0f}" if values else "-"
