"""Edits judged by the evaluator of light estimation, beside what others publish under it.

The sphere scene is edited towards the light of another map; then three other spheres are lit by the edited,
the unedited and the true map.
"""

import argparse
import json

import numpy as np

from envedit.export import light_list
from envedit.representations.layers.separation import separate
from experiments import puresky
from experiments.harness import Case, Done, Experiment
from experiments.light_estimation import protocol
from experiments.measures import irradiance_error, lights_error, peak_error
from experiments.summary import Summary

COUNT = 6
PUBLISHED = {
    "DiffusionLight, a photograph": {"si_rmse": (0.14, 0.45, 0.66), "angle": (2.14, 3.60, 4.29)},
    "LuxDiT, a photograph": {"angle": (1.23, 1.98, 2.78)},
}
"""Means over Poly Haven's maps: diffuse, matte silver, mirror."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=int, default=COUNT, help="so many maps (%(default)s)")


def cases(args):
    files = list(puresky.find().items())
    made = []
    for i in range(0, len(files), max(1, len(files) // max(args.count, 1))):
        name, file = files[i]
        other, other_file = files[(i + len(files) // 2) % len(files)]
        tables = {
            "input": {"envmap": str(file), "width": protocol.WIDTH},
            "scene": {"file": "sphere"},
            "target": {"file": str(other_file)},
        }
        made.append(Case(f"{name}-{other}", tables, {"map": name, "other": other}))
    return made[: args.count]


def measure(done: Done) -> list[dict]:
    """Return rows of the edited and of the unedited map: one for each sphere, and one of the map itself."""
    original, edited, true = done.maps
    lights = json.loads((done.folder / "lights.json").read_bytes())
    true_lights = light_list.listed(separate(true).lights, true.shape[:2], np.eye(3))
    expected = protocol.pictures(true)
    rows = []
    for kind, envmap, when in (("edited", edited, "after"), ("unedited", original, "before")):
        about = {"kind": kind, "rendering": done.metrics["render"]["psnr"]}
        for sphere, picture in protocol.pictures(envmap).items():
            errors = protocol.compared(picture, expected[sphere])
            rows.append(about | {"sphere": sphere} | errors)
        stops = np.abs(irradiance_error(envmap, true))
        of_map = {
            "peak": peak_error(envmap, true),
            "lights": lights_error(lights[when], true_lights),
            "stops": float(stops.mean()),
            "worst": float(stops.max()),
        }
        rows.append(about | {"sphere": ""} | of_map)
    return rows


def published() -> list[dict]:
    """Return the published means, a row for each sphere."""
    return [
        {"kind": name, "sphere": sphere} | {key: numbers[i] for key, numbers in means.items()}
        for name, means in PUBLISHED.items()
        for i, sphere in enumerate(protocol.SPHERES)
    ]


def summary(rows) -> str:
    """Return means over the maps beside the published ones, and measures of maps."""
    spheres = [row for row in rows if row["sphere"]]
    return f"{OF_SPHERES(spheres + published())}\n\n{OF_MAPS([row for row in rows if not row['sphere']])}"


OF_SPHERES = Summary(
    {"": "{kind}", "sphere": "{sphere}"},
    {
        "runs": "{runs}",
        "RMSE": "{rmse.mean:.3f}",
        "si-RMSE": "{si_rmse.mean:.3f}",
        "normalised RMSE": "{normalised.mean:.3f}",
        "angle, degrees": "{angle.mean:.3f}",
    },
)
OF_MAPS = Summary(
    {"mean (median), number of maps": "{kind}"},
    {
        "brightest direction": "{peak.mean:.2f} ({peak.median:.2f}), {peak.count}",
        "lights": "{lights.mean:.2f} ({lights.median:.2f}), {lights.count}",
        "irradiance: mean of six planes, stops": "{stops.mean:.2f} ({stops.median:.2f}), {stops.count}",
        "worst plane": "{worst.mean:.2f} ({worst.median:.2f}), {worst.count}",
    },
)
COLUMNS = {
    "Spheres": {
        "map": "{map} towards {other}",
        "": "{kind}",
        "rendering PSNR": "{rendering:.1f}",
        "sphere": "{sphere}",
        "si-RMSE": "{si_rmse:.3f}",
        "angle, degrees": "{angle:.1f}",
    },
    "Maps": {
        "map": "{map} towards {other}",
        "": "{kind}",
        "brightest direction": "{peak:.2f}",
        "lights": "{lights:.2f}",
        "irradiance: mean of six planes, stops": "{stops:.2f}",
        "worst plane": "{worst:.2f}",
    },
}


def panels(done: Done):
    """Return each sphere under the unedited, the edited and the true map."""
    of_maps = [protocol.pictures(envmap) for envmap in done.maps]
    return [protocol.display(spheres[name]) for name in protocol.SPHERES for spheres in of_maps]


EXPERIMENT = Experiment(
    cases,
    measure,
    COLUMNS,
    group=lambda row: "Spheres" if row["sphere"] else "Maps",
    summary=summary,
    panels=panels,
    options=options,
)
