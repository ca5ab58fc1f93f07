"""Tables of the HTML report: how good the result is, numbers of the run, time, statistics of the maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from envedit.core.color import luminance
from envedit.core.latlong import solid_angles
from envedit.report.curves import escape, number
from envedit.report.html_parts import NUMBERS, STAGES, show, table

_MEASURES = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "mse": "MSE",
    "lpips": "LPIPS",
    "log_rmse": "log RMSE (stops)",
    "beyond_display": "share that a display does not show",
}


def quality(metrics: dict, tonemap: str) -> str:
    """Compare renderings, and maps where the true one is known, with the target; each view by itself."""
    kinds = {"initial": "initial rendering", "render": "edited rendering"}
    kinds |= {"ceiling": "noise alone"} if metrics.get("ceiling") else {}
    kinds |= {"initial_envmap": "unedited map", "envmap": "edited map"} if metrics.get("envmap") else {}
    quality = [metrics.get(name) or {} for name in kinds]
    rows = [
        [name, *(show(one.get(key)) for one in quality)]
        for key, name in _MEASURES.items()
        if key != "lpips" or any(one.get(key) is not None for one in quality)
    ]
    columns = {"initial": "initial", "render": "edited", "ceiling": "noise alone"}
    views = [
        [
            f"{k} ({view['name']})",
            *(show((view.get(when) or {}).get(key)) for key in _MEASURES for when in columns),
        ]
        for k, view in enumerate(metrics.get("views") or [])
    ]
    head = ["view", *(f"{what}, {name}" for name in _MEASURES.values() for what in columns.values())]
    return "\n".join(
        [
            "<h2>Quality</h2>",
            table(["", *kinds.values()], rows),
            '<p class="soft">Against the target, and the map that it was rendered under where that is known. '
            f"All but log RMSE: under the tonemap {escape(metrics.get('tonemap') or tonemap)}. "
            "Noise alone: two renderings of the target's own map, or of the unedited one where the target "
            "was painted; no rendering can be expected to be closer.</p>",
            *([f"<h2>Views</h2>{table(head, views)}"] if views else []),
        ]
    )


def numbers(metrics: dict) -> str:
    """List the other numbers of the metrics, in words where there are any."""
    elsewhere = ("choices", "views", "tonemap", "worse")
    others = [
        (key, value)
        for key, value in metrics.items()
        if not isinstance(value, (dict, type(None))) and key not in elsewhere
    ]
    for part in ("natural", "painted", "fit", "transport"):
        others += [(f"{part} {key}", value) for key, value in (metrics.get(part) or {}).items()]
    rows = [[NUMBERS.get(key, key.replace("_", " ")), show(value)] for key, value in others]
    return f"<details><summary>Numbers of the run</summary>{table(['', ''], rows)}</details>" if rows else ""


def timing(metrics: dict) -> str:
    """List where the time went, with a bar for each stage."""
    timing = {key: number(value) for key, value in (metrics.get("timing") or {}).items()}
    longest = max((t for key, t in timing.items() if t and key.endswith("_s")), default=0)
    rows = []
    for key, seconds in timing.items():
        unit = "ms" if key.endswith("_ms") else "s"
        share = max(seconds, 0) / longest * 12 if seconds and longest and unit == "s" else 0
        stage = key.removesuffix("_ms").removesuffix("_s")
        label = STAGES.get(stage, stage.replace("_", " "))
        cell = f"{show(seconds, 3)} {unit}" if seconds is not None else "–"
        rows.append([label, cell, f'<span class="bar" style="width:{share:.2f}rem"></span>'])
    return f"<h2>Time</h2>{table(['', '', ''], rows)}" if rows else ""


def map_table(maps: Mapping[str, np.ndarray], names: Sequence[str]) -> str:
    """List peak, mean and median of every map."""
    rows = [[name, *_map_statistics(maps[name])] for name in names if name in maps]
    head = ["map", "size", "peak luminance", "at row, column", "mean", "median", "lowest", "not finite"]
    if not rows:
        return ""
    return (
        f"<h2>Environment maps</h2>{table(head, rows)}\n"
        '<p class="soft">Luminances are linear; the mean is over the sphere.</p>'
    )


def _map_statistics(image):
    """Fill the table's cells for one map: luminances (linear) and the peak's place."""
    bad = ~np.isfinite(image).all(axis=2)
    light = np.where(bad, 0, luminance(np.where(bad[..., None], 0, image).astype(np.float64)))
    height, width = light.shape
    weight = np.broadcast_to(np.reshape(solid_angles(height, width), (height, 1)), light.shape)
    row, column = np.unravel_index(np.argmax(light), light.shape)
    position = f"{row}, {column}" if light[row, column] > 0 else "–"
    mean = float((light * weight).sum() / weight.sum())
    cells = [show(light.max()), position, show(mean), show(float(np.median(light))), show(light.min())]
    return [f"{width} × {height}", *cells, f'<span class="alarm">{bad.sum()}</span>' if bad.any() else "0"]
