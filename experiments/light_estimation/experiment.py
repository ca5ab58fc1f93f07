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
from experiments.harness import Case, Done, Experiment, markdown, number
from experiments.light_estimation import protocol

COUNT = 6
PICTURES = {"rmse": "RMSE", "si_rmse": "si-RMSE", "normalised": "normalised RMSE", "angle": "angle, degrees"}
"""Measures of pictures."""
MAPS = {
    "peak": "brightest direction",
    "lights": "lights",
    "stops": "irradiance: mean of six planes, stops",
    "worst": "worst plane",
}
"""Measures of maps, the first two in degrees."""
PUBLISHED = {
    "DiffusionLight, a photograph": {"si_rmse": (0.14, 0.45, 0.66), "angle": (2.14, 3.60, 4.29)},
    "LuxDiT, a photograph": {"angle": (1.23, 1.98, 2.78)},
}
"""Means over Poly Haven's maps: diffuse, matte silver, mirror."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=int, default=COUNT, help="so many maps (%(default)s)")


def cases(given):
    files, found = list(puresky.find().items()), []
    for i in range(0, len(files), max(1, len(files) // max(given.count, 1))):
        name, file = files[i]
        other, other_file = files[(i + len(files) // 2) % len(files)]
        tables = {
            "input": {"envmap": str(file), "width": protocol.WIDTH},
            "scene": {"file": "sphere"},
            "target": {"file": str(other_file)},
        }
        found.append(Case(f"{name}-{other}", tables, {"map": name, "other": other}))
    return found[: given.count]


def pictures(envmap: np.ndarray) -> dict[str, np.ndarray]:
    """Render every sphere under a map (H, W, 3) of linear radiance."""
    lit = protocol.tonemapped(envmap)
    return {name: protocol.render(sphere, lit) for name, sphere in protocol.SPHERES.items()}


def measure(done: Done) -> dict:
    """Return the errors of the edited and of the unedited map."""
    original, edited, true = done.maps
    lights = json.loads((done.folder / "lights.json").read_bytes())
    true_lights = light_list.listed(separate(true), np.eye(3))
    expected = pictures(true)
    row = {"rendering": done.metrics["render"]["psnr"]}
    for kind, envmap, found in (("edited", edited, "after"), ("unedited", original, "before")):
        for name, picture in pictures(envmap).items():
            values = protocol.compared(picture, expected[name])
            row |= {f"{kind} {name} {key}": value for key, value in values.items()}
        stops = np.abs(protocol.irradiance_error(envmap, true))
        row[f"{kind} peak"] = protocol.peak_error(envmap, true)
        row[f"{kind} lights"] = protocol.lights_error(lights[found], true_lights)
        row[f"{kind} stops"] = float(stops.mean())
        row[f"{kind} worst"] = float(stops.max())
    return row


def summary(rows) -> str:
    """Return means over the maps beside the published ones, and measures of maps."""
    spheres, maps = [], []
    for kind in ("edited", "unedited"):
        means = {}
        for key in PICTURES:
            means[key] = [np.mean([row[f"{kind} {name} {key}"] for row in rows]) for name in protocol.SPHERES]
        spheres.append([f"{kind}, {len(rows)} maps", *(_three(values, ".3f") for values in means.values())])
        maps.append([kind, *(_average([row[f"{kind} {key}"] for row in rows]) for key in MAPS)])
    for name, values in PUBLISHED.items():
        spheres.append([name, *(_three(values.get(key, ()), ".2f") for key in PICTURES)])
    first = markdown(["diffuse / matte silver / mirror", *PICTURES.values()], spheres)
    return f"{first}\n\n{markdown(['mean (median)', *MAPS.values()], maps)}"


def _three(values, form):
    return " / ".join(format(value, form) for value in values) or "-"


def _average(values):
    """Return mean and median of those that there are, and of how many if not of all."""
    known = [value for value in values if value is not None and value == value]
    if not known:
        return "-"
    text = f"{np.mean(known):.2f} ({np.median(known):.2f})"
    return text if len(known) == len(values) else f"{text}, of {len(known)}"


def _both(key, form):
    return lambda row: f"{number(row[f'edited {key}'], form)} ({number(row[f'unedited {key}'], form)})"


def panels(done: Done):
    """Return each sphere under the unedited, the edited and the true map."""
    three = [pictures(envmap) for envmap in done.maps]
    return [protocol.display(lit[name]) for name in protocol.SPHERES for lit in three]


COLUMNS = {"map": "{map} towards {other}", "rendering PSNR": "{rendering:.1f}"}
COLUMNS |= {f"{name}: si-RMSE": _both(f"{name} si_rmse", ".3f") for name in protocol.SPHERES}
COLUMNS |= {f"{name}: angle": _both(f"{name} angle", ".1f") for name in protocol.SPHERES}
COLUMNS |= {title: _both(key, ".2f") for key, title in MAPS.items()}

EXPERIMENT = Experiment(
    "light_estimation",
    "Judge edits by the evaluator of light estimation, beside published numbers.",
    cases,
    measure,
    COLUMNS,
    summary=summary,
    panels=panels,
    sheet=lambda case: "sheet.jpg",
    options=options,
)
