"""Scenes as users have them, against plain Mitsuba: the file as it is, rendered by ``mi.load_file``."""

import re
import shutil

import mitsuba as mi
import numpy as np
import pytest

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.errors import ConfigError, InputError, NumericalError
from envedit.images import images
from envedit.transport.light_transport import LightTransport
from tests.oracles import ROOT, users_scenes
from tests.oracles.builders import BALL, SENSOR, sky, write_scene
from tests.oracles.users_scenes import FLOOR, KINDS, LAMP, PATH, PLUGINS, TURN, light

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


@pytest.mark.parametrize(
    "scale, inside, envmap",
    [(None, "", "auto"), (0.5, TURN, "auto"), (3, "", "scene"), (800, TURN, "auto"), (800, "", "other.exr")],
)
def test_the_initial_rendering_is_mitsuba_s_of_the_users_file(scale, inside, envmap, tmp_path, rng):
    """With a lamp beside the map, whose balance with it is the file's, and through T as well."""
    for name in ("own.exr", "other.exr"):
        images.write_exr(tmp_path / name, (sky(rng) + 0.1) / (scale or 1))
    path = write_scene(tmp_path, PATH, SENSOR, BALL, FLOOR, LAMP, light(scale, inside))
    used = path
    if envmap == "other.exr":
        parts = PATH, SENSOR, BALL, FLOOR, LAMP, light(scale, inside, envmap)
        used = write_scene(tmp_path, *parts, name="b.xml")
    given = {"input": {"envmap": envmap, "width": 16}, "scene": {"file": str(path), "width": 16}}
    settings = config.from_dict(given, tmp_path)
    lit = inputs.load_scene(settings.scene)
    radiance, warnings = inputs.load_map(settings.input, lit)
    expected = plain(used)
    close(lit.render(radiance, SPP, 3), expected)
    transport = LightTransport.build(lit, 8, 16, spp=128)
    transport.resolve(radiance)
    close(transport.apply(mi.TensorXf(radiance)).numpy(), expected, 0.02)
    said = " ".join(inputs.notes(settings.input, lit))
    assert not warnings and (f"scale {scale}" in said) == (scale is not None)
    assert ("not the scene's own" in said) == (envmap == "other.exr")
    assert (f"the scene's own, {tmp_path / 'own.exr'}" in said) == (envmap == "auto")


@pytest.mark.slow
@pytest.mark.parametrize("other", [False, True], ids=["own map", "another map"])
@pytest.mark.parametrize(
    ("scene", "own"), [("matpreview/matpreview.xml", "envmap.exr"), ("principled/scene.xml", "envmap.hdr")]
)
def test_public_scenes_are_as_bright_as_in_mitsuba(scene, own, other, data, tmp_path):
    """With their emitter's scale; the map at the file's width, in a picture 64 wide."""
    folder = tmp_path / "scene"
    shutil.copytree((data / "scenes" / scene).parent, folder)
    path, envmap = folder / (data / "scenes" / scene).name, folder / own
    text = path.read_text()
    if other:
        envmap = data / "puresky" / "kloppenheim_06_puresky_1k.hdr"
        text = text.replace(own, str(envmap))
    used = path.with_name("plain.xml")  # this Mitsuba takes no capitals in names of plugins
    used.write_text(re.sub('type="[A-Z][a-z]+"', lambda found: found[0].lower(), text))
    width = images.load_envmap(str(envmap))[0].shape[1]
    chosen = {"envmap": str(envmap) if other else "scene", "width": width}
    settings = config.from_dict({"input": chosen, "scene": {"file": str(path), "width": 64}}, tmp_path)
    lit = inputs.load_scene(settings.scene)
    radiance, _ = inputs.load_map(settings.input, lit)
    whole = mi.load_file(str(used))
    params = mi.traverse(whole)
    size = next(filter(lambda key: key.endswith("film.size"), params.keys()))
    params[size] = [lit.width, lit.height]
    params.update()
    expected = np.array(mi.render(whole, spp=256, seed=5))[..., :3]
    assert lit.render(radiance, 256, 3).mean() / expected.mean() == pytest.approx(1, abs=0.01)


# ---- kinds of scenes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", {kind.parts: kind for kind in KINDS}.values(), ids=lambda kind: kind.name)
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
        transport = LightTransport.build(lit, 8, 16, spp=256)
        transport.resolve(radiance)
        close(transport.apply(mi.TensorXf(radiance)).numpy(), expected, 0.02)


def test_plugins_that_are_replaced_or_refused(tmp_path):
    def said(*parts):
        return users_scenes.happened(users_scenes.Kind("", parts))

    for name, what in PLUGINS["sensor"].items():
        if what == users_scenes.REFUSED:
            sensor = SENSOR.replace("perspective", name).replace(users_scenes.FOV, "")
            assert f"sensor {name} makes no picture" in said(PATH, sensor, BALL, light())
    for name in PLUGINS["emitter"]:
        if name in ("constant", "sunsky", "timed_sunsky"):
            assert not said(PATH, SENSOR, BALL, f'<emitter type="{name}"/>')
    depth = '<integer name="max_depth" value="4"/>'
    expected = {"direct": 2, "depth": -1} | dict.fromkeys(("aov", "moment", "stokes"), 4)
    for name in PLUGINS["integrator"]:
        inside = (
            f'<integrator type="path">{depth}</integrator>' if name in ("aov", "moment", "stokes") else depth
        )
        inside = "" if name in ("direct", "depth") else inside
        parts = f'<integrator type="{name}">{inside}</integrator>', SENSOR, BALL, light()
        lit, _, notes = users_scenes.loaded(users_scenes.write(tmp_path, parts))
        assert lit.max_depth == expected.get(name, 4)
        assert any("depth is not used" in note for note in notes) == (name == "depth")
    for key, expected in (("max_depth", "-1 or a whole"), ("rr_depth", "a whole")):
        zero = f'<integrator type="path"><integer name="{key}" value="0"/></integrator>'
        assert f"{key} is 0, expected {expected} number above 0" in said(zero, SENSOR, BALL, light())


@pytest.mark.parametrize("scale", ["0", "-2", "nan", "1e-60"])
def test_a_scale_that_lights_nothing_is_refused(scale, tmp_path):
    kind = users_scenes.Kind("", (PATH, SENSOR, BALL, light(scale)))
    assert "scale of the environment map is" in users_scenes.happened(kind)


def test_a_map_that_its_scale_makes_too_bright_is_refused(tmp_path):
    kind = users_scenes.Kind("", (PATH, SENSOR, BALL, light("3e37")))
    assert "texels are brighter than 1.27e+30" in users_scenes.happened(kind)


def test_the_scene_s_own_map_must_be_there(tmp_path):
    assert "own map is missing" in users_scenes.happened(
        users_scenes.Kind("", (PATH, SENSOR, BALL, light(name="x" * 300)))
    )
    path = write_scene(tmp_path, PATH, SENSOR, BALL, light(name="gone.exr"))
    lit = inputs.load_scene(config.Scene(file=str(path), width=16))
    for word in ("auto", "scene"):
        with pytest.raises(InputError, match="gone.exr: the scene's own map is missing"):
            inputs.load_map(config.Input(envmap=word), lit)
    with pytest.raises(ConfigError, match='got "scene", but .* names no file'):
        inputs.load_map(config.Input(envmap="scene"), inputs.load_scene(config.Scene(width=16)))
    with pytest.raises(ConfigError, match='got "scene", but no scene is given'):
        inputs.load_map(config.Input(envmap="scene"))


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


def test_every_plugin_of_this_mitsuba_is_in_the_table():
    assert {name for plugins in PLUGINS.values() for name in plugins} == users_scenes.installed()


def test_the_page_is_the_one_that_is_written():
    """``python -m tests.oracles.users_scenes > docs/scenes.md`` writes it anew."""
    assert (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8") == users_scenes.page()
