"""Parts of an HTML report: its style, lists, tables of cells, and figures with base64 PNG pictures."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from envedit.images.images import png
from envedit.report.curves import escape, number
from envedit.report.preview import (
    INFLUENCE_RANGE,
    RISING,
    difference_image,
    display,
    exposed,
    fit_finite,
    influence_image,
    share_image,
    stops_of,
)
from envedit.representations.layers.separation import Separation

STYLE = """
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
.over { position: relative; } .over svg { position: absolute; inset: 0; width: 100%; height: 100%; }
svg.lights { stroke-width: .7; fill: none; font-size: 6px; paint-order: stroke; }
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

WIDEST = 1024
"""Pixels along a picture of the report, at most."""
MOST_DRAWN = 20
"""Lights that :func:`lights_figure` draws."""
NUMBERS = {
    "iterations": "iterations",
    "non_finite_steps": "steps that were not finite, and not taken",
    "turn_degrees": "turn of the whole sky (degrees)",
    "sun_offset_texels": "distance between the brightest texels of the edited and of the true map (texels)",
    "active_rows": "rows that were edited, first and last",
    "natural colours_outside": "share of the sky in colours that neither map has",
    "natural seam": "step at the horizon over the original's",
    "natural high_frequency": "detail of the sky over the original's",
    "natural white": "share of the sky that is white, less the original's",
    "natural patches": "patches of the edit, over those between two photographed skies",
    "painted towards": "share of the painted change that is reached",
    "painted elsewhere": "change of what was not painted (display values)",
    "painted reachable": "share of the painted change that is feasible",
    "fit log_psnr": "fit of the network, log-PSNR (dB)",
    "fit peak_ratio": "fit, peak over the map's",
    "fit epochs": "fit, epochs",
    "fit cached": "fit taken from disk",
    "transport cached": "light transport (T) taken from disk",
    "transport entries": "light transport, entries",
    "transport memory_bytes": "light transport, bytes",
    "transport columns": "light transport, exact columns",
    "transport samples": "light transport, samples a pixel",
    "transport path_depth": "light transport, longest path",
    "transport depth_error": "light transport, share of the light that longer paths would add",
    "transport predicted_error": "light transport, predicted relative error",
    "transport frozen": "share of texels that are frozen",
}
"""Numbers of metrics.json in words; terms that are ours are in docs/glossary.md."""
STAGES = {
    "import": "importing",
    "target": "rendering the target",
    "fit": "fitting the representation",
    "transport": "tracing the light transport, or reading it from disk",
    "reach": "estimating what is feasible",
    "start": "searching for lights",
    "edit": "optimising",
    "solve": "searching and optimising",
    "judge": "rendering the result",
    "full": "writing the maps, also at the resolution of the file",
    "report": "writing the report",
    "total": "total",
    "per_iteration": "one iteration",
}
"""Keys of the metrics' timing in words, without their units."""


def show(value: object, digits: int = 4) -> str:
    """Print a number of a table; a missing one, or one that is not finite, is a dash."""
    found = number(value)
    if value is None or isinstance(value, (float, np.floating)) and found is None:
        return "–"
    if found is None:
        return escape(value)
    return f"{found:.0f}" if found == int(found) and abs(found) < 1e6 else f"{found:.{digits}g}"


def show_list(value: object) -> str:
    """Print a number, or several."""
    return ", ".join(show(item) for item in value) if isinstance(value, list) else show(value)


def listing(items: Iterable[object]) -> str:
    """Build a list of texts."""
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def table(head: Iterable[object], body: Iterable[Sequence[str]]) -> str:
    """Build a table of cells that are HTML already, its head and first column text."""
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = [
        f"<tr><td>{escape(first)}</td>" + "".join(f"<td>{cell}</td>" for cell in rest) + "</tr>"
        for first, *rest in body
    ]
    rows = "\n".join(lines)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{rows}</tbody></table></div>'


def figure(pixels: np.ndarray, caption: str, below: str = "", over: str = "") -> str:
    """Show pixels (H, W, 3) uint8 over a caption; ``below`` is HTML between them, ``over`` on the pixels."""
    picture = base64.b64encode(png(pixels)).decode("ascii")
    caption = escape(caption)
    small = ' class="small"' if pixels.shape[1] < 400 else ""  # texels with edges where they are enlarged
    return (
        f'<figure><div class="over"><img{small} alt="{caption}" src="data:image/png;base64,{picture}">{over}'
        f"</div>{below}"
        f"<figcaption>{caption}</figcaption></figure>"
    )


def figure_of(pictures: Mapping[str, np.ndarray], name: str, what: str, tonemap: str) -> str:
    """Show one of some pictures, or that it is not known."""
    if name in pictures:
        stops = stops_of(pictures.values())
        return figure(shrunk(pictures[name], tonemap, stops), f"{name}, {what}{exposed(stops)}")
    return f'<div class="unknown">{escape(f"{name}, {what}: not known")}</div>'


def grid(figures: Sequence[str], columns: int | None = None) -> str:
    """Arrange figures in columns: as many as there are and at least three, or as given."""
    columns = columns or max(len(figures), 3)
    return f'<div class="grid" style="grid-template-columns:repeat({columns},1fr)">{"".join(figures)}</div>'


def shrunk(image: np.ndarray, tonemap: str, stops: float = 0.0) -> np.ndarray:
    """Expose and tonemap a picture at its own size, or at :data:`WIDEST` pixels where it is wider."""
    height, width = _size(image)
    return display(image, height, width, tonemap, stops)


def _size(image):
    factor = min(1.0, WIDEST / image.shape[1])
    return max(round(image.shape[0] * factor), 1), max(round(image.shape[1] * factor), 1)


def difference_figure(a: np.ndarray, b: np.ndarray, caption: str, kind: str, tonemap: str) -> str:
    """Show the difference a - b of two pictures; ``kind`` as of :func:`.preview.difference_image`."""
    (a, bad_a), (b, bad_b) = (fit_finite(image, *_size(a)) for image in (a, b))
    a[bad_a | bad_b] = np.nan
    pixels, scale = difference_image(a, b, kind, tonemap)
    unit = " stops" if kind == "stops" else ""
    ends = f'<div class="ends"><span>−{scale:g}{unit}</span><span>0</span><span>+{scale:g}{unit}</span></div>'
    return figure(pixels, caption, f'<div class="scale"></div>{ends}')


def identified_figure(identified: np.ndarray | None) -> list[str]:
    """List the figure of how well the rendering determines the sky, if that is known."""
    if identified is None:
        return []
    ends = '<div class="ends"><span>not at all</span><span>fully</span></div>'
    caption = "how well the rendering determines the brightness of the sky, smoothed over some 15 degrees"
    return [figure(share_image(identified), caption, f'<div class="scale rising"></div>{ends}')]


def influence_figure(influence: np.ndarray, frozen: np.ndarray | None) -> str:
    """Show the influence of each texel; see :func:`.preview.influence_image`."""
    low, high = INFLUENCE_RANGE
    ends = f'<div class="ends"><span>{low:g}</span><span>{high:g}</span></div>'
    caption = "influence of each texel on the rendering, per solid angle; 1 is the mean"
    if frozen is not None and frozen.any():
        caption += "; grey texels are not determined by this view and keep their original value"
    return figure(influence_image(influence, frozen), caption, f'<div class="scale rising"></div>{ends}')


def separation_figures(separation: Separation | None, tonemap: str) -> list[str]:
    """Draw background, glow and cores of a separation, or nothing where no light was found."""
    if separation is None or not separation.lights:
        return []
    count = len(separation.lights)
    pictures = {
        "background: the map without its lights": separation.background,
        "glow: what the lights add to the sky": separation.background * (separation.glow - 1),
        "the light" if count == 1 else f"the {count} lights": separation.core,
    }
    stops = stops_of([separation.background])
    return [figure(shrunk(image, tonemap, stops), caption) for caption, image in pictures.items()]


def lights_figure(envmap: np.ndarray, lights: Mapping[str, list[dict]], tonemap: str) -> list[str]:
    """Draw on the edited map where its lights are and were; nothing without any.

    ``lights`` are those of :func:`.light_list.matched`, of which the first :data:`MOST_DRAWN` are drawn.
    """
    before, after = ({one["id"]: one for one in lights.get(when, [])} for when in ("before", "after"))
    drawn: list[str] = []
    for which in list(before | after)[:MOST_DRAWN]:
        start, end = before.get(which), after.get(which)
        if start and end:
            drawn += _way(_on_map(start), _on_map(end))
        if start:
            drawn.append(_circle(_on_map(start), 3, "#fff", dashed=end is None))
        if end:
            drawn.append(_circle(_on_map(end), 4.5, "#fff" if start else "#ffb000"))
        x, y = _on_map(end or before[which])
        at = f'x="{min(x + 5, 350):.1f}" y="{max(y - 4, 7):.1f}"'
        drawn.append(f'<text {at} fill="#fff" stroke="#000">{which}</text>')
    if not drawn:
        return []
    over = f'<svg class="lights" viewBox="0 0 360 180" preserveAspectRatio="none">{"".join(drawn)}</svg>'
    caption = (
        "lights of the edited map, numbered as in lights.json; a small circle is where a light was "
        "(dashed: it is gone), a large one where it is (orange: it is new)"
    )
    return [figure(shrunk(envmap, tonemap, stops_of([envmap])), caption, over=over)]


def _on_map(light):
    """Return where a light is on a map of 360 by 180 units."""
    return light["azimuth"], 90 - light["elevation"]


def _way(start, end):
    """Draw the line from one place to another, the shorter way, over the edge of the map if need be."""
    near = start[0] + (end[0] - start[0] + 180) % 360 - 180
    ends = dict.fromkeys((start[0] + shift, near + shift) for shift in (0, end[0] - near))
    heights = f'y1="{start[1]:.1f}" y2="{end[1]:.1f}" stroke="#fff"'
    return [f'<line x1="{a:.1f}" x2="{b:.1f}" {heights}/>' for a, b in ends]


def _circle(centre, radius, colour, dashed=False):
    dash = ' stroke-dasharray="1.2"' if dashed else ""
    return f'<circle cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius}" stroke="{colour}"{dash}/>'


def unreachable_figure(pixels: np.ndarray, share: float | None) -> str:
    """Show what is not feasible, display values (h, w, 3); ``share`` of the painted change is feasible."""
    within = "" if share is None else f"; {100 * share:.0f} % of the painted change is feasible"
    words = "<span>marked red: stays darker than painted</span><span>marked blue: brighter</span>"
    ends = f'<div class="ends">{words}</div>'
    return figure(
        np.rint(255 * np.clip(pixels, 0, 1)).astype(np.uint8), f"what is not feasible{within}", ends
    )
