"""A light that is put where ``scene/placement`` says lights, rims or shades the place of the picture."""

import numpy as np
import pytest

from envedit.images import images
from envedit.representations.layers.placed_lights import direction
from envedit.scene import placement, scene
from envedit.scene.placement import NoPlaceError
from tests.oracles.builders import AHEAD, LIGHT, RIGHT, SENSOR, UP, write_scene
from tests.unit.test_shadow import FLOOR, SMALL_BALL, on_picture

TURN = '<transform name="to_world"><rotate y="1" angle="70"/></transform>'
TURNED = LIGHT.replace("</emitter>", f"{TURN}</emitter>")
EYE = -AHEAD
FLOOR_POINT = np.array([0.9, -1.0, 0.5])


@pytest.fixture(params=[LIGHT, TURNED], ids=["", "turned"])
def lit(request, tmp_path):
    images.write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32), {})
    return scene.load(write_scene(tmp_path, SENSOR, request.param, FLOOR, SMALL_BALL), width=64)


def on_ball(degrees, bearing=0.0):
    """Return a point of the ball at an angle from the camera's axis, to the right or by a bearing upwards."""
    aside = np.cos(np.radians(bearing)) * RIGHT + np.sin(np.radians(bearing)) * UP
    return 0.5 * (np.cos(np.radians(degrees)) * EYE + np.sin(np.radians(degrees)) * aside)


def in_world(lit, toward):
    return lit.to_world @ toward


def test_a_light_illuminates_along_the_normal_or_aside_of_what_stands_there(lit):
    point = on_ball(30, 60)
    toward = in_world(lit, placement.illuminating(lit, 0, *on_picture(point)))
    assert toward @ point / 0.5 > np.cos(np.radians(0.5))
    below = np.array([0.0, -1.0, 0.45])  # 0.9 below the floor's zenith stands the ball, 27 degrees wide
    toward = in_world(lit, placement.illuminating(lit, 0, *on_picture(below)))
    beside = np.degrees(np.arccos(toward @ -below / np.linalg.norm(below)))
    half = np.degrees(np.arcsin(0.5 / np.linalg.norm(below)))
    assert half < beside < half + placement.CLEARANCE_DEGREES + 4 and toward[1] > 0.7, beside - half


@pytest.mark.parametrize("bearing", [0.0, 90.0, 160.0])
def test_a_rim_light_stands_behind_and_lights_from_the_place_to_the_silhouette(lit, bearing):
    toward = in_world(lit, placement.rimming(lit, 0, *on_picture(on_ball(60, bearing))))
    assert toward @ EYE < -0.5, "not behind"
    lit_from = [degrees for degrees in range(0, 90, 2) if on_ball(degrees, bearing) @ toward > 0]
    assert 60 - 25 < lit_from[0] < 60 and lit_from[-1] == 88


def test_a_shadow_falls_where_it_is_asked_for_from_the_direction_that_is_closest(lit):
    x, y = on_picture(FLOOR_POINT)
    centre = -FLOOR_POINT / np.linalg.norm(FLOOR_POINT)
    half = np.arcsin(0.5 / np.linalg.norm(FLOOR_POINT))
    for light in (direction(200.0, 40.0), direction(300.0, 70.0), None):
        toward = placement.shading(lit, 0, x, y, light)
        point = placement.occluder(lit, 0, x, y, toward)
        assert np.linalg.norm(point) == pytest.approx(0.5, abs=1e-3), "the ball is not in between"
        # ---- Closest: on the great circle from the light to the ball, inside of its outline
        start = np.array([0.0, 1.0, 0.0]) if light is None else in_world(lit, light)
        inside = half - np.arccos(in_world(lit, toward) @ centre)
        assert np.radians(2) < inside < np.radians(placement.COVER_DEGREES + 4)
        away = np.arccos(start @ centre) - np.arccos(start @ in_world(lit, toward))
        assert away > half - np.radians(placement.COVER_DEGREES + 5)
    again = placement.shading(lit, 0, x, y, toward)
    assert again @ toward > np.cos(np.radians(0.1)), "a light that shades the place already stays"


def test_why_a_light_cannot_be_placed_is_said(lit, tmp_path):
    sky = (0.5, 0.02)
    for place in (placement.illuminating, placement.rimming, placement.shading):
        with pytest.raises(NoPlaceError, match="no surface is seen"):
            place(lit, 0, *sky)
    with pytest.raises(NoPlaceError, match="faces the camera"):
        placement.rimming(lit, 0, *on_picture(0.5 * EYE))
    with pytest.raises(NoPlaceError, match="in the way"):
        placement.rimming(lit, 0, *on_picture(on_ball(50, -90)))
    with pytest.raises(NoPlaceError, match="no object stands above"):
        placement.shading(lit, 0, *on_picture(on_ball(20, 90)))
    mirror = '<shape type="sphere"><bsdf type="conductor"/></shape>'
    mirrored = scene.load(write_scene(tmp_path, SENSOR, LIGHT, mirror, name="mirror.xml"), width=64)
    with pytest.raises(NoPlaceError, match="no object stands above"):
        placement.shading(mirrored, 0, 0.5, 0.6)
    with pytest.raises(NoPlaceError, match="only mirrors"):
        placement.illuminating(mirrored, 0, 0.5, 0.5)
