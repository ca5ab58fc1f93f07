"""The HTML report of a run: one file that opens offline, with inline SVG curves and base64 PNG pictures.

Only ``run_folder.py`` imports this module.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from envedit import config
from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance
from envedit.core.latlong import solid_angles
from envedit.core.types import FilePath
from envedit.report import html_parts as parts
from envedit.report import preview
from envedit.report.curves import curves_svg, escape, normalised
from envedit.report.plain_files import plain
from envedit.report.verdict import verdict

if TYPE_CHECKING:
    from envedit.results import Result

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


def write_report(path: FilePath, result: Result, manifest: dict) -> None:
    """Write ``report.html``: verdict, pictures, differences, curves, tables and configuration in one file.

    ``manifest`` is that of :func:`.manifest.manifest`. Raises InputError if the file cannot be written.
    """
    settings = result.settings

    # ---- What is shown
    metrics = plain(result.metrics, "", [])
    tonemap = settings.output.tonemap
    maps = preview.known(result.maps)
    by_view = _by_view(result.shown, result.views)

    warnings = result.warnings
    source = result.input_map.source if result.input_map else settings.input.envmap
    title = escape(f"{Path(source).stem}, {Path(settings.scene.file).stem}")
    manifest_text = json.dumps(plain(manifest, "", []), indent=1, ensure_ascii=False)

    # ---- The page
    page = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}</title><style>{parts.STYLE}</style></head><body>",
        f'<h1>{title}</h1><p class="verdict">{escape(verdict(metrics))}</p>',
        f'<div class="warnings"><strong>Warnings</strong>{parts.listing(warnings)}</div>' if warnings else "",
        _pictures(list(result.maps), by_view, maps, tonemap),
        _section("Differences", _differences(by_view, maps, tonemap), 2),
        _section("Lights and background", parts.lights_figure(maps["edited"], result.lights, tonemap), 1),
        _section("", _separation(result.separation, tonemap)),
        _section("What this view determines", _determined(result)),
        _section("What was painted", _painted(result)),
        _section("Photograph", _photograph(result)),
        _section("Other explanations", _variants(result, tonemap)),
        f"<h2>Losses</h2>{_losses(result.history, settings)}",
        _quality(metrics),
        _numbers(metrics),
        _map_table(maps),
        f"<h2>Choices made</h2>{parts.listing(result.notes)}" if result.notes else "",
        f"<h2>Configuration</h2><pre>{escape(config.to_toml(settings))}</pre>",
        "<h2>Manifest</h2><details><summary>Versions, machine, seeds, inputs</summary>"
        f"<pre>{escape(manifest_text)}</pre></details>",
        "</body></html>\n",
    ]
    write_atomically(path, "\n".join(part for part in page if part).encode("utf-8", "backslashreplace"))


def _section(heading, figures, columns=None):
    title = f"<h2>{heading}</h2>" if heading else "<p></p>"
    return title + parts.grid(figures, columns) if figures else ""


# ---- Pictures ----------------------------------------------------------------------------------------------


def _by_view(renders, views):
    """Return the renderings of each view by its name; "" for a single one."""
    if len(views) < 2:
        return {"": renders}
    return {
        f"view {k} ({view.name})": {name: image[view.rows] for name, image in renders.items()}
        for k, view in enumerate(views)
    }


def _pictures(names, by_view, maps, tonemap):
    """Show renderings, a row for each view, and maps below each other."""
    kinds = {f"rendering of {view}" if view else "rendering": renders for view, renders in by_view.items()}
    rows = []
    for what, pictures in [*kinds.items(), ("environment map", maps)]:
        stops = preview.stops_of(pictures.values())
        figures = []
        for name in names:
            caption = f"{name}, {what}"
            if name in pictures:
                pixels = preview.display(pictures[name], tonemap, stops)
                figures.append(parts.figure(pixels, caption + preview.exposed(stops)))
            else:
                figures.append(f'<div class="unknown">{escape(caption)}: not known</div>')
        rows.append(parts.grid(figures, 1 if pictures is maps else None))
    return (
        f"<h2>Renderings and maps</h2>{'<p></p>'.join(rows)}\n"
        f'<p class="soft">Tonemap of the pictures: {escape(tonemap)}.</p>'
    )


def _differences(by_view, maps, tonemap):
    """Draw the edited pictures less others."""
    figures = []
    for view, renders in by_view.items():
        pixels, most = preview.difference_image(renders["edited"], renders["target"], "tonemapped", tonemap)
        caption = f"{view}: renderings, edited − target: tonemapped luminance".removeprefix(": ")
        bar = parts.scale((f"−{most:g}", "0", f"+{most:g}"), preview.DIVERGING)
        figures.append(parts.figure(pixels, caption, bar))
    for name in [name for name in maps if name != "edited"]:
        pixels, most = preview.difference_image(maps["edited"], maps[name], "stops")
        bar = parts.scale((f"−{most:g} stops", "0", f"+{most:g} stops"), preview.DIVERGING)
        figures.append(parts.figure(pixels, f"maps, edited − {name}: luminance in stops", bar))
    return figures


def _separation(separation, tonemap):
    """Draw background, glow and cores of a separation; nothing where no light was found."""
    if separation is None or not separation.lights:
        return []
    count = len(separation.lights)
    pictures = {
        "background: the map without its lights": separation.background,
        "glow: what the lights add to the sky": separation.background * (separation.glow - 1),
        "the light" if count == 1 else f"the {count} lights": separation.core,
    }
    stops = preview.stops_of([separation.background])
    return [parts.figure(preview.display(image, tonemap, stops), text) for text, image in pictures.items()]


def _determined(result):
    """Draw what the picture says of the sky."""
    if result.influence is None:
        return []
    pixels = preview.influence_image(result.influence, result.frozen)
    bar = parts.scale((f"{share:g}" for share in preview.INFLUENCE_RANGE), preview.RISING)
    figures = [parts.figure(pixels, preview.influence_caption(result.frozen), bar)]
    if result.posterior is not None and result.posterior.identified is not None:
        pixels = preview.colours(preview.RISING, result.posterior.identified)
        caption = "how well the rendering determines the brightness of the sky, smoothed over some 15 degrees"
        bar = parts.scale(("not at all", "fully"), preview.RISING)
        figures.append(parts.figure(pixels, caption, bar))
    return figures


def _painted(result):
    """Draw what of the paint is not feasible, of each view."""
    if result.reach is None:
        return []
    codes = np.rint(255 * preview.unreachable(result.reach)).astype(np.uint8)
    caption = f"what is not feasible; {100 * result.reach.share:.0f} % of the painted change is feasible"
    words = parts.scale(("marked red: stays darker than painted", "marked blue: brighter"))
    return [parts.figure(codes[rows], caption, words) for rows in result.rows or (slice(None),)]


def _photograph(result):
    """Draw the photograph, the edited rendering as its camera shows it, and what light does not explain."""
    if result.photo is None:
        return []
    captions = (
        f"the photograph on the film of the rendering: {result.photo.summary}",
        "the edited rendering as that camera shows it",
        f"red: not explained by light, {100 * result.metrics['camera']['outliers']:.3g} % of the pixels",
    )
    pictures = preview.photograph(result.photo, result.render, result.outliers)
    return [
        parts.figure(np.rint(255 * values).astype(np.uint8), caption)
        for values, caption in zip(pictures, captions, strict=True)
    ]


def _variants(result, tonemap):
    """Draw the renderings of other explanations of the paint."""
    return [
        parts.figure(
            preview.display(one.render, tonemap), f"{one.summary}, -2 log evidence {one.evidence:.1f}"
        )
        for one in result.variants
    ]


def _losses(history, settings):
    """Draw the losses."""
    weights = {name: weight for name, weight in asdict(settings.loss).items() if weight}
    ramps = {name: weight if isinstance(weight, tuple) else (weight,) * 2 for name, weight in weights.items()}
    rows, about = normalised(history, ramps, max(settings.optimizer.iterations, 1))
    curves = curves_svg(rows)
    if not curves:
        return f'<p class="soft">No loss to draw in {len(history)} rows of history.</p>'
    return curves + (f'<p class="soft">{escape(about)}</p>' if about else "")


# ---- Tables ------------------------------------------------------------------------------------------------


def _quality(metrics):
    """Compare renderings, and maps where the true one is known, with the target; each view by itself."""
    kinds = {name: words for name, words in _COMPARED.items() if metrics.get(name)}
    rows = [
        [words, *(parts.show(metrics[name][key]) for name in kinds)]
        for key, words in _MEASURES.items()
        if key != "lpips" or any(metrics[name][key] is not None for name in kinds)
    ]
    tables = "<h2>Quality</h2>" + parts.table(["", *kinds.values()], rows)
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
            [f"{k} ({view['name']})", *(parts.show(view[name][key]) for key in _MEASURES for name in kinds)]
            for k, view in enumerate(metrics["views"])
        ]
        tables += f"<h2>Views</h2>{parts.table(head, rows)}"
    return tables


def _numbers(metrics):
    """List the other numbers by their keys of metrics.json, which docs/outputs.md explains."""
    elsewhere = ("choices", "views", "variants", "tonemap", "worse")
    others = {
        key: value
        for key, value in metrics.items()
        if not isinstance(value, (dict, type(None))) and key not in elsewhere
    }
    for part in ("natural", "painted", "fit", "transport", "timing"):
        others |= {f"{part}.{key}": value for key, value in (metrics.get(part) or {}).items()}
    rows = [[key, parts.show(value)] for key, value in others.items()]
    return f"<details><summary>Numbers of metrics.json</summary>{parts.table(['', ''], rows)}</details>"


def _map_table(maps):
    """List peak, mean and median of every map."""
    rows = [[name, *map_statistics(image)] for name, image in maps.items()]
    head = ["map", "size", "peak luminance", "at row, column", "mean", "median", "lowest"]
    return (
        f"<h2>Environment maps</h2>{parts.table(head, rows)}\n"
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
        parts.show(values.max()),
        f"{row}, {column}",
        parts.show(mean),
        parts.show(float(np.median(values))),
        parts.show(values.min()),
    ]
