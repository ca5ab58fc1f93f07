"""A light that is put where ``scene/placement`` says makes its highlight at the place of the picture."""

import numpy as np
import pytest

from envedit.representations.layers import placed_lights
from envedit.representations.layers.placed_lights import angles
from envedit.scene import placement, scene
from envedit.scene.placement import NoPlaceError
from tests.oracles.builders import AHEAD, BALL, HALF, LIGHT, ORIGIN, RIGHT, SENSOR, UP, write_scene
from tests.oracles.tiers import slow_but
from tests.unit.test_shadow import FLOOR

GLOSSY = {
    "rough": '<bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf>',
    "coated": '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.5"/></bsdf>',
    "glass": '<bsdf type="dielectric"/>',
    "pierced": '<bsdf type="mask"><float name="opacity" value="0.7"/>'
    '<bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf></bsdf>',
}


def ball(folder, bsdf, *more):
    shape = f'<shape type="sphere">{bsdf}</shape>'
    return scene.load(write_scene(folder, SENSOR, LIGHT, shape, *more), width=64)


def mirrored(x, y):
    """Return the reflected direction of the camera of SENSOR on the unit sphere, (3,)."""
    ray = AHEAD + RIGHT * HALF * (2 * x - 1) + UP * HALF * 12 / 16 * (1 - 2 * y)
    ray /= np.linalg.norm(ray)
    along = ORIGIN @ ray
    normal = ORIGIN + ray * (-along - np.sqrt(along**2 - ORIGIN @ ORIGIN + 1))
    return ray - 2 * (ray @ normal) * normal


@pytest.mark.parametrize("kind", slow_but(GLOSSY, *list(GLOSSY)[:1]))
def test_it_is_the_direction_of_the_mirror(kind, tmp_path):
    lit = ball(tmp_path, GLOSSY[kind])
    for place in ((0.45, 0.4), (0.56, 0.45), (0.5, 0.55)):
        off = placement.highlighting(lit, 0, *place) @ mirrored(*place)
        assert np.degrees(np.arccos(min(off, 1.0))) < (0.1 if kind in ("coated", "glass") else 6.0)


@pytest.mark.slow
def test_a_light_that_is_put_there_is_seen_there(tmp_path):
    lit, (x, y) = ball(tmp_path, GLOSSY["rough"]), (0.42, 0.45)
    azimuth, elevation = angles(placement.highlighting(lit, 0, x, y))
    light = {"azimuth": azimuth, "elevation": elevation, "flux": [1.0, 1.0, 1.0], "size": 3.0}
    sky = placed_lights.add(np.full((32, 64, 3), 1e-3, np.float32), [light])
    shown = lit.render(sky, 256).mean(axis=2)
    places = np.argwhere(shown[:, 20:44] > 0.8 * shown[:, 20:44].max()) + [0.5, 20.5]
    assert np.abs(places.mean(axis=0) - [y * 48, x * 64]).max() < 2


@pytest.mark.slow
def test_where_no_light_can_do_it_the_reason_is_told(tmp_path):
    for name in "abc":
        (tmp_path / name).mkdir()
    lit = scene.load(write_scene(tmp_path / "a", SENSOR, LIGHT, BALL), width=32)
    with pytest.raises(NoPlaceError, match="not glossy"):
        placement.highlighting(lit, 0, 0.5, 0.5)
    lit = ball(tmp_path / "b", GLOSSY["rough"], FLOOR)
    with pytest.raises(NoPlaceError, match="another object is reflected"):
        placement.highlighting(lit, 0, 0.5, 0.62)
    placement.highlighting(lit, 0, 0.5, 0.45)
    hidden = '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'
    lit = ball(tmp_path / "c", GLOSSY["coated"], hidden)
    with pytest.raises(NoPlaceError, match="not glossy"):
        placement.highlighting(lit, 0, 0.02, 0.02)
