"""Edit many skies in many scenes, and measure whether the results still look like photographs of a sky."""

import hashlib
import itertools

from envedit.images import analytic_sky
from experiments import puresky
from experiments.harness import Case, Done, Experiment
from experiments.measures import SAME, psnr
from experiments.summary import Summary

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


def cases(args):
    skies = {name: str(file) for name, file in puresky.find().items()}
    names = sorted(skies)
    data = puresky.data()
    ground = {name: str(file) for name, file in puresky.others().items()}
    analytic = {
        elevation: puresky.written(
            args.out, f"sunsky_{elevation}", analytic_sky.sunsky(WIDTH, 90.0, elevation)
        )
        for elevation in (ELEVATION, *ELEVATIONS)
    }
    maps = skies | ground | {"sunsky": analytic[ELEVATION]}
    made = []
    for scene, (i, (name, source)), turn in itertools.product(
        SCENES, enumerate(maps.items()), ("auto", False)
    ):
        targets = [(str(angle), "turned", {"rotate_degrees": angle}) for angle in ANGLES]
        if name == "sunsky":
            targets += [(f"elevation_{e}", "elevation", {"file": analytic[e]}) for e in ELEVATIONS]
        else:
            others = [names[(i + k) % len(names)] for k in OTHERS]
            targets += [(other, "another map", {"file": skies[other]}) for other in others]
        file = SCENES[scene]
        tables = {"file": str(data / "scenes" / file) if "/" in file else file, "width": 128}
        if scene == "sphere":
            tables["parameters"] = {"roughness": 0.3}
        word = str(turn).lower()
        for label, kind, target in targets:
            configuration = {
                "input": {"envmap": source, "width": WIDTH},
                "scene": tables,
                "target": target,
                "representation": {"turn": turn},
            }
            about = {"scene": scene, "map": name, "label": label, "kind": kind, "turn": word}
            made.append(Case(f"{scene}-{name}-{label}-turn_{word}", configuration, about))
    return made


def place(case: Case, kinds: tuple[str, ...] = ("kind", "turn", "scene")) -> tuple[str, str]:
    """Return digests: neighbours in a round of cases differ in all of what distinguishes their kinds."""
    kind = str(tuple(case.about[key] for key in kinds))
    digests = [hashlib.sha256(text.encode()).hexdigest() for text in (kind, case.name)]
    return digests[0], digests[1]


def gained(done: Done, part: slice) -> float | None:
    """Return how much nearer to the true map some rows came, dB; None where they were there before."""
    original, edited, true = (one[part] for one in done.maps)
    before = psnr(original, true)
    return psnr(edited, true) - before if before < SAME else None


def measure(done: Done) -> dict:
    """Return the numbers of a row. Maps are compared in units of the file: a scene's ``scale`` clips more."""
    original, edited, true = done.maps
    half = len(original) // 2
    render = done.metrics["render"]
    ceiling = done.metrics["ceiling"]
    return {
        **done.metrics,
        **done.metrics["natural"],
        "over": render["psnr"] - ceiling["psnr"] if ceiling else None,
        "psnr": psnr(edited, true),
        "unedited": psnr(original, true),
        "gain": gained(done, slice(None)),
        "upper": gained(done, slice(0, half)),
        "lower": gained(done, slice(half, None)),
    }


COLUMNS = {
    "scene": "{scene}",
    "map": "{map}",
    "target": "{label}",
    "turn": "{turn}",
    "rendering (unedited), dB": "{render[psnr]:.1f} ({initial[psnr]:.1f})",
    "over the true map's rendering, dB": "{over:+.2f}",
    "map (unedited), dB": "{psnr:.1f} ({unedited:.1f})",
    "upper, lower half": "{upper:+.1f} / {lower:+.1f}",
    "sun off, texels": "{sun_offset_texels:.1f}",
    "colours outside": "{colours_outside:.1%}",
    "seam": "{seam:.1f}",
    "high frequencies": "{high_frequency:.2f}",
}
STATISTICS = {
    "runs": "{runs}",
    "rendering, dB (worst)": "{render[psnr].mean:.1f} ({render[psnr].min:.1f})",
    "over the true map's rendering, dB (least)": "{over.mean:+.2f} ({over.min:+.2f})",
    "map over the unedited one, dB (worst)": "{gain.mean:+.1f} ({gain.min:+.1f})",
    "worse than unedited": "{gain.below[0]}",
    "lower half, dB": "{lower.mean:+.1f}",
    "colours outside (most), over 5 %": (
        "{colours_outside.mean:.1%} ({colours_outside.max:.1%}), {colours_outside.above[0.05]}"
    ),
    "seam (most), over 2.5": "{seam.mean:.1f} ({seam.max:.1f}), {seam.above[2.5]}",
    "high frequencies, under 0.7, over 1.3": (
        "{high_frequency.mean:.2f}, {high_frequency.below[0.7]}, {high_frequency.above[1.3]}"
    ),
}
GROUPS = {"target": "{kind}", "turn": "{turn}"}, {"scene": "{scene}"}, {"map": "{map}"}


EXPERIMENT = Experiment(
    cases,
    measure,
    COLUMNS,
    summary=lambda rows: "\n\n".join(Summary(by, STATISTICS)(rows) for by in GROUPS),
    sheet=lambda case: case.about["scene"] + ".jpg",
    place=place,
)
