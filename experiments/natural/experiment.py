"""Edit many skies in many scenes, and measure whether the results still look like photographs of a sky.

Every PureSky map, the maps with ground and the analytic sky, in five scenes, towards: the map turned by 60
and 140 degrees; three other PureSky maps; of the analytic sky its sun at other elevations instead of other
maps. With a turn of the sky allowed and without.
"""

import hashlib
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from envedit.images import analytic_sky, images
from experiments import puresky
from experiments.harness import Case, Done, Experiment, make, markdown, number

SCENES = {
    "sphere": "sphere",
    "statue": "statue",
    "mirror": "mirror",
    "matpreview": "matpreview/matpreview.xml",
    "principled": "principled/scene.xml",
}
ANGLES, OTHERS = (60, 140), (1, 4, 8)
"""Turns in degrees, and how many names farther on in the alphabet the other maps are."""
ELEVATIONS, ELEVATION = (5, 10, 20, 50, 65, 80), 35
"""Of the analytic sky's sun, degrees: targets, and before."""
WIDTH = 256
SAME = 120.0
"""PSNR from which two maps are taken to be the same, dB."""


def options(parser):
    parser.add_argument("--count", type=int, help="so many cases, evenly from all kinds of them")
    parser.add_argument("--quick", action="store_true", help="--count 10")


def cases(given):
    skies = {name: str(file) for name, file in puresky.find().items()}
    names, data = sorted(skies), puresky.data()
    ground = {file.stem.removesuffix("_1k"): str(file) for file in sorted((data / "hdri").glob("*_1k.hdr"))}
    analytic = {e: str(given.out.absolute() / "maps" / f"sunsky_{e}.exr") for e in (ELEVATION, *ELEVATIONS)}
    make(given.out / "maps")
    for elevation, file in analytic.items():
        if not Path(file).exists():
            images.write_exr(file, analytic_sky.sunsky(WIDTH, 90.0, elevation))
    maps = skies | ground | {"sunsky": analytic[ELEVATION]}
    found, turns = [], ("auto", False)
    for scene, (i, (name, source)), turn in itertools.product(SCENES, enumerate(maps.items()), turns):
        targets = [(str(angle), "turned", {"rotate_degrees": angle}) for angle in ANGLES]
        if name == "sunsky":
            targets += [(f"elevation_{e}", "elevation", {"file": analytic[e]}) for e in ELEVATIONS]
        else:
            others = [names[(i + k) % len(names)] for k in OTHERS]
            targets += [(other, "another map", {"file": skies[other]}) for other in others]
        file = SCENES[scene]
        shown = {"file": str(data / "scenes" / file) if "/" in file else file, "width": 128}
        if scene == "sphere":
            shown["parameters"] = {"roughness": 0.3}
        for label, kind, target in targets:
            word = str(turn).lower()
            found.append(
                Case(
                    f"{scene}-{name}-{label}-turn_{word}",
                    {
                        "input": {"envmap": source, "width": WIDTH},
                        "scene": shown,
                        "target": target,
                        "representation": {"turn": turn},
                    },
                    {"scene": scene, "map": name, "label": label, "kind": kind, "turn": word},
                )
            )
    found = [case for case in found if not given.only or any(text in case.name for text in given.only)]
    count = 10 if given.quick else given.count
    return found if count is None else evenly(found, count)


def evenly(found: list[Case], count: int, about: Sequence[str] = ("kind", "turn", "scene")) -> list[Case]:
    """Pick cases of all kinds, told by ``about``, in the same number, in an order that is always the same."""
    strata: dict[tuple, list[Case]] = {}
    for case in sorted(found, key=lambda c: hashlib.sha256(c.name.encode()).hexdigest()):
        strata.setdefault(tuple(case.about[key] for key in about), []).append(case)
    # Neighbours in a round differ in all of what tells their kinds.
    keys = sorted(strata, key=lambda key: hashlib.sha256(str(key).encode()).hexdigest())
    rounds = itertools.zip_longest(*(strata[key] for key in keys))
    return [case for some in rounds for case in some if case is not None][:count]


def psnr(a, b) -> float:
    """PSNR of display values; at most :data:`SAME`."""
    shown = [np.clip(np.float64(m), 0, 1) ** (1 / 2.2) for m in (a, b)]
    return float(-10 * np.log10(max(np.square(shown[0] - shown[1]).mean(), 10 ** (-SAME / 10))))


def gained(done: Done, part: slice) -> float | None:
    """Return how much nearer to the true map some rows came, dB; None where they were there before."""
    original, edited, true = (one[part] for one in done.maps)
    before = psnr(original, true)
    return psnr(edited, true) - before if before < SAME else None


def measure(done: Done) -> dict:
    """Return the numbers of a row. Maps are compared in units of the file: a scene's ``scale`` clips more."""
    found = done.metrics
    original, edited, true = done.maps
    return found["natural"] | {
        "render": found["render"]["psnr"],
        "initial": found["initial"]["psnr"],
        "psnr": psnr(edited, true),
        "unedited": psnr(original, true),
        "gain": gained(done, slice(None)),
        "upper": gained(done, slice(0, WIDTH // 4)),
        "lower": gained(done, slice(WIDTH // 4, None)),
        "off": found.get("sun_offset_texels"),
    }


COLUMNS = {
    "scene": "{scene}",
    "map": "{map}",
    "target": "{label}",
    "turn": "{turn}",
    "rendering (unedited), dB": "{render:.1f} ({initial:.1f})",
    "map (unedited), dB": "{psnr:.1f} ({unedited:.1f})",
    "upper, lower half": lambda m: f"{number(m['upper'], '+.1f')} / {number(m['lower'], '+.1f')}",
    "sun off, texels": lambda m: number(m["off"]),
    "colours outside": lambda m: f"{100 * m['colours_outside']:.1f} %",
    "seam": lambda m: number(m["seam"]),
    "high frequencies": lambda m: number(m["high_frequency"], ".2f"),
}


def summary(rows) -> str:
    """Return means and extremes of every kind of target, with a turn and without, of every scene and map."""
    head = (
        "runs", "rendering, dB (worst)", "map over the unedited one, dB (worst)", "worse than unedited",
        "lower half, dB", "colours outside (most), over 5 %", "seam (most), over 2.5",
        "high frequencies, outside 0.7 to 1.3",
    )  # fmt: skip
    tables = []
    for keys in (("kind", "turn"), ("scene",), ("map",)):
        groups: dict[tuple, list] = {}
        for m in rows:
            groups.setdefault(tuple(m[key] for key in keys), []).append(m)
        names = ["target" if key == "kind" else key for key in keys]
        lines = [[*name, *_told(some)] for name, some in sorted(groups.items())]
        tables.append(markdown((*names, *head), lines))
    return "\n\n".join(tables)


def _told(some):
    """Return means and extremes of rows, as words."""
    render, gain, lower, outside, seam, sharp = (
        np.array([m[key] for m in some if m[key] is not None] or [np.nan])
        for key in ("render", "gain", "lower", "colours_outside", "seam", "high_frequency")
    )
    return [
        str(len(some)),
        f"{render.mean():.1f} ({render.min():.1f})",
        f"{gain.mean():+.1f} ({gain.min():+.1f})",
        str((gain < 0).sum()),
        f"{lower.mean():+.1f}",
        f"{100 * outside.mean():.1f} % ({100 * outside.max():.1f}), {(outside > 0.05).sum()}",
        f"{number(seam.mean())} ({number(seam.max())}), {(seam > 2.5).sum()}",
        f"{number(sharp.mean(), '.2f')}, {((sharp < 0.7) | (sharp > 1.3)).sum()}",
    ]


EXPERIMENT = Experiment(
    "natural",
    "Edit many skies in many scenes, and measure whether the results still look like photographs of a sky.",
    cases,
    measure,
    COLUMNS,
    summary=summary,
    sheet=lambda case: case.about["scene"] + ".jpg",
    options=options,
)
