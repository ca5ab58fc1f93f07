"""Three spheres under edited maps: the protocol by which light estimation is judged.

A mirror, a matte silver and a diffuse sphere that no edit has seen are rendered under the true, the edited
and the unedited map. As Gardner et al. (2017), Weber et al. (2022) and Phongthawee et al. (DiffusionLight,
2024) have it: root mean square error, the same at the best scale, and the angle between colours; over the
pixels of the sphere, in linear radiance. A mirror shows the sun itself, whose square outweighs the sky:
errors are also taken between the 0.1th and the 99.9th percentile of the true picture.
"""

import mitsuba as mi
import numpy as np

from envedit.scene import scene
from experiments import puresky
from experiments.harness import Case, Done, Experiment, markdown, tonemap

SIZE, SPP, SEED = 64, 256, 900_001
DEGREES, INSIDE = 10.0, 0.95
"""Field of view of the camera, and the share of a sphere's radius whose pixels count."""
SPHERES = {
    "mirror": {"type": "conductor", "material": "none"},
    "matte silver": {"type": "roughconductor", "material": "none", "alpha": 0.3},
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
}
TASKS = {"turned": "turned by 140 degrees, without `turn`", "another": "the light of another map"}


def cases(given):
    files, found = list(puresky.find().items()), []
    for i, (name, file) in enumerate(files):
        other, other_file = files[(i + len(files) // 2) % len(files)]
        targets = {"turned": {"rotate_degrees": 140}, "another": {"file": str(other_file)}}
        for task, target in targets.items():
            tables = {
                "input": {"envmap": str(file), "width": 256},
                "scene": {"file": "statue"},
                "target": target,
                "representation": {"turn": False},
            }
            about = {"map": name, "task": TASKS[task], "other": other if task == "another" else ""}
            found.append(Case(f"{name}-{task}", tables, about))
    return found


def stage(bsdf: dict) -> dict:
    """Return a scene: one sphere that fills the picture, lit by a map alone."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    origin = [0, 0, 1 / np.sin(np.radians(DEGREES / 2))]
    to_world = mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": DEGREES, "to_world": to_world, "film": film},
        "map": {"type": "constant"},
        "sphere": {"type": "sphere", "bsdf": bsdf},
    }


def compared(found: np.ndarray, true: np.ndarray) -> dict:
    """Return errors of pixels (n, 3), the first three over the true picture's mean or range.

    ``angle`` in degrees, mean over pixels that are not black.
    """
    found, true = np.float64(found), np.float64(true)
    mean = max(true.mean(), 1e-30)
    scale = (found * true).sum() / max((found * found).sum(), 1e-30)
    low, high = np.percentile(true, (0.1, 99.9))
    clipped = [np.clip((x - low) / max(high - low, 1e-30), 0, 1) for x in (found, true)]
    lengths = np.linalg.norm(found, axis=1) * np.linalg.norm(true, axis=1)
    lit = lengths > 0
    cosine = (found * true).sum(axis=1)[lit] / lengths[lit]
    return {
        "rmse": float(np.sqrt(np.square(found - true).mean()) / mean),
        "si_rmse": float(np.sqrt(np.square(scale * found - true).mean()) / mean),
        "between": float(np.sqrt(np.square(clipped[0] - clipped[1]).mean())),
        "angle": float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()) if lit.any() else float("nan"),
    }


def pictures(maps) -> dict[str, list[np.ndarray]]:
    """Render every sphere under each map, (SIZE, SIZE, 3)."""
    lit = {name: scene.load(stage(bsdf)) for name, bsdf in SPHERES.items()}
    return {name: [np.asarray(one.render(m, SPP, SEED)) for m in maps] for name, one in lit.items()}


def disc() -> np.ndarray:
    """Return which pixels see the sphere, bool (SIZE, SIZE)."""
    at = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    return np.hypot(*np.meshgrid(at, at)) < INSIDE


def measure(done: Done) -> dict:
    """Return the errors of the edited and of the unedited map, by sphere."""
    original, edited, true = done.maps
    inside, row = disc(), {"rendering": done.metrics["render"]["psnr"]}
    for name, (first, found, right) in pictures([original, edited, true]).items():
        row |= {f"{name} {k}": v for k, v in compared(found[inside], right[inside]).items()}
        row |= {f"{name} {k} unedited": v for k, v in compared(first[inside], right[inside]).items()}
    return row


def cell(name, key, form):
    return lambda row: f"{row[f'{name} {key}']:{form}} ({row[f'{name} {key} unedited']:{form}})"


def summary(rows) -> str:
    """Return means over the maps, by task and sphere; unedited in brackets."""
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        some = [row for row in rows if row["task"] == task]
        for name in SPHERES:
            mean = {k: np.mean([row[k] for row in some]) for k in some[0] if k.startswith(name + " ")}
            forms = {"rmse": ".2f", "si_rmse": ".2f", "between": ".3f", "angle": ".1f"}
            shown = [cell(name, key, form)(mean) for key, form in forms.items()]
            lines.append([f"{task}, {len(some)} maps", name, *shown])
    head = ["", "sphere", "RMSE over the mean", "scale-invariant", "between percentiles", "angle, degrees"]
    return markdown(head, lines)


COLUMNS = {"map": lambda row: f"{row['map']} {row['other'] and 'towards ' + row['other']}".strip()}
COLUMNS |= {"rendering PSNR": "{rendering:.1f}"}
COLUMNS |= {f"{name}: scale-invariant": cell(name, "si_rmse", ".2f") for name in SPHERES}
COLUMNS |= {f"{name}: angle": cell(name, "angle", ".1f") for name in SPHERES}


def panels(done: Done):
    """Return the spheres under the unedited, the edited and the true map."""
    return [
        np.where(disc()[..., None], tonemap(picture / max(2 * three[2].mean(), 1e-30), "gamma"), 0)
        for three in pictures(done.maps).values()
        for picture in three
    ]


EXPERIMENT = Experiment(
    "three_spheres",
    "Render a mirror, a silver and a diffuse sphere under edited maps.",
    cases,
    measure,
    COLUMNS,
    group=lambda row: row["task"],
    summary=summary,
    panels=panels,
)
