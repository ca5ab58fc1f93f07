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

SCENE = str(Path(__file__).parent / "two.xml")
MATERIALS = {
    "glossy": {"material": "roughplastic", "alpha": 0.2},
    "metal": {"material": "roughconductor", "alpha": 0.3},
    "rough metal": {"material": "roughconductor", "alpha": 0.6},
}
MAPS = "autumn_field", "mud_road", "syferfontein_18d_clear"
SENSORS = {"front": ["front"], "behind": ["behind"], "both": "all"}


def cases(given):
    maps = {"sunsky": "sunsky"} | {name: str(file) for name, file in puresky.find().items() if name in MAPS}
    return [
        Case(
            f"{material}-{name}-{sensors}".replace(" ", "-"),
            {
                "input": {"envmap": maps[name], "width": 128},
                "scene": {
                    "file": SCENE,
                    "width": 96,
                    "sensors": SENSORS[sensors],
                    "parameters": MATERIALS[material],
                },
                "target": {"rotate_degrees": 140.0},
                "representation": {"turn": False},
            },
            {"ball": material, "map": name, "views": sensors},
        )
        for material, name, sensors in itertools.product(MATERIALS, maps, SENSORS)
    ]


def measure(done: Done) -> dict:
    deviation = layer(done.folder, "deviation")
    omega = latlong.solid_angles(*deviation.shape)[:, None] / (4 * np.pi)
    return {
        "unedited": done.metrics["initial_envmap"]["psnr"],
        "psnr": done.metrics["envmap"]["psnr"],
        "deviation": float((deviation * omega).sum()),
    }


def summary(rows) -> str:
    """Compare both views with the mean of one, where all three are done."""
    of = {(m["ball"], m["map"], m["views"]): np.array([m["psnr"], m["deviation"]]) for m in rows}
    balls = dict.fromkeys((m["ball"], m["map"]) for m in rows)
    whole = [key for key in balls if all((*key, views) in of for views in SENSORS)]
    if not whole:
        return "both views and each alone are not done for any ball and map"
    gains = [of[*key, "both"] - (of[*key, "front"] + of[*key, "behind"]) / 2 for key in whole]
    better, less = np.transpose(gains)
    return (
        f"Both views against the mean of one: map {better.mean():+.1f} dB (median {np.median(better):+.1f}, "
        f"worst {better.min():+.1f}), deviation {less.mean():+.3f} (worst {less.max():+.3f}); "
        f"{len(gains)} cases."
    )


EXPERIMENT = Experiment(
    "views",
    "Edit towards a turned map from one view, from another, and from both.",
    cases,
    measure,
    {
        "ball": "{ball}",
        "map": "{map}",
        "views": "{views}",
        "unedited, dB": "{unedited:.1f}",
        "map, dB": "{psnr:.1f}",
        "deviation": "{deviation:.3f}",
    },
    summary=summary,
)
