"""Times and errors of nine edits, to compare two versions of the solver; and how a run grows with its sizes.

Every edit is run twice and the second time counts: kernels, T and the target's rendering are on disk then.
Run two versions in one go, where nothing else runs.
"""

from envedit import pipeline
from experiments import puresky
from experiments.harness import Experiment, calling
from experiments.summary import Summary

EDITS = (  # map, scene, target (degrees or another map), whether the sky may turn
    ("sunflowers", "sphere", "60", False),
    ("sunflowers", "sphere", "autumn_field", True),
    ("rustig_koppie", "statue", "140", False),
    ("kloofendal_48d_partly_cloudy", "sphere", "140", False),
    ("wasteland_clouds", "statue", "60", False),
    ("evening_road_01", "sphere", "snow_field", True),
    ("mud_road", "statue", "sunflowers", True),
    ("syferfontein_18d_clear", "pair", "kloofendal_48d_partly_cloudy", True),
    ("kloppenheim_06", "sphere", "60", True),
)
SIZES = ((128, 256), (256, 256), (512, 256), (128, 512), (512, 512))
"""Pixels and texels across, of the first edit."""
PARTS = ("target", "fit", "transport", "start", "edit", "judge", "total")


def second(settings, folder) -> dict:
    """Run a configuration twice; returns the metrics of the second run."""
    pipeline.run(settings)
    return pipeline.run(settings).metrics


def case(group, name, edit, pixels=128, texels=256):
    """Return the case of an edit at a size."""
    files = puresky.find()
    source, scene, target, turn = edit
    tables = {
        "input": {"envmap": str(files[source]), "width": texels},
        "scene": {"file": scene, "width": pixels},
        "target": {"rotate_degrees": float(target)} if target.isdigit() else {"file": str(files[target])},
        "representation": {"turn": "auto" if turn else False},
    }
    return calling(name, second, tables, {"group": group, "edit": name})


def cases(given):
    edits = [case("edits", ", ".join(edit[:3]), edit) for edit in EDITS]
    sizes = [
        case("sizes", f"{pixels}², {texels}x{texels // 2}", EDITS[0], pixels, texels)
        for pixels, texels in SIZES
    ]
    return edits + sizes


EXPERIMENT = Experiment(
    cases,
    columns={
        "edits": {
            "edit": "{edit}",
            "solve, s": "{timing[solve_s]:.2f}",
            "total, s": "{timing[total_s]:.2f}",
            "steps": "{iterations}",
            "a step, ms": "{timing[per_iteration_ms]:.0f}",
            "rendering, dB": "{render[psnr]:.2f}",
            "map, dB": "{envmap[psnr]:.2f}",
        },
        "sizes": {
            "picture, map": "{edit}",
            "steps": "{iterations}",
            "a step, ms": "{timing[per_iteration_ms]:.0f}",
        }
        | {part: f"{{timing[{part}_s]:.2f}}" for part in PARTS},
    },
    group=lambda row: row["group"],
    summary=Summary(
        {"": "{group}"},
        {
            "runs": "{runs}",
            "solve, s": "{timing[solve_s].mean:.2f}",
            "total, s": "{timing[total_s].mean:.2f}",
            "steps": "{iterations.mean:.1f}",
            "a step, ms": "{timing[per_iteration_ms].mean:.0f}",
            "rendering, dB": "{render[psnr].mean:.2f}",
            "map, dB": "{envmap[psnr].mean:.2f}",
        },
    ),
    alone=True,
)
