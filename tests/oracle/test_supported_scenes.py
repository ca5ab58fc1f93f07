"""Scenes as users have them, against plain Mitsuba: the file as it is, rendered by ``mi.load_file``."""

import mitsuba as mi
import numpy as np
import pytest

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.errors import ConfigError, InputError, NumericalError
from envedit.images import images
from envedit.scene import scene
from envedit.transport.light_transport import LightTransport
from tests.oracles import ROOT, users_scenes
from tests.oracles.builders import BALL, SENSOR, sky, write_scene
from tests.oracles.users_scenes import CONSTANT, FLOOR, KINDS, LAMP, NO_FILM, PATH, light

pytestmark = pytest.mark.usefixtures("isolated")

SPP = 1024


def plain(path):
    """Render a file by Mitsuba alone: its own sensor, integrator, map and scale."""
    return np.array(mi.render(mi.load_file(str(path)), spp=SPP, seed=5))


def close(ours, theirs, noise=0.01):
    """Ratio of means 1, and 4x4 blocks alike, within the noise of two renderings."""
    assert ours.shape == theirs.shape
    height, width = (n // 4 for n in ours.shape[:2])
    blocks = [p.reshape(height, 4, width, 4, -1).mean((1, 3)) for p in (ours, theirs)]
    assert ours.mean() / theirs.mean() == pytest.approx(1, abs=noise)
    assert np.abs(blocks[0] - blocks[1]).mean() < 2 * noise * blocks[1].mean()


# ---- the scene's own map and its scale -----------------------------------------------------------------


@pytest.mark.slow
def test_under_another_map_the_picture_is_mitsuba_s_with_the_scene_s_scale(tmp_path, rng):
    """With a lamp beside the map, whose balance with it is the file's, and through T as well."""
    for name in ("own.exr", "other.exr"):
        images.write_exr(tmp_path / name, (sky(rng) + 0.1) / 800)
    parts = PATH, SENSOR, BALL, FLOOR, LAMP
    path = write_scene(tmp_path, *parts, light(800))
    given = {"input": {"envmap": "other.exr", "width": 16}, "scene": {"file": str(path), "width": 16}}
    settings = config.from_dict(given, tmp_path)
    lit = inputs.load_scene(settings.scene)
    given_map = inputs.read_map(settings.input, lit, settings.input.width)
    radiance, warnings = given_map.radiance, given_map.warnings
    expected = plain(write_scene(tmp_path, *parts, light(800, name="other.exr"), name="b.xml"))
    close(lit.render(radiance, SPP, 3), expected)
    transport = LightTransport.build(lit, 8, 16, spp=128).resolved(radiance)
    close(transport.apply(mi.TensorXf(radiance)).numpy(), expected, 0.02)
    said = " ".join(inputs.notes(settings.input, lit, given_map))
    assert not warnings and "scale 800" in said and "not the scene's own" in said


# ---- kinds of scenes -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_kind_of_scene_is_rendered_as_by_mitsuba_or_refused(kind, tmp_path):
    said = users_scenes.happened(kind)
    if kind.happens.startswith("refused: "):
        words = kind.happens.removeprefix("refused: ")
        assert said.startswith("refused: ") and words in said and len(said.splitlines()) <= 2
        return
    assert not said.startswith("refused")
    if not kind.happens.startswith("rendered"):
        assert kind.happens in said
    path = users_scenes.write(tmp_path, kind.parts)
    lit, radiance, _ = users_scenes.loaded(path)
    used = users_scenes.write(tmp_path, kind.like, "like.xml") if kind.like else path
    expected = plain(used)
    if kind.name == "hidden emitters":
        np.testing.assert_allclose(lit.alpha, expected[..., 3], atol=0.1)
        assert 0.2 < (lit.alpha == 0).mean() < 0.8 and expected[lit.alpha == 0].max() < 0.02
    else:
        assert lit.alpha is None
    expected = expected[..., :3]
    close(lit.render(radiance, SPP, 3), expected)
    if kind.traced:
        transport = LightTransport.build(lit, 8, 16, spp=256).resolved(radiance)
        close(transport.apply(mi.TensorXf(radiance)).numpy(), expected, 0.02)


@pytest.mark.slow
def test_plugins_that_are_replaced_or_refused(tmp_path):
    def said(*parts):
        return users_scenes.happened(users_scenes.Kind("", parts))

    for name in ("batch", "distant", "irradiancemeter", "radiancemeter"):
        sensor = SENSOR.replace("perspective", name).replace(users_scenes.FOV, "")
        assert f"sensor {name} makes no picture" in said(PATH, sensor, BALL, light())
    for name in ("constant", "sunsky", "timed_sunsky"):
        own = f'<emitter type="{name}"/>'
        assert said(PATH, SENSOR, BALL, own) == f"map: the scene's own light, {name}"
    depth = '<integer name="max_depth" value="4"/>'
    expected = {"direct": 2, "depth": -1} | dict.fromkeys(("aov", "moment", "stokes"), 4)
    for name in ("path", "ptracer", "direct", "volpath", "volpathmis", "aov", "moment", "stokes", "depth"):
        inside = (
            f'<integrator type="path">{depth}</integrator>' if name in ("aov", "moment", "stokes") else depth
        )
        inside = "" if name in ("direct", "depth") else inside
        parts = f'<integrator type="{name}">{inside}</integrator>', SENSOR, BALL, light()
        lit, _, notes = users_scenes.loaded(users_scenes.write(tmp_path, parts))
        assert lit.integrator.max_depth == expected.get(name, 4)
        assert any("depth is not used" in note for note in notes) == (name == "depth")
    for key, expected in (("max_depth", "-1 or a whole"), ("rr_depth", "a whole")):
        zero = f'<integrator type="path"><integer name="{key}" value="0"/></integrator>'
        assert f"{key} is 0, expected {expected} number above 0" in said(zero, SENSOR, BALL, light())


NOTHING = "scale of the environment map is"


@pytest.mark.parametrize(
    "scale, says",
    [*((scale, NOTHING) for scale in ("0", "-2", "nan", "1e-60")), ("3e37", "brighter than 1.27")],
)
def test_a_scale_that_lights_nothing_or_too_much_is_refused(scale, says):
    assert says in users_scenes.happened(users_scenes.Kind("", (PATH, SENSOR, BALL, light(scale))))


def test_the_scene_s_own_map_must_be_there(tmp_path):
    assert "own map is missing" in users_scenes.happened(
        users_scenes.Kind("", (PATH, SENSOR, BALL, light(name="x" * 300)))
    )
    path = write_scene(tmp_path, PATH, SENSOR, BALL, light(name="gone.exr"))
    lit = inputs.load_scene(config.Scene(file=str(path), width=16))
    for word in ("auto", "scene"):
        with pytest.raises(InputError, match="gone.exr: the scene's own map is missing"):
            inputs.load_map(config.Input(envmap=word), lit)
    with pytest.raises(ConfigError, match='got "scene", but .* has no light of its own'):
        inputs.load_map(config.Input(envmap="scene"), inputs.load_scene(config.Scene(width=16)))
    with pytest.raises(ConfigError, match='got "scene", but no scene is given'):
        inputs.load_map(config.Input(envmap="scene"))


# ---- light that is no file, or none ----------------------------------------------------------------------

Z_UP = SENSOR.replace('origin="0,1,6" target="0,0,0" up="0,1,0"', 'origin="0,-6,1" target="0,0,0" up="0,0,1"')
GROUND = """<shape type="rectangle"><transform name="to_world"><scale value="9"/><translate z="-1"/>
    </transform></shape>"""
SUN = '<emitter type="sunsky"><vector name="sun_direction" x="0.5" y="-0.6" z="0.7"/></emitter>'


def map_of(parts, folder, **keys):
    """Load a scene and the map of its configuration, 256 texels wide."""
    path = write_scene(folder, *parts)
    given = {"input": {"width": 256}, "scene": {"file": str(path), "width": 16} | keys}
    settings = config.from_dict(given, folder)
    lit = inputs.load_scene(settings.scene)
    given_map = inputs.read_map(settings.input, lit, 256)
    return lit, given_map.radiance, inputs.notes(settings.input, lit, given_map)


@pytest.mark.slow
def test_a_light_that_is_no_file_is_the_map(tmp_path):
    lit, radiance, notes = map_of((PATH, Z_UP, BALL, GROUND, SUN), tmp_path)
    close(lit.render(radiance, SPP, 3), plain(tmp_path / "test.xml"), 0.015)
    assert "map: the scene's own light, " in notes[0]


def test_the_texels_that_a_light_was_given_are_the_map(rng):
    texels = sky(rng)
    to_world = mi.ScalarTransform4f().look_at([0, 1, 6], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 12}
    given = {
        "type": "scene",
        "eye": {"type": "perspective", "to_world": to_world, "film": film},
        "ball": {"type": "sphere"},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(texels), "scale": 2.0},
    }
    found = inputs.read_map(config.Input(width=16), scene.load(given), 16)
    assert found.stored.tobytes() == texels.tobytes() and found.scale == 2


@pytest.mark.slow
def test_a_scene_without_an_environment_is_lit_by_a_map_beside_its_lamps(tmp_path, rng):
    parts = PATH, SENSOR, BALL, FLOOR, LAMP
    with pytest.raises(InputError, match=r"no environment emitter: add <emitter.*>, or .* --envmap FILE"):
        map_of(parts, tmp_path)
    images.write_exr(tmp_path / "own.exr", sky(rng) + 0.1)
    lit = inputs.load_scene(config.Scene(file=str(tmp_path / "test.xml"), width=16))
    radiance, _ = inputs.load_map(config.Input(envmap=str(tmp_path / "own.exr"), width=16), lit)
    alone, both = plain(tmp_path / "test.xml"), plain(write_scene(tmp_path, *parts, light(), name="both.xml"))
    close(lit.render(radiance, SPP, 3), both)
    assert inputs.share(lit, radiance, 1) == pytest.approx(1 - alone.mean() / both.mean(), abs=0.03)
    assert any("the map lights the scene beside any lamps of its own" in note for note in lit.notes)
    again = tmp_path / "again.xml"
    again.write_text(scene.relit(config.Scene(str(tmp_path / "test.xml")), "own.exr"))
    close(plain(again)[..., :3], both)


@pytest.mark.slow
@pytest.mark.parametrize(
    "origin, up, asked, zenith",
    [
        ("0,1,6", "0,1,0", "auto", [0, 1, 0]),
        ("0,6,3", "0,1,0", "auto", [0, 1, 0]),  # steeply down
        ("0,-6,1", "0,0,1", "auto", [0, 0, 1]),
        ("2,1,-6", "1,0,0", "auto", [1, 0, 0]),
        ("1,2,3", "1,1,1", "auto", [0, 1, 0]),  # no axis
        ("0,1,6", "0,1,0", "-x", [-1, 0, 0]),
    ],
)
def test_the_zenith_of_a_light_without_one_is_the_sensor_s_up(origin, up, asked, zenith, tmp_path):
    sensor = SENSOR.replace('origin="0,1,6"', f'origin="{origin}"').replace('up="0,1,0"', f'up="{up}"')
    lit, _, notes = map_of((PATH, sensor, BALL, CONSTANT), tmp_path, up=asked)
    np.testing.assert_allclose(lit.to_world @ [0, 1, 0], zenith, atol=1e-12)
    assert any("its zenith is the scene's" in note for note in notes) == (zenith != [0, 1, 0])
    assert np.linalg.det(lit.to_world) == pytest.approx(1)


@pytest.mark.slow
def test_a_light_with_an_orientation_keeps_it(tmp_path):
    lit, _, notes = map_of((PATH, Z_UP, BALL, SUN), tmp_path, up="y")
    np.testing.assert_allclose(lit.to_world @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    assert "scene.up has no effect: the scene's sunsky has an orientation of its own" in notes


def test_the_scene_s_own_file_is_known_by_another_path(tmp_path, rng):
    images.write_exr(tmp_path / "own.exr", sky(rng) + 0.1)
    (tmp_path / "maps").mkdir()
    path = str(write_scene(tmp_path, PATH, SENSOR, BALL, light(800)))
    lit = inputs.load_scene(config.Scene(file=path, width=16))
    named = config.Input(envmap=f"{tmp_path}/maps/../own.exr", width=16)
    assert inputs.notes(named, lit, inputs.read_map(named, lit)) == ["the scene multiplies it by scale 800"]


@pytest.mark.slow
def test_the_scale_of_the_scene_can_be_dropped(tmp_path, rng):
    images.write_exr(tmp_path / "own.exr", sky(rng) + 0.1)
    scaled, other, _ = map_of((PATH, SENSOR, BALL, light(800)), tmp_path)
    lit, radiance, notes = map_of((PATH, SENSOR, BALL, light(800)), tmp_path, scale=1)
    np.testing.assert_allclose(other, 800 * radiance, rtol=1e-6)
    assert lit.own.scale == 1 and any("scale 1 (scene.scale) takes the place of" in note for note in notes)
    again = tmp_path / "again.xml"
    again.write_text(scene.relit(config.Scene(str(tmp_path / "test.xml"), scale=1), "own.exr"))
    close(lit.render(radiance, SPP, 3), plain(again)[..., :3])


# ---- films ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_cropped_film_is_enlarged_with_its_crop(tmp_path):
    def cropped(size, part):
        film = f'<integer name="width" value="{size[0]}"/><integer name="height" value="{size[1]}"/>'
        names = "crop_width", "crop_height", "crop_offset_x", "crop_offset_y"
        film += "".join(f'<integer name="{n}" value="{v}"/>' for n, v in zip(names, part, strict=True))
        own = '<integer name="width" value="16"/><integer name="height" value="12"/>'
        return write_scene(tmp_path, PATH, SENSOR.replace(own, film), BALL, FLOOR, CONSTANT)

    expected = plain(cropped((32, 24), (16, 12, 8, 4)))
    lit = inputs.load_scene(config.Scene(file=str(cropped((16, 12), (8, 6, 4, 2))), width=16))
    radiance = inputs.read_map(config.Input(), lit, 64).radiance
    close(lit.render(radiance, SPP, 3), expected[..., :3])
    with pytest.raises(InputError, match="its crop 8 x 6 at 9, 2, expected .* the crop inside"):
        inputs.load_scene(config.Scene(file=str(cropped((16, 12), (8, 6, 9, 2)))))


def test_a_sensor_without_a_film_has_mitsuba_s(tmp_path):
    path = write_scene(tmp_path, PATH, NO_FILM, BALL, CONSTANT)
    lit = scene.load(path)
    assert (lit.width, lit.height) == tuple(mi.load_file(str(path)).sensors()[0].film().size()) == (768, 576)


def test_polarisation_that_is_left_out_is_said(tmp_path):
    polarised = BALL.replace("diffuse", "pplastic").replace("reflectance", "diffuse_reflectance")
    stokes = f'<integrator type="stokes">{PATH}</integrator>'
    notes = map_of((stokes, SENSOR, polarised, CONSTANT), tmp_path)[2]
    what = "integrator stokes", "pplastic"
    assert {f"{one}: rendered without polarisation" for one in what} <= {*notes}


def test_what_is_written_has_the_units_of_the_file_and_the_bits_of_what_stays(rng):
    stored = sky(rng) + 0.1
    given = inputs.InputMap("a.exr", stored, 0.3, (16, 8), [])
    turned = latlong.rotate(given.radiance, 33.0)
    assert given.as_stored(turned, 33.0).tobytes() == latlong.rotate(stored, 33.0).tobytes()
    edited = given.radiance.copy()
    edited[2, 3] *= 2
    found = given.as_stored(edited)
    np.testing.assert_allclose(found[2, 3], 2 * stored[2, 3], rtol=1e-6)
    found[2, 3] = stored[2, 3]
    assert found.tobytes() == stored.tobytes()
    with pytest.raises(NumericalError, match="divided by the scene's scale 1e-30 overflows float32"):
        inputs.InputMap("a.exr", stored, 1e-30, (16, 8), []).as_stored(stored * np.float32(1e12))


def test_the_page_names_every_kind_of_scene_and_what_happens():
    page = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8").replace("`", "")
    assert [kind.name for kind in KINDS if kind.name not in page or kind.happens not in page] == []
