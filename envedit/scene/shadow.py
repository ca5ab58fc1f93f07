"""Where a light must stand for a shadow to reach a place of the picture: beyond what casts the shadow."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.scene import camera_paths
from envedit.scene.camera_paths import NoPlaceError
from envedit.scene.scene import Scene

NEAR = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)])
"""Pixels around a picked one, in rows, of which one may be in the shadow: its edge is hard to hit."""
PASSED = 16
"""Most surfaces that a ray goes through without being scattered, such as the holes of a mask."""


def occluder(scene: Scene, view: int, x: float, y: float, toward: np.ndarray) -> np.ndarray:
    """Return the point that keeps a light from a place of a view, (3,) float64 in the scene's coordinates.

    It is the first that a ray from there ``toward`` the light, a direction (3,) in the frame of the map,
    hits. Other parameters are those of :func:`.highlight.direction`. NoPlaceError if no surface is seen
    there, it faces away from the light, or nothing is between both.
    """
    rows = scene.rows[view]
    offset = NEAR / [scene.width, rows.stop - rows.start]
    offset = offset[np.argsort(np.abs(NEAR).sum(axis=1), kind="stable")]
    places = np.clip(np.array([x, y]) + offset, 0, 1)
    surfaces = surfaces_seen(scene, view, places)
    ahead = mi.Vector3f(scene.to_world @ np.float64(toward))
    facing = surfaces.is_valid() & (
        dr.dot(surfaces.n, ahead) * dr.dot(surfaces.n, surfaces.to_world(surfaces.wi)) > 0
    )
    hit = first_surfaces(scene, surfaces.spawn_ray(ahead), facing)
    blocked = hit.is_valid().numpy()
    if blocked.any():
        return hit.p.numpy().T[int(np.argmax(blocked))].astype(np.float64)
    if not surfaces.is_valid().numpy()[0]:
        raise NoPlaceError("no surface is seen there")
    if not facing.numpy()[0]:
        raise NoPlaceError("the surface faces away from the light there: pick a shadow that is cast")
    raise NoPlaceError("the place is in no shadow of the light")


def direction(scene: Scene, view: int, x: float, y: float, point: np.ndarray) -> np.ndarray:
    """Return where a light must stand for the shadow of a point to lie at a place of a view.

    ``point`` (3,) is what :func:`occluder` returned; other parameters and the return value are those of
    :func:`.highlight.direction`. NoPlaceError if no surface is seen there, or it faces away from the point.
    """
    surface, normal, _ = surface_at(scene, view, x, y, smooth=False)
    toward = np.float64(point) - surface.p.numpy()[:, 0]
    if toward @ normal <= 0:
        raise NoPlaceError("the surface faces away from what casts the shadow")
    light = scene.to_world.T @ toward
    return light / np.linalg.norm(light)


def surface_at(
    scene: Scene, view: int, x: float, y: float, smooth: bool = True
) -> tuple[mi.SurfaceInteraction3f, np.ndarray, np.ndarray]:
    """Return the surface at a place, its normal on the camera's side, and the direction of the camera, (3,).

    ``smooth``: the shading normal, not that of the facet. NoPlaceError if no surface is seen there.
    """
    surface = surfaces_seen(scene, view, np.array([[x, y]]))
    if not surface.is_valid().numpy()[0]:
        raise NoPlaceError("no surface is seen there")
    vectors = surface.sh_frame.n if smooth else surface.n, surface.to_world(surface.wi)
    normal, eye = (vector.numpy()[:, 0].astype(np.float64) for vector in vectors)
    return surface, normal * (1.0 if normal @ eye >= 0 else -1.0), eye


def surfaces_seen(scene: Scene, view: int, places: np.ndarray) -> mi.SurfaceInteraction3f:
    """Return the surfaces that are seen at places (n, 2) of a view, as shares of its width and height."""
    ray = camera_paths.rays_through(scene.mi, view, places)
    return first_surfaces(scene, ray, dr.full(mi.Bool, True, len(places)))


def first_surfaces(scene: Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """Return the first surfaces on rays that do more than let light through."""
    surfaces = scene.mi.ray_intersect(ray, active)
    for _ in range(PASSED):
        bsdf = surfaces.bsdf()
        alone = dr.mean(mi.Color3f(mi.unpolarized_spectrum(bsdf.eval_null_transmission(surfaces, active))))
        through = active & surfaces.is_valid() & (alone > 0.5)
        if not dr.any(through):
            break
        ray = dr.select(through, surfaces.spawn_ray(ray.d), ray)
        surfaces = dr.select(through, scene.mi.ray_intersect(ray, through), surfaces)
    return surfaces
