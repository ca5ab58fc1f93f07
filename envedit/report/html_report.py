"""The HTML report of a run: one file that opens offline, with inline SVG curves and base64 PNG pictures.

Pictures come in as linear radiance, ``(H, W, 3)``, and are tonemapped for display only. Only
``run_folder.py`` imports this module.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from envedit import config
from envedit.core.atomic_files import write_atomically
from envedit.core.types import FilePath
from envedit.losses.metrics import saturated, score, worse
from envedit.report import html_tables as tables
from envedit.report.curves import curves_svg, escape, normalised, number
from envedit.report.html_parts import (
    STYLE,
    difference_figure,
    figure,
    figure_of,
    grid,
    identified_figure,
    influence_figure,
    lights_figure,
    listing,
    separation_figures,
    shrunk,
    unreachable_figure,
)
from envedit.report.manifest import plain
from envedit.report.preview import checked
from envedit.representations.layers.separation import Separation
from envedit.scene.scene import View
from envedit.solve import feasibility

if TYPE_CHECKING:
    from envedit.results import Result


@dataclass(frozen=True)
class Report:
    """What a report shows.

    Attributes
    ----------
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
    lights : dict
        Of :func:`.light_list.matched`.
    separation : separation.Separation, optional
        Lights and background of the rows that were edited.
    unreachable : array (h, w, 3), optional
        Display values of `envedit.solve.feasibility.unreachable`.
    variants : sequence of variants.Variant
        Other explanations of paint.
    warnings, notes : sequence of str
        What the user should know, and the choices made for settings left at "auto".
    tonemap : str
        A name of `envedit.core.color.TONEMAPS`, for the pictures.
    views : sequence of `scene.View`
        Name and rows of each view, where the renderings are of several.
    ramps : (dict of str to (float, float), int)
        First and last weight of each loss in the history, and the iterations between them.
    """

    title: str
    config_toml: str
    metrics: dict
    manifest: dict
    history: list[dict]
    renders: Mapping[str, np.ndarray | None]
    maps: Mapping[str, np.ndarray | None]
    influence: np.ndarray | None = None
    frozen: np.ndarray | None = None
    identified: np.ndarray | None = None
    lights: Mapping[str, list[dict]] = field(default_factory=dict)
    separation: Separation | None = None
    unreachable: np.ndarray | None = None
    variants: Sequence[Any] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[str] = ()
    tonemap: str = "gamma"
    views: Sequence[View] = ()
    ramps: tuple[dict[str, tuple[float, float]], int] = ({}, 1)

    @classmethod
    def of(cls, result: Result, settings: config.Config, manifest: dict) -> Report:
        """Make the report of a run from what it found, what was carried out, and its manifest."""
        weights = {key: value for key, value in asdict(settings.loss).items() if value}
        ends = {key: value if isinstance(value, tuple) else (value, value) for key, value in weights.items()}
        source = result.given.source if result.given else settings.input.envmap
        return cls(
            title=f"{Path(source).stem}, {Path(settings.scene.file).stem}",
            config_toml=config.to_toml(settings),
            manifest=manifest,
            identified=None if result.posterior is None else result.posterior.identified,
            unreachable=None if result.reach is None else feasibility.unreachable(result.reach),
            tonemap=settings.output.tonemap,
            ramps=(ends, max(settings.optimizer.iterations, 1)),
            **{name: getattr(result, name) for name in _OF_RESULT},
        )


_OF_RESULT = (
    "metrics", "history", "renders", "maps", "views", "influence", "frozen", "lights", "separation",
    "variants", "warnings", "notes",
)  # fmt: skip
"""What a report shows as the result has it."""


def write_report(path: FilePath, report: Report) -> None:
    """Write ``report.html``: verdict, pictures, differences, curves, tables and configuration in one file.

    Raises
    ------
    InputError
        If a picture is not ``(H, W, 3)`` or the file cannot be written.
    ConfigError
        If there is no such tonemap.
    """
    lost: list[str] = []
    metrics = plain(report.metrics, "metrics: ", lost)
    plain(report.history, "history", lost)
    shown = _Pictures.of(report)
    differences, unlike = shown.differences()
    said = [*map(str, report.warnings), *_not_finite(lost, shown), *unlike]
    manifest_text = json.dumps(plain(report.manifest, "", []), indent=1, ensure_ascii=False)
    page = [
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(report.title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(report.title)}</h1>{_verdict(metrics)}",
        f'<div class="warnings"><strong>Warnings</strong>{listing(said)}</div>' if said else "",
        shown.html(),
        _section("Differences", differences, 2),
        _section("Lights and background", _lights(report, shown.maps), 1),
        _section("", separation_figures(report.separation, report.tonemap)),
        _section("What this view determines", _determined(report)),
        _section("What was painted", _painted(report, metrics, shown.parts)),
        _section("Other explanations", _variants(report)),
        f"<h2>Losses</h2>{_curves(report)}",
        tables.quality(metrics, report.tonemap),
        tables.numbers(metrics),
        tables.map_table(shown.maps, shown.names),
        tables.timing(metrics),
        f"<h2>Choices made</h2>{listing(report.notes)}" if report.notes else "",
        f"<h2>Configuration</h2><pre>{escape(report.config_toml)}</pre>",
        f"<h2>Manifest</h2><details><summary>Versions, machine, seeds, inputs</summary>"
        f"<pre>{escape(manifest_text)}</pre></details>",
        "</body></html>\n",
    ]
    write_atomically(path, "\n".join(part for part in page if part).encode("utf-8", "backslashreplace"))


def _section(heading: str, figures: list[str], *columns: int) -> str:
    title = f"<h2>{heading}</h2>" if heading else "<p></p>"
    return title + grid(figures, *columns) if figures else ""


def _lights(report: Report, maps: Mapping[str, np.ndarray]) -> list[str]:
    """Draw where lights were and are."""
    return lights_figure(maps["edited"], report.lights, report.tonemap) if "edited" in maps else []


# ----------------------------------------------------------------------------------------------------------
# Pictures


def _determined(report: Report) -> list[str]:
    """Draw what the picture says of the sky."""
    if report.influence is None:
        return []
    return [influence_figure(report.influence, report.frozen), *identified_figure(report.identified)]


def _painted(report: Report, metrics: dict, parts: list[_Part]) -> list[str]:
    """Draw what of the paint is not feasible."""
    if report.unreachable is None:
        return []
    reachable = (metrics.get("painted") or {}).get("reachable")
    return [unreachable_figure(report.unreachable[part.rows], reachable) for part in parts]


def _variants(report: Report) -> list[str]:
    """Draw the renderings of other explanations of the paint."""
    return [
        figure(shrunk(one.render, report.tonemap), f"{one.said}, -2 log evidence {one.evidence:.1f}")
        for one in report.variants
    ]


def _curves(report: Report) -> str:
    """Draw the losses."""
    drawn, about = normalised(report.history, *report.ramps)
    curves = curves_svg(drawn)
    if not curves:
        curves = f'<p class="soft">No loss to draw in {len(report.history)} rows of history.</p>'
    return curves + (f'<p class="soft">{escape(about)}</p>' if "<svg" in curves and about else "")


class _Part(NamedTuple):
    """What one row of renderings shows: all of them, or those of a view."""

    what: str
    prefix: str
    rows: slice


def _parts(views: Sequence[View]) -> list[_Part]:
    if len(views) < 2:
        return [_Part("rendering", "", slice(None))]
    return [_Part(f"rendering of view {k} ({v.name})", f"view {k}: ", v.rows) for k, v in enumerate(views)]


@dataclass(frozen=True)
class _Pictures:
    """Renderings and maps (H, W, 3) by name, and the rows of each view."""

    names: list[str]
    renders: dict[str, np.ndarray]
    maps: dict[str, np.ndarray]
    parts: list[_Part]
    tonemap: str

    @classmethod
    def of(cls, report: Report) -> _Pictures:
        """Take the pictures of a report, checked."""
        renders, maps = (
            {name: checked(image, name) for name, image in pictures.items() if image is not None}
            for pictures in (report.renders, report.maps)
        )
        names = list(dict.fromkeys([*report.renders, *report.maps]))
        return cls(names, renders, maps, _parts(report.views), report.tonemap)

    def shown_in(self, part: _Part) -> dict[str, np.ndarray]:
        """Return the renderings of a view."""
        return {name: image[part.rows] for name, image in self.renders.items()}

    def html(self) -> str:
        """Show renderings, a row for each view, and maps; nothing where there are none."""
        if not self.names:
            return ""
        rows = [
            grid([figure_of(self.shown_in(part), name, part.what, self.tonemap) for name in self.names])
            for part in self.parts
        ]
        maps = [figure_of(self.maps, name, "environment map", self.tonemap) for name in self.names]
        return (
            f"<h2>Renderings and maps</h2>{'<p></p>'.join(rows)}<p></p>{grid(maps, 1)}\n"
            f'<p class="soft">Tonemap of the pictures: {escape(self.tonemap)}.</p>'
        )

    def differences(self) -> tuple[list[str], list[str]]:
        """Draw the edited pictures less others; also return what to warn of."""
        figures, warnings = [], []
        pairs = [(self.shown_in(part), "target", part.prefix) for part in self.parts]
        for pictures, other, prefix in (*pairs, (self.maps, "initial", ""), (self.maps, "target", "")):
            if "edited" not in pictures or other not in pictures:
                continue
            is_map = pictures is self.maps
            kind, what = ("stops", "maps") if is_map else ("tonemapped", f"{prefix}renderings")
            a, b = pictures["edited"], pictures[other]
            if a.shape != b.shape:
                sizes = f"{a.shape[:2]} and {b.shape[:2]}"
                warnings.append(f"{what} edited and {other} differ in size, {sizes}: no difference is drawn.")
                continue
            how = "luminance in stops" if kind == "stops" else "tonemapped luminance"
            caption = f"{what}, edited − {other}: {how}"
            figures.append(difference_figure(a, b, caption, kind, self.tonemap))
        return figures, warnings


def _not_finite(lost: list[str], shown: _Pictures) -> list[str]:
    """Say which numbers and pixels are not finite."""
    said = []
    if lost:
        some = ", ".join(lost[:5]) + (f" and {len(lost) - 5} more" if len(lost) > 5 else "")
        said.append(f"Not finite, shown as missing: {some}.")
    for kind, pictures in (("rendering", shown.renders), ("map", shown.maps)):
        for name, image in pictures.items():
            if bad := int((~np.isfinite(image).all(axis=2)).sum()):
                said.append(f"{kind} {name}: {bad} pixels are not finite, drawn in magenta.")
    return said


def _verdict(metrics):
    def table_of(name):
        found = metrics.get(name) or {}
        return found if number(found.get("psnr")) is not None else None

    before, after, true_map = table_of("initial"), table_of("render"), table_of("envmap")
    unedited, ceiling = table_of("initial_envmap"), table_of("ceiling")
    known = [one for one in (before, after) if one]
    total = number((metrics.get("timing") or {}).get("total_s"))

    def as_text(one):
        return "unknown" if one is None else score(one, known)

    kind = "log RMSE: a display shows little of what differs" if saturated(known) else "PSNR"
    parts = [f"Rendering against the target: {as_text(before)} → <strong>{as_text(after)}</strong> {kind}"]
    parts[0] += f" (noise alone: {score(ceiling, known)})" if ceiling else ""
    if true_map:
        since = f"{score(unedited, [])} → " if unedited else ""
        parts.append(f"map against the true one: {since}{score(true_map, [])}")
    painted = metrics.get("painted") or {}
    towards, elsewhere = number(painted.get("towards")), number(painted.get("elsewhere"))
    if towards is not None:
        parts[0] = f"<strong>{100 * towards:.0f} %</strong> of the painted change reached"
        feasible = number(painted.get("reachable"))
        parts[0] += f" ({100 * feasible:.0f} % feasible)" if feasible is not None else ""
        parts += [f"mean change elsewhere {elsewhere:.3f}"] if elsewhere is not None else []
    elif painted:
        parts[0] = "The painted change is below the noise of the renderings"
    parts += [f"{total:.1f} s in total"] if total is not None else []
    line = f'<p class="verdict">{" · ".join(parts)}</p>'
    if towards is not None and towards < 0:
        line += '<p class="alarm">The edited rendering is further from the paint than the unedited one.</p>'
    if not painted and before and after and worse(after, before):
        line += '<p class="alarm">The edited rendering is further from the target than the unedited one.</p>'
    return line
