"""The painters of experiments/painted_edits: what they cover, and where the sun of a painted shadow is."""

import numpy as np
import pytest

import envedit
from envedit.representations.layers.separation import separate
from experiments.painted_edits.painters import PAINTERS, SHADOWS, View, turned


@pytest.fixture(scope="module")
def view():
    scene = envedit.load_scene("sphere", width=32, height=32)
    return View(scene, envedit.sunsky(64, azimuth=200, elevation=35))


@pytest.fixture(scope="module")
def picture(view):
    return view.scene.render(view.envmap, spp=64, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("edit", PAINTERS)
def test_what_is_not_covered_is_not_painted(view, picture, edit):
    paint = PAINTERS[edit](view, picture)
    bare = paint.coverage == 0
    assert np.isfinite(paint.picture).all() and (paint.picture >= 0).all() and paint.coverage.min() >= 0
    assert 0.01 < paint.coverage.mean() <= 1 + 1e-9
    if not edit.startswith(("all", "dark")):
        assert bare.mean() > 0.5
    np.testing.assert_allclose(paint.picture[bare], picture[bare], rtol=1e-6)
    assert not np.allclose(paint.picture, picture, rtol=0.02)


@pytest.mark.slow
def test_a_painted_shadow_is_that_of_the_map_turned_for_it(view, picture):
    paint = PAINTERS["shadow moved by 60 degrees"](view, picture)
    moved = np.roll(view.envmap, -round(60 / 360 * 64), axis=1)
    sun = separate(moved).lights[0].direction
    assert np.degrees(np.arccos(sun @ paint.sun)) < 360 / 64  # a texel
    rendered = view.scene.render(moved, spp=64, seed=2)
    floor = view.floor & (paint.coverage > 0.9)
    before, after = (np.abs(one - rendered)[floor].mean() for one in (picture, paint.picture))
    assert after < 0.5 * before


@pytest.mark.slow
def test_without_a_sun_there_is_no_shadow_to_paint(view, picture):
    dull = View(view.scene, np.ones((32, 64, 3), np.float32))
    assert all(painter(dull, picture) is None for painter in SHADOWS.values())


def test_a_direction_is_turned_about_the_vertical_and_lifted():
    np.testing.assert_allclose(turned([0.0, 0.0, 1.0], 90), [1, 0, 0], atol=1e-12)
    found = turned([0.6, 0.8, 0.0], 0, lift=-20)
    assert np.degrees(np.arcsin(found[1])) == pytest.approx(np.degrees(np.arcsin(0.8)) - 20)
