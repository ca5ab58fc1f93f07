"""Regions of a map that are kept, scaled or filled: ``[[input.regions]]``."""

import sys

import numpy as np
import pytest

from envedit import config
from envedit.core import latlong
from envedit.core.errors import ConfigError, MachineError
from envedit.images import map_regions
from envedit.representations.layers.oriented import oriented, oriented_share
from tests.oracles.devices import on_cpu
from tests.oracles.runs import DARKER, at_both_resolutions

SHAPE = 64, 128
WHOLE = [[0.0, -90.0], [360.0, -90.0], [360.0, 90.0], [0.0, 90.0]]


def brush(action, azimuth, elevation, radius, **more):
    return {"action": action, "softness": 0.0, "points": [[azimuth, elevation]], "radius": radius, **more}


def weight(region):
    return map_regions.kept([{"softness": 0.0, **region, "action": "keep"}], *SHAPE)


@pytest.mark.parametrize(("key", "region"), [
    ("action: got none", {}),
    ("got neither of points and polygon", {"action": "keep"}),
    ("radius: got none", {"action": "keep", "points": [[0, 0]]}),
    ("radius: got 0", {"action": "keep", "points": [[0, 0]], "radius": 0}),
    ("points: got .* at most 90", {"action": "keep", "points": [[0, 91]], "radius": 1}),
    ("factor: got none", {"action": "scale", "polygon": WHOLE}),
    ("factor: got .* expected none", {"action": "fill", "polygon": WHOLE, "factor": [1, 1, 1]}),
    ("did you mean polygon", {"action": "keep", "poligon": WHOLE}),
])  # fmt: skip
def test_an_unusable_region_is_named(key, region):
    with pytest.raises(ConfigError, match=rf"input.regions\[1\].*{key}"):
        config.from_dict({"input": {"regions": [{"action": "keep", "polygon": WHOLE}, region]}})


@pytest.mark.parametrize("centre", [(0.0, 0.0), (123.0, 90.0), (10.0, -90.0), (359.9, 40.0)])
def test_a_brush_is_a_cap_of_the_sphere_at_poles_and_seam(centre):
    toward = latlong.directions(*SHAPE)
    polar, azimuth = np.radians([90 - centre[1], centre[0]])
    away = np.degrees(np.arccos(np.clip(toward @ latlong.on_sphere(polar, azimuth), -1, 1)))
    got = weight(brush("keep", *centre, 20.0))
    texel = 180 / (SHAPE[0] - 1)
    assert (got[away < 20 - 1e-6] == 1).all() and (got[away > 20 + texel] == 0).all()


def test_polygons_go_around_and_across_the_edge_and_dots_are_in_the_nearest_texel():
    assert (weight({"polygon": WHOLE}) == 1).all()
    low = weight({"polygon": [[0, -90], [360, -90], [360, -60], [0, -60]]})
    elevation = np.linspace(90, -90, SHAPE[0])
    assert (low[elevation < -60] == 1).all() and (low[elevation > -57] == 0).all()
    here = weight({"polygon": [[350, -20], [370, -20], [370, 20], [350, 20]]})
    there = weight({"polygon": [[170, -20], [190, -20], [190, 20], [170, 20]]})
    assert np.allclose(np.roll(here, SHAPE[1] // 2, axis=1), there, atol=1e-6)
    got = weight(brush("keep", 100.0, 0.0, 0.01))
    assert 0 < got.max() < 1 and np.count_nonzero(got) <= 4


def test_scaling_fades_outside_the_border():
    envmap = np.full((*SHAPE, 3), 65504.0, np.float32)
    region = brush("scale", 90.0, 0.0, 20.0, factor=[0.5, 1.0, 0.0]) | {"softness": 30.0}
    changed = map_regions.changed(envmap, [region])
    inside = weight(region)
    assert (changed[inside == 1] == [32752, 65504, 0]).all() and (inside == 1).any()
    assert np.array_equal(changed[inside == 0], envmap[inside == 0])
    fading = (inside > 0) & (inside < 1)
    assert np.allclose(changed[fading][:, 2], 65504 * (1 - inside[fading]), rtol=1e-5)


@pytest.mark.parametrize(("centre", "radius", "error"), [
    ((0.0, -90.0), 20.0, 0.6), ((0.0, 0.0), 15.0, 0.5), ((123.0, 88.0), 10.0, 0.2),
])  # fmt: skip
def test_a_filling_continues_its_surroundings(centre, radius, error):
    """What was there (1e4) leaves no trace; on a smooth map the hole is guessed to its own variation."""
    pytest.importorskip("cv2")
    toward = latlong.directions(*SHAPE)
    smooth = np.exp(1.5 * toward[..., 1:2] + toward[..., :1] * np.array([1, 0.5, 0.2])).astype(np.float32)
    region = brush("fill", *centre, radius)
    inside = weight(region)
    before = np.where(inside[..., None] > 0, np.float32(1e4), smooth)
    filled = map_regions.changed(before, [region])
    assert np.array_equal(filled[inside == 0], smooth[inside == 0])
    assert np.abs(filled / smooth - 1)[inside == 1].max() < error


def test_a_filling_of_black_and_beside_a_sun_is_finite_and_needs_opencv(monkeypatch):
    pytest.importorskip("cv2")
    region = brush("fill", 100.0, 10.0, 8.0)
    black = np.zeros((*SHAPE, 3), np.float32)
    assert not map_regions.changed(black, [region]).any()
    inside = weight(region)
    bright = np.where(np.roll(inside, 3, axis=1)[..., None] > 0, np.float32([65504] * 3), np.float32(1e-6))
    filled = map_regions.changed(bright, [region])
    assert np.isfinite(filled).all() and filled.min() >= 1e-6 * (1 - 1e-5) and filled.max() <= 65504
    with pytest.raises(ConfigError, match=r"regions\[0\]: covers the whole map"):
        map_regions.changed(bright, [{"action": "fill", "softness": 0.0, "polygon": WHOLE}])
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MachineError, match=r"'.\[inpaint\]'"):
        map_regions.changed(np.ones((*SHAPE, 3), np.float32), [brush("fill", 0.0, 0.0, 9.0)])


@on_cpu
@pytest.mark.slow
@pytest.mark.parametrize(("kind", "tilt"), [("layers", 20), ("pixels", 0)])
def test_what_is_kept_has_the_bits_of_the_input_at_both_resolutions(tmp_path, kind, tilt):
    """Under a target that asks for half the light, all but the region with the sun gets darker."""
    keep = {"action": "keep", "points": [[90, 35]], "radius": 30}
    scale = {"action": "scale", "points": [[270, 35]], "radius": 20, "factor": [2, 2, 2]}
    asked = {"rotate_degrees": 90, "tilt_degrees": tilt, "regions": [keep, scale]}
    tables = DARKER | {"representation": {"kind": kind}}
    wide, settings, result, full = at_both_resolutions(tmp_path, asked, **tables)
    regions, orientation = settings.input.regions, settings.input.orientation
    given = oriented(map_regions.changed(wide, regions), orientation)
    for edited, before in ((result.envmap, result.maps["initial"]), (full, given)):
        kept = oriented_share(map_regions.kept(regions, *edited.shape[:2]), orientation)
        assert (kept == 1).sum() > 20 and np.array_equal(edited[kept == 1], before[kept == 1])
        assert edited[kept == 0].mean() < 0.98 * before[kept == 0].mean(), "what is free does not follow"
    brighter = oriented_share(map_regions.kept([{**regions[1], "action": "keep"}], 64, 128), orientation) == 1
    twice = 2 * oriented(wide, orientation)[brighter]
    assert np.allclose(given[brighter], twice, rtol=0 if tilt == 0 else 0.02)
