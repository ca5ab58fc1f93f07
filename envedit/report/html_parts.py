"""Parts of an HTML report: its style, lists, tables of cells, and figures with base64 PNG pictures."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from envedit.images.images import png
from envedit.report import preview
from envedit.report.curves import escape, number

STYLE = """
:root { --ink: #22223b; --soft: #6b6b7b; --line: #e4e4ea; --alarm: #a63d2f; }
* { box-sizing: border-box; }
body { font: 15px/1.55 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; color: var(--ink);
  background: #fbfbfc; margin: 0 auto; max-width: 1120px; padding: 2.5rem 1.5rem 4rem;
  overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; font-weight: 600; margin: 0 0 .3rem; }
h2 { font-size: 1.05rem; font-weight: 600; margin: 2.6rem 0 .8rem; padding-top: .9rem;
  border-top: 1px solid var(--line); }
p, ul { margin: .4rem 0; }
ul { padding-left: 1.2rem; }
.soft, figcaption, .ends, .unknown { color: var(--soft); font-size: .87rem; }
.verdict { font-size: 1.1rem; }
.warnings { border-left: 3px solid var(--alarm); background: #fff; margin: 1.2rem 0; padding: .6rem 1rem; }
.grid { display: grid; gap: 1rem; align-items: end; }
figure { margin: 0; }
figcaption { margin: .3rem 0 0; }
figure img { display: block; width: 100%; border-radius: 3px; }
img.small { image-rendering: pixelated; }
.over { position: relative; }
.over svg { position: absolute; inset: 0; width: 100%; height: 100%; }
svg.lights { stroke-width: .7; fill: none; font-size: 6px; paint-order: stroke; }
.unknown { min-height: 4rem; background: #e9e9ee; border-radius: 3px; display: grid; place-items: center; }
.scale { height: 8px; border-radius: 2px; margin-top: .5rem; }
.ends { display: flex; justify-content: space-between; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: 22rem;
  overflow-wrap: normal; }
th { font-weight: 500; color: var(--soft); }
th, td { text-align: right; padding: .28rem .9rem; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
tbody tr td { border-top: 1px solid var(--line); }
svg.curves { width: 100%; font-size: 12px; fill: var(--soft); }
svg.curves, pre { background: #fff; border: 1px solid var(--line); border-radius: 3px; }
svg.curves polyline { fill: none; stroke-width: 1.4; stroke-linejoin: round; }
svg.curves polyline.total { stroke-width: 2.4; }
svg.curves path.grid { stroke: var(--line); fill: none; }
pre { padding: .9rem; font-size: .8rem; white-space: pre-wrap; }
summary { cursor: pointer; }
@media (max-width: 640px) { .grid { grid-template-columns: 1fr !important; } }
"""
SMALL = 400
"""Pixels along a picture below which it is shown with sharp texels where it is enlarged."""
MOST_DRAWN = 20
"""Lights that :func:`lights_figure` draws."""


def show(value: object) -> str:
    """Print a number of a table, or several; a missing one, or one that is not finite, is a dash."""
    if isinstance(value, list):
        return ", ".join(show(item) for item in value)
    finite = number(value)
    if finite is None:
        return escape(value) if isinstance(value, (str, bool)) else "–"
    return f"{finite:.0f}" if finite == int(finite) and abs(finite) < 1e6 else f"{finite:.4g}"


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


def grid(figures: Sequence[str], columns: int | None = None) -> str:
    """Arrange figures in columns: as many as there are and at least three, or as given."""
    columns = columns or max(len(figures), 3)
    return f'<div class="grid" style="grid-template-columns:repeat({columns},1fr)">{"".join(figures)}</div>'


# ---- Figures -----------------------------------------------------------------------------------------------


def figure(pixels: np.ndarray, caption: str, below: str = "", over: str = "") -> str:
    """Show pixels (H, W, 3) uint8 over a caption; ``below`` is HTML between them, ``over`` on the pixels."""
    picture = base64.b64encode(png(pixels)).decode("ascii")
    caption = escape(caption)
    small = ' class="small"' if pixels.shape[1] < SMALL else ""
    return (
        f'<figure><div class="over"><img{small} alt="{caption}" src="data:image/png;base64,{picture}">{over}'
        f"</div>{below}<figcaption>{caption}</figcaption></figure>"
    )


def scale(words: Iterable[str], colours: np.ndarray | None = None) -> str:
    """Draw a bar of evenly spaced colours (n, 3) over words that explain it from left to right."""
    ends = "".join(f"<span>{escape(word)}</span>" for word in words)
    bar = ""
    if colours is not None:
        stops = ", ".join(f"rgb({r},{g},{b})" for r, g, b in colours)
        bar = f'<div class="scale" style="background:linear-gradient(90deg, {stops})"></div>'
    return f'{bar}<div class="ends">{ends}</div>'


def lights_figure(envmap: np.ndarray, lights: Mapping[str, list[dict]], tonemap: str) -> list[str]:
    """Draw on the edited map where its lights are and were; nothing without any.

    ``lights`` are those of :func:`.light_list.matched`, of which the first :data:`MOST_DRAWN` are drawn.
    """
    before, after = ({one["id"]: one for one in lights.get(when, [])} for when in ("before", "after"))
    drawn: list[str] = []
    for light_id in list(before | after)[:MOST_DRAWN]:
        start = before.get(light_id)
        end = after.get(light_id)
        if start and end:
            drawn += _path(start, end)
        if start:
            dash = ' stroke-dasharray="1.2"' if end is None else ""
            drawn.append(f'<circle {_centre(start)} r="3" stroke="#fff"{dash}/>')
        if end:
            drawn.append(f'<circle {_centre(end)} r="4.5" stroke="{"#fff" if start else "#ffb000"}"/>')
        x, y = _on_map(end or start)
        place = f'x="{min(x + 5, 350):.1f}" y="{max(y - 4, 7):.1f}"'
        drawn.append(f'<text {place} fill="#fff" stroke="#000">{light_id}</text>')
    if not drawn:
        return []
    over = f'<svg class="lights" viewBox="0 0 360 180" preserveAspectRatio="none">{"".join(drawn)}</svg>'
    caption = (
        "lights of the edited map, numbered as in lights.json; a small circle is where a light was "
        "(dashed: it no longer stands out), a large one where it is (orange: it is new)"
    )
    pixels = preview.display(envmap, tonemap, preview.stops_of([envmap]))
    return [figure(pixels, caption, over=over)]


def _on_map(light):
    """Return where a light is on a map of 360 by 180 units."""
    return light["azimuth"], 90 - light["elevation"]


def _centre(light):
    x, y = _on_map(light)
    return f'cx="{x:.1f}" cy="{y:.1f}"'


def _path(start, end):
    """Draw the line from one light to another, the shorter way, over the edge of the map if need be."""
    x, y = _on_map(start)
    end_x, end_y = _on_map(end)
    near = x + (end_x - x + 180) % 360 - 180
    ends = dict.fromkeys((x + shift, near + shift) for shift in (0, end_x - near))
    heights = f'y1="{y:.1f}" y2="{end_y:.1f}" stroke="#fff"'
    return [f'<line x1="{a:.1f}" x2="{b:.1f}" {heights}/>' for a, b in ends]
