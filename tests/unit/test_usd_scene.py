"""The stage that a run leaves: directions and irradiance as the schemas of UsdLux define them."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.export import light_list
from envedit.maps import usd_scene
from envedit.representations.layers.separation import separate

Usd = pytest.importorskip("pxr.Usd", reason="usd-core, of the extra dev, is not installed")
UsdGeom = pytest.importorskip("pxr.UsdGeom")
UsdLux = pytest.importorskip("pxr.UsdLux")
HEIGHT, WIDTH = 32, 64


def stage_of(folder, to_world, scale=1.0):
    envmap = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32)
    envmap[7, 50] = [900, 600, 300]
    envmap[12, 9] = [30, 90, 200]
    lights = light_list.listed(separate(envmap).lights, (HEIGHT, WIDTH), to_world)
    text = usd_scene.text("edited.exr", "edited_sky.exr", lights, to_world, scale)
    (folder / "edited.usda").write_text(text)
    return Usd.Stage.Open(str(folder / "edited.usda")), lights


def in_world(prim, vector):
    return np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim).TransformDir(tuple(vector)))


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_texel_of_the_dome_is_where_it_is_in_the_scene(tmp_path, up):
    turn = np.radians(35)
    about_y = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    to_world = about_y if up == "y" else np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]) @ about_y
    stage, _ = stage_of(tmp_path, to_world, scale=0.5)
    assert UsdGeom.GetStageUpAxis(stage) == up.upper()
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/Environment/Dome"))
    assert dome.GetTextureFileAttr().Get().path == "./edited.exr"
    assert dome.GetTextureFormatAttr().Get() == "latlong"
    assert dome.GetIntensityAttr().Get() == 0.5 and dome.GetExposureAttr().Get() == 0
    for row, column in ((7, 50), (12, 9), (15, 0), (20, 33)):
        # Of the schema: longitude pi at the left edge, 0 towards +z, pi/2 towards +x.
        longitude = np.pi - 2 * np.pi * (column + 0.5) / WIDTH
        latitude = np.pi / 2 - np.pi * row / (HEIGHT - 1)
        across = np.cos(latitude)
        local = across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)
        expected = to_world @ latlong.directions(HEIGHT, WIDTH)[row, column]
        np.testing.assert_allclose(in_world(dome.GetPrim(), local), expected, atol=1e-6)


def test_lights_stand_in_for_those_of_the_map(tmp_path):
    to_world = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    stage, lights = stage_of(tmp_path, to_world)
    environment = stage.GetPrimAtPath("/Environment")
    assert [prim.GetTypeName() for prim in environment.GetChildren()] == ["DomeLight"]
    assert environment.GetVariantSet("lighting").SetVariantSelection("sky_and_lights")
    sky, *lamps = environment.GetChildren()
    assert UsdLux.DomeLight(sky).GetTextureFileAttr().Get().path == "./edited_sky.exr"
    assert len(lamps) == len(lights) == 2
    for prim, light in zip(lamps, lights, strict=True):
        lamp = UsdLux.DistantLight(prim)
        np.testing.assert_allclose(in_world(prim, (0, 0, -1)), -np.array(light["direction"]), atol=1e-6)
        assert lamp.GetAngleAttr().Get() == pytest.approx(light["angle"], rel=1e-6)
        # Normalized, radiance is intensity over pi sin^2 of half the angle: a disc's irradiance, over it.
        assert lamp.GetNormalizeAttr().Get() and lamp.GetExposureAttr().Get() == 0
        irradiance = lamp.GetIntensityAttr().Get() * np.array(lamp.GetColorAttr().Get())
        np.testing.assert_allclose(irradiance, light["flux"], rtol=1e-6)


def test_a_light_at_the_zenith_and_a_map_without_lights(tmp_path):
    light = {"direction": [0.0, 1.0, 0.0], "angle": 1.0, "flux": [0.0, 0.0, 0.0]}
    (tmp_path / "edited.usda").write_text(usd_scene.text("edited.exr", "edited_sky.exr", [light]))
    stage = Usd.Stage.Open(str(tmp_path / "edited.usda"))
    stage.GetPrimAtPath("/Environment").GetVariantSet("lighting").SetVariantSelection("sky_and_lights")
    prim = stage.GetPrimAtPath("/Environment/Light_1")
    np.testing.assert_allclose(in_world(prim, (0, 0, 1)), [0, 1, 0], atol=1e-9)
    assert UsdLux.DistantLight(prim).GetIntensityAttr().Get() == 0
