"""Move the lights of a map and compare with the map turned as a whole: the layers alone, no rendering.

All lights with a glow go about the vertical together, by two angles. What differs from the turned map is
what separation, glow and the sky behind it have wrong.
"""

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE, tonemap
from envedit.core.rotations import rotated, rotation_vector
from envedit.images import images
from envedit.representations.layers.layers import SCALES, Layers
from experiments import puresky
from experiments.harness import Experiment
from experiments.measures import psnr
from experiments.summary import Summary

WIDTH = 128
UP = np.array([0.0, 1.0, 0.0])
DEGREES = (100.0, 201.0)
NEAR_DEGREES = (4.0, 35.0)
"""Angles from the strongest light, above the horizon, between which the sky is compared."""
FAINT = 1e-3


def moved(made: Layers, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the map whose lights are turned about the vertical, and where the strongest is then."""
    about = np.radians(degrees) * UP
    params = made.start()
    turn = params["turn"].numpy()
    for i in range(made.lights.own):
        centre = made.lights.centres[i]
        turn[i] = rotation_vector(centre, rotated(centre, about)) / SCALES["turn"]
    strongest = made.lights.centres[int(np.argmax(made.lights.flux[: made.lights.own] @ LUMINANCE))]
    return made.decode(params | {"turn": tensor(turn)}).numpy(), rotated(strongest, about)


def compare(settings, folder, file: str) -> dict:
    """Compare at both angles; returns means, {} of a map without a light that has a glow."""
    image = np.ascontiguousarray(images.load_envmap(file, WIDTH)[0], np.float32)
    made = Layers.of(image, horizon="mirror")
    if not made.lights.own or not made.lights.glowing:
        return {}
    directions = latlong.directions(*image.shape[:2])
    found = []
    for degrees in DEGREES:
        true = latlong.rotate(image, degrees)
        edited, sun = moved(made, degrees)
        nearest, farthest = np.cos(np.radians(NEAR_DEGREES))
        cosine = directions @ sun
        near = (cosine < nearest) & (cosine > farthest) & (directions[..., 1] > 0)
        logs = [np.log(one @ LUMINANCE + FAINT)[near] for one in (edited, true)]
        off = np.subtract(*logs)
        white = [(tonemap(one)[near].min(axis=1) >= 1).mean() for one in (edited, true)]
        found.append(
            [
                psnr(edited, true),
                psnr(image, true),
                np.sqrt(np.square(off).mean()),
                off.mean(),
                white[0] - white[1],
            ]
        )
    names = "map_psnr", "unedited", "rms", "bias", "white"
    return dict(zip(names, np.mean(found, axis=0).tolist(), strict=True))


def columns(statistic: str = "") -> dict[str, str]:
    """Return the columns of a table of maps, or of a statistic of them, such as ".mean"."""
    return {
        "map, dB": f"{{map_psnr{statistic}:.1f}}",
        "unedited, dB": f"{{unedited{statistic}:.1f}}",
        "log radiance near the sun, RMS": f"{{rms{statistic}:.2f}}",
        "mean": f"{{bias{statistic}:+.2f}}",
        "white there": f"{{white{statistic}:+.1%}}",
    }


EXPERIMENT = Experiment(
    lambda given: puresky.cases(compare),
    columns={"map": "{map}"} | columns(),
    summary=Summary({}, {"maps": "{runs}"} | columns(".mean")),
)
