"""From samples to pixels in a fixed order: the same seed gives the same bits with any number of threads.

Mitsuba's film adds samples with atomics: where a pixel's samples lie with two threads, and wherever a filter
is wider than a pixel, in the order in which the threads come to them; a NaN is dropped silently. Here the
samples of a pixel are one block, summed by one thread in double precision, and blocks of neighbouring pixels
are added in turn. Rays and samples are those of Mitsuba's own loop.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np


def render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int, view: int = 0) -> np.ndarray:
    """Render one sensor of a scene as ``mi.render`` does, with sums in a fixed order.

    ``view`` is the sensor's index; its film gives size, crop and filter. ``integrator`` is a sampling one,
    such as ``path``. There are ``spp`` samples a pixel, or as many more as the sampler needs to fill its
    grid. Returned, as (height, width, 4) float64, are sum f(p - s) L(s) / sum f(p - s), over the samples s
    near a pixel p, f the film's filter; and alpha, the same of samples whose path hits something that is not
    hidden.
    """
    # ---- Sampler and size, with the border that the filter reaches into
    sensor = scene.sensors()[view]
    film = sensor.film()
    rfilter = film.rfilter()
    border = rfilter.border_size() if film.sample_border() else 0
    width, height = (int(n) for n in film.crop_size())
    across, down = width + 2 * border, height + 2 * border
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    sampler.set_samples_per_wavefront(spp)
    count = across * down * spp
    sampler.seed(seed, count)

    # ---- Radiance of every sample
    pixel = dr.arange(mi.UInt32, count) // spp
    corner = mi.Point2f(mi.Float(pixel % across), mi.Float(pixel // across)) - border
    inside = sampler.next_2d()
    channels = _radiance(scene, sensor, integrator, sampler, corner + inside, spp)
    dr.eval(channels, inside)  # the sums below must not trace again

    # ---- Sums over the samples of each pixel, for every neighbour that they count for
    reach = int(np.ceil(rfilter.radius() - 0.5))
    total = np.zeros((down + 2 * reach, across + 2 * reach, 5))
    for row, column in itertools.product(range(2 * reach + 1), repeat=2):
        dx, dy = dr.opaque(mi.Float, reach - column), dr.opaque(mi.Float, reach - row)
        weight = rfilter.eval(inside.x - 0.5 + dx) * rfilter.eval(inside.y - 0.5 + dy)
        planes = []
        for channel in (*channels, mi.Float(1)):
            weighted = dr.select(weight == 0, 0, weight * channel)  # 0 also of an infinite channel
            planes.append(dr.block_sum(mi.Float64(weighted), spp).numpy().reshape(down, across))
        total[row : row + down, column : column + across] += np.stack(planes, axis=-1)
    first = reach + border
    total = total[first : first + height, first : first + width]
    return total[..., :4] / np.where(total[..., 4:] == 0, 1, total[..., 4:])


def _radiance(scene, sensor, integrator, sampler, position, spp):
    """Trace one path a position, in pixels from the crop's corner; returns red, green, blue and alpha."""
    lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(
        time, 0, position / mi.Vector2f(sensor.film().crop_size()), lens
    )
    ray.scale_differential(spp**-0.5)
    radiance, valid, _ = integrator.sample(scene, sampler, ray)
    return *mi.Color3f(mi.unpolarized_spectrum(weight * radiance)), dr.select(valid, mi.Float(1), 0)


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let Dr.Jit work with so many threads."""
    before = dr.thread_count()
    dr.set_thread_count(count)
    try:
        yield
    finally:
        dr.set_thread_count(before)
