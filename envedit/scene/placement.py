"""Where a light must stand to illuminate, rim or shade a place of the picture, by rays through the scene."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.scene import shadow
from envedit.scene.camera_paths import NoPlaceError
from envedit.scene.scene import Scene

RAYS = 2048
"""Directions that are tried, spread evenly over the hemisphere above a surface: 3 degrees apart."""
CLEARANCE_DEGREES = 10.0
"""Radius around a direction that should be free of objects, for a light that illuminates."""
COVER_DEGREES = 8.0
"""Likewise that objects should fill, for a shadow: a sun of a texel reaches 6 degrees to each side in a map
64 texels wide. Not measured; an object that is smaller is aimed at in its middle."""
GRAZING_DEGREES = 10.0
"""Angle of a rim light above the tangent plane of the picked place; at 0 it would light what lies beyond."""


def illuminating(scene: Scene, view: int, x: float, y: float) -> np.ndarray:
    """Return the direction from which a light illuminates a place of a view most.

    It maximises cos(angle to the normal) times the share of directions within :data:`CLEARANCE_DEGREES` in
    which no object stands: the shading normal, where nothing is in the way.

    Parameters and return value are those of :func:`.highlight.direction`. NoPlaceError if no surface is seen
    there, it only reflects as a mirror, or no part of the map is seen from it.
    """
    surface, normal, _ = shadow.surface_at(scene, view, x, y)
    scatters = int(mi.BSDFFlags.Diffuse | mi.BSDFFlags.Glossy)
    if not surface.bsdf().flags().numpy()[0] & scatters:
        raise NoPlaceError("the surface only mirrors: use Move highlight")
    toward = np.concatenate([[normal], _hemisphere(normal)])
    free = ~_blocked(scene, surface, toward)
    gain = free * (toward @ normal) * _share_within(toward, free, CLEARANCE_DEGREES)
    if not gain.any():
        raise NoPlaceError("objects stand on all sides: no light of the map reaches the place")
    return scene.to_world.T @ toward[np.argmax(gain)]


def rimming(scene: Scene, view: int, x: float, y: float) -> np.ndarray:
    """Return the direction of a light behind an object that lights its rim up to a place of a view.

    It would lie in the plane of normal and camera, away from the camera, :data:`GRAZING_DEGREES` above the
    tangent plane: what lies between the place and the silhouette faces the light. It is the direction closest
    to that behind the place with no object within :data:`CLEARANCE_DEGREES`, such as a floor.

    Parameters and return value are those of :func:`.highlight.direction`. NoPlaceError if no surface is seen
    there, it faces the camera, or objects are in the way.
    """
    surface, normal, eye = shadow.surface_at(scene, view, x, y)
    grazing = np.radians(GRAZING_DEGREES)
    away = (eye @ normal) * normal - eye  # the tangent away from the camera
    if np.linalg.norm(away) <= np.sin(grazing):
        raise NoPlaceError("the surface faces the camera there: pick a place nearer to the object's outline")
    best = np.cos(grazing) * away / np.linalg.norm(away) + np.sin(grazing) * normal
    toward = np.concatenate([[best], _hemisphere(normal)])
    free = _share_within(toward, ~_blocked(scene, surface, toward), CLEARANCE_DEGREES) == 1
    behind = free & (toward @ eye < 0)
    if not behind.any():
        raise NoPlaceError("objects are in the way of a light behind it: pick another side of its outline")
    return scene.to_world.T @ toward[np.argmax(np.where(behind, toward @ best, -np.inf))]


def shading(scene: Scene, view: int, x: float, y: float, light: np.ndarray | None = None) -> np.ndarray:
    """Return the direction from which a light casts the shadow of an object on a place of a view.

    Of the directions above the horizon in which objects fill all within :data:`COVER_DEGREES`, or most of it
    where nothing fills all, it is the one closest to ``light`` (3,), where the light stands in the frame of
    the map; without it the one closest to the normal.

    Other parameters and the return value are those of :func:`.highlight.direction`. NoPlaceError if no
    surface is seen there, or no object stands above it.
    """
    surface, normal, _ = shadow.surface_at(scene, view, x, y, smooth=False)  # facets do not shade one another
    toward = _hemisphere(normal)
    above = (toward @ scene.to_world[:, 1] > 0) & (toward @ normal > np.sin(np.radians(COVER_DEGREES)))
    covered = above * _share_within(toward, above & _blocked(scene, surface, toward), COVER_DEGREES)
    if not covered.any():
        raise NoPlaceError("no object stands above the place: none can cast a shadow there")
    closeness = toward @ (normal if light is None else scene.to_world @ np.float64(light))
    return scene.to_world.T @ toward[np.argmax(np.where(covered == covered.max(), closeness, -np.inf))]


def _hemisphere(normal):
    """Return :data:`RAYS` directions (n, 3) around a normal: a Fibonacci lattice."""
    k = np.arange(RAYS) + 0.5
    cosine = 1 - k / RAYS
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    frame = mi.Frame3f(mi.Vector3f(normal))
    tangents = np.stack([frame.s.numpy()[:, 0], frame.t.numpy()[:, 0], normal])
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1) @ tangents


def _blocked(scene, surface, toward):
    """Return in which directions (n, 3) from a surface an object stands, (n,)."""
    ray = surface.spawn_ray(mi.Vector3f(toward.T.astype(np.float32)))
    return shadow.first_surfaces(scene, ray, dr.full(mi.Bool, True, len(toward))).is_valid().numpy()


def _share_within(toward, true, degrees):
    """Return the share of directions (n, 3) within an angle of each for which something is true, (n,)."""
    near = np.float64(toward @ toward.T >= np.cos(np.radians(degrees)))
    return (near @ true) / near.sum(axis=1)
