"""The evaluator of light estimation: three spheres under a tonemapped map, and what is measured.

StyleLight's (Wang et al. 2022), which DiffusionLight (Phongthawee et al. 2024) and LuxDiT (Liang et al.
2025) use, ported from Blender's Cycles to Mitsuba. The map is resized to 256x128 texels and tonemapped, and
lights a sphere alone; a picture is that light's, not that of the map's radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance, tonemap

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
AXES = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
"""Normals of the planes: +x, -x, +y, -y, +z, -z."""
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
    (width, height), crop = (size // sphere.reduction for size in FILM), CROP // sphere.reduction
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


def display(picture: np.ndarray) -> np.ndarray:
    """Return the part of a picture that :func:`render` renders as display values, (300, 300, 3)."""
    reduction = FILM[1] // len(picture)
    left, top = ((size - CROP) // 2 // reduction for size in FILM)
    crop = CROP // reduction
    shown = picture[top : top + crop, left : left + crop, :3]
    return tonemap(np.kron(shown, np.ones((reduction, reduction, 1))), "gamma")


# ---- Measures of pictures ----------------------------------------------------------------------------------


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
    angles = _degrees((a * b).sum(axis=1)[coloured] / lengths[coloured])
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


# ---- Measures of maps --------------------------------------------------------------------------------------


def peak_error(estimate: np.ndarray, true: np.ndarray) -> float:
    """Return the angle between the brightest texels of two maps (H, W, 3), degrees.

    NaN if a map has the same luminance everywhere.
    """
    peaks = []
    for envmap in (estimate, true):
        values = luminance(envmap)
        if values.max() == values.min():
            return float("nan")
        peaks.append(latlong.directions(*values.shape)[np.unravel_index(values.argmax(), values.shape)])
    return _degrees(peaks[0] @ peaks[1])


def lights_error(estimate: list[dict], true: list[dict], count: int = 5) -> float:
    """Return how far the lights of two maps are from each other, degrees (EnvMapNet, Somanath and Kurz 2021).

    Lights are those of ``lights.json``, the strongest first; ``count`` of either list count, and not more
    than the shorter one has, or two. The angle to the nearest light of the other list: mean over the lights
    of a list, mean of both lists; NaN if there is no light in one of them.
    """
    if not estimate or not true:
        return float("nan")
    count = min(count, max(len(estimate), 2), max(len(true), 2))
    a, b = (_directions(lights[:count]) for lights in (estimate, true))
    angles = _degrees(a @ b.T)
    return float((angles.min(axis=0).mean() + angles.min(axis=1).mean()) / 2)


def irradiance(envmap: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the irradiance (n, 3) under a map (H, W, 3) on planes that face unit vectors (n, 3)."""
    size = envmap.shape[:2]
    light = np.float64(envmap) * latlong.lookup_solid_angles(*size)[:, None, None]
    cosines = np.maximum(latlong.directions(*size) @ normals.T, 0)
    return np.einsum("hwc,hwn->nc", light, cosines)


def irradiance_error(estimate: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the difference of irradiance on planes that face +x, -x, +y, -y, +z, -z, (6,) stops.

    Of luminance; of maps (H, W, 3). 0 where neither map lights a plane, infinite where one does.
    """
    a, b = (luminance(irradiance(envmap, AXES)) for envmap in (estimate, true))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a == b, 0.0, np.log2(a / b))


def _directions(lights):
    theta = np.radians([90 - light["elevation"] for light in lights])
    return latlong.on_sphere(theta, np.radians([light["azimuth"] for light in lights]))


def _degrees(cosine):
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
