"""Eight cameras, and what they make of a scene under a map: a JPEG that is shifted, exposed and noisy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config, inputs
from envedit.core.color import luminance
from envedit.core.tone_curves import TONE_CURVES
from envedit.targets.alignment import Placement
from envedit.targets.photo import Camera
from envedit.targets.strokes import balance

PHOTO_SIZE = 3
"""Pixels of the photograph for one of the rendering, along each axis."""
GREY = 0.18
"""Exposed radiance that the light meter gives the geometric mean of the picture, before compensation."""
SHIFT, SCALE, DEGREES = 0.02, 0.01, 0.5
"""Shift, as a share of the width, in any direction; largest scale beside 1, and rotation."""
ELECTRONS, READ_NOISE = 2500, 3.0
"""Of a pixel of a full-frame sensor at ISO 3200: electrons of an exposed radiance of 1 (a full well of 80,000
at ISO 100), and the standard deviation of its reading."""
JPEG_QUALITY = 85
SPP = 256


@dataclass(frozen=True)
class Model:
    """Compensation of the exposure in stops, white balance in kelvin, and tone curve."""

    stops: float
    kelvin: float
    curve: str


CAMERAS = (
    Model(0, 6500, "srgb"),
    Model(-3, 4500, "srgb"),
    Model(1, 5500, "filmic"),
    Model(2, 7500, "agx"),
    Model(-1, 3200, "aces"),
    Model(0, 9000, "reinhard"),
    Model(-2, 5000, "agx"),
    Model(3, 6500, "aces"),
)


def photograph(model: Model, scene: config.Scene, envmap: np.ndarray, seed: int, file: Path) -> Camera:
    """Write the photograph of a scene under a map (H, W, 3), and return its camera."""
    # ---- Path traced, metered and exposed
    film = inputs.load_scene(replace(scene, width=PHOTO_SIZE * scene.width))
    radiance = film.render(np.ascontiguousarray(envmap, np.float32), SPP, seed)
    mean = np.exp(np.log(np.maximum(luminance(radiance), 1e-6)).mean())
    factor = GREY / mean * 2**model.stops * balance(model.kelvin)

    # ---- Moved
    rng = np.random.default_rng(seed)
    direction, scale, degrees = rng.uniform(-np.pi, np.pi), *rng.uniform(-1, 1, 2)
    moved = Placement(
        SHIFT * np.cos(direction), SHIFT * np.sin(direction), 1 + SCALE * scale, DEGREES * degrees
    )
    exposed, _ = moved.sampled(radiance * factor, *radiance.shape[:2])

    # ---- Noisy, developed and compressed
    electrons = rng.poisson(ELECTRONS * exposed) + rng.normal(0, READ_NOISE, exposed.shape)
    shown = TONE_CURVES[model.curve].shown(np.maximum(electrons / ELECTRONS, 0))
    mi.Bitmap(np.rint(255 * shown).astype(np.uint8)).write(str(file), quality=JPEG_QUALITY)
    return Camera(model.curve, np.log(factor))
