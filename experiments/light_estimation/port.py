"""The spheres against the ground truth of DiffusionLight's evaluation, which Blender has rendered.

The map of that ground truth is not published with it. It is read off the mirror sphere, which reflects nearly
every direction; under it the diffuse and the matte silver sphere are compared with theirs. The mirror is
compared with what was read off it: that checks camera and sphere, and not how the map is oriented.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.errors import InputError
from experiments import puresky
from experiments.harness import Experiment, calling
from experiments.light_estimation import protocol

NAME = "abandoned_bakery_4k.exr"
HOW = "it is the folder example of the repository DiffusionLight-evaluation"
HEIGHT, WIDTH = 256, 512
"""Texels of the map that is read; the mirror of 280 pixels shows little more."""
EDGE = 1.5
"""Pixels within the silhouette that are not read: they are mixed with what is behind the sphere."""

_ROUGHER = {"type": "blendbsdf", "weight": 0.54, "0": protocol.silver(0.3271), "1": protocol.silver(0.369)}
BLEND = {"matte silver, blended": protocol.Sphere(_ROUGHER)}
"""The mixture that the evaluator's script makes and does not use, by Fresnel's term at normal incidence."""


def truth(name: str) -> np.ndarray:
    """Return the ground truth of a sphere, RGBA (540, 960, 4).

    Raises
    ------
    ConfigError, InputError
        ENVEDIT_DATA is not set; there is no such file.
    """
    place = f"evaluation/ground_truth/stylelight/{name.replace(' ', '_')}/{NAME}"
    file = puresky.data(place, HOW) / place
    if not file.is_file():
        raise InputError(f"{file}: no such file; {HOW}")
    return np.asarray(mi.Bitmap(str(file)))


def read_off(mirror: np.ndarray) -> np.ndarray:
    """Return what lights a mirror sphere, (256, 512, 3), given its picture (540, 960, >= 3).

    Each direction is looked up where the sphere reflects it to the camera; directions that are reflected
    nearer to the silhouette than EDGE, behind the sphere, at EDGE.
    """
    distance = np.linalg.norm(protocol.CAMERA)
    forward = -protocol.CAMERA / distance
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)

    # ---- The point of the sphere that reflects each direction to the camera, by fixed-point iteration
    directions = latlong.directions(HEIGHT, WIDTH)
    to_camera = np.broadcast_to(-forward, directions.shape)
    for _ in range(30):
        normal = _unit(directions + to_camera)
        to_camera = _unit(protocol.CAMERA - protocol.RADIUS * normal)

    # ---- Its pixel
    height, width = mirror.shape[:2]
    focal = protocol.LENS / protocol.SENSOR * width
    offset = protocol.RADIUS * normal - protocol.CAMERA
    place = focal * np.stack([offset @ right, -offset @ up], axis=2) / (offset @ forward)[..., None]
    silhouette = focal * np.tan(np.arcsin(protocol.RADIUS / distance))
    radius = np.linalg.norm(place, axis=2, keepdims=True)
    place *= np.minimum(1, (silhouette - EDGE) / np.maximum(radius, 1e-9))
    pixel = place + [width / 2 - 0.5, height / 2 - 0.5]

    # ---- Its colour, interpolated, over the mirror's reflectance
    first = pixel.astype(int)
    part = pixel - first
    found = np.zeros((HEIGHT, WIDTH, 3))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.abs(1 - i - part[..., 1]) * np.abs(1 - j - part[..., 0])
        found += weight[..., None] * mirror[first[..., 1] + i, first[..., 0] + j, :3]
    cosine = np.clip((normal * to_camera).sum(axis=2), 0, 1)
    return (found / (0.8 + 0.2 * (1 - cosine) ** 5)[..., None]).astype(np.float32)


def _unit(v):
    return v / np.maximum(np.linalg.norm(v, axis=2, keepdims=True), 1e-9)


def pairs() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the picture of each sphere, and its ground truth reduced to the same size."""
    lit = read_off(truth("mirror"))
    found = {}
    for name, sphere in (protocol.SPHERES | BLEND).items():
        picture = protocol.render(sphere, lit)
        height, width, step = *picture.shape[:2], sphere.reduction
        true = truth(name.partition(",")[0]).reshape(height, step, width, step, 4).mean(axis=(1, 3))
        found[name] = (picture, true)
    return found


def compare(settings, folder: Path) -> dict:
    """Return the errors of each sphere, and the ratio of the means, by its name."""
    return {
        name: protocol.compared(picture, true)
        | {"ratio": float(picture[..., :3].mean() / true[..., :3].mean())}
        for name, (picture, true) in pairs().items()
    }


EXPERIMENT = Experiment(
    "light_estimation.port",
    "Compare the spheres of light estimation with their ground truth by Blender.",
    lambda given: [calling("port", "experiments.light_estimation.port:compare", {})],
    lambda done: [{"sphere": name} | values for name, values in done.metrics.items()],
    {
        "sphere": "{sphere}",
        "RMSE": "{rmse:.3f}",
        "si-RMSE": "{si_rmse:.3f}",
        "normalised RMSE": "{normalised:.3f}",
        "angle, degrees": "{angle:.2f}",
        "mean over the ground truth's": "{ratio:.3f}",
    },
    panels=lambda done: [protocol.display(picture) for both in pairs().values() for picture in both],
    sheet=lambda case: "port.jpg",
)
