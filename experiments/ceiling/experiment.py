"""Measure what the true map itself scores: two renderings of it, as target and result are rendered.

Of Table 3 of the paper (names ``paper-...``), and of the turned maps of ``natural`` that a turn of the sky
leads to (its names), beside their edits where they are done. No edit can be expected to score more than
the noise of its judge allows: one that does shows a picture that is smoother than the truth.
"""

from pathlib import Path

import numpy as np

from envedit import inputs
from envedit.core.seeds import Seeds
from envedit.losses import metrics
from envedit.targets import target
from experiments import puresky
from experiments.harness import Done, Experiment, calling, done_of, markdown, number
from experiments.natural import experiment as natural

BELOW = 0.5
"""Decibels under the true map's rendering, from which a case is named."""
ROUGHNESS = (0.0, 0.5, 1.0)


def twice(settings, folder) -> dict:
    """Render the true map with the target's and with the result's samples: ``metrics.compare`` of the two."""
    lit = inputs.load_scene(settings.scene)
    original, _ = inputs.load_map(settings.input, lit)
    wanted = target.make(settings, lit, original)
    result = lit.sampled(wanted.envmap, settings.output.spp, Seeds.of(settings.seed).judged)[0]
    return metrics.compare(result, wanted.picture)


def cases(given):
    maps = puresky.find().items()
    found = [
        (
            f"paper-{name}-{roughness:.1f}",
            {
                "input": {"envmap": str(file)},
                "scene": {"file": "statue", "width": 128, "parameters": {"roughness": roughness}},
                "target": {"rotate_degrees": 60},
            },
            {"scene": f"Table 3, roughness {roughness:g}", "edit": None},
        )
        for roughness in ROUGHNESS
        for name, file in maps
    ]
    for case in natural.cases(given):
        if case.about["kind"] == "turned" and case.about["turn"] == "auto":
            edit = done_of([(case, case.job())], given.edits.absolute())
            about = {"scene": case.about["scene"], "edit": edit[0] if edit else None}
            found.append((case.name, case.tables, about))
    return [calling(n, "experiments.ceiling.experiment:twice", t, {"name": n} | a) for n, t, a in found]


def measure(done: Done) -> dict:
    edit = done.case.about["edit"]
    return {
        "psnr": done.metrics["psnr"],
        "ssim": done.metrics["ssim"],
        "edit": edit.metrics["render"]["psnr"] if edit else np.nan,
    }


def summary(rows) -> str:
    """Return means by scene, the edits' over the true maps', and how many are BELOW under them."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        keys = "psnr", "ssim", "edit"
        some = np.array([[row[key] for key in keys] for row in rows if row["scene"] == scene])
        over = some[:, 2] - some[:, 0]
        psnr, ssim, edit = some.mean(axis=0)
        shown = number(psnr, ".2f"), number(ssim, ".3f"), number(edit, ".2f"), number(over.mean(), "+.2f")
        lines.append([scene, str(len(some)), *shown, number(over.min(), "+.2f"), str((over < -BELOW).sum())])
    head = ["scene", "runs", "true maps, dB", "SSIM", "edits, dB", "edits over them", "least"]
    return markdown([*head, f"under -{BELOW}"], lines)


def options(parser):
    natural.options(parser)
    parser.add_argument("--edits", type=Path, default=Path("runs/natural"), metavar="DIR", help="of natural")


EXPERIMENT = Experiment(
    "ceiling",
    "Measure what the true map itself scores: two renderings of it, as target and result are rendered.",
    cases,
    measure,
    {
        "case": "{name}",
        "true map, dB": "{psnr:.2f}",
        "SSIM": "{ssim:.3f}",
        "edit, dB": lambda m: number(m["edit"], ".2f"),
    },
    group=lambda m: m["scene"],
    summary=summary,
    options=options,
)
