"""Tables of what is done, as Markdown: a row a method, the paper's own numbers in brackets."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envedit.sweep import DONE
from experiments.harness import Done, done_of, markdown, number
from experiments.painted_edits import experiment as painted_edits

from .published import COLUMNS, PUBLISHED


@dataclass(frozen=True)
class Column:
    """A number of :func:`measure`, how it is written, and what picks the best of several, if it is marked."""

    key: str | tuple[str, str]
    form: str
    best: Callable | None = None


_METRICS = {
    "psnr": ("PSNR", ".2f", max),
    "lpips": ("LPIPS", ".3f", min),
    "mse": ("MSE", ".5f", min),
    "ssim": ("SSIM", ".3f", max),
}
_IMAGES = {"envmap": "map", "render": "rendering"}
_UNEDITED = {"envmap": "initial_envmap", "render": "initial"}
_TIMES = {"fit, s": Column("fit_s", ".0f"), "rest, s": Column("rest_s", ".0f")}
EDITS = {
    f"{_IMAGES[image]} {_METRICS[name][0]}": Column((image, name), *_METRICS[name][1:])
    for image, name in COLUMNS
} | _TIMES
FITS = {
    "log PSNR, dB": Column("log_psnr", ".1f"),
    "peak": Column("peak_ratio", ".3f"),
    "mean luminance": Column("mean_ratio", ".3f"),
    "log PSNR with noise, dB": Column("noisy_psnr", ".1f"),
    "s": Column("seconds", ".0f"),
}
PAINTED = {
    "towards the paint": Column("towards", ".0%"),
    "feasible": Column("reachable", ".0%"),
    "change elsewhere": Column("elsewhere", ".4f"),
    "map SSIM": Column("ssim", ".3f"),
    "high frequencies": Column("sharp", ".2f"),
} | _TIMES
_OF_FIGURES = {"figure4": FITS, "figure5": FITS, "figure9": PAINTED}


def measure(name: str, done: Done) -> dict:
    """Return the numbers of a run for table ``name``, by the keys of its columns."""
    found = done.metrics
    if name in ("figure4", "figure5"):
        return found | {"noisy_psnr": mean(found["noisy"])}
    if name == "figure9":
        return painted_edits.measure(done) | seconds(done)
    images = (*_IMAGES, *_UNEDITED.values())
    return {(i, metric): (found[i] or {}).get(metric) for i in images for metric in _METRICS} | seconds(done)


def seconds(done: Done) -> dict[str, float | None]:
    """Return the seconds of the fit, and of all the rest, of an edit.

    A fit that was on disk has the seconds that are kept with it; None where there is no fit. The rest is NaN
    where a run was interrupted and resumed, whose time is not known.
    """
    fit, timing = done.metrics["fit"], done.metrics["timing"]
    resumed = json.loads((done.folder / DONE).read_bytes())["resumed"]
    rest = timing["total_s"] - (timing["fit_s"] if fit else 0)
    return {"fit_s": fit and fit["seconds"], "rest_s": math.nan if resumed else rest}


def rows_of(name: str, made, out: Path) -> list[dict]:
    """Return what is known of each case: its ``about``, and its numbers, ``found``: None if not done."""
    found = {one.case.name: measure(name, one) for one in done_of(made, out)}
    return [case.about | {"found": found.get(case.name)} for case, _ in made]


def mean(values: Iterable[float | None]) -> float | None:
    """Average numbers; None if there is none or one is None: an average is of all maps or of no map.

    NaN, the time of a resumed run, is left out.
    """
    values = list(values)
    if not values or None in values:
        return None
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else None


def shared(rows: list[dict]) -> set[str]:
    """Return the maps that are done in every method's row that has any done."""
    ready: dict[str, set[str]] = {}
    for row in rows:
        if row["found"]:
            ready.setdefault(row["row"], set()).add(row["map"])
    return set.intersection(*ready.values()) if ready else set()


def text(name: str, title: str, rows: list[dict]) -> str:
    """Write the tables of one table or figure: one for either settings and every roughness.

    Averages are over the maps of :func:`shared`, so that methods can be compared; how many of a method's own
    are done stands last. The best of a column is in bold.
    """
    parts = [f"## {title}"]
    for group in dict.fromkeys((row["settings"], row["roughness"]) for row in rows):
        some = [row for row in rows if (row["settings"], row["roughness"]) == group]
        parts += [_heading(*group, some), _table(name, group[1], some)]
    return "\n\n".join(parts)


def _heading(settings, roughness, rows):
    names, count = sorted({row["map"] for row in rows}), len(shared(rows))
    maps = names[0] if len(names) == 1 else f"{len(names)} maps"
    at = "" if roughness is None else f", roughness {roughness:g}"
    over = "" if count in (0, len(names)) else f", averages over {count} of them"
    if not count and any(row["found"] for row in rows):
        over = ", no map is done in every row"
    whose = {"paper": "The paper's settings", "ours": "Our settings"}[settings]
    return f"{whose}{at}, {maps}{over}:"


def _table(name, roughness, rows):
    columns = _OF_FIGURES.get(name, EDITS)
    published = PUBLISHED.get(name, {}).get(roughness, {})
    maps, over = {row["map"] for row in rows}, shared(rows)
    methods = {row["row"]: row["title"] for row in rows}
    done = {method: [r for r in rows if r["row"] == method and r["found"]] for method in methods}
    averages = {
        method: {c.key: mean(r["found"][c.key] for r in some if r["map"] in over) for c in columns.values()}
        for method, some in done.items()
    }
    best = {}
    for column in columns.values():
        values = [one[column.key] for one in averages.values() if one[column.key] is not None]
        best[column.key] = column.best(values) if column.best and len(values) > 1 else None
    lines = [_unedited(rows, over, len(maps))] if columns is EDITS else []
    for method, title in methods.items():
        cells = []
        for column in columns.values():
            own, theirs = averages[method][column.key], published.get(method, {}).get(column.key)
            shown = number(own, column.form)
            shown = f"**{shown}**" if own is not None and own == best[column.key] else shown
            cells.append(shown if theirs is None else f"{shown} ({number(theirs, column.form)})")
        lines.append([title, *cells, f"{len(done[method])}/{sum(row['row'] == method for row in rows)}"])
    return markdown(["", *columns, "maps"], lines)


def _unedited(rows, over, count):
    """Return the row before any edit: of every map the numbers of the first run that is done."""
    first: dict[str, dict] = {}
    for row in rows:
        if row["found"] and row["map"] in over:
            first.setdefault(row["map"], row["found"])
    cells = []
    for image, name in COLUMNS:
        value = mean(found[_UNEDITED[image], name] for found in first.values())
        cells.append(number(value, _METRICS[name][1]))
    return ["unedited", *cells, "-", "-", f"{len(first)}/{count}"]
