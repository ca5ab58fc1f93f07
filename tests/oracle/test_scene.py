"""Loading and rendering scenes: against Mitsuba itself, closed forms, and files broken on purpose."""

import importlib.util
import os
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import shipped
from envedit.core.errors import ConfigError, InputError, NumericalError
from envedit.images import images
from envedit.scene import film, scene
from tests.oracles import ROOT
from tests.oracles.builders import BALL, LIGHT, SENSOR, sky, write_scene

SCENES = ROOT / "scenes"


@pytest.fixture
def loaded(tmp_path):
    return scene.load(write_scene(tmp_path, SENSOR, BALL, LIGHT))


# ---- rendering ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_russian_roulette_begins_where_the_scene_says(tmp_path, rng):
    image = sky(rng)
    for kind in ("path", "volpath"):
        asked = f'<integrator type="{kind}"><integer name="rr_depth" value="1"/></integrator>'
        loaded = scene.load(write_scene(tmp_path, asked, SENSOR, BALL, LIGHT))
        ours = loaded.render(image, spp=16, seed=3)
        seed = int(np.random.SeedSequence([3, 0, 0]).generate_state(1)[0])
        for depth in (1, 5):
            integrator = mi.load_dict({"type": "path", "rr_depth": depth})
            theirs = film.render(loaded.mi, integrator, 16, seed)[..., :3].astype(np.float32)
            assert np.array_equal(ours, theirs) == (depth == 1)


@pytest.mark.slow
@pytest.mark.parametrize("row", [0, -1])
def test_light_in_the_row_of_a_pole_alone_is_seen(row, loaded):
    """As in the sum with another map, as rendering is linear."""
    pole = np.zeros((16, 32, 3), np.float32)
    pole[row] = 100
    even = np.full_like(pole, 0.1)
    alone, both, faint = (loaded.render(image, spp=4096).mean() for image in (pole, pole + even, even))
    assert alone > 0.01 and alone == pytest.approx(both - faint, rel=0.02)


def test_convex_body_in_a_white_furnace_shows_its_albedo(loaded):
    picture = loaded.render(np.ones((8, 16, 3)), spp=256)
    np.testing.assert_allclose(picture[0, 0], 1.0, rtol=1e-6)
    np.testing.assert_allclose(picture[5:7, 7:9].mean(axis=(0, 1)), [0.2, 0.4, 0.6], rtol=0.02)


@pytest.mark.slow
def test_passes_have_their_own_seeds_and_average_to_the_whole(loaded, rng, monkeypatch):
    image = sky(rng)
    whole = loaded.render(image, spp=10)
    calls = []
    render = film.render

    def record(built, integrator, spp, seed, view=0):
        calls.append((spp, seed, result := render(built, integrator, spp, seed, view=view)))
        return result

    monkeypatch.setattr(scene, "_PASS_SAMPLES", 4 * 16 * 12)
    monkeypatch.setattr(film, "render", record)
    split = loaded.render(image, spp=10)
    assert [c[0] for c in calls] == [4, 4, 2] and len({c[1] for c in calls}) == 3
    np.testing.assert_allclose(split, sum(n / 10 * p[..., :3] for n, _, p in calls), rtol=1e-6)
    assert np.array_equal(loaded.render(image, spp=10), split) and not np.array_equal(split, whole)
    assert not np.array_equal(loaded.render(image, spp=10, seed=1), split)


@pytest.mark.slow
def test_auto_takes_as_many_samples_as_noise_asks_for(loaded, rng):
    """A lone bright texel over a rough ball is noisier than an even sky."""
    even = np.ones((8, 16, 3), np.float32)
    sunny = 0.05 * even
    sunny[2, 3] = 300
    quiet, few, noise = loaded.sampled(even, "auto", 4)
    _, many, louder = loaded.sampled(sunny, "auto", 4)
    assert few == 256 <= many <= 768
    truth = loaded.render(even, spp=4096, seed=99)
    error = np.mean((np.clip(quiet, 0, 1) ** (1 / 2.2) - np.clip(truth, 0, 1) ** (1 / 2.2)) ** 2)
    assert error < 2 * 10 ** (-scene.QUIET_DECIBELS / 10)
    assert noise.shape == quiet.shape[:2] and error / 4 < np.mean(noise**2) < 4 * error
    assert louder.mean() > noise.mean()
    assert np.array_equal(loaded.sampled(even, "auto", 4)[0], quiet)
    picture, taken, unknown = loaded.sampled(even, 16, 4)
    assert taken == 16 and unknown is None and np.array_equal(picture, loaded.render(even, spp=16, seed=4))


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-3, 1e300])
def test_a_bad_texel_is_named_and_not_rendered(loaded, value):
    image = np.ones((8, 16, 3))
    image[3, 5, 1] = value
    with pytest.raises(NumericalError, match=r"1 texel .* row 3, column 5"):
        loaded.render(image)


@pytest.mark.parametrize("given", [{"spp": 0}, {"spp": 1.5}, {"seed": -1}, {"max_depth": -2}, {"spp": True}])
def test_unusable_rendering_settings_are_refused(loaded, given):
    with pytest.raises(ConfigError, match=next(iter(given))):
        loaded.render(np.ones((8, 16, 3)), **given)


@pytest.mark.parametrize("image", [np.ones((8, 16)), np.ones((8, 16, 4)), np.ones((2, 4, 3)), "sky.exr"])
def test_a_map_of_the_wrong_shape_is_refused(loaded, image):
    with pytest.raises(InputError):
        loaded.set_envmap(image)


@pytest.mark.slow
def test_a_dict_scene_is_the_same_as_its_xml(tmp_path, rng):
    to_world = mi.ScalarTransform4f().look_at([0, 1, 6], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 12, "filter": {"type": "box"}}
    given = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": to_world, "film": film},
        "ball": {
            "type": "sphere",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}},
        },
        "light": {"type": "envmap", "filename": "not-there.exr"},
    }
    image = sky(rng)
    from_xml = scene.load(write_scene(tmp_path, SENSOR, BALL, LIGHT)).render(image, spp=8)
    from_dict = scene.load(given)
    assert from_dict.path is None
    np.testing.assert_allclose(from_dict.render(image, spp=8), from_xml, rtol=1e-4, atol=1e-6)
    given["light"] = mi.load_dict({"type": "constant"})
    with pytest.raises(InputError):
        scene.load(given)


# ---- what is wrong with a file -----------------------------------------------------------------------------

TEXTURED = """<shape type="sphere"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
    <string name="filename" value="wood.png"/></texture></bsdf></shape>"""
MESH = '<shape type="ply"><string name="filename" value="a.ply"/></shape>'
SCALED = """<emitter type="envmap"><string name="filename" value="no.exr"/>
    <transform name="to_world"><scale x="-1"/></transform></emitter>"""


@pytest.mark.parametrize(
    "parts, says",
    [
        ((SENSOR, BALL, LIGHT, '<emitter type="envmap"/>'), r"2 environment emitters \(constant, envmap\)"),
        ((SENSOR, BALL, SCALED), "to_world of the environment emitter .*rotation"),
        ((SENSOR, TEXTURED, LIGHT), r"line \d+.*texture names a missing file: wood.png"),
        ((SENSOR, MESH, LIGHT), "shape names a missing file: a.ply"),
        ((SENSOR, '<shape type="sphere"><ref id="gold"/></shape>', LIGHT), 'unresolved reference to "gold"'),
        ((SENSOR, '<shape type="spere"/>', LIGHT), 'Plugin "spere" not found'),
        ((SENSOR, BALL.replace("<bsdf", '<float name="raduis" value="2"/><bsdf'), LIGHT), "raduis"),
        ((SENSOR, BALL, LIGHT, "<shape"), r"line \d+: a tag is not well formed"),
        ((BALL, LIGHT), "no sensor"),
        ((SENSOR.replace("hdrfilm", "specfilm"), BALL, LIGHT), "hdrfilm"),
        ((SENSOR, TEXTURED, MESH, LIGHT), r"file: wood.png, looked in .*\nalso: .* file: a.ply, [^;]*$"),
    ],
)
def test_a_broken_scene_is_told_in_short(tmp_path, parts, says):
    path = write_scene(tmp_path, *parts)
    with pytest.raises(InputError, match=says) as caught:
        scene.load(path)
    text = str(caught.value)
    assert "test.xml" in text and len(text.splitlines()) <= 2 and not re.search(r"\.cpp:", text), text


@pytest.mark.parametrize(
    "name, says",
    [
        ("spere", "did you mean sphere?"),
        ("nowhere/sphere.xml", "no such file"),
        ("x" * 300 + "/a.xml", "no such file"),
        ("", "folder"),
        ("zzz", "one of matte, mesh, mirror"),
    ],
)
def test_a_missing_scene_is_told_with_the_nearest_name(name, says):
    with pytest.raises(InputError, match=re.escape(says)):
        scene.load(name)


# ---- parameters --------------------------------------------------------------------------------------------


def test_parameters_fill_the_names_and_reach_the_material():
    loaded = scene.load("sphere", width=8, parameters={"roughness": 0.45})
    np.testing.assert_allclose(np.array(loaded.params["object.bsdf.alpha.value"]), 0.45, rtol=1e-6)


@pytest.mark.parametrize(
    "name, parameters, says",
    [
        ("sphere", {"rougness": 1}, r"no parameter rougness; did you mean roughness\? \(known: roughness\)"),
        ("mirror", {"roughness": 1}, r"known: none"),
        ("mesh", {}, "mesh.xml needs mesh, .* --set scene.parameters.mesh=VALUE$"),
        ("sphere", {"roughness": float("nan")}, "roughness alpha is nan"),
        ("sphere", {"roughness": -0.1}, "roughness alpha is -0.1"),
        ("mesh", {"mesh": "statue.ply", "up": "w"}, "up axis is 'w'"),
    ],
)
def test_unusable_parameters_are_config_errors(name, parameters, says):
    with pytest.raises(ConfigError, match=says):
        scene.load(name, parameters=parameters)


def test_a_default_after_its_use_is_told_with_what_to_give(tmp_path):
    """Mitsuba takes a default where it stands, for what follows."""
    sized = BALL.replace("<bsdf", '<float name="radius" value="$size"/><bsdf')
    path = write_scene(tmp_path, SENSOR, sized, '<default name="size" value="1"/>', LIGHT)
    with pytest.raises(InputError, match=r"parameter: \$size; give it: --set scene.parameters.size=VALUE"):
        scene.load(path)
    scene.load(path, parameters={"size": 0.5})


def test_names_are_found_in_included_files(tmp_path):
    sized = BALL.replace("<bsdf", '<float name="radius" value="$size"/><bsdf')
    write_scene(tmp_path, '<default name="size" value="1"/>', sized, name="ball.xml")
    path = write_scene(tmp_path, SENSOR, '<include filename="ball.xml"/>', LIGHT)
    box = scene.load(path, parameters={"size": 0.5}).mi.bbox()
    np.testing.assert_allclose(np.array(box.max).ravel(), 0.5, rtol=1e-6)


# ---- shipped scenes and the statue -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped.scenes())
def test_shipped_scenes_render(name, rng):
    parameters = {"mesh": "statue.ply"} if name == "mesh" else None
    loaded = scene.load(name, parameters=parameters)
    assert (loaded.width, loaded.height) == (256, 256)
    picture = scene.load(f"{name}.xml", width=16, parameters=parameters).render(np.ones((8, 16, 3)), spp=64)
    # In the open the plane shows its albedo; nothing reflects more than it receives, and nothing is black.
    np.testing.assert_allclose(picture[0].mean(), 0.5, rtol=0.03)
    assert picture.min() > 0.1 and picture.max() < 1.2
    box = {s.id(): s.bbox() for s in loaded.mi.shapes()}.get("object")
    if name != "pair":  # two smaller objects
        low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
        np.testing.assert_allclose([low[1], high[1]], [0, 2], atol=1e-5)
    # The plane below hides the lower half of the sky.
    below = np.zeros((8, 16, 3))
    below[5:] = 1
    assert scene.load(name, width=16, parameters=parameters).render(below, spp=16).max() < 1e-2


@pytest.fixture(scope="module")
def statue():
    spec = importlib.util.spec_from_file_location("make_statue", SCENES / "make_statue.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_committed_statue_is_the_scripts(statue, tmp_path):
    committed = (SCENES / "statue.ply").read_bytes()
    statue.write_ply(tmp_path / "statue.ply", *statue.build())
    made = (tmp_path / "statue.ply").read_bytes()
    assert len(made) == len(committed) < 1_200_000
    body = made.index(b"end_header\n") + len(b"end_header\n")
    assert made[:body] == committed[:body]
    count = len(statue.build()[0]) * 24
    # Positions to the last digits: another machine's sine may differ there.
    ours, theirs = (np.frombuffer(t[body : body + count], "<f4") for t in (made, committed))
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    assert made[body + count :] == committed[body + count :]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be taken away here")
def test_a_texture_is_read_on_one_core(tmp_path):
    """Mitsuba's reader of EXR files waits for a second thread."""
    images.write_exr(tmp_path / "wood.exr", np.full((4, 4, 3), 0.5, np.float32))
    wood = '<texture type="bitmap" name="reflectance"><string name="filename" value="wood.exr"/></texture>'
    ball = f'<shape type="sphere"><bsdf type="diffuse">{wood}</bsdf></shape>'
    path = write_scene(tmp_path, SENSOR, ball, LIGHT)
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        f"from envedit.scene import scene; print(scene.load({str(path)!r}).width)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.strip().isdecimal(), done.stderr
