"""Carry out the six edits of scenes/edits on the analytic sky and on real maps.

The two real maps have their sun where the strokes expect one.
"""

import itertools
import tomllib
from pathlib import Path

from envedit.core.color import tonemap
from envedit.images import images
from envedit.losses import metrics
from experiments import puresky
from experiments.harness import Case, Done, Experiment
from experiments.summary import Summary

FOLDER = Path(__file__).parents[2] / "scenes" / "edits"
EDITS = ("move_shadow", "add_reflection", "add_shadow", "warmer", "enhance_shadow", "blur_shadow")
MAPS = ("sunsky", "kloofendal_48d_partly_cloudy", "sunflowers")
NOTE = "likeliest explanation of the paint: "


def cases(given):
    made = []
    for edit, name in itertools.product(EDITS, MAPS):
        tables = tomllib.loads((FOLDER / f"{edit}.toml").read_text(encoding="utf-8"))
        tables["input"]["envmap"] = name if name == "sunsky" else puresky.file(name)
        made.append(Case(f"{edit}-{name}", tables, {"edit": edit, "map": name}))
    return made


def explanation(notes: list[str]) -> str:
    """Return what a run's notes say of how the paint is explained; a dash where they say nothing."""
    return next((note.removeprefix(NOTE) for note in notes if note.startswith(NOTE)), "-")


def measure(done: Done) -> dict:
    original, edited, _ = done.maps
    rows = done.rows
    painted = done.metrics["painted"]
    before = metrics.high_frequency_energy(original[rows])
    return {
        **done.metrics,
        **painted,
        **done.metrics["natural"],
        "explanation": explanation(done.metrics.get("choices", [])),
        "share": painted["towards"] / painted["reachable"] if painted["reachable"] else None,
        "ssim": metrics.compare(edited[rows], original[rows])["ssim"],
        "sharp": metrics.high_frequency_energy(edited[rows]) / before if before else None,
    }


def panels(done: Done):
    """Return initial, painted and edited rendering, what no light can do; original and edited map."""
    shown = done.shown("render_initial", "render_target", "render_edited")
    unreachable, _ = images.read_stored(str(done.folder / "unreachable.png"))
    return [*shown, unreachable[..., :3] / 255, *(tonemap(one, "gamma") for one in done.maps[:2])]


PAINT = {
    "towards the paint": "{towards:.0%}",
    "feasible": "{reachable:.0%}",
    "change elsewhere": "{elsewhere:.3f}",
    "white": "{white:+.1%}",
    "patches": "{patches:.2f}",
    "colours outside": "{colours_outside:.1%}",
    "explanation": "{explanation}",
    "s": "{timing[total_s]:.0f}",
}
"""Columns that all painted edits have."""
STATISTICS = {
    "runs": "{runs}",
    "towards the paint": "{towards.mean:.0%}",
    "feasible": "{reachable.mean:.0%}",
    "change elsewhere (most)": "{elsewhere.mean:.3f} ({elsewhere.max:.3f})",
    "white (most), over 2 %": "{white.mean:+.1%} ({white.max:+.1%}), {white.above[0.02]}",
    "colours outside, over 5 %": "{colours_outside.mean:.1%}, {colours_outside.above[0.05]}",
    "s, median": "{timing[total_s].median:.0f}",
}

EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "edit": "{edit}",
        "map": "{map}",
        "share of what is feasible": "{share:.0%}",
        "map SSIM": "{ssim:.3f}",
        "high frequencies": "{sharp:.2f}",
        **PAINT,
    },
    summary=Summary({"edit": "{edit}"}, STATISTICS),
    panels=panels,
    sheet=lambda case: case.about["map"],
)
