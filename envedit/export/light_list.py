"""The lights of a map as a list, for programs that take the sun as a lamp and the sky as a map.

The lights are those that :mod:`.separation` tells from the background, of any map, however it was edited.
Radiance is what reaches the scene, ``scale`` included.
"""

from __future__ import annotations

import math

import numpy as np

from envedit.core import latlong
from envedit.representations.layers.separation import Separation, separate


def split(envmap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split a map (H, W, 3) into its sky, without lights but with their glow, and its lights.

    Returns
    -------
    sky, lights : ndarray (H, W, 3) float32
        Not negative; their sum is the map, to rounding. Where there is no light the sky has the map's bits.
    """
    core = separate(envmap).core
    lights = np.minimum(core, envmap).astype(np.float32)
    return np.where(lights > 0, envmap - lights, envmap).astype(np.float32), lights


def listed(envmap: np.ndarray, to_world: np.ndarray) -> list[dict]:
    """List the lights of a map, those with most flux first.

    Parameters
    ----------
    envmap : ndarray (H, W, 3)
        Linear radiance that reaches the scene.
    to_world : ndarray (3, 3)
        Rotation from the map's frame (+y up) to the scene's.

    Returns
    -------
    list of dict
        ``azimuth`` and ``elevation`` in degrees: the light is at column azimuth / 360 W - 1/2 and row
        (90 - elevation) / 180 (H - 1). ``direction``: unit vector towards it in the scene.
        ``solid_angle``: of its texels, steradian. ``angle``: degrees across a disc of that solid angle.
        ``flux``: integral of its radiance over its solid angle, RGB; this is its irradiance on a surface
        that faces it. ``irradiance``: on the horizontal plane of the map, flux max(sin(elevation), 0).
    """
    found: Separation = separate(envmap)
    height, width, _ = envmap.shape
    omega = latlong.lookup_solid_angles(height, width)
    lights = []
    for light in found.lights:
        weight = omega[light.texels // width]
        flux = (np.float64(light.radiance) * weight[:, None]).sum(axis=0)
        solid = float(weight.sum())
        x, y, z = light.direction
        elevation = math.atan2(y, math.hypot(x, z))
        lights.append(
            {
                "azimuth": math.degrees(math.atan2(x, -z)) % 360,
                "elevation": math.degrees(elevation),
                "direction": (np.asarray(to_world, np.float64) @ light.direction).tolist(),
                "solid_angle": solid,
                "angle": 2 * math.degrees(math.acos(max(1 - solid / (2 * math.pi), -1))),
                "flux": flux.tolist(),
                "irradiance": (flux * max(math.sin(elevation), 0)).tolist(),
            }
        )
    return sorted(lights, key=lambda light: -sum(light["flux"]))
