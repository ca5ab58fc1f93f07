"""Measure what the true map itself scores: two renderings of it, as target and result are rendered.

Of Table 3 of the paper (names ``paper-...``), and of the turned maps of ``natural`` that a turn of the sky
leads to (its names), beside their edits where they are done. No edit can be expected to score more than
the noise of its judge allows: one that does shows a picture that is smoother than the truth.
"""

from pathlib import Path

from envedit import inputs
from envedit.core.seeds import Seeds
from envedit.losses import metrics
from envedit.targets import target
from experiments import puresky
from experiments.harness import Done, Experiment, Summary, calling, done_of
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
    found = [
        (
            f"paper-{name}-{roughness:.1f}",
            {
                "input": {"envmap": str(file)},
                "scene": {"file": "statue", "width": 128, "parameters": {"roughness": roughness}},
                "target": {"rotate_degrees": 60},
            },
            {"scene": f"Table 3, roughness {roughness:g}", "done": []},
        )
        for roughness in ROUGHNESS
        for name, file in puresky.find().items()
    ]
    for case in natural.cases(given):
        if case.about["kind"] == "turned" and case.about["turn"] == "auto":
            done = done_of([(case, case.job())], given.edits.absolute())
            found.append((case.name, case.tables, {"scene": case.about["scene"], "done": done}))
    return [calling(n, "experiments.ceiling.experiment:twice", t, {"name": n} | a) for n, t, a in found]


def measure(done: Done) -> dict:
    true = done.metrics["psnr"]
    edit = next((one.metrics["render"]["psnr"] for one in done.case.about["done"]), None)
    return {
        "psnr": true,
        "ssim": done.metrics["ssim"],
        "edit": edit,
        "over": None if edit is None else edit - true,
    }


def below(rows: list[dict]) -> str:
    """Count the edits that are more than :data:`BELOW` under the true map."""
    return str(sum(row["over"] is not None and row["over"] < -BELOW for row in rows))


def options(parser):
    natural.options(parser)
    parser.add_argument("--edits", type=Path, default=Path("runs/natural"), metavar="DIR", help="of natural")


EXPERIMENT = Experiment(
    "ceiling",
    "Measure what the true map itself scores: two renderings of it, as target and result are rendered.",
    cases,
    measure,
    {"case": "{name}", "true map, dB": "{psnr:.2f}", "SSIM": "{ssim:.3f}", "edit, dB": "{edit:.2f}"},
    group=lambda row: row["scene"],
    summary=Summary(
        {
            "runs": "{rows}",
            "true maps, dB": "{psnr.mean:.2f}",
            "SSIM": "{ssim.mean:.3f}",
            "edits, dB": "{edit.mean:.2f}",
            "edits over them": "{over.mean:+.2f}",
            "least": "{over.min:+.2f}",
            f"under -{BELOW}": below,
        },
        by=("scene",),
    ),
    options=options,
)
