"""Ratios to the standard preset, means over cells, fronts, and the rows of the tables."""

from __future__ import annotations

import math
import statistics

from experiments.harness import Done, number

MOST_PSNR = 55.0
"""Most dB of a rendering that are shown: beyond, the estimate without noise may itself be noise (57 dB for
the true map, where the judge has most of it)."""
UNDISTURBED = 0.85
"""Share of its setting's usual processor time, by wall time, that a run is to have had."""
SHARES = (2.0, 1.5, 1.0, 0.75, 0.5, 0.35)
"""Times, as multiples of the standard preset's, for which the best setting is looked up."""
COSTS = ("time", "again", "memory")
WORTH = ("psnr", "map_psnr", "map_ssim")


def by(rows: list[dict], *keys: str) -> list[list[dict]]:
    """Group rows that are equal in some keys."""
    found: dict[tuple, list[dict]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return list(found.values())


# ---- runs --------------------------------------------------------------------------------------------------


def flat(cost: dict, judged: dict) -> dict:
    """Return the numbers of one run that tables show.

    Returns
    -------
    dict
        ``time`` and ``again`` in seconds: the latter less what fit and tracing took (a run that finds them on
        disk takes a tenth of a second to load them, which is left out); ``memory`` in bytes; ``psnr`` of the
        rendering, without the judge's noise and at most :data:`MOST_PSNR`, and ``map_psnr``, in dB;
        ``map_ssim``; ``sun`` in degrees and ``noise`` of the loss, or None; ``share`` of the processor.
    """
    timing = judged["timing"]
    return {
        "time": cost["wall_s"],
        "again": cost["wall_s"] - timing["fit_s"] - timing["transport_s"],
        "memory": cost["peak_bytes"],
        "psnr": min(judged["render"]["psnr_without_noise"], MOST_PSNR),
        "map_psnr": judged["map"]["psnr"],
        "map_ssim": judged["map"]["ssim"],
        "sun": judged["sun_degrees"],
        "noise": judged["loss_noise"],
        "share": cost["cpu_s"] / cost["wall_s"],
    }


def compared(done: Done) -> list[dict]:
    """Put every run of a case beside its runs of the standard preset.

    Returns
    -------
    list of dict
        ``setting`` and ``group``, the numbers of :func:`flat`, and ``ratio``: :data:`COSTS` over the median
        of the standard preset's runs; ``change``: :data:`WORTH` less that of its first run, which has the
        seed of all other settings: the noise of the target, which both share, is the largest difference
        under a sun (6 dB between seeds). The standard preset's own ratios are 1 and changes 0. All have the
        case's ``name``, ``unedited`` and ``ceiling``.
    """
    found = done.metrics
    same = {"name": done.case.name, "unedited": found["unedited"], "ceiling": found["ceiling"]}
    runs = [
        same | {"setting": r["setting"], "group": r["group"]} | flat(r["cost"], r["judged"])
        for r in found["runs"]
    ]
    standard = [run for run in runs if run["group"] == "standard"]
    median = {key: statistics.median(run[key] for run in standard) for key in COSTS}
    for run in runs:
        run["ratio"] = {key: run[key] / median[key] for key in COSTS}
        run["change"] = {key: run[key] - standard[0][key] for key in WORTH}
    for run in standard:
        run |= {
            "setting": "standard",
            "ratio": dict.fromkeys(COSTS, 1.0),
            "change": dict.fromkeys(WORTH, 0.0),
        }
    return runs


def disturbed(runs: list[dict]) -> list[dict]:
    """List runs that had less of the processor than others of their setting: something else ran beside them.

    Processor time over wall time, of which a run had less than :data:`UNDISTURBED` of the median of its
    setting's runs; settings of fewer than three runs are not examined.
    """
    found = []
    for some in by(runs, "setting"):
        usual = statistics.median(run["share"] for run in some)
        found += [run for run in some if len(some) >= 3 and run["share"] < UNDISTURBED * usual]
    return found


def spread(runs: list[dict]) -> dict[str, float]:
    """Return how far the standard preset's seeds differ in one cell, standard deviation, pooled over cells.

    Returns
    -------
    dict
        ``psnr``, ``map_psnr`` in dB, ``map_ssim``, and ``time`` relative to its mean.
    """
    variances: dict[str, list[float]] = {}
    for some in by([run for run in runs if run["group"] == "standard"], "name"):
        for key in (*WORTH, "time"):
            values = [run[key] for run in some]
            scale = statistics.fmean(values) if key == "time" else 1.0
            variances.setdefault(key, []).append(statistics.variance(values) / scale**2)
    return {key: math.sqrt(statistics.fmean(values)) for key, values in variances.items()}


def summary(runs: list[dict]) -> str:
    """Return how far seeds differ, and which runs were disturbed."""
    differ = spread(runs)
    lines = [
        f"Standard deviation between seeds of the standard preset in one cell: rendering "
        f"{differ['psnr']:.2f} dB, map {differ['map_psnr']:.2f} dB, map SSIM {differ['map_ssim']:.3f}, "
        f"time {100 * differ['time']:.1f} %."
    ]
    lines += [
        f"{run['name']}: {run['setting']} had less of the processor than others of its setting: if something "
        f"else ran beside it, remove the folder of this case and run again."
        for run in disturbed(runs)
    ]
    return "\n\n".join(lines)


# ---- a setting in many cells -------------------------------------------------------------------------------


def means(runs: list[dict]) -> list[dict]:
    """Average every setting over its cells.

    Returns
    -------
    list of dict
        ``setting``, ``group``, ``cells``: how many; ``ratio``: geometric means; ``change``: means;
        ``sun``: mean degrees over the cells that have a sun, None without one; ``noise``: median, or None.
    """
    found = []
    for some in by(runs, "setting"):
        suns = [run["sun"] for run in some if run["sun"] is not None]
        noises = [run["noise"] for run in some if run["noise"] is not None]
        found.append(
            {
                "setting": some[0]["setting"],
                "group": some[0]["group"],
                "cells": len({run["cell"] for run in some}),
                "ratio": {key: statistics.geometric_mean(run["ratio"][key] for run in some) for key in COSTS},
                "change": {key: statistics.fmean(run["change"][key] for run in some) for key in WORTH},
                "sun": statistics.fmean(suns) if suns else None,
                "noise": statistics.median(noises) if noises else None,
            }
        )
    return found


def everywhere(averages: list[dict]) -> list[dict]:
    """Pick the settings that ran in most cells, which alone can be compared with each other."""
    most = max(row["cells"] for row in averages)
    return [row for row in averages if row["cells"] == most]


def front(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """List the points (cost, worth) that no other beats in both, by rising cost."""
    found: list[tuple[float, float]] = []
    for cost, worth in sorted(points, key=lambda point: (point[0], -point[1])):
        if not found or worth > found[-1][1]:
            found.append((cost, worth))
    return found


def best_within(rows: list[dict], share: float) -> dict | None:
    """Return the setting of the highest sum of both PSNRs of those that take at most a share of the time."""
    quick = [row for row in rows if row["ratio"]["time"] <= share * (1 + 1e-9)]
    return max(quick, key=lambda row: row["change"]["psnr"] + row["change"]["map_psnr"], default=None)


# ---- tables ------------------------------------------------------------------------------------------------


def presets(runs: list[dict]) -> list[dict]:
    """Return medians of the presets' runs in every cell."""
    some = [run for run in runs if run["group"] in ("standard", "preset")]
    return [
        same[0]
        | {"table": "presets"}
        | {key: statistics.median(run[key] for run in same) for key in (*COSTS, *WORTH)}
        | {"sun": same[0]["sun"] and statistics.median(run["sun"] for run in same)}
        for same in by(some, "cell", "setting")
    ]


def combine(runs: list[dict]) -> list[dict]:
    """Return the rows of all tables, each with the name of its ``table``."""
    averages = means(runs)
    best = [(share, best_within(everywhere(averages), share)) for share in SHARES]
    return [
        *({"table": "halving", "share": share} | row for share, row in best if row),
        *presets(runs),
        *({"table": "settings"} | row for row in averages),
        *({"table": "cells"} | row for row in {run["cell"]: run for run in runs}.values()),
    ]


_RATIOS = {key: f"{{ratio[{key}]:.2f}}" for key in COSTS}
_CHANGES = {
    "rendering, dB": "{change[psnr]:+.2f}",
    "map, dB": "{change[map_psnr]:+.2f}",
    "map SSIM": "{change[map_ssim]:+.3f}",
    "sun off, degrees": lambda row: number(row["sun"]),
}
COLUMNS = {
    "halving": {"time at most": "{share:g}", "best setting": "{setting}"} | _RATIOS | _CHANGES,
    "presets": {
        "cell": "{cell}",
        "preset": "{setting}",
        "s": "{time:.1f}",
        "s again": "{again:.1f}",
        "GB": lambda row: f"{row['memory'] / 1e9:.2f}",
        "rendering, dB": "{psnr:.1f}",
        "map, dB": "{map_psnr:.1f}",
        "map SSIM": "{map_ssim:.3f}",
        "sun off, degrees": lambda row: number(row["sun"]),
    },
    "settings": {"setting": "{setting}", "cells": "{cells}"}
    | _RATIOS
    | _CHANGES
    | {"noise of the loss, %": lambda row: number(row["noise"] and 100 * row["noise"], ".2g")},
    "cells": {
        "cell": "{cell}",
        "rendering unedited, dB": "{unedited[render][psnr_without_noise]:.1f}",
        "noise of the judge, dB": "{ceiling[render][psnr]:.1f}",
        "map unedited, dB": "{unedited[map][psnr]:.1f}",
        "its SSIM": "{unedited[map][ssim]:.3f}",
    },
}
