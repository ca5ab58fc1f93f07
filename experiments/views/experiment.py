"""Edit towards a turned map from one view, from another, and from both.

A ball of three materials under four maps, turned by 140 degrees, without a turn of the whole sky. Measured
are the map against the true one, and the posterior standard deviation of the log gain (mean over the sphere).
"""

import itertools
from pathlib import Path

import numpy as np

from envedit.core import latlong
from experiments import puresky
from experiments.harness import Case, Done, Experiment, layer
from experiments.summary import Summary

SCENE = str(Path(__file__).parent / "two.xml")
MATERIALS = {
    "glossy": {"material": "roughplastic", "alpha": 0.2},
    "metal": {"material": "roughconductor", "alpha": 0.3},
    "rough metal": {"material": "roughconductor", "alpha": 0.6},
}
MAPS = "autumn_field", "mud_road", "syferfontein_18d_clear"
SENSORS = {"front": ["front"], "behind": ["behind"], "both": "all"}


def cases(args):
    maps = {"sunsky": "sunsky"} | {name: str(file) for name, file in puresky.find().items() if name in MAPS}
    made = []
    for material, name, sensors in itertools.product(MATERIALS, maps, SENSORS):
        scene = {"file": SCENE, "width": 96, "sensors": SENSORS[sensors], "parameters": MATERIALS[material]}
        tables = {
            "input": {"envmap": maps[name], "width": 128},
            "scene": scene,
            "target": {"rotate_degrees": 140.0},
            "representation": {"turn": False},
        }
        about = {"ball": material, "map": name, "views": sensors}
        made.append(Case(f"{material}-{name}-{sensors}".replace(" ", "-"), tables, about))
    return made


def measure(done: Done) -> dict:
    deviation = layer(done.folder, "deviation")
    omega = latlong.solid_angles(*deviation.shape)[:, None] / (4 * np.pi)
    maps = {name: done.metrics[name]["psnr"] for name in ("initial_envmap", "envmap")}
    return maps | {"deviation": float((deviation * omega).sum())}


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "ball": "{ball}",
        "map": "{map}",
        "views": "{views}",
        "unedited, dB": "{initial_envmap:.1f}",
        "map, dB": "{envmap:.1f}",
        "deviation": "{deviation:.3f}",
    },
    summary=Summary(
        {"views": "{views}"},
        {
            "runs": "{runs}",
            "map, dB (worst)": "{envmap.mean:.1f} ({envmap.min:.1f})",
            "deviation (largest)": "{deviation.mean:.3f} ({deviation.max:.3f})",
        },
    ),
)
