"""Lights moved, changed or added by hand before an edit, and the map rotated: ``[input]``."""

import numpy as np
import pytest

from envedit import config, inputs
from envedit.config.list_schema import LIGHT_SHAPES
from envedit.core import latlong
from envedit.core.color import LUMINANCE
from envedit.core.errors import ConfigError, InputError
from envedit.core.rotations import Orientation
from envedit.images import images
from envedit.maps.adjusted import Adjustments, adjusted
from envedit.representations.layers import placed_lights
from envedit.representations.layers.oriented import oriented
from envedit.representations.layers.placed_lights import PlacedLights, add, angles, direction
from tests.oracles.devices import on_cpu
from tests.oracles.maps import flux
from tests.oracles.runs import DARKER, at_both_resolutions


@pytest.fixture(scope="module")
def sky():
    return inputs.read_map(config.Input(envmap="sunsky", width=64), None, 64).radiance


def test_directions_and_angles_are_inverse():
    for azimuth, elevation in [(0, 0), (90, 35), (200, -60), (359, 89)]:
        assert angles(direction(azimuth, elevation)) == pytest.approx((azimuth, elevation))
    height, width = 32, 64
    row, column = latlong.texel_position(direction(90, 45), height, width)
    assert (row, column) == (pytest.approx(45 / 180 * 31), pytest.approx(90 / 360 * 64 - 0.5))


@pytest.mark.slow
def test_nothing_asked_changes_no_bit_and_a_map_is_levelled_as_by_envedit_adjust(sky):
    assert PlacedLights(sky).place([]) is sky
    same = PlacedLights(sky).place([{"light": 1, "flux": [1.0] * 3, "size": 1.0}])
    assert np.array_equal(same, sky)
    keys = {"rotate_degrees": 100.0, "tilt_degrees": 8.0, "horizon_degrees": -5.0}
    levelled = inputs.read_map(config.Input(envmap="sunsky", width=64, **keys), None, 64)
    expected, _ = adjusted(sky, Adjustments(turn=100.0, tilt=8.0, horizon=-5.0))
    assert np.array_equal(levelled.radiance, expected) and not np.array_equal(expected, sky)
    assert np.array_equal(levelled.unmoved, sky)


def test_a_light_goes_where_it_is_put_with_its_flux(sky):
    placed = PlacedLights(sky)
    assert len(placed.lights) == 1
    moved = placed.place([{"light": 1, "azimuth": 200.0, "elevation": 50.0, "flux": [1.0] * 3, "size": 1.0}])
    row, column = np.unravel_index(moved.mean(axis=2).argmax(), moved.shape[:2])
    there = latlong.directions(*moved.shape[:2])[row, column]
    assert np.degrees(np.arccos(there @ direction(200, 50))) < 6, "half a texel's diagonal is 4 degrees"
    core = placed.layers.separation.core
    assert np.allclose(flux(np.maximum(moved, 0)), flux(sky), rtol=0.1) and flux(core).min() > 0
    out = placed.place([{"light": 1, "flux": [0.0] * 3, "size": 1.0}])
    assert out.max() < 0.2 * sky.max() and np.isfinite(out).all()


@pytest.mark.parametrize("size", [2.0, 5.0])
def test_a_light_that_grows_is_not_torn_into_rows(size, sky):
    placed = PlacedLights(sky)
    entry = {"light": 1, "flux": [1.0] * 3, "size": size}
    grown = placed.place([entry])
    assert np.allclose(flux(grown), flux(sky), rtol=0.05)
    lights = [placed.params([entry | {"flux": [f] * 3}]) for f in (1.0, 0.0)]
    torn = np.subtract(*(placed.layers.parts(one)[1].numpy() for one in lights))
    whole = grown - placed.place([entry | {"flux": [0.0] * 3}])

    def rises(core):
        """Count rows that are darker than one on either side, and by how much flux."""
        rows = core.sum(axis=(1, 2))
        above, below = np.maximum.accumulate(rows), np.maximum.accumulate(rows[::-1])[::-1]
        return (np.minimum(above, below) - rows).max() / rows.max()

    assert rises(whole) < 0.05 < 0.1 < rises(torn)  # its glow lights the ground, which is darker far away


@on_cpu
@pytest.mark.parametrize("horizon", ["mirror", "keep", "free"])
def test_lights_are_placed_as_without_any_gain(horizon, sky):
    placed = PlacedLights(sky, horizon)
    place = {"azimuth": 200.0, "elevation": 50.0}
    params = placed.params([{"light": 1, "flux": [2.0] * 3, "size": 2.0} | place])
    lights = {name: value for name, value in params.items() if not name.startswith("gain.")}
    assert len(lights) < len(params)
    found, with_gain = (placed.layers.decode(one).numpy() for one in (lights, params))
    assert np.array_equal(found, with_gain) and not np.array_equal(found, sky)


A = np.radians(6)
AREA = {
    "disc": 0.5 * np.pi * A**2,
    "rectangle": 2 * A**2,
    "ring": 0.375 * np.pi * A**2,
    "gradient": A**2,  # times the radiance at its upper side
    "strip": A**2 + np.pi * A**2 / 4,
}
"""Of each shape in steradian, for a size of 6 degrees and an aspect of 1/2, as if the sphere were flat."""


@pytest.mark.parametrize("shape", [one for one in LIGHT_SHAPES if one != "image"])
@pytest.mark.parametrize("softness", [0.0, 1.0])
@pytest.mark.parametrize("elevation", [-90.0, 20.0, 89.9])
def test_a_shape_has_its_flux_its_area_and_its_place(shape, softness, elevation):
    light = {"azimuth": 359.0, "elevation": elevation, "flux": [1.0, 2.0, 3.0], "size": 6.0, "aspect": 0.5}
    light |= {"shape": shape, "softness": softness, "rotation": 30.0}
    for height in (16, 160):
        for size in (0.01, 6.0, 90.0):
            found = add(np.zeros((height, 2 * height, 3), np.float32), [light | {"size": size}])
            assert np.allclose(flux(found), [1, 2, 3], rtol=1e-6) and np.isfinite(found).all()
    if softness == 0 and shape in AREA:
        sharp = add(np.zeros((320, 640, 3), np.float32), [light])
        assert sharp[..., 0].max() == pytest.approx(1 / AREA[shape], rel=0.06)
    fine = latlong.resize(add(np.zeros((192, 384, 3), np.float32), [light | {"size": 30.0}]), 48, 96)
    coarse = add(np.zeros((48, 96, 3), np.float32), [light | {"size": 30.0}])
    omega = latlong.solid_angles(48, 96)[:, None, None]
    assert (omega * np.abs(fine - coarse)).sum() < 0.05 * 6, "another shape at another resolution"


def test_a_disc_of_ninety_degrees_is_a_half_dome():
    light = {"azimuth": 200.0, "elevation": 30.0, "flux": [1.0] * 3, "size": 90.0, "shape": "disc"}
    dome = add(np.zeros((64, 128, 3), np.float32), [light])
    cosine = latlong.directions(64, 128) @ direction(200, 30)
    assert np.allclose(dome[cosine > 0.06], 1 / (2 * np.pi), rtol=2e-3) and not dome[cosine < -0.06].any()


@pytest.mark.parametrize("elevation", [0.0, 60.0, 90.0])
def test_rotation_turns_a_shape_to_the_left_and_softness_moves_no_border(elevation):
    light = {"azimuth": 120.0, "elevation": elevation, "flux": [1.0] * 3, "size": 20.0, "aspect": 0.25}
    light |= {"shape": "rectangle"}
    toward = direction(120, elevation)
    east = direction(210, 0)
    up = np.cross(east, toward)
    for rotation in (0.0, 40.0, -90.0):
        turn = np.radians(rotation)
        longer = np.cos(turn) * east + np.sin(turn) * up
        shorter = np.cos(turn) * up - np.sin(turn) * east
        for softness in (0.0, 0.3, 1.0):
            placed = light | {"rotation": rotation, "softness": softness}
            for axis, half in ((longer, 20.0), (shorter, 5.0)):
                angle = np.radians([half - 0.01, half + 0.01])[:, None]
                around = np.cos(angle) * toward + np.sin(angle) * axis
                border = placed_lights.profile(placed, around, np.radians(0.2))
                assert border.mean() == pytest.approx(0.5, abs=0.02)
                assert (placed_lights.profile(placed, toward, np.radians(0.2)) == 1).all()


@pytest.mark.parametrize("tall", [False, True])
def test_an_image_on_a_light_lies_as_it_is_seen_and_keeps_the_flux(tall, tmp_path):
    """Red at the left, blue at the right, darker below: larger azimuths are at the right."""
    picture = np.zeros((40, 80, 3), np.float32)
    picture[:, :40, 0], picture[:, 40:, 2] = 8, 2
    picture[20:] *= 0.25
    picture = picture.transpose(1, 0, 2)[::-1] if tall else picture  # to the left: red is below, dark right
    images.write_exr(tmp_path / "softbox.exr", picture, panorama=False)
    text = "[input]\n[[input.lights]]\nazimuth = 180\nelevation = 0\nflux = [1, 1, 1]\nsize = 30\n"
    settings = config.loads(text + 'shape = "image"\nimage = "softbox.exr"', tmp_path)
    (light,) = settings.input.lights
    assert light["image"] == str(tmp_path / "softbox.exr")
    found = add(np.zeros((180, 360, 3), np.float32), [light])
    assert flux(found) @ LUMINANCE == pytest.approx(1, rel=1e-6)
    inside = found.sum(axis=2) > 1e-3 * found.max()
    sides = np.count_nonzero(inside[90]), np.count_nonzero(inside[:, 180])
    assert sides == pytest.approx((30, 60) if tall else (60, 30), abs=1)
    brighter = found[100, 173] if tall else found[85, 165]
    darker = found[100, 187] if tall else found[95, 165]
    assert brighter[0] == pytest.approx(4 * darker[0], rel=1e-5) and not brighter[2] > 1e-5 * brighter[0]
    other = found[80, 173] if tall else found[85, 195]
    assert other[2] == pytest.approx(brighter[0] / 4, rel=1e-5)
    for height in (4, 32):
        for size in (0.01, 90.0):
            coarse = add(np.zeros((height, 2 * height, 3), np.float32), [light | {"size": size}])
            assert flux(coarse) @ LUMINANCE == pytest.approx(1, rel=1e-5) and np.isfinite(coarse).all()


def test_images_that_cannot_be_on_a_light_are_named(tmp_path):
    light = {"azimuth": 0, "elevation": 0, "flux": [1, 1, 1]}
    for keys in ({"shape": "image"}, {"image": "a.exr"}, {"shape": "disc", "image": "a.exr"}):
        with pytest.raises(ConfigError, match=r'lights\[0\]: got one of shape = "image" and image = FILE'):
            config.from_dict({"input": {"lights": [light | keys]}})
    images.write_exr(tmp_path / "black.exr", np.zeros((4, 4, 3)), panorama=False)
    for name, says in (("no.exr", "No such file"), ("black.exr", "black.exr: is black")):
        entry = light | {"size": 5.0, "shape": "image", "image": str(tmp_path / name)}
        with pytest.raises(InputError, match=says):
            add(np.zeros((8, 16, 3), np.float32), [entry])


def test_what_the_map_does_not_have_is_told(sky):
    settings = config.Input(envmap="sunsky", width=64, lights=[{"light": 5, "flux": [0, 0, 0]}])
    given = inputs.read_map(settings, None, 64)
    assert (
        placed_lights.missing(settings.lights, 1) == [5]
        and "got light = 5, but the map has" in given.warnings[-1]
    )
    assert np.array_equal(given.radiance, sky)
    two = config.Input(envmap="sunsky", width=64, lights=[{"light": k, "flux": [0, 0, 0]} for k in (5, 7)])
    assert "got light = 5, 7, but" in inputs.read_map(two, None, 64).warnings[-1]


def test_keys_that_cannot_be_are_named():
    for light, said in [
        ({"light": 0}, r"input.lights\[0\].light"),
        ({"light": 1, "elevation": 91, "azimuth": 0}, "elevation"),
        ({"light": 1, "flux": [1, 1, 2e6]}, "flux"),
        ({"flux": [1, 1, 1]}, "azimuth"),
        ({"light": 1, "sise": 2}, "did you mean size"),
        ({"light": 1, "role": "backlight"}, r"lights\[0\].role.*key"),
        ({"light": 1, "shape": "disc"}, "has no key 'shape'"),
        ({"azimuth": 1, "elevation": 2, "flux": [1, 1, 1], "shape": "discs"}, "shape.*did you mean disc"),
        ({"azimuth": 1, "elevation": 2, "flux": [1, 1, 1], "softness": np.nan}, r"lights\[0\].softness"),
        ({"azimuth": 1, "elevation": 2, "flux": [1, 1, 1], "aspect": 0}, r"lights\[0\].aspect"),
    ]:
        with pytest.raises(ConfigError, match=said):
            config.Input(lights=[light])
    text = "input.lights=[{light = 1, flux = [2, 2, 2]}]"
    settings = config.loads("", overrides=[text])
    assert config.loads(config.to_toml(settings)).input.lights == settings.input.lights


@pytest.mark.slow
def test_the_full_map_has_the_same_lights(tmp_path):
    """The map's own resolution against the working one, without a target."""
    moved = {"light": 1, "azimuth": 300, "elevation": 40}
    strip = {"azimuth": 30, "elevation": 20, "flux": [0.3, 0.2, 0.1], "size": 12, "shape": "strip"}
    strip |= {"softness": 0.5, "rotation": 30}
    rotated = {"rotate_degrees": 90, "tilt_degrees": 12, "horizon_degrees": -7}
    asked = rotated | {"lights": [moved, strip]}
    _, _, result, full = at_both_resolutions(tmp_path, asked, target={"kind": "none"})
    assert full.shape == (64, 128, 3)
    small = latlong.resize(full, 32, 64)
    assert np.allclose(flux(full), flux(result.envmap), rtol=0.05)
    sun, shown = (np.unravel_index(m.mean(axis=2).argmax(), m.shape[:2]) for m in (small, result.envmap))
    assert np.abs(np.subtract(sun, shown)).max() <= 1
    toward = Orientation(90, 12, -7).matrix @ direction(300, 40)
    expected = latlong.texel_position(toward, 32, 64)
    assert np.abs(np.subtract(shown, expected)).max() < 1.5


def test_a_muted_light_is_off_and_keeps_its_flux(sky):
    placed = PlacedLights(sky)
    added = {"azimuth": 30.0, "elevation": 20.0, "flux": [1.0] * 3, "size": 6.0}
    off = placed.place([{"light": 1, "flux": [2.0] * 3, "size": 1.0, "muted": True}, added | {"muted": True}])
    assert np.array_equal(off, placed.place([{"light": 1, "flux": [0.0] * 3, "size": 1.0}]))


@on_cpu
@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0, 12])
def test_a_locked_light_is_left_by_the_edit_at_both_resolutions(tilt, tmp_path):
    """Under a target that asks for half the light all but the sun gets darker, also the sky behind it."""
    key = {"light": 1, "name": "key", "locked": True}
    asked = {"rotate_degrees": 90, "tilt_degrees": tilt, "lights": [key]}
    wide, _, result, full = at_both_resolutions(tmp_path, asked, **DARKER)
    rotated = oriented(wide, Orientation(90, tilt))
    for edited, before in ((result.envmap, result.maps["initial"]), (full, rotated)):
        sun = before.mean(axis=2) > 0.5 * before.mean(axis=2).max()
        behind = np.quantile(before[~sun], 0.98, axis=0) / 2
        assert (np.abs(edited - before)[sun] < behind).all(), "more than half the sky behind the sun"
        assert edited[~sun].mean() < 0.9 * before[~sun].mean(), "what is free does not follow"
