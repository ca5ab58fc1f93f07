"""Ratios to the standard preset, means over cells, fronts, and the tables."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable

from experiments.engine.tables import table

from .plan import references

TIMES = {"time": "whole run", "again": "run again, T and fit at hand"}
"""Kinds of time: of a run from nothing but compiled kernels; of one that finds T and fit on disk."""
MOST_PSNR = 55.0
"""Most dB of a rendering that are told: beyond, the estimate without noise may itself be noise (57 dB for the
true map, where the judge has most of it)."""
UNDISTURBED = 0.85
"""Share of its setting's usual processor time, by wall time, that a run is to have had."""
PAIRED = references(0).name
"""The run of the standard preset whose seed all other settings have."""
SHARES = (2.0, 1.5, 1.0, 0.75, 0.5, 0.35)
"""Times, as multiples of the standard preset's, for which the best setting is looked up."""


# ---- one run -----------------------------------------------------------------------------------------------


def flat(cost: dict, judged: dict) -> dict:
    """Return the numbers of one run that tables show.

    Returns
    -------
    dict
        ``time`` and ``again`` in seconds: the latter less what fit and tracing took (a run that finds them on
        disk takes a tenth of a second to load them, which is left out); ``memory`` in bytes; ``psnr`` of the
        rendering, without the judge's noise and at most :data:`MOST_PSNR`, and ``map_psnr``, in dB;
        ``map_ssim``; ``sun`` in degrees and ``noise`` of the loss, or None.
    """
    timing = judged["timing"]
    ready = timing["fit_s"] + timing["transport_s"]
    return {
        "time": cost["wall_s"],
        "again": cost["wall_s"] - ready,
        "memory": cost["peak_bytes"],
        "psnr": min(judged["render"]["psnr_without_noise"], MOST_PSNR),
        "map_psnr": judged["map"]["psnr"],
        "map_ssim": judged["map"]["ssim"],
        "sun": judged["sun_degrees"],
        "noise": judged["loss_noise"],
    }


def ratios(runs: list[dict]) -> list[dict]:
    """Put every run beside the standard preset's of the same cell and session.

    Parameters
    ----------
    runs : list of dict
        ``setting``, ``group``, ``map``, ``scene``, ``session``, and the numbers of :func:`flat`.

    Returns
    -------
    list of dict
        The same with ``ratio``: ``time``, ``again`` and ``memory`` over the median of the standard preset's
        runs in that session; and ``change``: ``psnr``, ``map_psnr`` and ``map_ssim`` less those of the
        standard preset with the same seed, :data:`PAIRED`, as the noise of the target, which both share, is
        the largest difference under a sun (6 dB between seeds); of the same session, or of the last before
        it that has this seed, as the program may have changed in between; less the median of all where that
        seed was not run. Runs in whose session the standard preset was not measured are left out.
    """
    standard = [r for r in runs if r["group"] == "standard"]
    found = []
    for run in runs:
        same = [s for s in standard if _cell(s) == _cell(run)]
        beside = [s for s in same if s["session"] == run["session"]]
        if not beside:
            continue
        cost = ("time", "again", "memory")
        ratio = {key: run[key] / statistics.median(s[key] for s in beside) for key in cost}
        won = ("psnr", "map_psnr", "map_ssim")
        paired = _last([s for s in same if s["setting"] == PAIRED and s["session"] <= run["session"]]) or same
        change = {key: run[key] - statistics.median(s[key] for s in paired) for key in won}
        found.append(run | {"ratio": ratio, "change": change})
    return found


def disturbed(runs: list[dict]) -> list[dict]:
    """List runs that had less of the processor than others of their setting: something else ran beside them.

    Processor time over wall time, of which a run had less than :data:`UNDISTURBED` of the median of its
    setting's runs; settings of fewer than three runs are not told.
    """
    found = []
    for name in dict.fromkeys(run["setting"] for run in runs):
        some = [run for run in runs if run["setting"] == name]
        shares = [run["cost"]["cpu_s"] / run["cost"]["wall_s"] for run in some]
        usual = statistics.median(shares)
        if len(some) >= 3:
            found += [r for r, share in zip(some, shares, strict=True) if share < UNDISTURBED * usual]
    return found


def _last(runs):
    """Pick the runs of the last session among them."""
    return [run for run in runs if run["session"] == max(other["session"] for other in runs)]


def _cell(run):
    return run["map"], run["scene"]


# ---- a setting in many cells -------------------------------------------------------------------------------


def means(compared: list[dict]) -> list[dict]:
    """Average every setting over its cells; of the standard preset, by which all is measured, the medians.

    Returns
    -------
    list of dict
        ``setting``, ``group``, ``cells``: how many; ``ratio``: geometric means; ``change``: means;
        ``sun``: mean degrees over the cells that have a sun, None without one; ``noise``: median, or None.
    """
    groups: dict[str, list[dict]] = {}
    for run in compared:
        name = "standard" if run["group"] == "standard" else run["setting"]
        groups.setdefault(name, []).append(run)
    found = []
    for name, some in groups.items():
        suns = [r["sun"] for r in some if r["sun"] is not None]
        noises = [r["noise"] for r in some if r["noise"] is not None]
        if name == "standard":  # its median, by which all is measured
            some = [r | {"ratio": dict.fromkeys(r["ratio"], 1.0)} for r in some]
            some = [r | {"change": dict.fromkeys(r["change"], 0.0)} for r in some]
        found.append(
            {
                "setting": name,
                "group": some[0]["group"],
                "cells": len({_cell(r) for r in some}),
                "ratio": {k: _geometric(r["ratio"][k] for r in some) for k in some[0]["ratio"]},
                "change": {k: statistics.fmean(r["change"][k] for r in some) for k in some[0]["change"]},
                "sun": statistics.fmean(suns) if suns else None,
                "noise": statistics.median(noises) if noises else None,
            }
        )
    return found


def _geometric(values: Iterable[float]) -> float:
    return math.exp(statistics.fmean(math.log(v) for v in values))


def front(points: list[tuple[float, float]]) -> list[int]:
    """List the points (cost, worth) that no other beats in both, by rising cost.

    Of points that are equal the first is listed.
    """
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1], i))
    found: list[int] = []
    for i in order:
        if not found or points[i][1] > points[found[-1]][1]:
            found.append(i)
    return found


def score(row: dict) -> float:
    """Sum up what a setting is worth, dB: the changes of rendering and map PSNR."""
    return row["change"]["psnr"] + row["change"]["map_psnr"]


def best_within(rows: list[dict], share: float, time: str = "time") -> dict | None:
    """Return the row of the highest :func:`score` among those that take at most a share of the time."""
    quick = [r for r in rows if r["ratio"][time] <= share * (1 + 1e-9)]
    return max(quick, key=score, default=None)


def spread(runs: list[dict]) -> dict[str, float] | None:
    """Tell how far the standard preset's seeds differ in one cell, standard deviation, pooled over cells.

    Returns
    -------
    dict or None
        ``psnr``, ``map_psnr`` in dB, ``map_ssim``, and ``time`` relative to its mean, within a session.
    """
    standard, pooled = [r for r in runs if r["group"] == "standard"], {}
    for key in ("psnr", "map_psnr", "map_ssim", "time"):
        variances = []
        for cell in {(*_cell(r), r["session"]) for r in standard}:
            values = [r[key] for r in standard if (*_cell(r), r["session"]) == cell]
            if len(values) > 1:
                scale = statistics.fmean(values) if key == "time" else 1.0
                variances.append(statistics.variance(values) / scale**2)
        if not variances:
            return None
        pooled[key] = math.sqrt(statistics.fmean(variances))
    return pooled


# ---- tables ------------------------------------------------------------------------------------------------


def tables(results: dict) -> dict[str, str]:
    """Return Markdown tables by the names of the markers in the README.

    Parameters
    ----------
    results : dict
        As ``results.json`` of :mod:`.experiment`.
    """
    compared = ratios(results["runs"])
    rows = means(compared)
    most = max((r["cells"] for r in rows), default=0)
    whole = [r for r in rows if r["cells"] == most]
    found = {f"halving-{kind}": halving(whole, kind) for kind in TIMES}
    found["presets"] = presets(compared)
    found["settings"] = every(rows)
    found["cells"] = bounds(results)
    if differ := spread(results["runs"]):
        found["spread"] = (
            f"Standard deviation between seeds of the standard preset in one cell: rendering "
            f"{differ['psnr']:.2f} dB, map {differ['map_psnr']:.2f} dB, map SSIM {differ['map_ssim']:.3f}, "
            f"time {100 * differ['time']:.1f} %."
        )
    return found


_WORTH = "rendering, dB | map, dB | map SSIM | sun off, degrees"


def _worth(row):
    sun = "-" if row["sun"] is None else f"{row['sun']:.1f}"
    change = row["change"]
    return (f"{change['psnr']:+.2f}", f"{change['map_psnr']:+.2f}", f"{change['map_ssim']:+.3f}", sun)


def halving(rows: list[dict], kind: str = "time") -> str:
    """Return the table of what is lost when there is less time, over settings measured in the same cells."""
    lines = []
    for share in SHARES:
        row = best_within(rows, share, kind)
        if row is None:
            quickest = min((r["ratio"][kind] for r in rows), default=math.nan)
            lines.append((f"{share:g}", f"none: the quickest takes {quickest:.2f}", *["-"] * 6))
            continue
        ratio = row["ratio"]
        lines.append(
            (f"{share:g}", row["setting"], f"{ratio[kind]:.2f}", f"{ratio['memory']:.2f}", *_worth(row))
        )
    return table(f"time at most | best setting | time | memory | {_WORTH}", lines)


def every(rows: list[dict]) -> str:
    """Return the table of all settings, in the order in which they were run."""
    lines = [
        (
            r["setting"],
            r["cells"],
            *(f"{r['ratio'][key]:.2f}" for key in ("time", "again", "memory")),
            *_worth(r),
            "-" if r["noise"] is None else f"{100 * r['noise']:.2g} %",
        )
        for r in rows
    ]
    return table(f"setting | cells | time | again | memory | {_WORTH} | noise of the loss", lines)


def presets(compared: list[dict]) -> str:
    """Return the table of the presets in seconds and absolute numbers, cell by cell."""
    lines = []
    wanted = [r for r in compared if r["group"] in ("standard", "preset", "paper")]
    for cell in dict.fromkeys(_cell(r) for r in wanted):
        here = [r for r in wanted if _cell(r) == cell]
        for name in ("draft", "standard", "paper"):
            some = _last([r for r in here if r["setting"].split(",")[0] == name])
            if not some:
                continue
            middle = {k: statistics.median(r[k] for r in some) for k in ("time", "again", "memory", "psnr")}
            maps = [statistics.median(r[k] for r in some) for k in ("map_psnr", "map_ssim")]
            suns = [r["sun"] for r in some if r["sun"] is not None]
            lines.append(
                (
                    ", ".join(cell),
                    name,
                    f"{middle['time']:.1f}",
                    f"{middle['again']:.1f}",
                    f"{middle['memory'] / 1e9:.2f}",
                    f"{middle['psnr']:.1f}",
                    f"{maps[0]:.1f}",
                    f"{maps[1]:.3f}",
                    f"{statistics.median(suns):.1f}" if suns else "-",
                )
            )
    head = "cell | preset | s | s again | GB | rendering, dB | map, dB | map SSIM | sun off, degrees"
    return table(head, lines)


def bounds(results: dict) -> str:
    """Return the table of what the unedited map has, and of the judge's own noise.

    The latter is the PSNR of one rendering of the true map against another, which is left out elsewhere.
    """
    lines = []
    for cell in results["cells"]:
        before, most = cell["unedited"], cell["ceiling"]
        lines.append(
            (
                f"{cell['map']}, {cell['scene']}",
                f"{before['render']['psnr_without_noise']:.1f}",
                f"{most['render']['psnr']:.1f}",
                f"{before['map']['psnr']:.1f}",
                f"{before['map']['ssim']:.3f}",
            )
        )
    head = "cell | rendering unedited, dB | noise of the judge, dB | map unedited, dB | its SSIM"
    return table(head, lines)
