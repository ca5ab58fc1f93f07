"""Camera paths of a scene, traced once without looking at the environment map.

What a map of any content contributes to a picture is decided by three things found here: the surface points
that a pixel sees directly and after further bounces (:class:`Vertex`), and the directions in which its paths
leave the scene (:class:`Escape`).

Sample positions are a rank-1 lattice (R2, Roberts 2018) shifted at random in every pixel, so that the
samples of one pixel are spread evenly and the errors of neighbouring pixels are independent. The index is
permuted anew for every pair of dimensions, otherwise two of them would move together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import flat

# 2^32 divided by the plastic number and by its square: integer overflow takes the fractional part.
_R2 = (0xC13FA9A9, 0x91E10DA5)
_TO_UNIT = 2.0**-32
_MOST_SURVIVAL = 0.95  # of Russian roulette, as Mitsuba's: also a path that nothing absorbs ends


@dataclass
class Vertex:
    """Surface points of one bounce; lane = pixel * paths + path.

    ``bounce`` counts from 1, the point that the camera sees. ``throughput`` is the RGB weight of the path up
    to the point, before its BSDF; lanes that left the scene have zero throughput. ``hit`` is the ray and its
    intersection from which ``si`` was computed, a third of its size.
    """

    bounce: int
    si: mi.SurfaceInteraction3f
    throughput: mi.Color3f
    active: mi.Bool
    hit: tuple[mi.Ray3f, mi.PreliminaryIntersection3f] | None = None


@dataclass
class Escape:
    """Directions in which the paths left the scene after ``bounce`` bounces (0: seen by the camera).

    ``bounce`` is an array where paths were followed beyond the last one. ``pdf`` is the solid-angle density
    of the BSDF sample that chose the direction, infinite for camera rays and specular reflection, which no
    other strategy can sample.
    """

    bounce: int | mi.UInt32
    direction: mi.Vector3f
    throughput: mi.Color3f
    pdf: mi.Float
    active: mi.Bool


def lattice(index: mi.UInt32, scramble: mi.UInt32) -> mi.Point2f:
    """Return point ``index`` of the R2 sequence, shifted by a hash of ``scramble``; in [0, 1)^2."""
    shift = mi.sample_tea_32(scramble, mi.UInt32(0x9E3779B9))
    # float(2^32 - 1) * 2^-32 rounds to 1: stay below.
    limit = 1 - 2.0**-24
    return mi.Point2f(
        dr.minimum(mi.Float(index * _R2[0] + shift[0]) * _TO_UNIT, limit),
        dr.minimum(mi.Float(index * _R2[1] + shift[1]) * _TO_UNIT, limit),
    )


def trace(
    scene: mi.Scene, pixels: np.ndarray, paths: int, bounces: int, seed: int, beyond: bool = False
) -> Iterator[Vertex | Escape]:
    """Trace camera paths and yield, bounce by bounce, where they leave the scene and where they hit it.

    That is the escape of bounce 0, the vertex of bounce 1, the escape of bounce 1, ... the escape of bounce
    ``bounces``; then, with ``beyond``, one escape of all further bounces. Where the scene's integrator hides
    emitters, camera rays pass shapes that are lamps, and those that leave the scene are not active.

    ``pixels`` are indices row * width + column of the pixels to trace, uint32, the views' pictures below each
    other; the views are the scene's sensors. There are ``paths`` camera paths a pixel and ``bounces`` surface
    points along each (Mitsuba's ``max_depth`` - 1); with 0 only camera rays are traced. ``seed`` is that of
    every random choice. With ``beyond`` paths that have not left the scene by then are followed to their end,
    by Russian roulette.
    """
    # ---- One lane for each path, with its own samples
    n = len(pixels) * paths
    lane = dr.arange(mi.UInt32, n)
    pixel = dr.gather(mi.UInt32, dr.opaque(mi.UInt32(pixels.astype(np.uint32))), lane // paths)
    path = lane % paths
    context = mi.BSDFContext()

    def sample(dimension: int) -> mi.Point2f:
        scramble = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, (seed * 1009 + dimension) & 0xFFFFFFFF))[0]
        return lattice(mi.permute_kensler(path, paths, scramble), scramble ^ mi.UInt32(0x5BD1E995))

    # ---- Camera rays
    ray, weight = _camera_rays(scene, pixels, pixel, sample)
    throughput = mi.Color3f(mi.unpolarized_spectrum(weight))
    active = mi.Bool(dr.full(mi.Bool, True, n))
    pdf = dr.full(mi.Float, dr.inf, n)
    hidden = getattr(scene.integrator(), "hide_emitters", False)

    # ---- Bounce by bounce
    for bounce in range(bounces + 1):
        hit = ray, scene.ray_intersect_preliminary(ray, active=active)
        si = hit[1].compute_surface_interaction(ray, mi.RayFlags.All, active)
        if hidden and bounce == 0:
            hit, si = _behind_lamps(scene, hit, si, active)
        dr.eval(si, throughput, pdf, active, ray, hit)
        visible = mi.Bool(bounce > 0 or not hidden)
        yield Escape(bounce, ray.d, throughput, pdf, active & ~si.is_valid() & visible)
        active &= si.is_valid()
        if bounce == bounces:
            if beyond:
                yield _to_their_end(scene, ray, dr.select(active, throughput, 0), bounces, seed)
            break
        yield Vertex(bounce + 1, si, dr.select(active, throughput, 0), mi.Bool(active), hit)
        bs, value = si.bsdf().sample(context, si, sample(3 * bounce + 3).x, sample(3 * bounce + 4), active)
        ray = si.spawn_ray(si.to_world(bs.wo))
        throughput = throughput * mi.Color3f(
            mi.unpolarized_spectrum(si.to_world_mueller(value, -bs.wo, si.wi))
        )
        active &= dr.max(dr.abs(throughput)) > 0
        pdf = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), dr.inf, bs.pdf)


@dr.syntax
def _to_their_end(scene, ray, throughput, bounces, seed):
    """Follow paths from the last ray that met a surface until they leave the scene; returns their Escape.

    A path survives a bounce with the probability of its albedo there, so that throughputs stay as they are.
    """
    random = mi.PCG32(dr.width(ray), dr.opaque(mi.UInt64, seed))
    bounce = dr.opaque(mi.UInt32, bounces)
    active = dr.any(throughput != 0)
    while active:
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bounce = dr.select(active, bounce + 1, bounce)
        lobe = random.next_float32()
        u = mi.Point2f(random.next_float32(), random.next_float32())
        bs, value = si.bsdf().sample(mi.BSDFContext(), si, lobe, u, active)
        value = mi.Color3f(mi.unpolarized_spectrum(value))
        survival = dr.clip(dr.max(value) * dr.square(bs.eta), 0, _MOST_SURVIVAL)
        value = dr.select(random.next_float32() < survival, value / survival, 0)
        throughput = dr.select(active, throughput * value, throughput)
        active &= dr.any(throughput != 0)
        ray = si.spawn_ray(si.to_world(bs.wo))
    return Escape(bounce, ray.d, throughput, mi.Float(dr.inf), mi.Bool(True))


def _behind_lamps(scene, hit, si, active):
    """Return what camera rays meet behind shapes that are lamps."""
    ray, _ = hit
    lamp = active & si.is_valid() & (si.shape.emitter() != None)  # noqa: E711 (an array)
    onwards = si.spawn_ray(ray.d)
    preliminary = scene.integrator().skip_area_emitters(scene, onwards, False, lamp)
    behind = preliminary.compute_surface_interaction(onwards, mi.RayFlags.All, lamp)
    return dr.select(lamp, (onwards, preliminary), hit), dr.select(lamp, behind, si)


def _camera_rays(scene, pixels, pixel, sample):
    """Rays through the footprints of ``pixel``, one a lane, of the views that ``pixels`` lie in."""
    first = 0
    chosen = None
    for sensor in scene.sensors():
        count = int(dr.prod(sensor.film().crop_size()))
        if ((pixels >= first) & (pixels < first + count)).any():
            start = dr.opaque(mi.UInt32, first)
            own = pixel - start if first else pixel
            rays = _rays_of_view(sensor, own, sample)
            # Views come in the order of their pixels: a lane of an earlier one keeps its ray.
            chosen = rays if chosen is None else dr.select(pixel >= start, rays, chosen)
        first += count
    return chosen


def _rays_of_view(sensor, pixel, sample):
    """Rays of one sensor, distributed as its film's reconstruction filter, and their weights."""
    film = sensor.film()
    size = film.crop_size()
    column, row = pixel % size.x, pixel // size.x
    u = sample(0)
    x, weight_x = _filter_offset(film.rfilter(), u.x, column, size.x, film.sample_border())
    y, weight_y = _filter_offset(film.rfilter(), u.y, row, size.y, film.sample_border())
    # Relative to the crop window, as the sensor expects it.
    position = mi.Point2f((mi.Float(column) + x) / size.x, (mi.Float(row) + y) / size.y)
    shutter = sample(2)
    ray, weight = sensor.sample_ray(
        sensor.shutter_open() + sensor.shutter_open_time() * shutter.x, shutter.y, position, sample(1)
    )
    return mi.Ray3f(ray), mi.Color3f(mi.unpolarized_spectrum(weight)) * weight_x * weight_y


def _filter_offset(rfilter, u, index, size, border):
    """Offset in pixels from the pixel's lower corner, drawn from |filter|, and its exact weight.

    The film normalises by the weights of samples that fell inside it, so the filter is cut at the borders of
    the image, unless it samples a ``border`` around it.
    """
    radius = rfilter.radius()
    if rfilter.is_box_filter():
        return u, mi.Float(1)
    knots = np.linspace(-radius, radius, 4097)
    centres = (knots[:-1] + knots[1:]) / 2
    values = np.array(rfilter.eval(flat(mi.Float, np.abs(centres).astype(np.float32)))).astype(np.float64)
    cumulative = np.concatenate([[0], np.cumsum(np.abs(values))])
    signed = np.concatenate([[0], np.cumsum(values)])
    table, signed_table = (dr.opaque(mi.Float(t / cumulative[-1])) for t in (cumulative, signed))
    step = 2 * radius / len(values)

    def at(t, x):
        position = dr.clip((x + radius) / step, 0, len(values))
        i = dr.minimum(mi.UInt32(position), len(values) - 1)
        return dr.lerp(dr.gather(mi.Float, t, i), dr.gather(mi.Float, t, i + 1), position - i)

    low, high = -mi.Float(index) - 0.5, mi.Float(size) - 0.5 - mi.Float(index)
    if border:
        low, high = mi.Float(-radius), mi.Float(radius)
    c0, c1 = at(table, low), at(table, high)
    target = dr.lerp(c0, c1, u)
    i = dr.binary_search(0, len(values), lambda k: dr.gather(mi.Float, table, k) < target)
    i = dr.clip(i, 1, len(values)) - 1
    a, b = dr.gather(mi.Float, table, i), dr.gather(mi.Float, table, i + 1)
    x = -radius + (i + dr.clip((target - a) / dr.maximum(b - a, 1e-20), 0, 1)) * step
    sign = dr.sign(dr.gather(mi.Float, dr.opaque(mi.Float(values)), i))
    return x + 0.5, sign * (c1 - c0) / (at(signed_table, high) - at(signed_table, low))
