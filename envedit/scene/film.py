"""From samples to pixels in a fixed order: the same seed gives the same bits with any number of threads.

Mitsuba's film adds samples with atomics: where a pixel's samples lie with two threads, and wherever a filter
is wider than a pixel, in the order in which the threads come to them; a NaN is dropped silently. Here the
samples of a pixel are one block, summed by one thread in double precision. Rays and samples are those of
Mitsuba's own loop.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np


def render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int, view: int = 0) -> np.ndarray:
    """Render one sensor of a scene as ``mi.render`` does, with sums in a fixed order.

    ``view`` is the sensor's index; its film gives size, crop and filter. ``integrator`` is a sampling one,
    such as ``path``. There are ``spp`` samples a pixel, or as many more as the sampler needs to fill its
    grid.

    Returns
    -------
    array (height, width, 4) float64
        sum f(p - s) L(s) / sum f(p - s), over the samples s near a pixel p, f the film's filter; and alpha,
        the same of samples whose path hits something that is not hidden.
    """
    # ---- Sampler and size, with the border that the filter reaches into
    sensor = scene.sensors()[view]
    film = sensor.film()
    rfilter = film.rfilter()
    box = rfilter.is_box_filter()
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

    # ---- Sums over the samples of each pixel, in a fixed order
    if box:
        sums = [
            dr.block_sum(mi.Float64(channel), spp) for channel in (*channels, dr.full(mi.Float, 1, count))
        ]
        total = np.stack([plane.numpy() for plane in sums], axis=-1).reshape(down, across, 5)
        total = total[border : border + height, border : border + width]
    else:
        reach = int(np.ceil(rfilter.radius() - 0.5))
        places = [dr.opaque(mi.Int32, n) for n in (width, across, down, border, reach, spp)]
        pixels = dr.arange(mi.Int32, width * height)
        sums = _filtered(pixels, rfilter, channels, inside.x - 0.5, inside.y - 0.5, *places)
        total = np.stack([plane.numpy() for plane in sums], axis=-1).reshape(height, width, 5)
    return total[..., :4] / np.where(total[..., 4:] == 0, 1, total[..., 4:])


@dr.syntax
def _filtered(pixel, rfilter, channels, x, y, width, across, down, border, reach, spp):
    """Sum the samples around each pixel by the filter: red, green, blue, alpha and weight, Float64.

    ``x`` and ``y`` are the samples' places from the middle of their own pixel.
    """
    row, column = pixel // width + border, pixel % width + border
    red, green, blue, alpha, total = (mi.Float64(0) for _ in range(5))
    dy = mi.Int32(-reach)
    while dy <= reach:
        dx = mi.Int32(-reach)
        while dx <= reach:
            r, c = row + dy, column + dx
            first = (r * across + c) * spp
            k = mi.Int32(0)
            stop = dr.select((r >= 0) & (r < down) & (c >= 0) & (c < across), spp, 0)
            while k < stop:
                i = mi.UInt32(first + k)
                weight = rfilter.eval(dx + dr.gather(mi.Float, x, i)) * rfilter.eval(
                    dy + dr.gather(mi.Float, y, i)
                )
                if weight != 0:
                    red += mi.Float64(weight * dr.gather(mi.Float, channels[0], i))
                    green += mi.Float64(weight * dr.gather(mi.Float, channels[1], i))
                    blue += mi.Float64(weight * dr.gather(mi.Float, channels[2], i))
                    alpha += mi.Float64(weight * dr.gather(mi.Float, channels[3], i))
                    total += mi.Float64(weight)
                k += 1
            dx += 1
        dy += 1
    return red, green, blue, alpha, total


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
