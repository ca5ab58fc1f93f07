"""Where a light must stand for what is asked for at a place of the picture: light, a highlight, a shadow.

A place is given by ``view``, the index of a sensor of the scene, and by ``x`` and ``y``, shares of the
picture's width and height from the upper left corner. Directions that are returned are unit vectors (3,)
float64 in the frame of the map.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat
from envedit.scene import camera_paths
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
HIGHLIGHT_PATHS = 256
"""Paths from one place: samples of the glossy lobes that are seen there."""
HIGHLIGHT_BOUNCES = 8
"""Most surfaces on a path, such as mirrors that show a glossy surface."""
NEAR = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)])
"""Pixels around a picked one, in rows, of which one may be in the shadow: its edge is hard to hit."""
PASSED = 16
"""Most surfaces that a ray goes through without being scattered, such as the holes of a mask."""


class NoPlaceError(ValueError):
    """No light makes what is asked for at a place of a picture; the text says why."""


# ---- Light -------------------------------------------------------------------------------------------------


def illuminating(scene: Scene, view: int, x: float, y: float) -> np.ndarray:
    """Return the direction from which a light illuminates a place of a view most.

    It maximises cos(angle to the normal) times the share of directions within :data:`CLEARANCE_DEGREES` in
    which no object stands: the shading normal, where nothing is in the way.

    NoPlaceError if no surface is seen there, it only reflects as a mirror, or no part of the map is seen from
    it.
    """
    surface, normal, _ = _surface_at(scene, view, x, y)
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

    NoPlaceError if no surface is seen there, it faces the camera, or objects are in the way.
    """
    surface, normal, eye = _surface_at(scene, view, x, y)
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

    NoPlaceError if no surface is seen there, or no object stands above it.
    """
    surface, normal, _ = _surface_at(scene, view, x, y, smooth=False)  # facets do not shade one another
    toward = _hemisphere(normal)
    above = (toward @ scene.to_world[:, 1] > 0) & (toward @ normal > np.sin(np.radians(COVER_DEGREES)))
    covered = above * _share_within(toward, above & _blocked(scene, surface, toward), COVER_DEGREES)
    if not covered.any():
        raise NoPlaceError("no object stands above the place: none can cast a shadow there")
    closeness = toward @ (normal if light is None else scene.to_world @ np.float64(light))
    return scene.to_world.T @ toward[np.argmax(np.where(covered == covered.max(), closeness, -np.inf))]


# ---- Highlights --------------------------------------------------------------------------------------------


def highlighting(scene: Scene, view: int, x: float, y: float) -> np.ndarray:
    """Return the direction of a map from which a light is reflected best into a place of a view.

    Paths from the camera follow glossy and specular reflection only. A path that leaves the scene after
    surfaces of glossy lobes f_i (with cosine) shows prod(f_i) of a small light that stands there, and after
    specular surfaces alone the light itself. The result is the mean of the directions that show at least
    half as much as the best one.

    NoPlaceError if what is seen there is not glossy, or reflects mostly another object.
    """
    value, specular, bounces, leaves, toward = _followed(scene, view, x, y)
    reflected = bounces > 0
    if not reflected.any():
        reflected = leaves  # the map itself is seen there
    if not reflected.any():
        raise NoPlaceError("the surface is not glossy there: no light makes a highlight")
    if specular[reflected].any():
        reflected &= specular
    lobe = reflected & (value >= 0.5 * value[reflected].max())
    if 2 * np.count_nonzero(lobe & leaves) < np.count_nonzero(lobe):
        raise NoPlaceError("another object is reflected there: no light makes a highlight")
    mean = scene.to_world.T @ toward[lobe & leaves].mean(axis=0)
    return mean / np.linalg.norm(mean)


def _followed(scene, view, x, y):
    """Follow paths by glossy and specular reflection, and return arrays with an entry a path.

    They are prod(f_i), with the reflectance of specular surfaces; whether all surfaces are specular; how many
    reflect; whether the path leaves the scene, and does not end at a surface that is not glossy; and its last
    direction in the world, (paths, 3).
    """
    path = dr.arange(mi.UInt32, HIGHLIGHT_PATHS)
    context = mi.BSDFContext()
    passed = mi.BSDFFlags.Null
    context.type_mask = int(passed | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.DeltaReflection)
    ray = _rays_through(scene.mi, view, np.tile([x, y], (HIGHLIGHT_PATHS, 1)))
    active = dr.full(mi.Bool, True, HIGHLIGHT_PATHS)
    value, specular = np.ones(HIGHLIGHT_PATHS), np.ones(HIGHLIGHT_PATHS, bool)
    bounces, leaves = np.zeros(HIGHLIGHT_PATHS, int), np.zeros(HIGHLIGHT_PATHS, bool)
    for bounce in range(HIGHLIGHT_BOUNCES + 1):
        # ---- The next surface, or none: what the camera sees beside all surfaces may be hidden
        si = scene.mi.ray_intersect(ray, active)
        if bounce or not scene.integrator.hide_emitters:
            leaves |= (active & ~si.is_valid()).numpy()
        active &= si.is_valid()

        # ---- A glossy, specular or null sample there; some BSDFs sample other lobes although not asked to
        lobe_sample, direction_sample = (
            camera_paths.lattice(path, dr.opaque(mi.UInt32, 2 * bounce + k)) for k in range(2)
        )
        bs, weight = si.bsdf().sample(context, si, lobe_sample.x, direction_sample, active)
        weight = dr.mean(mi.Color3f(mi.unpolarized_spectrum(weight)))
        active &= ((bs.sampled_type & context.type_mask) != 0) & (weight > 0)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | mi.has_flag(bs.sampled_type, passed)
        factor = weight * dr.select(delta, 1, bs.pdf)
        ray = dr.select(active, si.spawn_ray(si.to_world(bs.wo)), ray)
        dr.eval(ray, active, factor)
        goes_on = active.numpy()
        value = np.where(goes_on, value * factor.numpy(), value)
        specular &= ~goes_on | delta.numpy()
        bounces += goes_on & ~mi.has_flag(bs.sampled_type, passed).numpy()
    return value, specular, bounces, leaves, ray.d.numpy().T.astype(np.float64)


# ---- Shadows -----------------------------------------------------------------------------------------------


def occluder(scene: Scene, view: int, x: float, y: float, toward: np.ndarray) -> np.ndarray:
    """Return the point that keeps a light from a place of a view, (3,) float64 in the scene's coordinates.

    It is the first that a ray from there ``toward`` the light, a direction (3,) in the frame of the map,
    hits. The place is as of the module. NoPlaceError if no surface is seen there, it faces away from the
    light, or nothing is between both.
    """
    rows = scene.rows[view]
    offset = NEAR / [scene.width, rows.stop - rows.start]
    offset = offset[np.argsort(np.abs(NEAR).sum(axis=1), kind="stable")]
    places = np.clip(np.array([x, y]) + offset, 0, 1)
    surfaces = _surfaces_seen(scene, view, places)
    ahead = mi.Vector3f(scene.to_world @ np.float64(toward))
    facing = surfaces.is_valid() & (
        dr.dot(surfaces.n, ahead) * dr.dot(surfaces.n, surfaces.to_world(surfaces.wi)) > 0
    )
    hit = _first_surfaces(scene, surfaces.spawn_ray(ahead), facing)
    blocked = hit.is_valid().numpy()
    if blocked.any():
        return hit.p.numpy().T[int(np.argmax(blocked))].astype(np.float64)
    if not surfaces.is_valid().numpy()[0]:
        raise NoPlaceError("no surface is seen there")
    if not facing.numpy()[0]:
        raise NoPlaceError("the surface faces away from the light there: pick a shadow that is cast")
    raise NoPlaceError("the place is in no shadow of the light")


def shadowing(scene: Scene, view: int, x: float, y: float, point: np.ndarray) -> np.ndarray:
    """Return where a light must stand for the shadow of a point to lie at a place of a view.

    ``point`` (3,) is what :func:`occluder` returned; place and direction are as of the module. NoPlaceError
    if no surface is seen there, or it faces away from the point.
    """
    surface, normal, _ = _surface_at(scene, view, x, y, smooth=False)
    toward = np.float64(point) - surface.p.numpy()[:, 0]
    if toward @ normal <= 0:
        raise NoPlaceError("the surface faces away from what casts the shadow")
    light = scene.to_world.T @ toward
    return light / np.linalg.norm(light)


# ---- Rays --------------------------------------------------------------------------------------------------


def _rays_through(scene: mi.Scene, view: int, places: np.ndarray) -> mi.Ray3f:
    """Return the camera's rays through places (n, 2) of a view, as shares of its width and height."""
    sensor = scene.sensors()[view]
    place = mi.Point2f(*(flat(mi.Float, np.float32(share)) for share in places.T))
    return mi.Ray3f(sensor.sample_ray(mi.Float(sensor.shutter_open()), 0.5, place, mi.Point2f(0.5))[0])


def _surface_at(
    scene: Scene, view: int, x: float, y: float, smooth: bool = True
) -> tuple[mi.SurfaceInteraction3f, np.ndarray, np.ndarray]:
    """Return the surface at a place, its normal on the camera's side, and the direction of the camera, (3,).

    ``smooth``: the shading normal, not that of the facet. NoPlaceError if no surface is seen there.
    """
    surface = _surfaces_seen(scene, view, np.array([[x, y]]))
    if not surface.is_valid().numpy()[0]:
        raise NoPlaceError("no surface is seen there")
    vectors = surface.sh_frame.n if smooth else surface.n, surface.to_world(surface.wi)
    normal, eye = (vector.numpy()[:, 0].astype(np.float64) for vector in vectors)
    return surface, normal * (1.0 if normal @ eye >= 0 else -1.0), eye


def _surfaces_seen(scene: Scene, view: int, places: np.ndarray) -> mi.SurfaceInteraction3f:
    """Return the surfaces that are seen at places (n, 2) of a view, as shares of its width and height."""
    ray = _rays_through(scene.mi, view, places)
    return _first_surfaces(scene, ray, dr.full(mi.Bool, True, len(places)))


def _first_surfaces(scene: Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
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
    return _first_surfaces(scene, ray, dr.full(mi.Bool, True, len(toward))).is_valid().numpy()


def _share_within(toward, true, degrees):
    """Return the share of directions (n, 3) within an angle of each for which something is true, (n,)."""
    near = np.float64(toward @ toward.T >= np.cos(np.radians(degrees)))
    return (near @ true) / near.sum(axis=1)
