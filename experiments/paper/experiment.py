"""Tables 1 to 3 of the paper: ``python -m experiments paper run NAME``.

Tables share the runs that they have in common.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from pathlib import Path

from envedit.config import presets
from envedit.sweep import DONE
from experiments import puresky
from experiments.harness import Case, Done, Experiment
from experiments.summary import Numbers, values

from .methods import METHODS, ONLY_OURS
from .published import COLUMNS, PUBLISHED

DEGREES = 60.0
"""Turn of the true map to the left."""
DEFAULT = "kloofendal_48d_partly_cloudy"
"""The map of a table that the paper made with one; it does not name its own."""


@dataclass(frozen=True)
class Kind:
    """One table.

    Attributes
    ----------
    rows : tuple of str
        Of :data:`METHODS`, in the order in which they are shown.
    scene : str
        Shipped scene.
    roughness : tuple
        Values of the scene's parameter, (None,): as the scene has it.
    several : bool
        Averaged over all maps; else of one, unless ``--all-maps`` is given.
    """

    rows: tuple[str, ...]
    scene: str
    roughness: tuple[float | None, ...] = (None,)
    several: bool = False


KINDS = {
    "table1": Kind(tuple(row for row in METHODS if row != "siren-reg"), "statue"),
    "table2": Kind(tuple(METHODS), "mirror"),
    "table3": Kind(tuple(METHODS), "statue", (0.0, 0.5, 1.0), several=True),
}


def options(parser):
    parser.add_argument("name", choices=KINDS, metavar="NAME", help=", ".join(KINDS))
    parser.add_argument("--all-maps", action="store_true", help="where the paper has one map")


def maps_of(args) -> dict[str, Path]:
    """Return the maps of a table by name."""
    maps = puresky.find()
    if KINDS[args.name].several or args.all_maps:
        return maps
    name = DEFAULT if DEFAULT in maps else next(iter(maps))
    return {name: maps[name]}


def cases(args):
    kind, maps = KINDS[args.name], maps_of(args)
    made = []
    # Maps last: what shares a fit is then many jobs apart, and finds it on disk also with several workers.
    for settings, roughness, row, sky in itertools.product(
        ("paper", "ours"), kind.roughness, kind.rows, maps
    ):
        if settings == "paper" and row in ONLY_OURS:
            continue
        scene = {"file": kind.scene} | ({} if roughness is None else {"parameters": {"roughness": roughness}})
        question = {
            "input": {"envmap": str(maps[sky])},
            "scene": scene,
            "target": {"rotate_degrees": DEGREES},
            "output": {"report": False, "full": False},
            "renderer": {"cache": False},  # every run pays for its transport, whichever comes first
        }
        about = {"table": args.name, "settings": settings, "row": row, "map": sky, "roughness": roughness}
        name = f"{settings}-{row}-{sky}" + ("" if roughness is None else f"-{roughness:.1f}")
        made.append(Case(name, presets.overlaid(METHODS[row].under(settings), question), about))
    return made


# ---- Tables ------------------------------------------------------------------------------------------------

UNEDITED = {"envmap": "initial_envmap", "render": "initial"}
"""What ``metrics.json`` calls the unedited map and its rendering."""
FORMS = {"psnr": ".2f", "lpips": ".3f", "mse": ".5f", "ssim": ".3f"}
HEADINGS = {
    f"{'map' if image == 'envmap' else 'rendering'} {metric.upper()}": (image, metric)
    for image, metric in COLUMNS
}


def measure(done: Done) -> dict:
    """Return the numbers of a run by (map or rendering, metric); those before the edit; seconds."""
    numbers: dict = {}
    for image, metric in COLUMNS:
        numbers[image, metric] = (done.metrics[image] or {}).get(metric)
        numbers["unedited", image, metric] = (done.metrics[UNEDITED[image]] or {}).get(metric)
    return values(numbers | seconds(done))


def seconds(done: Done) -> dict[str, float | None]:
    """Return the seconds of the fit, and of all the rest, of an edit.

    A fit that was on disk has the seconds that are kept with it; None where there is no fit. The rest is None
    where a run was interrupted and resumed, whose time is not known.
    """
    fit, timing = done.metrics["fit"], done.metrics["timing"]
    resumed = json.loads((done.folder / DONE).read_bytes())["resumed"]
    rest = timing["total_s"] - (timing["fit_s"] if fit else 0)
    return {"fit": fit["seconds"] if fit else None, "rest": None if resumed else rest}


def averages(rows: list[dict]) -> list[dict]:
    """Return the cells of a table for either settings and every roughness: a row for each method.

    Averages are over the maps that are done in every row that has any, so that methods can be compared. The
    paper's own numbers are in brackets.
    """
    lines = []
    for settings, roughness in dict.fromkeys((row["settings"], row["roughness"]) for row in rows):
        some = [row for row in rows if (row["settings"], row["roughness"]) == (settings, roughness)]
        methods = {row["row"]: [r for r in some if r["row"] == row["row"]] for row in some}
        maps = set.intersection(*({row["map"] for row in method} for method in methods.values()))
        published = PUBLISHED[some[0]["table"]].get(roughness, {})
        whose = {"paper": "The paper's settings", "ours": "Our settings"}[settings]
        at = "" if roughness is None else f", roughness {roughness:g}"
        heading = f"{whose}{at}, {', '.join(maps) if len(maps) == 1 else f'{len(maps)} maps'}"

        # ---- Before any edit: the same for every method
        first = [row for row in next(iter(methods.values())) if row["map"] in maps]
        cells = {text: _cell(first, ("unedited", *key)) for text, key in HEADINGS.items()}
        lines.append(
            {"heading": heading, "title": "unedited", "fit, s": "-", "rest, s": "-", "maps": "-", **cells}
        )

        # ---- Methods
        for name, method in methods.items():
            compared = [row for row in method if row["map"] in maps]
            cells = {text: _cell(compared, key, published.get(name)) for text, key in HEADINGS.items()}
            for key in ("fit", "rest"):
                cells[f"{key}, s"] = f"{Numbers([row[key] for row in compared]).mean:.0f}"
            title = METHODS[name].title
            lines.append({"heading": heading, "title": title, "maps": str(len(method)), **cells})
    return lines


def _cell(rows, key, published=None):
    """Write the mean of a number, and what the paper has."""
    form = FORMS[key[-1]]
    text = f"{Numbers([row[key] for row in rows]).mean:{form}}"
    return f"{text} ({published[key]:{form}})" if published else text


EXPERIMENT = Experiment(
    "paper",
    "Tables 1 to 3 of the paper, under its settings and under ours.",
    cases,
    measure,
    {"": "{title}"} | {text: f"{{{text}}}" for text in (*HEADINGS, "fit, s", "rest, s", "maps")},
    group=lambda row: row["heading"],
    combine=averages,
    sheet=lambda case: "{table}-{settings}-{roughness}".format(**case.about).removesuffix("-None"),
    options=options,
    file=lambda args: args.name,
)
