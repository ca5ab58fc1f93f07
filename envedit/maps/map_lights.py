"""The lights of a map as a list, the map as sky and lights, and the irradiance of a map."""

from __future__ import annotations

import math

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.export import light_list
from envedit.representations.layers.separation import Light

IRRADIANCE_WIDTH = 512
"""Most columns of the copy that irradiance is integrated over: a texel's mean cosine then errs by 1e-5."""
AXES = {
    "+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1),
}  # fmt: skip
"""Normals of the surfaces that irradiance is compared on, in the frame of the map: +y is up."""


def listed(lights: list[Light], shape: tuple[int, int], sky: np.ndarray) -> list[dict]:
    """List lights as of :func:`.light_list.listed`, with their ``stops`` over the sky.

    ``shape`` is that of the map, ``sky`` (H, W, 3) the map without its lights, linear radiance. ``stops``:
    log2 of the luminance of the light's irradiance over that of the sky, on a surface that faces the light;
    None under a black sky.
    """
    rows = light_list.listed(lights, shape, np.eye(3))
    if rows:
        of_sky = luminance(irradiance(sky, np.array([row["direction"] for row in rows])))
        for row, value in zip(rows, of_sky, strict=True):
            row["stops"] = stops(float(luminance(row["flux"])), float(value))
    return rows


def irradiance(envmap: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Integrate a map over the hemisphere of each normal: E = sum of L max(n . w, 0) dw.

    ``envmap`` (H, W, 3) is linear radiance, ``normals`` (n, 3) are unit vectors in its frame. Returns (n, 3),
    radiance times steradian.
    """
    height, width = envmap.shape[:2]
    if width > IRRADIANCE_WIDTH:
        height, width = max(round(height * IRRADIANCE_WIDTH / width), 3), IRRADIANCE_WIDTH
    small = latlong.resize(envmap, height, width).astype(np.float64)
    small *= latlong.solid_angles(height, width)[:, None, None]
    cosine = np.maximum(latlong.directions(height, width) @ np.asarray(normals, np.float64).T, 0)
    return np.einsum("hwn,hwc->nc", cosine, small)


def stops(value: float, reference: float) -> float | None:
    """Return log2 of a ratio; None where either is 0, or the ratio is not finite."""
    if not (value > 0 and reference > 0):
        return None
    return math.log2(value) - math.log2(reference)


def split(stored: np.ndarray, cores: list[np.ndarray], lights: list[Light]) -> tuple[np.ndarray, np.ndarray]:
    """Split the values of a file into sky and lights, whose sum in float32 is the file's, bit for bit.

    ``stored`` (H, W, 3) float32 are values in the colours of the file; they become the sky. ``cores`` (n, 3)
    are the radiance of each light in these colours. Sky and lights are as of :func:`.light_list.split`.
    """
    alone = np.zeros_like(stored)
    for core, light in zip(cores, lights, strict=True):
        texels = np.divmod(light.texels, stored.shape[1])  # of a map in any memory layout
        stored[texels], alone[texels] = light_list.split(stored[texels], core)
    return stored, alone
