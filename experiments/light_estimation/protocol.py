"""The evaluator of light estimation: three spheres under a tonemapped map, and measures of their pictures.

StyleLight's (Wang et al. 2022), which DiffusionLight (Phongthawee et al. 2024) and LuxDiT (Liang et al.
2025) use, ported from Blender's Cycles to Mitsuba. The map is resized to 256x128 texels and tonemapped, and
lights a sphere alone; a picture is that light's, not that of the map's radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.color import tonemap

HEIGHT, WIDTH = 128, 256
"""Texels of the map."""
GAMMA, PERCENTILE, LEVEL = 2.4, 50, 0.5
"""The map is E^(1 / GAMMA), scaled so that this percentile of its positive values is LEVEL."""
CAMERA = np.array([-16.0, 2.0, 0.0])
"""Blender's (0, -16, 2): its (x, y, z) is (z, x, y) of the map's frame."""
LENS, SENSOR = 85.0, 36.0
"""Focal length and width of the sensor, millimetres."""
FILM, CROP = (960, 540), 300
"""Pixels of the film, and of the square of it that is rendered; it holds the sphere."""
RADIUS = 0.9896
"""Of the sphere: Blender's subdivided mesh is smaller than 1; the area of the ground truth's alpha."""
SPP, SEED = 16, 900_001
_GRAY = {"type": "rgb", "value": 0.8}


@dataclass(frozen=True)
class Sphere:
    """Material of a sphere, by how much its film is smaller than FILM, and directions sampled for each ray.

    Rough spheres are smooth pictures, and need many directions.
    """

    bsdf: dict
    reduction: int = 3
    samples: int = 128


def silver(roughness: float) -> dict:
    """Return Cycles' metallic BSDF of specular 0: its index of refraction is 1, there is no Fresnel term."""
    bsdf = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
    return bsdf | {"alpha": roughness**2, "specular_reflectance": _GRAY}


SPHERES = {
    "diffuse": Sphere({"type": "principled", "base_color": _GRAY, "roughness": 0.364, "specular": 0.5}),
    "matte silver": Sphere(silver(0.3271)),
    "mirror": Sphere({"type": "principled", "base_color": _GRAY, "metallic": 1.0, "roughness": 0.0}, 1, 1),
}


# ---- Pictures ----------------------------------------------------------------------------------------------


def tonemapped(envmap: np.ndarray) -> np.ndarray:
    """Return what lights the spheres under a map (H, W, 3) of linear radiance, (128, 256, 3).

    A black map stays black.
    """
    power = latlong.resize(envmap, HEIGHT, WIDTH) ** (1 / GAMMA)
    positive = power[power > 0]
    return power * (LEVEL / np.percentile(positive, PERCENTILE)) if len(positive) else power


def render(sphere: Sphere, tonemapped_map: np.ndarray) -> np.ndarray:
    """Render a sphere under a tonemapped map (H, W, 3).

    Directions are sampled by the BSDF alone, with the same seed: they are the same under every map, and so is
    most of the noise of two pictures. Returns RGBA (540 / reduction, 960 / reduction, 4) float32, black where
    there is no sphere.
    """
    width, height = (size // sphere.reduction for size in FILM)
    crop = CROP // sphere.reduction
    left, top = (width - crop) // 2, (height - crop) // 2
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    film |= {"crop_offset_x": left, "crop_offset_y": top, "crop_width": crop, "crop_height": crop}
    film |= {"pixel_format": "rgba", "component_format": "float32"}
    to_world = mi.ScalarTransform4f().look_at(origin=CAMERA.tolist(), target=[0, 0, 0], up=[0, 1, 0])
    fov = float(np.degrees(2 * np.arctan(SENSOR / 2 / LENS)))
    integrator = {"type": "direct", "emitter_samples": 0, "bsdf_samples": sphere.samples}
    scene = {
        "type": "scene",
        "integrator": integrator | {"hide_emitters": True},
        "sensor": {"type": "perspective", "fov": fov, "to_world": to_world, "film": film},
        "map": {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(tonemapped_map, np.float32))},
        "sphere": {"type": "sphere", "radius": RADIUS, "bsdf": sphere.bsdf},
    }
    picture = np.asarray(mi.render(mi.load_dict(scene), spp=SPP, seed=SEED))
    return np.pad(picture, ((top, height - top - crop), (left, width - left - crop), (0, 0)))


def pictures(envmap: np.ndarray) -> dict[str, np.ndarray]:
    """Render every sphere under a map (H, W, 3) of linear radiance."""
    light = tonemapped(envmap)
    return {name: render(sphere, light) for name, sphere in SPHERES.items()}


def display(picture: np.ndarray) -> np.ndarray:
    """Return the part of a picture that :func:`render` renders as display values, (300, 300, 3)."""
    reduction = FILM[1] // len(picture)
    left, top = ((size - CROP) // 2 // reduction for size in FILM)
    crop = CROP // reduction
    shown = picture[top : top + crop, left : left + crop, :3]
    return tonemap(np.kron(shown, np.ones((reduction, reduction, 1))), "gamma")


# ---- Measures --------------------------------------------------------------------------------------------


def compared(estimate: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Compare two pictures of a sphere, RGBA (H, W, 4), over the pixels where the first has an alpha.

    Returns ``rmse``: squared errors summed over channels, mean over pixels, square root; ``si_rmse``: the
    same with the factor of the first picture at which it is least; ``angle``: between colours, degrees, mean
    over the pixels that are black in neither, NaN without any; ``normalised``: ``rmse`` of pictures of which
    each is scaled so that the 0.01th and 99.9th percentile of its values, those around the sphere included,
    are 0 and 1.
    """
    mask = estimate[..., 3] > 0
    scaled = [_scaled(np.float64(picture[..., :3]))[mask] for picture in (estimate, true)]
    a, b = (np.float64(picture[..., :3])[mask] for picture in (estimate, true))
    factor = (a * b).sum() / max((a * a).sum(), 1e-30)
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    coloured = lengths > 0
    cosine = (a * b).sum(axis=1)[coloured] / lengths[coloured]
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return {
        "rmse": _rmse(a, b),
        "si_rmse": _rmse(factor * a, b),
        "angle": float(angles.mean()) if coloured.any() else float("nan"),
        "normalised": _rmse(scaled[0], scaled[1]),
    }


def _rmse(a, b):
    return float(np.sqrt(np.square(a - b).sum(axis=1).mean()))


def _scaled(picture):
    low, high = np.percentile(picture, (0.01, 99.9))
    return (picture - low) / (high - low) if high > low else np.zeros_like(picture)
