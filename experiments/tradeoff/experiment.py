"""Measure what speed costs in accuracy: every setting in every cell, one run at a time.

A case is all runs of a cell, with the standard preset before, amid and after them: times are compared with
those of the same call. Nothing else should run on the machine meanwhile.
"""

from __future__ import annotations

import itertools
import statistics

from experiments import puresky
from experiments.harness import Done, Experiment, calling
from experiments.summary import Summary

from .cell import cell

MAPS = ("overcast_soil", "wasteland_clouds", "kloofendal_48d_partly_cloudy")
"""Overcast, in between, and sunny: peaks of 4.5, 309 and 8,963 at 256 texels across."""
SCENES = {
    "matte": {"file": "matte"},
    "glossy": {"file": "sphere", "parameters": {"roughness": 0.05}},
}
STANDARD = "standard, seed "
"""Begin of the names of the runs of the standard preset."""
MOST_PSNR = 55.0
"""Most dB of a rendering that are shown: beyond, the estimate without noise may itself be noise (57 dB for
the true map, where the judge has most of it)."""
PARTS = {
    "rendering_s": ("target_s", "judge_s"),
    "tracing_s": ("transport_s", "start_s"),
    "numbers_s": ("fit_s", "edit_s", "report_s"),
}
"""Seconds of a run by part, as ``--budget`` reckons with them, and the timings that each is the sum of."""


def base(file: str, scene: str) -> dict:
    """Return the configuration of the standard preset with a map's file, in one of :data:`SCENES`.

    Fits and transports are not kept on disk, so that every run pays for its own.
    """
    return {
        "input": {"envmap": file},
        "scene": SCENES[scene],
        "target": {"rotate_degrees": 60},
        # Where the sky turned, every setting would find the same map.
        "representation": {"turn": False},
        "renderer": {"cache": False},
        "fit": {"cache": False},
    }


def cases(given):
    made = []
    for name, scene in itertools.product(MAPS, SCENES):
        title = f"{name}, {scene}"
        standard = base(puresky.file(name), scene)
        made.append(calling(title, cell, standard, {"cell": title}, standard=standard, sets=given.sets))
    return made


def worth(judged: dict) -> dict:
    """Return how good a map is: dB of the rendering, without the judge's noise, and of the map; its SSIM."""
    return {
        "psnr": min(judged["render"]["psnr_without_noise"], MOST_PSNR),
        "map_psnr": judged["map"]["psnr"],
        "map_ssim": judged["map"]["ssim"],
        "sun": judged["sun_degrees"],
    }


def costs(run: dict) -> dict:
    """Return what a run cost.

    ``again_s`` is the time less what fit and tracing took: a run that finds them on disk takes a tenth of a
    second to load them, which is left out.
    """
    cost = run["cost"]
    timing = run["judged"]["timing"]
    return {
        "s": cost["wall_s"],
        "again_s": cost["wall_s"] - timing["fit_s"] - timing["transport_s"],
        "gb": cost["peak_bytes"] / 1e9,
    } | {part: sum(timing[key] for key in keys) for part, keys in PARTS.items()}


def measure(done: Done) -> list[dict]:
    """Return a row for every run of a cell, and one each for the unedited and for the true map.

    ``time``, ``again``, ``memory``: ratios to the median of the standard preset's runs. ``rendering``,
    ``map``, ``ssim``: differences from its first run, which has the seed of all other settings: the noise of
    the target, which both share, is the largest difference under a sun (6 dB between seeds).
    """
    rows = [{"setting": run["setting"]} | costs(run) | worth(run["judged"]) for run in done.metrics["runs"]]
    standard = [row for row in rows if row["setting"].startswith(STANDARD)]
    for row in rows:
        for ratio, key in {"time": "s", "again": "again_s", "memory": "gb"}.items():
            row[ratio] = row[key] / statistics.median(one[key] for one in standard)
        for change, key in {"rendering": "psnr", "map": "map_psnr", "ssim": "map_ssim"}.items():
            row[change] = row[key] - standard[0][key]
    unknown = dict.fromkeys(rows[0])
    bounds = {name: worth(judged) for name, judged in done.metrics["bounds"].items()}
    rows += [unknown | {"setting": f"({name} map)"} | found for name, found in bounds.items()]
    return rows


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "cell": "{cell}",
        "setting": "{setting}",
        "s": "{s:.1f}",
        "s again": "{again_s:.1f}",
        "rendering s": "{rendering_s:.1f}",
        "tracing and search s": "{tracing_s:.1f}",
        "numbers s": "{numbers_s:.1f}",
        "GB": "{gb:.2f}",
        "rendering, dB": "{psnr:.1f}",
        "map, dB": "{map_psnr:.1f}",
        "map SSIM": "{map_ssim:.3f}",
        "sun off, degrees": "{sun:.1f}",
    },
    summary=Summary(
        {"setting": "{setting}"},
        {
            "cells": "{runs}",
            "time": "{time.geometric:.2f}",
            "again": "{again.geometric:.2f}",
            "memory": "{memory.geometric:.2f}",
            "rendering, dB": "{rendering.mean:+.2f}",
            "map, dB": "{map.mean:+.2f}",
            "map SSIM": "{ssim.mean:+.3f}",
            "sun off, degrees": "{sun.mean:.1f}",
        },
    ),
    alone=True,
)
