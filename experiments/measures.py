"""Measures of maps that several experiments share: display values, directions, lights, irradiance."""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance, tonemap
from envedit.losses import metrics

AXES = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
"""Normals of planes: +x, -x, +y, -y, +z, -z."""
SAME = 120.0
"""PSNR from which two maps are taken to be the same, dB."""


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the PSNR of display values of two images of linear radiance; at most :data:`SAME`."""
    return min(SAME, metrics.psnr(tonemap(np.float64(a)), tonemap(np.float64(b))))


# ---- Directions --------------------------------------------------------------------------------------------


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between unit vectors, of the product ``a @ b``."""
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


def brightest(envmap: np.ndarray) -> np.ndarray:
    """Return the direction of the brightest texel of a map (H, W, 3), a unit vector (3,)."""
    return latlong.directions(*envmap.shape[:2])[metrics.peak_position(envmap)]


def peak_error(estimate: np.ndarray, true: np.ndarray) -> float:
    """Return the angle between the brightest texels of two maps (H, W, 3), degrees.

    NaN if a map has the same luminance everywhere.
    """
    if any(np.ptp(luminance(envmap)) == 0 for envmap in (estimate, true)):
        return float("nan")
    return float(degrees(brightest(estimate), brightest(true)))


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
    angles = degrees(a, b.T)
    return float((angles.min(axis=0).mean() + angles.min(axis=1).mean()) / 2)


def _directions(lights):
    theta = np.radians([90 - light["elevation"] for light in lights])
    return latlong.on_sphere(theta, np.radians([light["azimuth"] for light in lights]))


# ---- Irradiance --------------------------------------------------------------------------------------------


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
