"""What other programs take from a run: the scene with its map, formats of the map, its lights."""

import json

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit.core import latlong
from envedit.core.errors import NumericalError
from envedit.core.primaries import ACES_AP1
from envedit.export import light_list
from envedit.images import images
from envedit.maps import looks
from envedit.representations.layers.separation import separate
from tests.oracles import users_scenes
from tests.oracles.builders import BALL
from tests.oracles.runs import TINY, as_toml, call, changed, content, measured, pixels, small_world
from tests.oracles.users_scenes import FLOOR, HIDDEN, LAMP, SEEN, TURN, light

pytestmark = pytest.mark.usefixtures("isolated")


def written(folder, parts, **tables):
    """Write a scene and a configuration of a short run over its own map; returns the configuration."""
    users_scenes.write(folder, parts)
    given = TINY | {"scene": {"file": "scene.xml", "width": 16}, "output": {"spp": 1024}}
    given |= {
        "target": {"spp": 1024, "rotate_degrees": 120.0},
        "renderer": {"spp": 256, "max_depth": 3},
    } | tables
    (folder / "c.toml").write_text(as_toml(given), encoding="utf-8")
    return folder / "c.toml"


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """Return the folder of a run over a scene's own map, with a scale, a lamp, and hidden emitters."""
    folder = tmp_path_factory.mktemp("own")
    path = written(folder, (HIDDEN, SEEN, BALL, FLOOR, LAMP, light(0.55, TURN)))
    with small_world(folder / "cache"):
        assert call(path, "--quiet") == 0
    return folder


@pytest.mark.slow
def test_plain_mitsuba_renders_the_written_scene_as_the_run_judged_it(own):
    out = own / "c_out"
    file = OpenEXR.File(str(out / "render_edited.exr"), separate_channels=True).channels()
    judged = np.stack([file[c].pixels for c in "RGBA"], axis=2)
    theirs = np.array(mi.render(mi.load_file(str(out / "edited.xml")), spp=4096, seed=2))
    assert theirs.shape == judged.shape == (12, 16, 4)
    assert judged.mean() / theirs.mean() == pytest.approx(1, abs=0.01)
    a, b = (p.reshape(3, 4, 4, 4, 4).mean((1, 3)) for p in (judged, theirs))
    assert np.abs(a - b).mean() < 0.02 * b.mean()
    start = np.array(mi.render(mi.load_file(str(own / "scene.xml")), spp=4096, seed=2))
    assert np.abs(theirs - start).mean() > 0.015 * start.mean()  # something was edited
    hidden = judged[..., 3] == 0
    assert 0.05 < hidden.mean() < 0.9 and judged[hidden].max() < 0.05
    assert any("the scene multiplies it by scale 0.55" in line for line in measured(out)["choices"])
    before, after = pixels(own / "own.exr"), pixels(out / "edited.exr")
    assert after[4:].tobytes() == before[4:].tobytes()  # rows that are not active, in the file's units


@pytest.mark.slow
def test_sky_and_lights_add_up_to_the_map(own, rng):
    out = own / "c_out"
    parts = [pixels(out / f"edited_{name}.exr") for name in ("sky", "lights")]
    np.testing.assert_allclose(sum(parts), pixels(out / "edited.exr"), rtol=3e-7)
    lights = json.loads((out / "lights.json").read_text())
    assert set(lights) == {"before", "after"}
    assert {"id", "removed"} <= set(lights["before"][0])
    assert any("light 1 at azimuth" in line for line in measured(out)["choices"])


@pytest.mark.slow
def test_the_stage_and_the_look_of_a_run_are_of_its_scene_and_its_lights(own):
    out = own / "c_out"
    usd = pytest.importorskip("pxr.Usd", reason="usd-core, of the extra dev, is not installed")
    stage = usd.Stage.Open(str(out / "edited.usda"))
    environment = stage.GetPrimAtPath("/Environment")
    dome = stage.GetPrimAtPath("/Environment/Dome")
    assert dome.GetAttribute("inputs:intensity").Get() == pytest.approx(0.55)
    rotation = np.array(dome.GetAttribute("xformOp:transform").Get())[:3, :3].T
    environment.GetVariantSet("lighting").SetVariantSelection("sky_and_lights")
    lights = json.loads((out / "lights.json").read_text())["after"]
    assert len(environment.GetChildren()) == 1 + len(lights) > 1
    for entry in lights:
        azimuth, elevation = np.radians([entry["azimuth"], entry["elevation"]])
        across = np.cos(elevation)
        there = across * np.sin(azimuth), np.sin(elevation), -across * np.cos(azimuth)
        np.testing.assert_allclose(rotation @ there, entry["direction"], atol=1e-6)
    looks.read(out / "look.toml")


def test_lights_are_where_and_as_strong_as_in_the_map():
    """One texel of a known place, against what Mitsuba renders under it on planes that face and lie flat."""
    height, width, row, column = 32, 64, 9, 50
    envmap = np.full((height, width, 3), 0.2, np.float32)
    envmap[row, column] = [900, 600, 300]
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    (found,) = light_list.listed(separate(envmap).lights, envmap.shape[:2], turn)
    d = latlong.directions(height, width)[row, column]
    np.testing.assert_allclose(found["direction"], turn @ d, atol=1e-6)
    assert found["azimuth"] == pytest.approx(360 * (column + 0.5) / width, abs=1e-3)
    assert found["elevation"] == pytest.approx(90 - 180 * row / (height - 1), abs=1e-3)
    omega = latlong.lookup_solid_angles(height, width)[row]
    assert found["solid_angle"] == pytest.approx(omega, rel=1e-6)
    assert 0.5 < found["angle"] / np.degrees(2 * np.sqrt(omega / np.pi)) < 2
    np.testing.assert_allclose(found["flux"], np.array([900, 600, 300]) * omega, rtol=2e-3)
    np.testing.assert_allclose(found["irradiance"], np.array(found["flux"]) * d[1], rtol=1e-6)
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(light_list.split(envmap, separate(envmap).core)[1])}
    eye = mi.ScalarTransform4d().look_at(origin=[0, 5, 0.01], target=[0, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "rgb", "rf": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 1, "to_world": eye, "film": film}
    flat = mi.ScalarTransform4d().rotate([1, 0, 0], -90).scale(3)
    plane = {"type": "rectangle", "to_world": flat, "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    scene = mi.load_dict({"type": "scene", "e": emitter, "s": sensor, "p": plane})
    picture = mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096)
    np.testing.assert_allclose(np.pi * np.array(picture).ravel(), found["irradiance"], rtol=0.02)


# ---- formats -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [6, 16, 300])
def test_radiance_files_hold_every_exponent_to_a_256th(width, tmp_path, rng):
    image = (10 ** rng.uniform(-30, 30, (width // 2, width, 3))).astype(np.float32)
    image[0, :5] = [[0, 0, 0], [1e-45, 0, 0], [3e38, 1, 1], [65504, 0, 1], [255.9999, 1, 1]]
    images.write_hdr(tmp_path / "a.hdr", image)
    for found in (pixels(tmp_path / "a.hdr"), np.array(mi.Bitmap(str(tmp_path / "a.hdr")))):
        largest = np.minimum(image.max(axis=2, keepdims=True), 2.0**127)
        error = np.abs(found - np.minimum(image, 2.0**127 * 255 / 256)) / np.maximum(largest, 1e-38)
        assert error.max() <= 1 / 255.9 and np.isfinite(found).all()
    with pytest.raises(NumericalError, match="not finite"):
        images.write_hdr(tmp_path / "b.hdr", np.full((3, 6, 3), np.nan))


@pytest.mark.parametrize("ending", ["exr", "hdr"])
def test_a_map_whose_colours_mitsuba_takes_for_others_is_named(ending, tmp_path, capsys):
    """Mitsuba knows no primaries of a file; a Radiance file is written in Rec. 709."""
    path = written(tmp_path, (users_scenes.PATH, users_scenes.SENSOR, BALL, light()))
    images.write_exr(tmp_path / "own.exr", pixels(tmp_path / "own.exr"), chromaticities=ACES_AP1)
    quick = changed(target__kind="none", output__exposure=1, output__spp=256, output__format=ending)
    assert call(path, "--quiet", *quick) == 0
    warned = "edited.xml: edited.exr is in ACEScg" in capsys.readouterr().err
    plain = np.array(mi.render(mi.load_file(str(tmp_path / "c_out" / "edited.xml")), spp=256))[..., :3]
    ratio = plain.mean((0, 1)) / pixels(tmp_path / "c_out" / "render_edited.exr").mean((0, 1))
    assert warned == (ending == "exr") == (np.ptp(ratio) > 0.03)


@pytest.mark.slow
def test_a_run_writes_the_format_that_is_asked_for(tmp_path):
    parts = (users_scenes.PATH, users_scenes.SENSOR, BALL, light(2))
    few = {"target": {"spp": 16}, "renderer": {"spp": 16, "max_depth": 2}}
    path = written(tmp_path, parts, output={"spp": 16, "format": "hdr"}, **few)
    kind = changed(representation__kind="pixels")
    assert call(path, "--quiet", "--set", "optimizer.iterations=0", *kind) == 0
    left = content(tmp_path / "c_out")
    assert "edited.hdr" in left and "edited.exr" not in left and b'"edited.hdr"' in left["edited.xml"]
    np.testing.assert_allclose(
        pixels(tmp_path / "c_out" / "edited.hdr"), pixels(tmp_path / "own.exr"), rtol=0.01, atol=0.02
    )
