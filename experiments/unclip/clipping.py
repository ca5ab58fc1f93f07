"""Clipped versions of a map, what its sun truly is, and renderings of a shadow under it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.color import linear_to_srgb, luminance, srgb_to_linear
from envedit.images import images
from envedit.representations.layers.clipped_light import CORE_DEGREES
from envedit.representations.layers.separation import separate
from envedit.scene import scene
from experiments.measures import degrees, irradiance
from experiments.painted_edits.painters import View

KEPT = ("evening_road_01", "kloppenheim_06", "rustig_koppie", "syferfontein_18d_clear")
"""Maps that no choice and no constant has seen: every third by name."""
ROOMS = ("royal_esplanade", "studio_small_03")
"""Of ENVEDIT_DATA/hdri, those without a sky."""
LEVELS = ("1", "10", "100", "1000", "8 bit")
MEDIAN = 0.3
"""Median luminance of the sky, over solid angle, in an 8-bit picture: exposed for the sky, whose median
is then 0.58 of the display's range."""
SUNNY = 1 / 8
"""Flux of the sun over the sky's horizontal irradiance from which on a map is sunny: with less, its
shadows are hardly seen."""
SPHERE_ON_FLOOR = {
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 3},
    "sensor": {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.scalar_rgb.ScalarTransform4f().look_at([0, 6, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 96, "height": 72, "rfilter": {"type": "box"}},
    },
    "floor": {
        "type": "rectangle",
        "to_world": mi.scalar_rgb.ScalarTransform4f().rotate([1, 0, 0], -90).scale(30),
        "bsdf": {"type": "diffuse", "reflectance": 0.5},
    },
    "sphere": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7},
    "light": {"type": "constant"},
}
SAMPLES = 256


@dataclass(frozen=True)
class Truth:
    """The brightest light of a map."""

    direction: np.ndarray  # (3,), unit vector to it
    flux: float  # irradiance on a surface that faces it, luminance
    sky: float  # horizontal irradiance of the sky, luminance
    sunny: bool  # whether it is a sun that casts shadows


def load(file: str | Path) -> np.ndarray:
    """Return a map (H, W, 3) float32."""
    return images.load_envmap(str(file), None)[0]


def clipped(radiance: np.ndarray, level: str) -> tuple[np.ndarray, float]:
    """Return a map clipped at a level, or as 8-bit sRGB, and the exposure that it was given."""
    if level != "8 bit":
        return np.minimum(radiance, np.float32(level)), 1.0
    height, width, _ = radiance.shape
    above = luminance(radiance[: height // 2]).ravel()
    omega = np.repeat(latlong.solid_angles(height, width)[: height // 2], width)
    order = np.argsort(above, kind="stable")
    share = np.cumsum(omega[order])
    exposure = MEDIAN / float(above[order][np.searchsorted(share, share[-1] / 2)])
    codes = np.rint(255 * linear_to_srgb(exposure * radiance.astype(np.float64)))
    return srgb_to_linear(codes / 255).astype(np.float32), exposure


def truth(radiance: np.ndarray) -> Truth:
    """Measure the sun of an unclipped map: the core of the light of :func:`.separate` with most flux.

    Where there is no light above the horizon, what is around the brightest texel.
    """
    height, width, _ = radiance.shape
    omega = latlong.lookup_solid_angles(height, width)[:, None]
    directions = latlong.directions(height, width)
    lum = luminance(radiance)
    lights = [light for light in separate(radiance).lights if light.direction[1] > 0]
    direction = directions.reshape(-1, 3)[np.argmax(lum[: height // 2])]
    if lights:
        direction = lights[0].direction
    near = directions @ direction > np.cos(np.radians(2 * CORE_DEGREES))
    brightest = directions.reshape(-1, 3)[np.argmax(np.where(near, lum, 0))]
    core = directions @ brightest > np.cos(np.radians(CORE_DEGREES))
    direction = (directions * (lum * omega * core)[..., None]).sum(axis=(0, 1))
    direction /= np.linalg.norm(direction)

    # ---- As much as stands out within the core, and what is left for the sky
    angle = degrees(directions, direction)
    around = (angle > 1.5 * CORE_DEGREES) & (angle < 2.5 * CORE_DEGREES)
    core = angle < CORE_DEGREES
    flux = float((np.maximum(lum - np.median(lum[around]), 0) * omega)[core].sum())
    sky = float((lum * omega * np.maximum(directions[..., 1], 0))[~core].sum())
    return Truth(direction, flux, sky, bool(lights) and flux > SUNNY * sky)


def horizontal(radiance: np.ndarray) -> float:
    """Return the horizontal irradiance of a map, luminance."""
    return float(luminance(irradiance(radiance, np.array([[0.0, 1.0, 0.0]])))[0])


class Shadow:
    """A sphere on a floor, seen from above: renderings, and the contrast of the true sun's shadow in them."""

    def __init__(self, direction: np.ndarray):
        self._scene = scene.load(SPHERE_ON_FLOOR)
        view = View(self._scene)
        self._shadow = view.blocked(direction)
        self._open = view.floor & ~self._shadow

    def render(self, radiance: np.ndarray) -> np.ndarray:
        """Return the picture (h, w, 3) under a map."""
        return self._scene.render(radiance, SAMPLES)

    def contrast(self, picture: np.ndarray) -> float:
        """Return 1 less the light in the true sun's shadow over that on the open floor."""
        lum = luminance(picture)
        return float(1 - lum[self._shadow].mean() / lum[self._open].mean())
