"""Where a light must stand for its highlight to lie at a place of the picture: what is reflected there."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.scene import camera_paths
from envedit.scene.camera_paths import NoPlaceError
from envedit.scene.scene import Scene

PATHS = 256
"""Paths from one place: samples of the glossy lobes that are seen there."""
BOUNCES = 8
"""Most surfaces on a path, such as mirrors that show a glossy surface."""


def direction(scene: Scene, view: int, x: float, y: float) -> np.ndarray:
    """Return the direction of a map from which a light is reflected best into a place of a view.

    Paths from the camera follow glossy and specular reflection only. A path that leaves the scene after
    surfaces of glossy lobes f_i (with cosine) shows prod(f_i) of a small light that stands there, and after
    specular surfaces alone the light itself. The result is the mean of the directions that show at least
    half as much as the best one.

    ``view`` is the index of a sensor of the scene, ``x`` and ``y`` are shares of the picture's width and
    height from the upper left corner. Returns a unit vector (3,) float64 in the frame of the map.
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
    path = dr.arange(mi.UInt32, PATHS)
    context = mi.BSDFContext()
    passed = mi.BSDFFlags.Null
    context.type_mask = int(passed | mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.DeltaReflection)
    ray = camera_paths.rays_through(scene.mi, view, np.tile([x, y], (PATHS, 1)))
    active = dr.full(mi.Bool, True, PATHS)
    value, specular = np.ones(PATHS), np.ones(PATHS, bool)
    bounces, leaves = np.zeros(PATHS, int), np.zeros(PATHS, bool)
    for bounce in range(BOUNCES + 1):
        # ---- The next surface, or none: what the camera sees beside all surfaces may be hidden
        si = scene.mi.ray_intersect(ray, active)
        if bounce or not scene.hide_emitters:
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
