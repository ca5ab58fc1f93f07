"""How far colours of maps are from guesses of them: ``python -m experiments.photograph.colours``.

A photograph shows the white balance of its camera times the colour of the light. An edit leaves the colour of
the map that it begins with. Other guesses: that of the mean of all other skies, and what is likeliest by the
deviations of skies and cameras.
"""

import argparse
import itertools

import numpy as np

from envedit.core.color import AXES
from envedit.export.adjustments import balance
from envedit.images import images
from envedit.targets.photo import BALANCE_DEVIATION, TINT_DEVIATION
from experiments import puresky
from experiments.light_estimation import protocol
from experiments.photograph.cameras import CAMERAS
from experiments.photograph.experiment import FARTHER

WIDTH = 128
CAMERA_DEVIATIONS = np.array([BALANCE_DEVIATION, TINT_DEVIATION])


def mean_log_irradiance(envmap: np.ndarray) -> np.ndarray:
    """Return the mean log irradiance (3,) of six planes along the axes, under a map (H, W, 3)."""
    return np.log(protocol.irradiance(envmap, protocol.AXES)).mean(axis=0)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between the colours of two log irradiances, degrees."""
    a, b = np.exp(one), np.exp(other)
    return float(np.degrees(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1))))


def main() -> None:
    """Print the mean angles over all maps, and of the last guess over all cameras too."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    maps = [images.load_envmap(str(file), WIDTH, False)[0] for _, file in sorted(puresky.find().items())]
    light = np.array([mean_log_irradiance(envmap) for envmap in maps])
    begun = np.roll(light, FARTHER, axis=0)  # with the map that the experiment edits
    print(f"the map that is edited: {np.mean([angle(*pair) for pair in zip(begun, light, strict=True)]):.1f}")
    means, likely = [], []
    for i, camera in itertools.product(range(len(light)), CAMERAS):
        coordinates = np.delete(light, i, axis=0) @ AXES.T
        mean, deviations = coordinates.mean(axis=0), coordinates.std(axis=0, ddof=1)[1:]
        shown = (light[i] + np.log(balance(camera.kelvin))) @ AXES.T - mean
        share = deviations**2 / (deviations**2 + CAMERA_DEVIATIONS**2)
        means.append(angle(mean @ AXES, light[i]))
        likely.append(angle((mean + np.array([0, *share]) * shown) @ AXES, light[i]))
    print(
        f"mean of the other skies: {np.mean(means):.1f}; likeliest by both deviations: {np.mean(likely):.1f}"
    )


if __name__ == "__main__":
    main()
