"""How the parts of a run grow with the picture and with the map.

Every size is run twice and the second time counts: kernels, T and the target's rendering are on disk then.
Nothing else may run on the machine.
"""

from envedit import pipeline
from experiments import puresky
from experiments.harness import Experiment, calling

SIZES = ((128, 256), (256, 256), (512, 256), (128, 512), (512, 512))
"""Pixels and texels across."""
PARTS = ("target", "fit", "transport", "start", "edit", "judge", "total")


def second(settings, folder) -> dict:
    """Run a configuration twice; returns the metrics of the second run."""
    return [pipeline.run(settings).metrics for _ in range(2)][1]


def cases(given):
    file = puresky.file("sunflowers")
    return [
        calling(
            f"{pixels}x{texels}",
            "experiments.solver.growth:second",
            {
                "input": {"envmap": file, "width": texels},
                "scene": {"file": "sphere", "width": pixels},
                "target": {"rotate_degrees": 60},
                "representation": {"turn": False},
            },
            {"size": f"{pixels}², {texels}x{texels // 2}"},
        )
        for pixels, texels in SIZES
    ]


EXPERIMENT = Experiment(
    "solver.growth",
    "How the parts of a run grow with the picture and with the map.",
    cases,
    columns={
        "picture, map": "{size}",
        "steps": "{iterations}",
        "a step, ms": lambda m: f"{m['timing']['per_iteration_ms'] or 0:.0f}",
    }
    | {part: f"{{timing[{part}_s]:.2f}}" for part in PARTS},
    alone=True,
)
