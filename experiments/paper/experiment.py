"""Tables 1 to 3 and Figures 4, 5, 8 and 9 of the paper: ``python -m experiments paper run NAME``.

Tables share the runs that they have in common. The chart of Figure 4 needs matplotlib (envedit[report]).
"""

from __future__ import annotations

import hashlib
import itertools
import tomllib
from dataclasses import dataclass
from pathlib import Path

from envedit import config
from envedit.config import presets
from envedit.core import latlong
from envedit.images import images
from envedit.losses.perceptual import installed
from experiments import puresky
from experiments.harness import Case, Experiment, calling, make, overridden
from experiments.painted_edits import experiment as painted_edits

from . import sheets, tables
from .methods import FITS, METHODS, ONLY_OURS, PAINTED, REGULARISERS

ROUGHNESS = (0.0, 0.5, 1.0)
"""Of Table 3 and Figure 8."""
DEGREES = 60.0
"""Turn of the true map to the left."""
DEFAULT = "kloofendal_48d_partly_cloudy"
"""The map of a table that the paper made with one; it does not name its own."""
OTHER = "autumn_field"
"""The true map of Figure 8, turned: "a different environment map in a different light orientation"."""


@dataclass(frozen=True)
class Kind:
    """What one table or figure asks.

    Attributes
    ----------
    title : str
        Its heading.
    methods : dict
        Methods by name, of which ``rows`` are taken.
    rows : tuple of str
        In the order in which they are shown.
    scene : str
        Shipped scene; "" for fits, and for a painted edit, which has its own.
    roughness : tuple
        Values of the scene's parameter, (None,): as the scene has it.
    several : bool
        Averaged over all maps; else of one, unless ``--all-maps`` is given.
    """

    title: str
    methods: dict
    rows: tuple[str, ...]
    scene: str = ""
    roughness: tuple[float | None, ...] = (None,)
    several: bool = False


_FIRST = ("pixels", "log-pixels", "siren-no-hdr", "siren", "r-siren", "r-siren-reg", "layers")
_OTHERS = (*_FIRST[:4], "siren-reg", *_FIRST[4:])
_STOCK = ("stock", "stock-scaled", "siren-no-hdr", "siren", "siren-polished")
_NOISE = ("siren", "r-siren", "r-siren-polished")
_REGULARISED = ("r-siren-reg", "layers")

KINDS = {
    "table1": Kind("Table 1: shifted map", METHODS, _FIRST, "statue"),
    "table2": Kind("Table 2: full mirror", METHODS, _OTHERS, "mirror"),
    "table3": Kind("Table 3: maps and roughness", METHODS, _OTHERS, "statue", ROUGHNESS, several=True),
    "figure4": Kind("Figure 4: stock SIREN and SIREN HDR", FITS, _STOCK),
    "figure5": Kind("Figure 5: the same noise on weights", FITS, _NOISE),
    "figure8": Kind("Figure 8: roughness", METHODS, _REGULARISED, "statue", ROUGHNESS),
    "figure9": Kind("Figure 9: regularisers on a painted edit", PAINTED, tuple(PAINTED)),
}


def options(parser):
    parser.add_argument("name", choices=KINDS, metavar="NAME", help=", ".join(KINDS))
    parser.add_argument("--all-maps", action="store_true", help="where the paper has one map")
    edits = painted_edits.EDITS
    parser.add_argument("--edit", choices=edits, default=edits[0], help="of Figure 9 (%(default)s)")


def cases(given):
    kind, maps = KINDS[given.name], maps_of(given)
    regularised = config.from_dict(overridden({"loss": {"dists": REGULARISERS["dists"]}}, given.sets))
    has_dists = "vgg" in installed.files(regularised)
    found = []
    # Maps last: what shares a fit is then many jobs apart, and finds it on disk also with several workers.
    for settings, roughness, row, sky in itertools.product(
        ("paper", "ours"), kind.roughness, kind.rows, maps
    ):
        if (settings == "paper" and row in ONLY_OURS) or (row == "lum-l1-dists" and not has_dists):
            continue
        method = kind.methods[row]
        question = presets.overlaid(asked(given, kind, roughness), {"input": {"envmap": str(maps[sky])}})
        configuration = presets.overlaid(method.under(settings), question)
        about = {"settings": settings, "row": row, "title": method.title, "map": sky, "roughness": roughness}
        name = f"{settings}-{row}-{sky}" + ("" if roughness is None else f"-{roughness:.1f}")
        if kind.methods is FITS:
            recipe = row if row.startswith("stock") else "configured"
            function = "experiments.paper.network:measure"
            found.append(calling(name, function, configuration, about, recipe=recipe))
        else:
            found.append(Case(name, configuration, about))
    return found


def maps_of(given) -> dict[str, Path | str]:
    """Return the maps of a table by name."""
    if given.name == "figure9":
        return {"sunsky": "sunsky"}
    found = puresky.find()
    if KINDS[given.name].several or given.all_maps:
        return found
    name = DEFAULT if DEFAULT in found else next(iter(found))
    return {name: found[name]}


def asked(given, kind: Kind, roughness: float | None) -> dict:
    """Return the tables of a configuration that neither row nor map decides."""
    if kind.methods is FITS:
        return {}
    # Every run pays for its transport, whichever comes first.
    common = {"output": {"report": False, "full": False}, "renderer": {"cache": False}}
    if kind.methods is PAINTED:
        edit = tomllib.loads((painted_edits.FOLDER / f"{given.edit}.toml").read_text(encoding="utf-8"))
        return edit | common
    scene = {"file": kind.scene} | ({} if roughness is None else {"parameters": {"roughness": roughness}})
    target = {"rotate_degrees": DEGREES}
    if given.name == "figure8":
        other = Path(puresky.file(OTHER))
        target = {"file": str(turned(other, DEGREES, given.out / "maps"))}
    return common | {"scene": scene, "target": target}


def turned(file: Path, degrees: float, folder: Path) -> Path:
    """Write a map turned to the left about the vertical to ``NAME-turned-DEGREES-CONTENT.exr``, if missing.

    All PureSky maps have their sun in the middle: another map alone is not another orientation of the light.
    """
    content = hashlib.sha256(file.read_bytes()).hexdigest()[:8]
    path = make(folder.absolute()) / f"{file.stem}-turned-{degrees:g}-{content}.exr"
    if not path.exists():
        images.write_exr(path, latlong.rotate(images.load_envmap(str(file))[0], degrees))
    return path


EXPERIMENT = Experiment(
    "paper",
    "Tables 1 to 3 and Figures 4, 5, 8 and 9 of the paper, under its settings and under ours.",
    cases,
    options=options,
    tabulate=lambda made, out, given: tables.text(
        given.name, KINDS[given.name].title, tables.rows_of(given.name, made, out)
    ),
    draw=lambda made, out, to, given: sheets.draw(given.name, made, out, to),
    file=lambda given: given.name,
)
