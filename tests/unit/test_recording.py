"""Samples of the light transport: those that are not finite, and how samples and path depth are chosen."""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.scene import scene
from envedit.transport import recording, sampling_plan
from envedit.transport.light_transport import LightTransport
from envedit.transport.texel_sampling import Grid
from tests.oracles.scenes import WHITE, ball, stage

NAN, INF = float("nan"), float("inf")


def batch(*values):
    """One batch of contributions to pixels 0, 1, ... and texels 0, 1, ..., as the tracer would yield it."""
    lane = dr.arange(mi.UInt32, len(values))
    return [(1, lane, mi.UInt32(lane), mi.Color3f(np.array(values, np.float32).T))]


def record(monkeypatch, batches):
    monkeypatch.setattr(recording, "contributions", lambda *arguments: iter(batches))
    grid = Grid(4, 8, np.eye(3), np.ones(4))
    return recording.record(None, grid, np.arange(8, dtype=np.uint32), 1, 1, 0)


def test_contributions_that_are_not_finite_are_left_out_and_counted(monkeypatch):
    # One bad channel is enough, whatever the others are: a maximum over channels may hide a NaN.
    bad = [(NAN, 1, 1), (1, NAN, 0), (0, 0, NAN), (INF, 0, 0), (1, 1, -INF)]
    got = record(monkeypatch, batch((1, 2, 3), *bad, (0, 0, 0), (0, 0, 1e-30)) + batch((1, 1, 1), (NAN,) * 3))
    assert got.lost == len(bad) + 1
    np.testing.assert_array_equal(got.pixels, [0, 7])
    np.testing.assert_array_equal(got.texels, [0, 7])
    np.testing.assert_allclose(got.weights, [(2, 3, 4), (0, 0, 1e-30)], rtol=1e-6)
    got = record(monkeypatch, batch((NAN, NAN, NAN), (INF, INF, INF)))
    assert got.lost == 2 and got.weights.shape == (0, 3) and len(got.pixels) == len(got.texels) == 0


@pytest.mark.slow
def test_transport_says_how_many_were_left_out(tmp_path, monkeypatch):
    s = scene.load("matte", 8, 8)
    options = {"spp": 4, "max_depth": 2, "memory_gb": 0.1}
    clean = LightTransport.build(s, 4, 8, **options)
    assert not any("not finite" in line for line in clean.choices)
    real = recording.contributions

    def spoiled(*arguments):
        # Lane 0 of every batch: escape, vertex, escape.
        for bounce, pixel, texel, value in real(*arguments):
            yield bounce, pixel, texel, dr.select(dr.arange(mi.UInt32, len(pixel)) == 0, NAN, value)

    with monkeypatch.context() as patch:
        patch.setattr(recording, "contributions", spoiled)
        t = LightTransport.build(s, 4, 8, folder=tmp_path, **options)
        assert left_out(t) == [3]
        assert left_out(t.recorded_again(1)) == [6]  # another recording: one line still, with the sum
    assert np.isfinite(t.apply(dr.ones(mi.TensorXf, (4, 8, 3))).numpy()).all()
    kept = LightTransport.build(s, 4, 8, folder=tmp_path, **options)
    assert kept.cached and kept.choices == t.choices


def left_out(transport):
    """Return the numbers in the lines about what was not finite."""
    said = [line for line in transport.choices if "not finite" in line]
    return [int(number) for line in said for number in re.findall(r"\b\d+\b", line)]


def test_depth_follows_the_light_by_bounce():
    s = scene.load("matte", 8, 8)
    light = np.zeros(sampling_plan.MAX_BOUNCES + 1)
    light[:4] = 0.5, 0.4, 0.0985, 0.0015
    bounces, (line,) = sampling_plan.choose_bounces(s, "auto", light)
    assert bounces == 2 and "depth 3" in line and "0.15 %" in line
    assert sampling_plan.choose_bounces(s, 4, light) == (3, [])
    light[:] = 1
    assert sampling_plan.choose_bounces(s, "auto", light)[0] == sampling_plan.MAX_BOUNCES
    light[:2] = 0
    for depth, where in ((2, " within path depth 2"), ("auto", "")):
        with pytest.raises(InputError, match=f"no pixel receives light from the environment{where}: check"):
            sampling_plan.choose_bounces(s, depth, light * (depth == 2))


@pytest.mark.slow
def test_depth_error_is_the_share_of_a_rendering_without_bound():
    """In the middle of a long white tube: paths of nine segments lack a part of the picture."""
    eye = mi.ScalarTransform4d().look_at([0, 0, 0], [1, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.9}}
    tube = {"type": "cylinder", "p0": [0, 0, -2], "p1": [0, 0, 2], "radius": 1, "bsdf": white}
    sensor = {"type": "perspective", "fov": 90, "to_world": eye, "film": film}
    s = scene.load({"type": "scene", "sensor": sensor, "tube": tube, "sky": {"type": "constant"}})
    white = np.ones((4, 8, 3), np.float32)
    whole = s.render(white, spp=1024, max_depth=-1).mean(dtype=np.float64)
    for asked, depth in (("auto", sampling_plan.MAX_BOUNCES + 1), (3, 3)):
        t = LightTransport.build(s, 4, 8, spp=64, max_depth=asked, memory_gb=0.1)
        left = 1 - s.render(white, spp=1024, max_depth=depth).mean(dtype=np.float64) / whole
        assert left > 0.05 and t.depth_error == pytest.approx(left, abs=0.01)
        (warning,) = t.warnings
        said = f"paths of more than {depth} segments are left out, which add {100 * t.depth_error:.2g} % of"
        assert said in warning
        enough = int(re.search(r"set \[renderer\] max_depth = (\d+)", warning)[1])
    assert not LightTransport.build(s, 4, 8, spp=4, max_depth=enough, memory_gb=0.1).warnings


def test_rows_share_samples_by_their_light_and_none_gets_nothing():
    sphere = np.array([0.1, 0.4, 0.4, 0.1])
    mass = sampling_plan.row_mass(sphere, np.array([0.4, 0.4, 0.0, 0.0]))
    assert (mass > 0).all()
    # Four times the light per solid angle: twice the samples per solid angle.
    assert mass[0] / sphere[0] == pytest.approx(2 * mass[1] / sphere[1])
    dark = mass[2:] / sphere[2:]
    assert dark[0] == pytest.approx(dark[1]) and dark[0] < mass[1] / sphere[1]


@pytest.mark.parametrize("size", [64, 1024, 2048, 8192])
def test_an_index_into_the_exact_columns_fits_into_32_bits(size):
    class Film:
        width = height = size

    _, capacity, _ = sampling_plan.choose_samples(Film(), "auto", 256 * 128, 1e4)
    assert 4 * (size * size + 7) * capacity < 2**32 and (capacity == 256 or size > 1024)


@pytest.mark.slow
def test_light_of_lamps_is_cut_only_where_a_path_depth_is_asked_for():
    lamp = {"type": "point", "position": [0, 2, 2]}
    s = scene.load(stage(ball(WHITE), film={"width": 8, "height": 8}) | {"lamp": lamp})
    black = dr.zeros(mi.TensorXf, (4, 8, 3))
    for asked, depth in (("auto", -1), (2, 2)):
        t = LightTransport.build(s, 4, 8, spp=4, max_depth=asked, memory_gb=0.1, seed=3)
        np.testing.assert_array_equal(t.apply(black).numpy(), recording.other_light(s, depth, 3))
    assert recording.other_light(s, -1, 3).sum() > 1.01 * recording.other_light(s, 2, 3).sum()
