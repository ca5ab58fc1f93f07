"""Camera paths: their samples, order, throughput and footprint; and the statistics that judge renderings."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.scene import camera_paths, scene
from tests.oracles.plain import lookup
from tests.oracles.statistics import disagreement, normal_square, student

# ---- statistics (also used by the tests of the renderers) --------------------------------------------------


def test_student_has_the_quantiles_of_the_tables():
    # Two-sided 5 % and 0.1 % points of Student's t (any statistics book).
    t, f = np.array([2.365, 5.408, 2.262, 4.781, 12.706]), [7, 7, 9, 9, 1]
    p = [student(v, n) for v, n in zip(t, f, strict=True)]
    np.testing.assert_allclose(p, [0.05, 0.001, 0.05, 0.001, 0.05], rtol=2e-3)
    z2 = normal_square(np.array([0.05, 0.001, 1.0]))
    np.testing.assert_allclose(z2, [1.96**2, 3.2905**2, 0], atol=1e-3)


def test_comparison_passes_noise_and_sees_a_bias(rng):
    def noise():
        return 1 + 0.1 * rng.standard_normal((8, 24, 24, 3))

    theirs = noise()
    assert disagreement(noise(), theirs) == ""
    # A common bias of 1 % is a tenth of a pixel's sigma: seen in the mean of the picture.
    assert "blocks of 0" in disagreement(noise() * 1.01, theirs)
    one = noise()
    one[:, 5, 5] += 2
    assert "blocks of 1" in disagreement(one, theirs)
    assert "z^2" in disagreement(noise() + 0.1 * rng.standard_normal((24, 24, 1)), theirs)


# ---- samples -----------------------------------------------------------------------------------------------


def test_lattice_is_the_r2_sequence_below_one():
    index = np.concatenate([np.arange(2000), 2**32 - 1 - np.arange(2000)]).astype(np.uint32)
    points = np.array(camera_paths.lattice(mi.UInt32(index), dr.full(mi.UInt32, 7, len(index)))).astype(
        np.float64
    )
    assert (points >= 0).all() and (points < 1).all()
    # Roberts 2018: steps of 1/g and 1/g^2 with g^3 = g + 1. 2000 steps of an error of 2^-33, float32's 2^-24.
    g = np.real(np.roots([1, 0, -1, -1])[0])
    expected = (np.arange(2000)[None] / np.array([[g], [g * g]])) % 1
    difference = (points[:, :2000] - points[:, :1] - expected + 0.5) % 1 - 0.5
    assert np.abs(difference).max() < 2000 * 2.0**-33 + 3 * 2.0**-24


def test_lattice_stays_below_one_at_every_shift():
    # 2^32 - 1 rounds to 2^32 in float32.
    shift = dr.arange(mi.UInt32, 1 << 20)
    points = camera_paths.lattice(dr.full(mi.UInt32, 3, 1 << 20), shift)
    assert dr.max(dr.maximum(points.x, points.y))[0] < 1


def test_lattice_fills_the_square_more_evenly_than_random_points():
    index = mi.UInt32(np.tile(np.arange(256, dtype=np.uint32), 50))
    scramble = mi.UInt32(np.repeat(np.arange(50, dtype=np.uint32), 256))
    points = np.array(camera_paths.lattice(index, scramble)).reshape(2, 50, 256)
    variance = np.mean([np.histogram2d(*points[:, i], 8, [(0, 1)] * 2)[0].var() for i in range(50)])
    assert variance < 0.25 * (256 / 64)  # 256 / 64 for random points (Poisson)
    # Shifts of different pixels are independent: their first points are uniform (mean 1/2 within 5 sigma).
    assert np.abs(points[:, :, 0].mean(axis=1) - 0.5).max() < 5 / np.sqrt(12 * 50)


# ---- tracing -----------------------------------------------------------------------------------------------


def stage(*shapes, film=None, target=(0, 0, 0)):
    to_world = mi.ScalarTransform4d().look_at(origin=[0, 1, 6], target=list(target), up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}} | (film or {})
    sensor = {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}
    objects = {f"shape{i}": shape for i, shape in enumerate(shapes)}
    return scene.load({"type": "scene", "sensor": sensor, "light": {"type": "constant"}, **objects})


def ball(bsdf):
    return {"type": "sphere", "bsdf": bsdf}


WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}


def every_pixel(s):
    return np.arange(s.width * s.height, dtype=np.uint32)


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_trace_yields_escapes_and_vertices_bounce_by_bounce(bounces):
    s = scene.load("matte", 8, 8)
    events = list(camera_paths.trace(s.mi, every_pixel(s), 4, bounces, 0))
    order = [(type(e).__name__, e.bounce) for e in events]
    expected = [("Escape", 0)]
    for b in range(bounces):
        expected += [("Vertex", b + 1), ("Escape", b + 1)]
    assert order == expected
    assert all(len(e.active) == 64 * 4 for e in events)
    # A path either leaves the scene or goes on: grey surfaces absorb none.
    alive = 64 * 4
    for escape, vertex in zip(events[::2], events[1::2], strict=False):
        assert dr.count(escape.active)[0] + dr.count(vertex.active)[0] == alive
        assert not dr.any(escape.active & vertex.active)
        assert dr.all(vertex.active | (dr.max(vertex.throughput) == 0))
        alive = dr.count(vertex.active)[0]


def test_every_path_carries_all_light_of_a_white_furnace():
    s = stage(ball(WHITE))
    total = mi.Color3f(0)
    for event in camera_paths.trace(s.mi, every_pixel(s), 8, 2, 3):
        if isinstance(event, camera_paths.Escape):
            total += dr.select(event.active, event.throughput, 0)
    # A white convex body absorbs nothing and no path meets it twice; a few roundings.
    np.testing.assert_allclose(np.array(total), 1, rtol=1e-5)


def test_density_is_infinite_for_what_only_the_path_can_find():
    s = stage(ball({"type": "conductor", "material": "none"}))
    seen, hit, mirrored, *_ = camera_paths.trace(s.mi, every_pixel(s), 4, 1, 0)
    assert dr.all(dr.isinf(seen.pdf)) and dr.any(hit.active)
    assert dr.all(dr.isinf(mirrored.pdf) | ~mirrored.active)
    np.testing.assert_array_equal(np.array(mirrored.active), np.array(hit.active))
    *_, matte = camera_paths.trace(stage(ball(WHITE)).mi, every_pixel(s), 4, 1, 0)
    pdf = np.array(matte.pdf)[np.array(matte.active)]
    assert (pdf > 0).all() and (pdf <= 1 / np.pi * 1.0001).all()  # cos / pi


def test_same_seed_same_paths_and_another_seed_others():
    s = stage(ball(WHITE))

    def directions(seed):
        seen, *_, scattered = camera_paths.trace(s.mi, every_pixel(s), 4, 1, seed)
        gone = np.array(scattered.active)  # paths that never hit anything have no direction now
        return np.array(seen.direction), np.array(scattered.direction) * gone

    first = directions(5)
    np.testing.assert_array_equal(directions(5), first)
    for other, one in zip(directions(6), first, strict=True):
        assert (other != one).any(axis=0)[one.any(axis=0)].mean() > 0.99
    # All seeds that a configuration may hold, and what is derived from them.
    assert np.isfinite(directions(2**32 - 1)).all()
    assert np.isfinite(directions(1_000_003 * 1000)).all()


def test_pixels_of_a_path_are_those_asked_for():
    s = stage(ball(WHITE))
    whole = list(camera_paths.trace(s.mi, every_pixel(s), 4, 1, 0))[-1]
    some = np.array([200, 3, 77], np.uint32)
    part = list(camera_paths.trace(s.mi, some, 4, 1, 0))[-1]
    lanes = (some[:, None] * 4 + np.arange(4)).ravel()
    np.testing.assert_array_equal(np.array(part.direction), np.array(whole.direction)[:, lanes])


# ---- the footprint of a pixel ------------------------------------------------------------------------------

CROP = {"width": 24, "height": 20}
CROP |= {"crop_offset_x": 7, "crop_offset_y": 3, "crop_width": 14, "crop_height": 13}
FILMS = {
    "box": {"rfilter": {"type": "box"}},
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "wide gaussian": {"rfilter": {"type": "gaussian", "stddev": 1.2}},
    "tent": {"rfilter": {"type": "tent"}},
    "mitchell": {"rfilter": {"type": "mitchell"}},
    "lanczos": {"rfilter": {"type": "lanczos"}},
    "cropped box": CROP,
    "cropped gaussian": CROP | {"rfilter": {"type": "gaussian"}},
    "sampled border": {"rfilter": {"type": "gaussian"}, "sample_border": True},
    "one row": {"width": 40, "height": 1, "rfilter": {"type": "gaussian"}},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILMS)
def test_pixels_see_the_sky_through_the_filter_of_the_film(rng, name):
    # The sky fills the picture and changes from pixel to pixel: a texel is 2.8 degrees wide, a pixel 2.5.
    s = stage(ball(WHITE), film=FILMS[name], target=(0, 4, 0))
    sky = rng.random((64, 128, 3), dtype=np.float32) ** 3
    count = 64

    def ours(seed):
        seen = next(iter(camera_paths.trace(s.mi, every_pixel(s), count, 0, seed)))
        radiance = lookup(sky, np.array(seen.direction).T.astype(np.float64))
        radiance *= np.array(seen.throughput).T * np.array(seen.active)[:, None]
        return radiance.reshape(s.height, s.width, count, 3).mean(axis=2)

    pictures = np.stack([ours(seed) for seed in range(8)])
    # 512 samples: Mitsuba divides by the sum of its random filter weights, which is off by O(1/samples).
    reference = np.stack([s.render(sky, spp=512, seed=seed, max_depth=1) for seed in range(8)])
    # Negative control: the picture moved by a tenth of a pixel.
    moved = 0.9 * pictures + 0.1 * np.roll(pictures, 1, axis=2)
    assert disagreement(pictures, reference) == ""
    assert disagreement(moved, reference) != ""
