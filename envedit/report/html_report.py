"""The HTML report of a run: one file that opens offline, with inline SVG curves and base64 PNG pictures.

Pictures come in as linear radiance, ``(H, W, 3)``, and are tonemapped for display only. Only
``run_folder.py`` imports this module.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance
from envedit.core.latlong import solid_angles
from envedit.core.types import FilePath
from envedit.images.images import png
from envedit.losses.metrics import saturated, score, worse
from envedit.report.curves import curves_svg, escape, normalised, number
from envedit.report.manifest import plain
from envedit.report.preview import (
    INFLUENCE_RANGE,
    RISING,
    checked,
    difference_image,
    display,
    fit_finite,
    influence_image,
    share_image,
)
from envedit.representations.layers.separation import Separation
from envedit.scene.scene import View

_STYLE = """
:root { --ink: #22223b; --soft: #6b6b7b; --line: #e4e4ea; --alarm: #a63d2f; }
* { box-sizing: border-box; }
body { font: 15px/1.55 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink);
  background: #fbfbfc; margin: 0 auto; max-width: 1120px; padding: 2.5rem 1.5rem 4rem;
  overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; font-weight: 600; margin: 0 0 .3rem; }
h2 { font-size: 1.05rem; font-weight: 600; margin: 2.6rem 0 .8rem; padding-top: .9rem;
  border-top: 1px solid var(--line); }
p { margin: .4rem 0; } .soft, figcaption { color: var(--soft); font-size: .87rem; }
.verdict { font-size: 1.1rem; } .alarm { color: var(--alarm); }
.warnings { border-left: 3px solid var(--alarm); background: #fff; margin: 1.2rem 0; padding: .6rem 1rem; }
ul { margin: .4rem 0; padding-left: 1.2rem; }
.grid { display: grid; gap: 1rem; align-items: end; }
figure { margin: 0; } figcaption { margin: .3rem 0 0; }
figure img { display: block; width: 100%; border-radius: 3px; }
img.small { image-rendering: pixelated; }
.unknown { min-height: 4rem; background: #e9e9ee; border-radius: 3px; color: var(--soft);
  display: grid; place-items: center; font-size: .87rem; }
.scale { height: 8px; border-radius: 2px; margin-top: .5rem;
  background: linear-gradient(90deg, #2166ac, #92c5de, #f7f7f7, #f4a582, #b2182b); }
.scale.rising { background: linear-gradient(90deg, RISING); }
.ends { display: flex; justify-content: space-between; color: var(--soft); font-size: .8rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: 22rem;
  overflow-wrap: normal; }
th { font-weight: 500; color: var(--soft); } th, td { text-align: right; padding: .28rem .9rem; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td:has(.bar) { text-align: left; } tbody tr td { border-top: 1px solid var(--line); }
.bar { display: inline-block; height: .55rem; background: #b9c3d6; border-radius: 2px;
  vertical-align: middle; }
svg.curves { width: 100%; background: #fff; border: 1px solid var(--line); border-radius: 3px; }
svg.curves text { font-size: 12px; fill: var(--soft); }
svg.curves path { fill: none; stroke-width: 1.4; stroke-linecap: round; stroke-linejoin: round; }
svg.curves path.total { stroke-width: 2.4; }
svg.curves .axis { stroke: #9a9aa8; } svg.curves line.grid { stroke: var(--line); }
pre { background: #fff; border: 1px solid var(--line); border-radius: 3px; padding: .9rem; font-size: .8rem;
  white-space: pre-wrap; }
summary { cursor: pointer; }
@media (max-width: 640px) { .grid { grid-template-columns: 1fr !important; } }
""".replace("RISING", ", ".join(f"rgb({r},{g},{b})" for r, g, b in RISING))


_RUN = {
    "iterations": "iterations",
    "non_finite_steps": "steps that were not finite, and not taken",
    "turn_degrees": "turn of the whole sky (degrees)",
    "sun_offset_texels": "brightest texel, edited to true map (texels)",
    "active_rows": "rows that were edited, first and last",
    "natural colours_outside": "share of the sky in colours that neither map has",
    "natural seam": "step at the horizon over the original's",
    "natural high_frequency": "detail of the sky over the original's",
    "painted towards": "share of the way to the paint",
    "painted elsewhere": "change of what was not painted (display values)",
    "painted reachable": "feasible share of the way to the paint",
    "fit log_psnr": "fit of the network, log-PSNR (dB)",
    "fit peak_ratio": "fit, peak over the map's",
    "fit epochs": "fit, epochs",
    "fit cached": "fit taken from disk",
    "transport cached": "T taken from disk",
    "transport entries": "T, entries",
    "transport memory_bytes": "T, bytes",
    "transport columns": "T, exact columns",
    "transport samples": "T, samples a pixel",
    "transport path_depth": "T, longest path",
    "transport depth_error": "T, share of the light that longer paths would add",
    "transport predicted_error": "T, predicted relative error",
    "transport frozen": "share of texels that are frozen",
}
"""Numbers of metrics.json in words; terms that are ours are in docs/glossary.md."""
_TIMES = {
    "import": "importing",
    "target": "rendering the target",
    "fit": "fitting the representation",
    "transport": "tracing T, or reading it from disk",
    "reach": "estimating what is feasible",
    "start": "searching for lights",
    "edit": "optimising",
    "solve": "searching and optimising",
    "judge": "rendering the result",
    "full": "the edit at the resolution of the file",
    "report": "writing the report",
    "total": "total",
    "per_iteration": "one iteration",
}


def _show(value, digits=4):
    """Print a number of a table; a missing one, or one that is not finite, is a dash."""
    found = number(value)
    if value is None or isinstance(value, (float, np.floating)) and found is None:
        return "–"
    if found is None:
        return escape(value)
    return f"{found:.0f}" if found == int(found) and abs(found) < 1e6 else f"{found:.{digits}g}"


def _table(head, body):
    """Build a table of cells that are HTML already, its head and first column text."""
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = [
        f"<tr><td>{escape(first)}</td>" + "".join(f"<td>{cell}</td>" for cell in rest) + "</tr>"
        for first, *rest in body
    ]
    body = "\n".join(lines)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(pixels, caption, below=""):
    picture = base64.b64encode(png(pixels)).decode("ascii")
    caption = escape(caption)
    small = ' class="small"' if pixels.shape[1] < 400 else ""  # texels with edges where they are enlarged
    return (
        f'<figure><img{small} alt="{caption}" src="data:image/png;base64,{picture}">{below}'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _figure_of(pictures, name, what, tonemap):
    if name in pictures:
        return _figure(_shrunk(pictures[name], tonemap), f"{name}, {what}")
    return f'<div class="unknown">{escape(f"{name}, {what}: not known")}</div>'


def _grid(figures, columns=None):
    columns = columns or max(len(figures), 3)
    return f'<div class="grid" style="grid-template-columns:repeat({columns},1fr)">{"".join(figures)}</div>'


def _shrunk(image, tonemap, exposure=0.0, widest=1024):
    """Tonemap a picture at its own size, or at 1024 pixels where it is wider."""
    height, width = image.shape[:2]
    factor = min(1.0, widest / width)
    return display(image, max(round(height * factor), 1), max(round(width * factor), 1), tonemap, exposure)


def _difference_figure(a, b, caption, kind, tonemap):
    factor = min(1.0, 1024 / a.shape[1])
    size = max(round(a.shape[0] * factor), 1), max(round(a.shape[1] * factor), 1)
    (a, bad_a), (b, bad_b) = fit_finite(a, *size), fit_finite(b, *size)
    a[bad_a | bad_b] = np.nan
    pixels, scale = difference_image(a, b, kind, tonemap)
    unit = " stops" if kind == "stops" else ""
    ends = f'<div class="ends"><span>−{scale:g}{unit}</span><span>0</span><span>+{scale:g}{unit}</span></div>'
    return _figure(pixels, caption, f'<div class="scale"></div>{ends}')


def _identified_figure(identified):
    """List the figure of how well the rendering determines the sky, if that is known."""
    if identified is None:
        return []
    ends = '<div class="ends"><span>not at all</span><span>fully</span></div>'
    caption = "how well the rendering determines the brightness of the sky, smoothed over some 15 degrees"
    return [_figure(share_image(identified), caption, f'<div class="scale rising"></div>{ends}')]


def _influence_figure(influence, frozen):
    low, high = INFLUENCE_RANGE
    ends = f'<div class="ends"><span>{low:g}</span><span>{high:g}</span></div>'
    caption = "influence of each texel on the rendering, per solid angle; 1 is the mean"
    if frozen is not None and frozen.any():
        caption += "; grey texels are not determined by this view and keep their original value"
    return _figure(influence_image(influence, frozen), caption, f'<div class="scale rising"></div>{ends}')


def _separation_figures(separation, tonemap):
    """Draw background, glow and cores of a separation, or nothing where no light was found."""
    if separation is None or not separation.lights:
        return []
    count = len(separation.lights)
    pictures = {
        "background: the map without its lights": separation.background,
        "glow: what the lights add to the sky": separation.background * (separation.glow - 1),
        "the light" if count == 1 else f"the {count} lights": separation.core,
    }
    return [_figure(_shrunk(image, tonemap), caption) for caption, image in pictures.items()]


def _unreachable_figure(pixels, share):
    within = "" if share is None else f"; {100 * share:.0f} % of the request is feasible"
    ends = '<div class="ends"><span>red: stays darker than asked</span><span>blue: brighter</span></div>'
    return _figure(
        np.rint(255 * np.clip(pixels, 0, 1)).astype(np.uint8), f"what no light can do{within}", ends
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
    cells = [_show(light.max()), position, _show(mean), _show(float(np.median(light))), _show(light.min())]
    return [f"{width} × {height}", *cells, f'<span class="alarm">{bad.sum()}</span>' if bad.any() else "0"]


def _verdict(metrics):
    def table(name):
        found = metrics.get(name) or {}
        return found if number(found.get("psnr")) is not None else None

    before, after, true_map = table("initial"), table("render"), table("envmap")
    unedited = table("initial_envmap")
    known = [one for one in (before, after) if one]
    total = number((metrics.get("timing") or {}).get("total_s"))

    def told(one):
        return "unknown" if one is None else score(one, known)

    kind = "log RMSE: a display shows little of what differs" if saturated(known) else "PSNR"
    parts = [f"Rendering against the target: {told(before)} → <strong>{told(after)}</strong> {kind}"]
    if true_map:
        since = f"{score(unedited, [])} → " if unedited else ""
        parts.append(f"map against the true one: {since}{score(true_map, [])}")
    painted = metrics.get("painted") or {}
    towards, elsewhere = number(painted.get("towards")), number(painted.get("elsewhere"))
    if towards is not None:
        parts[0] = f"<strong>{100 * towards:.0f} %</strong> of the way to the paint"
        parts += [f"the rest changed by {elsewhere:.3f} of white"] if elsewhere is not None else []
    parts += [f"{total:.1f} s in total"] if total is not None else []
    line = f'<p class="verdict">{" · ".join(parts)}</p>'
    if towards is not None and towards < 0:
        line += '<p class="alarm">The edited rendering is further from the paint than the unedited one.</p>'
    if towards is None and before and after and worse(after, before):
        line += '<p class="alarm">The edited rendering is further from the target than the unedited one.</p>'
    return line


def write_report(
    path: FilePath,
    *,
    title: str,
    config_toml: str,
    metrics: dict,
    manifest: dict,
    history: list[dict],
    renders: Mapping[str, np.ndarray | None],
    maps: Mapping[str, np.ndarray | None],
    influence: np.ndarray | None = None,
    frozen: np.ndarray | None = None,
    identified: np.ndarray | None = None,
    separation: Separation | None = None,
    unreachable: np.ndarray | None = None,
    warnings: Sequence[str] = (),
    notes: Sequence[str] = (),
    tonemap: str = "gamma",
    views: Sequence[View] = (),
    ramps: tuple[dict[str, tuple[float, float]], int] | None = None,
) -> None:
    """Write ``report.html``: verdict, pictures, differences, curves, tables and configuration in one file.

    Parameters
    ----------
    path : path
        File to write.
    title : str
        Heading of the page.
    config_toml : str
        The resolved configuration.
    metrics, manifest : dict
        As written by `write_metrics` and `write_manifest`; whatever is missing is shown as a dash.
    history : list of dict
        A row an iteration; may be empty.
    renders, maps : dict of str to array or None
        As for `preview`. Differences are drawn between the names ``initial``, ``target`` and ``edited``.
    influence, frozen : array (H, W), optional
        As for `envedit.report.preview.influence_image`.
    identified : array (H, W), optional
        Share of the prior's variance of the sky's gain that the target removes.
    separation : separation.Separation, optional
        Lights and background of the rows that were edited.
    unreachable : array (h, w, 3), optional
        Display values of `envedit.solve.feasibility.unreachable`.
    warnings, notes : sequence of str
        What the user should know, and the choices made for settings left at "auto".
    tonemap : str
        A name of `envedit.core.color.TONEMAPS`, for the pictures.
    views : sequence of `scene.View`
        Name and rows of each view, where the renderings are of several.
    ramps : (dict of str to (float, float), int), optional
        First and last weight of each loss in the history, and the iterations between them.

    Raises
    ------
    InputError
        If a picture is not ``(H, W, 3)`` or the file cannot be written.
    ConfigError
        If there is no such tonemap.
    """
    names = list(dict.fromkeys([*renders, *maps]))
    renders = {name: checked(image, name) for name, image in renders.items() if image is not None}
    maps = {name: checked(image, name) for name, image in maps.items() if image is not None}
    lost: list[str] = []
    metrics = plain(metrics, "metrics: ", lost)
    plain(history, "history", lost)
    warnings = [str(warning) for warning in warnings]
    if lost:
        shown = ", ".join(lost[:5]) + (f" and {len(lost) - 5} more" if len(lost) > 5 else "")
        warnings.append(f"Not finite, shown as missing: {shown}.")
    for kind, pictures in (("rendering", renders), ("map", maps)):
        for name, image in pictures.items():
            if bad := int((~np.isfinite(image).all(axis=2)).sum()):
                warnings.append(f"{kind} {name}: {bad} pixels are not finite, drawn in magenta.")

    # Pictures
    shown = [(f"rendering of view {k} ({v.name})", f"view {k}: ", v.rows) for k, v in enumerate(views)]
    if len(views) < 2:
        shown = [("rendering", "", slice(None))]
    of_views = [{name: image[rows] for name, image in renders.items()} for _, _, rows in shown]
    figures = [
        _grid([_figure_of(pictures, name, what, tonemap) for name in names])
        for pictures, (what, _, _) in zip(of_views, shown, strict=True)
    ]
    map_figures = [_figure_of(maps, name, "environment map", tonemap) for name in names]
    differences = []
    pairs = [(one, "target", part) for one, (_, part, _) in zip(of_views, shown, strict=True)]
    for pictures, other, part in (*pairs, (maps, "initial", ""), (maps, "target", "")):
        if "edited" not in pictures or other not in pictures:
            continue
        kind, what = ("stops", "maps") if pictures is maps else ("tonemapped", f"{part}renderings")
        a, b = pictures["edited"], pictures[other]
        if a.shape != b.shape:
            sizes = f"{a.shape[:2]} and {b.shape[:2]}"
            warnings.append(f"{what} edited and {other} differ in size, {sizes}: no difference is drawn.")
            continue
        how = "luminance in stops" if kind == "stops" else "tonemapped luminance"
        differences.append(_difference_figure(a, b, f"{what}, edited − {other}: {how}", kind, tonemap))

    # Tables
    kinds = {"initial": "initial rendering", "render": "edited rendering"}
    kinds |= {"initial_envmap": "unedited map", "envmap": "edited map"} if metrics.get("envmap") else {}
    quality = [metrics.get(table) or {} for table in kinds]
    measures = {"psnr": "PSNR (dB)", "ssim": "SSIM", "mse": "MSE", "lpips": "LPIPS"}
    measures |= {"log_rmse": "log RMSE (stops)", "beyond_display": "share that a display does not show"}
    quality_rows = [
        [name, *(_show(table.get(key)) for table in quality)]
        for key, name in measures.items()
        if key != "lpips" or any(table.get(key) is not None for table in quality)
    ]
    others = [(key, value) for key, value in metrics.items() if not isinstance(value, (dict, type(None)))]
    elsewhere = ("choices", "views", "tonemap", "worse")
    others = [(key, value) for key, value in others if key not in elsewhere]
    view_rows = [
        [
            f"{k} ({view['name']})",
            *(_show(view[when][key]) for key in measures for when in ("initial", "render")),
        ]
        for k, view in enumerate(metrics.get("views") or [])
    ]
    view_head = ["view", *(f"{what}, {name}" for name in measures.values() for what in ("initial", "edited"))]
    for part in ("natural", "painted", "fit", "transport"):
        others += [(f"{part} {key}", value) for key, value in (metrics.get(part) or {}).items()]
    others = [[_RUN.get(key, key.replace("_", " ")), _show_list(value)] for key, value in others]
    timing = {key: number(value) for key, value in (metrics.get("timing") or {}).items()}
    longest = max((t for key, t in timing.items() if t and key.endswith("_s")), default=0)
    timing_rows = []
    for key, seconds in timing.items():
        unit = "ms" if key.endswith("_ms") else "s"
        share = max(seconds, 0) / longest * 12 if seconds and longest and unit == "s" else 0
        label = key.removesuffix("_ms").removesuffix("_s")
        label = _TIMES.get(label, label.replace("_", " "))
        cell = f"{_show(seconds, 3)} {unit}" if seconds is not None else "–"
        timing_rows.append([label, cell, f'<span class="bar" style="width:{share:.2f}rem"></span>'])
    map_rows = [[name, *_map_statistics(maps[name])] for name in names if name in maps]
    map_head = ["map", "size", "peak luminance", "at row, column", "mean", "median", "lowest", "not finite"]

    parts = _separation_figures(separation, tonemap)
    painted = metrics.get("painted") or {}
    asked = [] if unreachable is None else [
        _unreachable_figure(unreachable[rows], painted.get("reachable")) for _, _, rows in shown
    ]  # fmt: skip

    # The page
    seen = []
    if influence is not None:
        seen = [_influence_figure(influence, frozen), *_identified_figure(identified)]
    drawn, about = normalised(history, *(ramps or ({}, 1)))
    curves = curves_svg(drawn) or f'<p class="soft">No loss to draw in {len(history)} rows of history.</p>'
    curves += f'<p class="soft">{escape(about)}</p>' if "<svg" in curves and about else ""
    manifest_text = json.dumps(plain(manifest, "", []), indent=1, ensure_ascii=False)
    page = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>{_verdict(metrics)}",
        f'<div class="warnings"><strong>Warnings</strong>{_list(warnings)}</div>' if warnings else "",
        f"<h2>Renderings and maps</h2>{'<p></p>'.join(figures)}<p></p>{_grid(map_figures, 1)}"
        if names
        else "",
        f'<p class="soft">Tonemap of the pictures: {escape(tonemap)}.</p>' if names else "",
        f"<h2>Differences</h2>{_grid(differences, 2)}" if differences else "",
        f"<h2>Lights and background</h2>{_grid(parts)}" if parts else "",
        f"<h2>What this view determines</h2>{_grid(seen)}" if seen else "",
        f"<h2>What was painted</h2>{_grid(asked)}" if asked else "",
        f"<h2>Losses</h2>{curves}",
        "<h2>Quality</h2>",
        _table(["", *kinds.values()], quality_rows),
        '<p class="soft">Against the target, and the map that it was rendered under where that is known. '
        f"All but log RMSE: under the tonemap {escape(metrics.get('tonemap') or tonemap)}.</p>",
        f"<h2>Views</h2>{_table(view_head, view_rows)}" if view_rows else "",
        f"<details><summary>Numbers of the run</summary>{_table(['', ''], others)}</details>"
        if others
        else "",
        f"<h2>Environment maps</h2>{_table(map_head, map_rows)}" if map_rows else "",
        '<p class="soft">Luminances are linear; the mean is over the sphere.</p>' if map_rows else "",
        f"<h2>Time</h2>{_table(['', '', ''], timing_rows)}" if timing_rows else "",
        f"<h2>Choices made</h2>{_list(notes)}" if notes else "",
        f"<h2>Configuration</h2><pre>{escape(config_toml)}</pre>",
        f"<h2>Manifest</h2><details><summary>Versions, machine, seeds, inputs</summary>"
        f"<pre>{escape(manifest_text)}</pre></details>",
        "</body></html>\n",
    ]
    write_atomically(path, "\n".join(part for part in page if part).encode("utf-8", "backslashreplace"))


def _list(items):
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def _show_list(value):
    return ", ".join(_show(item) for item in value) if isinstance(value, list) else _show(value)
