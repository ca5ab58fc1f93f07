"""Carry out the six edits of scenes/edits on the analytic sky and on real maps.

The two real maps have their sun where the strokes expect one; without ENVEDIT_DATA only the analytic sky is
used.
"""

import itertools
import sys
import tomllib
from pathlib import Path

from envedit.core.color import tonemap
from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.losses import metrics
from experiments import puresky
from experiments.harness import Case, Done, Experiment, number, overridden

FOLDER = Path(__file__).parents[2] / "scenes" / "edits"
EDITS = ("move_shadow", "add_reflection", "add_shadow", "warmer", "enhance_shadow", "blur_shadow")
MAPS = ("sunsky", "kloofendal_48d_partly_cloudy", "sunflowers")
ABLATION = {
    "no regulariser": ["loss.change=0"],
    "change 0.01": [],
    "luminance + L1": ["loss.change=0", "loss.luminance=[1e-5, 1e-9]", "loss.l1=[1e-5, 1e-9]"],
    "change 0.1": ["loss.change=0.1"],
}
"""What the ablation sets, with Adam: Gauss-Newton has the prior in place of these terms."""
NOTE = "likeliest explanation of the paint: "


def options(parser):
    parser.add_argument("--ablation", action="store_true", help="regularisers on the analytic sky (Figure 9)")


def file_of(name: str) -> str | None:
    """Return what [input] envmap is for a map, None where the data are not there."""
    if name == "sunsky":
        return name
    try:
        file = puresky.find().get(name)
    except EnveditError:
        return None
    return str(file) if file else None


def cases(given):
    maps = {name: file_of(name) for name in (MAPS[:1] if given.ablation else MAPS)}
    for name in [name for name in maps if not maps[name]]:
        print(f"{name}: skipped, ENVEDIT_DATA has no puresky/{name}_puresky_1k.hdr", file=sys.stderr)
        maps.pop(name)
    found = []
    for kind, edit, name in itertools.product(ABLATION if given.ablation else [""], EDITS, maps):
        tables = tomllib.loads((FOLDER / f"{edit}.toml").read_text(encoding="utf-8"))
        tables.pop("output", None)
        tables = overridden(tables, [f"input.envmap={maps[name]}", *regularised(kind)])
        label = "-".join(part.replace(" ", "_") for part in (edit, name, kind) if part)
        shown = {"edit": f"{edit}, {kind}" if kind else edit, "map": name, "kind": kind}
        found.append(Case(label, tables, shown))
    return found


def regularised(kind: str) -> list[str]:
    """Return the settings of one kind of the ablation; none without one."""
    return ["optimizer.kind=adam", *ABLATION[kind]] if kind else []


def explanation(notes: list[str]) -> str:
    """Return what a run's notes say of how the paint is explained; a dash where they say nothing."""
    return next((note.removeprefix(NOTE) for note in notes if note.startswith(NOTE)), "-")


def percent(value: float | None, form: str = ".0f") -> str:
    """Format a share; a dash for None and NaN."""
    return "-" if value is None or value != value else f"{100 * value:{form}} %"


def measure(done: Done) -> dict:
    original, edited, _ = done.maps
    rows, painted = done.rows, done.metrics["painted"]
    before = metrics.high_frequency_energy(original[rows])
    return painted | {
        "outside": done.metrics["natural"]["colours_outside"],
        "white": done.metrics["natural"]["white"],
        "patches": done.metrics["natural"]["patches"],
        "explanation": explanation(done.metrics.get("choices", [])),
        "share": painted["towards"] / painted["reachable"] if painted["reachable"] else float("nan"),
        "ssim": metrics.compare(edited[rows], original[rows])["ssim"],
        "sharp": metrics.high_frequency_energy(edited[rows]) / before if before else float("nan"),
        "seconds": done.metrics["timing"]["total_s"],
    }


def panels(done: Done):
    """Return initial, painted and edited rendering, what no light can do; original and edited map."""
    shown = [tonemap(done.picture(f"render_{n}"), "gamma") for n in ("initial", "target", "edited")]
    unreachable, _ = images.read_stored(str(done.folder / "unreachable.png"))
    original, edited, _ = done.maps
    return [*shown, unreachable[..., :3] / 255, *(tonemap(m, "gamma") for m in (original, edited))]


EXPERIMENT = Experiment(
    "painted_edits",
    "Carry out the six edits of scenes/edits on the analytic sky and on real maps.",
    cases,
    measure,
    {
        "edit": "{edit}",
        "map": "{map}",
        "towards the paint": lambda m: percent(m["towards"]),
        "feasible": lambda m: percent(m["reachable"]),
        "share of it": lambda m: percent(m["share"]),
        "change elsewhere": lambda m: number(m["elsewhere"], ".4f"),
        "white": lambda m: percent(m["white"], "+.1f"),
        "patches": "{patches:.2f}",
        "colours outside": lambda m: percent(m["outside"], ".1f"),
        "map SSIM": "{ssim:.3f}",
        "high frequencies": lambda m: number(m["sharp"], ".2f"),
        "explanation": "{explanation}",
        "s": "{seconds:.0f}",
    },
    panels=panels,
    sheet=lambda case: case.about["map"] + "-ablation" * bool(case.about["kind"]),
    options=options,
)
