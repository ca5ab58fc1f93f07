"""A light that is put where ``scene/placement`` says casts its shadow to the place of the picture."""

import numpy as np
import pytest

from envedit.representations.layers import placed_lights
from envedit.representations.layers.placed_lights import angles, direction
from envedit.scene import placement, scene
from envedit.scene.placement import NoPlaceError
from tests.oracles.builders import AHEAD, BALL, HALF, LIGHT, ORIGIN, RIGHT, SENSOR, UP, write_scene

FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><scale value="50"/>'
    '<rotate x="1" angle="-90"/><translate y="-1"/></transform></shape>'
)
SMALL_BALL = BALL.replace('type="sphere">', 'type="sphere"><float name="radius" value="0.5"/>')
PIERCED = (
    '<shape type="sphere"><float name="radius" value="0.7"/>'
    '<bsdf type="mask"><float name="opacity" value="0.2"/><bsdf type="diffuse"/></bsdf></shape>'
)


@pytest.fixture
def lit(tmp_path):
    return scene.load(write_scene(tmp_path, SENSOR, LIGHT, FLOOR, SMALL_BALL, PIERCED), width=64)


def on_picture(point):
    """Return the place (x, y) at which the camera of SENSOR sees a point."""
    toward = point - ORIGIN
    half = HALF * (toward @ AHEAD)
    return (toward @ RIGHT) / half / 2 + 0.5, 0.5 - (toward @ UP) / half * 16 / 12 / 2


def test_the_occluder_is_found_and_the_light_follows_the_pointer(lit):
    sun = direction(60.0, 40.0)
    ground = -sun / sun[1]  # where the shadow of the ball's middle falls, on the plane y = -1
    point = placement.occluder(lit, 0, *on_picture(ground), sun)
    assert np.linalg.norm(point) == pytest.approx(0.5, abs=1e-3), "not the ball, or what lets light through"
    there = np.array([1.2, -1.0, 0.4])
    toward = placement.shadowing(lit, 0, *on_picture(there), point)
    assert toward @ (point - there) / np.linalg.norm(point - there) > np.cos(np.radians(0.2))


@pytest.mark.slow
def test_a_light_that_is_put_there_casts_its_shadow_there(lit):
    sun = direction(60.0, 40.0)
    point = placement.occluder(lit, 0, *on_picture(-sun / sun[1]), sun)
    x, y = on_picture(np.array([1.0, -1.0, 0.5]))
    azimuth, elevation = angles(placement.shadowing(lit, 0, x, y, point))
    light = {"azimuth": azimuth, "elevation": elevation, "flux": [1.0, 1.0, 1.0], "size": 2.0}
    shown = lit.render(placed_lights.add(np.full((32, 64, 3), 1e-3, np.float32), [light]), 64).mean(axis=2)
    row, column = int(y * 48), int(x * 64)
    assert shown[row, column] < 0.5 * np.median(shown[row]), "the place is in no shadow"


@pytest.mark.slow
def test_where_there_is_no_shadow_the_reason_is_given(lit):
    front = 0.5 * ORIGIN / np.linalg.norm(ORIGIN)
    for place, toward, reason in (
        (on_picture(np.array([1.5, -1.0, 0.0])), direction(240.0, 10.0), "in no shadow"),
        ((0.5, 0.02), direction(240.0, 10.0), "no surface is seen"),
        (on_picture(front), -ORIGIN / np.linalg.norm(ORIGIN), "faces away"),
    ):
        with pytest.raises(NoPlaceError, match=reason):
            placement.occluder(lit, 0, *place, toward)
    with pytest.raises(NoPlaceError, match="no surface is seen"):
        placement.shadowing(lit, 0, 0.5, 0.02, np.zeros(3))
    with pytest.raises(NoPlaceError, match="faces away"):
        placement.shadowing(lit, 0, *on_picture(np.array([1.2, -1.0, 0.0])), np.array([0.0, -2.0, 0.0]))
