"""Tables of the HTML report: how good the result is, numbers of the run, time, statistics of the maps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from envedit.core.color import luminance
from envedit.core.latlong import solid_angles
from envedit.report.curves import escape
from envedit.report.html_parts import NUMBERS, STAGES, show, table

_COMPARED = {
    "initial": "initial rendering",
    "render": "edited rendering",
    "ceiling": "noise alone",
    "initial_envmap": "unedited map",
    "envmap": "edited map",
}
_MEASURES = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "mse": "MSE",
    "lpips": "LPIPS",
    "log_rmse": "log RMSE (stops)",
    "beyond_display": "share that a display does not show",
}


def quality(metrics: dict) -> str:
    """Compare renderings, and maps where the true one is known, with the target; each view by itself."""
    kinds = {name: words for name, words in _COMPARED.items() if metrics.get(name)}
    rows = [
        [words, *(show(metrics[name][key]) for name in kinds)]
        for key, words in _MEASURES.items()
        if key != "lpips" or any(metrics[name][key] is not None for name in kinds)
    ]
    tables = "<h2>Quality</h2>" + table(["", *kinds.values()], rows)
    tables += (
        '<p class="soft">Against the target, and the map that it was rendered under where that is known. '
        f"All but log RMSE: under the tonemap {escape(metrics['tonemap'])}. "
        "Noise alone: two renderings of the target's own map, or of the unedited one where the target "
        "was painted; no rendering can be expected to be closer.</p>"
    )
    if metrics.get("views"):
        kinds = {name: words for name, words in kinds.items() if "map" not in words}
        head = [
            "view",
            *(f"{words}, {measure}" for measure in _MEASURES.values() for words in kinds.values()),
        ]
        rows = [
            [f"{k} ({view['name']})", *(show(view[name][key]) for key in _MEASURES for name in kinds)]
            for k, view in enumerate(metrics["views"])
        ]
        tables += f"<h2>Views</h2>{table(head, rows)}"
    return tables


def numbers(metrics: dict) -> str:
    """List the other numbers of the metrics, in words where there are any."""
    elsewhere = ("choices", "views", "variants", "tonemap", "worse")
    others = {
        key: value
        for key, value in metrics.items()
        if not isinstance(value, (dict, type(None))) and key not in elsewhere
    }
    for part in ("natural", "painted", "fit", "transport"):
        others |= {f"{part} {key}": value for key, value in (metrics.get(part) or {}).items()}
    rows = [[NUMBERS.get(key, key.replace("_", " ")), show(value)] for key, value in others.items()]
    return f"<details><summary>Numbers of the run</summary>{table(['', ''], rows)}</details>"


def timing(metrics: dict) -> str:
    """List where the time went, with a bar for each stage."""
    timing = {key: value for key, value in metrics["timing"].items() if value is not None}
    longest = max(value for key, value in timing.items() if key.endswith("_s"))
    rows = []
    for key, value in timing.items():
        stage, _, unit = key.rpartition("_")
        width = 12 * value / max(longest, 1e-3) if unit == "s" else 0
        bar = f'<span class="bar" style="width:{width:.2f}rem"></span>'
        rows.append([STAGES.get(stage, stage.replace("_", " ")), f"{show(value, 3)} {unit}", bar])
    return f"<h2>Time</h2>{table(['', '', ''], rows)}"


def map_table(maps: Mapping[str, np.ndarray]) -> str:
    """List peak, mean and median of every map."""
    rows = [[name, *map_statistics(image)] for name, image in maps.items()]
    head = ["map", "size", "peak luminance", "at row, column", "mean", "median", "lowest"]
    return (
        f"<h2>Environment maps</h2>{table(head, rows)}\n"
        '<p class="soft">Luminances are linear; the mean is over the sphere.</p>'
    )


def map_statistics(envmap: np.ndarray) -> list[str]:
    """Return the table's cells for one map (H, W, 3): its size, luminances, and where the peak is."""
    values = luminance(envmap.astype(np.float64))
    height, width = values.shape
    row, column = np.unravel_index(np.argmax(values), values.shape)
    mean = float(np.average(values.mean(axis=1), weights=solid_angles(height, width)))
    return [
        f"{width} × {height}",
        show(values.max()),
        f"{row}, {column}",
        show(mean),
        show(float(np.median(values))),
        show(values.min()),
    ]
