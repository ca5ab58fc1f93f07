"""A light that is put where ``scene/placement`` says lights, shades or shines at the place of the picture."""

import numpy as np
import pytest

from envedit.representations.layers import placed_lights
from envedit.representations.layers.placed_lights import angles, direction
from envedit.scene import placement, scene
from envedit.scene.placement import NoPlaceError
from tests.oracles.builders import AHEAD, BALL, HALF, LIGHT, ORIGIN, RIGHT, SENSOR, UP, write_scene
from tests.oracles.users_scenes import HIDDEN

FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><scale value="50"/>'
    '<rotate x="1" angle="-90"/><translate y="-1"/></transform></shape>'
)
SMALL_BALL = BALL.replace('type="sphere">', 'type="sphere"><float name="radius" value="0.5"/>')
PIERCED = (
    '<shape type="sphere"><float name="radius" value="0.7"/>'
    '<bsdf type="mask"><float name="opacity" value="0.2"/><bsdf type="diffuse"/></bsdf></shape>'
)
TURN = '<transform name="to_world"><rotate y="1" angle="70"/></transform>'
TURNED = LIGHT.replace("</emitter>", f"{TURN}</emitter>")
EYE = -AHEAD
FLOOR_POINT = np.array([0.9, -1.0, 0.5])


def on_picture(point):
    """Return the place (x, y) at which the camera of SENSOR sees a point."""
    toward = point - ORIGIN
    half = HALF * (toward @ AHEAD)
    return (toward @ RIGHT) / half / 2 + 0.5, 0.5 - (toward @ UP) / half * 16 / 12 / 2


@pytest.fixture(params=[LIGHT, TURNED], ids=["", "turned"])
def lit(request, tmp_path):
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


# ---- shadows ----------------------------------------------------------------------------------------------


@pytest.fixture
def shaded(tmp_path):
    return scene.load(write_scene(tmp_path, SENSOR, LIGHT, FLOOR, SMALL_BALL, PIERCED), width=64)


def test_the_occluder_is_found_and_the_light_follows_the_pointer(shaded):
    sun = direction(60.0, 40.0)
    ground = -sun / sun[1]  # where the shadow of the ball's middle falls, on the plane y = -1
    point = placement.occluder(shaded, 0, *on_picture(ground), sun)
    assert np.linalg.norm(point) == pytest.approx(0.5, abs=1e-3), "not the ball, or what lets light through"
    there = np.array([1.2, -1.0, 0.4])
    toward = placement.shadowing(shaded, 0, *on_picture(there), point)
    assert toward @ (point - there) / np.linalg.norm(point - there) > np.cos(np.radians(0.2))


@pytest.mark.slow
def test_a_light_that_is_put_there_casts_its_shadow_there(shaded):
    sun = direction(60.0, 40.0)
    point = placement.occluder(shaded, 0, *on_picture(-sun / sun[1]), sun)
    x, y = on_picture(np.array([1.0, -1.0, 0.5]))
    azimuth, elevation = angles(placement.shadowing(shaded, 0, x, y, point))
    light = {"azimuth": azimuth, "elevation": elevation, "flux": [1.0, 1.0, 1.0], "size": 2.0}
    shown = shaded.render(placed_lights.add(np.full((32, 64, 3), 1e-3, np.float32), [light]), 64).mean(axis=2)
    row, column = int(y * 48), int(x * 64)
    assert shown[row, column] < 0.5 * np.median(shown[row]), "the place is in no shadow"


@pytest.mark.slow
def test_where_there_is_no_shadow_the_reason_is_given(shaded):
    front = 0.5 * ORIGIN / np.linalg.norm(ORIGIN)
    for place, toward, reason in (
        (on_picture(np.array([1.5, -1.0, 0.0])), direction(240.0, 10.0), "in no shadow"),
        ((0.5, 0.02), direction(240.0, 10.0), "no surface is seen"),
        (on_picture(front), -ORIGIN / np.linalg.norm(ORIGIN), "faces away"),
    ):
        with pytest.raises(NoPlaceError, match=reason):
            placement.occluder(shaded, 0, *place, toward)
    with pytest.raises(NoPlaceError, match="no surface is seen"):
        placement.shadowing(shaded, 0, 0.5, 0.02, np.zeros(3))
    with pytest.raises(NoPlaceError, match="faces away"):
        placement.shadowing(shaded, 0, *on_picture(np.array([1.2, -1.0, 0.0])), np.array([0.0, -2.0, 0.0]))


# ---- highlights -------------------------------------------------------------------------------------------

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


@pytest.mark.parametrize("kind", GLOSSY)
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
    lit = ball(tmp_path / "c", GLOSSY["coated"], HIDDEN)
    with pytest.raises(NoPlaceError, match="not glossy"):
        placement.highlighting(lit, 0, 0.02, 0.02)
