"""Tables 1 to 3 and Figures 8 and 9 of the paper: ``python -m experiments paper run NAME``.

Tables share the runs that they have in common.
"""

from __future__ import annotations

import csv
import itertools
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

from envedit.config import presets
from envedit.core import latlong
from envedit.images import images
from envedit.sweep import DONE
from experiments import puresky
from experiments.harness import Case, Done, Experiment
from experiments.painted_edits import experiment as painted_edits
from experiments.summary import Summary

FOLDER = Path(__file__).parent
METHODS = tomllib.loads((FOLDER / "methods.toml").read_text())
"""Rows of all tables: ``title``, tables of a ``run``, and more tables under the ``paper``'s settings."""
PAINTED = ("none", "lum-l1", "lum-l1-dists", "layers-painted")
"""Those of Figure 9."""
ROWS = tuple(name for name in METHODS if name not in PAINTED)
ONLY_OURS = ("r-siren-own", "layers", "layers-painted")
"""Rows that the paper's settings do not have."""
PRESETS = {"paper": "paper", "ours": "standard"}
"""Preset of either settings: Sec. 6 to the letter, with fresh samples of a path tracer at every step; the
stored transport, and losses on pictures beside the SSIM."""
DEGREES = 60.0
"""Turn of the true map to the left."""
DEFAULT = "kloofendal_48d_partly_cloudy"
"""The map of a table that the paper made with one; it does not name its own."""
OTHER = "autumn_field"
"""The true map of Figure 8, turned: "a different environment map in a different light orientation"."""


@dataclass(frozen=True)
class Kind:
    """One table or figure."""

    rows: tuple[str, ...]  # of METHODS, in the order in which they are shown
    scene: str  # shipped scene; "" for a painted edit, which has its own
    roughness: tuple[float | None, ...] = (None,)  # values of its parameter; None: as the scene has it
    several: bool = False  # averaged over all maps; else of one, unless --all-maps is given


KINDS = {
    "table1": Kind(ROWS, "statue"),
    "table2": Kind(ROWS, "mirror"),
    "table3": Kind(ROWS, "statue", (0.0, 0.5, 1.0), several=True),
    "figure8": Kind(("r-siren-reg", "layers"), "statue", (0.0, 0.5, 1.0)),
    "figure9": Kind(PAINTED, ""),
}


def options(parser):
    parser.add_argument("name", choices=KINDS, metavar="NAME", help=", ".join(KINDS))
    parser.add_argument("--all-maps", action="store_true", help="where the paper has one map")


def maps_of(args) -> dict[str, Path | str]:
    """Return the maps of a table by name."""
    if args.name == "figure9":
        return {"sunsky": "sunsky"}
    maps = puresky.find()
    if KINDS[args.name].several or args.all_maps:
        return maps
    name = DEFAULT if DEFAULT in maps else next(iter(maps))
    return {name: maps[name]}


def cases(args):
    kind = KINDS[args.name]
    maps = maps_of(args)
    made = []
    # Maps last: what shares a fit is then many jobs apart, and finds it on disk also with several workers.
    for settings, roughness, row, sky in itertools.product(
        ("paper", "ours"), kind.roughness, kind.rows, maps
    ):
        if settings == "paper" and row in ONLY_OURS:
            continue
        question = presets.overlaid(asked(args, kind, roughness), {"input": {"envmap": str(maps[sky])}})
        about = {"table": args.name, "settings": settings, "row": row, "map": sky, "roughness": roughness}
        name = f"{settings}-{row}-{sky}" + ("" if roughness is None else f"-{roughness:.1f}")
        made.append(Case(name, presets.overlaid(under(settings, row), question), about))
    return made


def under(settings: str, row: str) -> dict:
    """Return the tables of a method under the settings "paper" or "ours"."""
    # The paper's task: the upper rows of a turned map, for models that cannot turn it.
    task = {"preset": PRESETS[settings], "input": {"rows": "upper"}, "representation": {"turn": False}}
    tables = presets.overlaid(task, METHODS[row]["run"])
    return presets.overlaid(tables, METHODS[row].get("paper", {})) if settings == "paper" else tables


def asked(args, kind: Kind, roughness: float | None) -> dict:
    """Return the tables of a configuration that neither row nor map decides."""
    # Every run pays for its transport, whichever comes first.
    common = {"output": {"report": False, "full": False}, "renderer": {"cache": False}}
    if not kind.scene:
        file = painted_edits.FOLDER / f"{painted_edits.EDITS[0]}.toml"
        return tomllib.loads(file.read_text(encoding="utf-8")) | common
    scene = {"file": kind.scene} | ({} if roughness is None else {"parameters": {"roughness": roughness}})
    target = {"rotate_degrees": DEGREES}
    if args.name == "figure8":
        # All PureSky maps have their sun in the middle: another one, unturned, has its light there too.
        turned = latlong.rotate(images.load_envmap(puresky.file(OTHER))[0], DEGREES)
        target = {"file": puresky.written(args.out, f"{OTHER}-turned", turned)}
    return common | {"scene": scene, "target": target}


# ---- Tables ------------------------------------------------------------------------------------------------


def measure(done: Done) -> list[dict]:
    """Return rows: before the edit; what the true map itself scores, rendered twice; the edit."""
    title = METHODS[done.case.about["row"]]["title"]
    edited = {**done.metrics, "title": title, **seconds(done)}
    if done.case.about["row"] in PAINTED:
        return [edited]
    unedited = {"envmap": done.metrics["initial_envmap"], "render": done.metrics["initial"]}
    return [
        {"title": "unedited", **unedited},
        {"title": "the true map", "render": done.metrics["ceiling"]},
        edited,
    ]


def seconds(done: Done) -> dict[str, float | None]:
    """Return the seconds of the fit, and of all the rest, of an edit.

    A fit that was on disk has the seconds that are kept with it; None where there is no fit. The rest is None
    where a run was interrupted and resumed, whose time is not known.
    """
    fit = done.metrics["fit"]
    timing = done.metrics["timing"]
    resumed = json.loads((done.folder / DONE).read_bytes())["resumed"]
    rest = timing["total_s"] - (timing["fit_s"] if fit else 0)
    return {"fit_s": fit["seconds"] if fit else None, "rest_s": None if resumed else rest}


def published(table: str, roughness: float | None) -> list[dict]:
    """Return the numbers that the paper printed, a row for each method; PSNR in dB."""
    rows = []
    for line in csv.DictReader((FOLDER / "published.csv").read_text().splitlines()):
        if (line["table"], line["roughness"]) == (table, "" if roughness is None else f"{roughness:.1f}"):
            numbers = {
                image: {metric: float(line[f"{image} {metric}"]) for metric in FORMS}
                for image in ("envmap", "render")
            }
            rows.append({"title": f"{METHODS[line['row']]['title']}, published", **numbers})
    return rows


def summary(rows: list[dict]) -> str:
    """Return a table for either settings and every roughness: means of each method, and the paper's own.

    Means are over the maps that are done in every row that has any, so that methods can be compared.
    """
    parts = []
    for settings, roughness in dict.fromkeys((row["settings"], row["roughness"]) for row in rows):
        some = [row for row in rows if (row["settings"], row["roughness"]) == (settings, roughness)]
        maps = set.intersection(
            *({row["map"] for row in some if row["row"] == name} for name in {row["row"] for row in some})
        )
        compared = [row for row in some if row["map"] in maps]
        whose = {"paper": "The paper's settings", "ours": "Our settings"}[settings]
        at = "" if roughness is None else f", roughness {roughness:g}"
        over = ", ".join(maps) if len(maps) == 1 else f"{len(maps)} maps"
        means = PAINT if some[0]["row"] in PAINTED else MEANS
        parts += [f"{whose}{at}, {over}:", means(compared + published(some[0]["table"], roughness))]
    return "\n\n".join(parts)


FORMS = {"psnr": ".2f", "lpips": ".3f", "mse": ".5f", "ssim": ".3f"}
MEANS = Summary(
    {"": "{title}"},
    {
        f"{words} {metric.upper()}": f"{{{image}[{metric}].mean:{form}}}"
        for image, words in (("envmap", "map"), ("render", "rendering"))
        for metric, form in FORMS.items()
    }
    | {"fit, s": "{fit_s.mean:.0f}", "rest, s": "{rest_s.mean:.0f}", "rows": "{runs}"},
)
PAINT = Summary(
    {"": "{title}"},
    {
        "towards the paint": "{painted[towards].mean:.2f}",
        "change elsewhere": "{painted[elsewhere].mean:.3f}",
        "rest, s": "{rest_s.mean:.0f}",
    },
)

EXPERIMENT = Experiment(
    cases,
    measure,
    summary=summary,
    sheet=lambda case: "{table}-{settings}-{roughness}".format(**case.about).removesuffix("-None"),
    options=options,
)
