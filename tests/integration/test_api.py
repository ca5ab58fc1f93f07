"""envedit from Python: arrays, dicts and built scenes in, a result that shows and saves itself out."""

import dataclasses
import inspect
import os
import runpy
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

import envedit
from envedit import config, pipeline
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from envedit.maps import map_lights
from envedit.scene import built_scene
from tests.oracles import ROOT

MASKED = np.ma.array(np.ones((8, 16, 3)), mask=np.arange(384).reshape(8, 16, 3) < 3)
TINY = {
    "preset": "draft",
    "input": {"width": 16},
    "target": {"spp": 16},
    "output": {"spp": 16, "report": False},
    "renderer": {"spp": 16, "max_depth": 2},
    "optimizer": {"iterations": 2},
}


def ball(texels, scale=2.0):
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 30)
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(texels), "scale": scale, "to_world": turned},
        "camera": {
            "type": "perspective",
            "to_world": look,
            "fov": 40,
            "film": {"type": "hdrfilm", "width": 12, "height": 8},
            "sampler": {"type": "multijitter"},
        },
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
    }


# ---- the example of the documentation ----------------------------------------------------------------------


@pytest.mark.slow
def test_the_example_runs(tmp_path, monkeypatch, capsys, here):
    pytest.importorskip("matplotlib")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    found = runpy.run_path(str(ROOT / "docs" / "edit_in_python.py"))
    result = found["result"]
    assert result.metrics["render"]["psnr"] > result.metrics["initial"]["psnr"] + 10
    assert repr(result) in capsys.readouterr().out and len(repr(result)) < 100
    assert (tmp_path / "edit.png").stat().st_size > 10_000
    shown = result._repr_png_()
    assert shown.startswith(b"\x89PNG") and shown == (tmp_path / "edit" / "preview.png").read_bytes()
    # T E for a resolved sky is the rendering that Mitsuba makes of it, to the noise of both.
    rendered = found["scene"].render(found["sky"], spp=64)
    assert np.abs(found["initial"] - rendered).mean() < 0.05 * rendered.mean()

    assert np.array_equal(images.read(tmp_path / "edit" / "edited.exr")[0], result.envmap)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["image", "rendering"])
def test_a_picture_is_paint_or_a_rendering_and_what_is_saved_runs_to_the_same_map(kind, tmp_path, own_cache):
    sky = np.random.default_rng(5).uniform(0.1, 2, (16, 32, 3)).astype(np.float32)
    scene = envedit.load_scene("sphere", 16, parameters={"roughness": 0.4})
    picture = scene.render(np.roll(sky, 9, axis=1), spp=16)
    asked = {"spp": 8} | ({"kind": kind, "file": "array"} if kind == "rendering" else {})
    settings = TINY | {"target": asked, "representation": {"kind": "pixels"}}
    result = envedit.edit(settings, scene=scene, envmap=sky, target=picture, mask=np.ones((16, 16)))
    assert (result.metrics["painted"] is None) == (kind == "rendering")
    result.save(tmp_path / "out")
    found = config.load(tmp_path / "out" / "config.toml")
    assert found.scene.parameters == {"roughness": 0.4}
    assert found.target.kind == kind and found.target.spp == 8
    again = pipeline.run(found)
    assert np.array_equal(again.envmap, result.envmap) and again.input_map.size == (32, 16)
    before = result.metrics["timing"]["total_s"], list(result.warnings)
    result.save(tmp_path / "out")  # a second time: the first is moved aside, and the result is as it was
    assert (tmp_path / "out" / "earlier-1" / "given_envmap.exr").exists()
    assert (result.metrics["timing"]["total_s"], result.warnings) == before


def test_a_plot_without_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(envedit.MachineError, match=r"pip install '\.\[report\]'"):
        envedit.Result.plot(object())


# ---- what an edit takes ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_built_scene_is_edited_and_has_its_own_map_again(tmp_path):
    own = np.full((8, 16, 3), 0.5, np.float32)
    own[2, 3] = 20
    scene = mi.load_dict(ball(own))
    other = latlong.rotate(own, 90)
    result = envedit.edit(TINY, scene=scene, target_map=other)
    assert np.array_equal(built_scene.own_map(scene), own)
    assert float(np.array(mi.traverse(scene)["sky.scale"]).item()) == 2
    # The map is in the units of the scene's own, which scale multiplies.
    assert np.array_equal(result.input_map.stored, own) and np.array_equal(result.maps["initial"], 2 * own)
    assert np.allclose(result.maps["target"], 2 * other) and result.render.shape == (8, 12, 3)
    warned = result.save(tmp_path / "out")
    assert any("the scene was given as an object" in line for line in warned)
    assert not (tmp_path / "out" / "edited.xml").exists()
    assert config.load(tmp_path / "out" / "config.toml").target.file.endswith("given_target_map.exr")


@pytest.mark.slow
def test_a_built_scene_renders_as_the_same_scene_from_a_dict():
    own = np.random.default_rng(3).uniform(0.1, 2, (8, 16, 3)).astype(np.float32)
    built, parsed = envedit.load_scene(mi.load_dict(ball(own))), envedit.load_scene(ball(own), 12, 8)
    for scene in (built, parsed):
        assert (scene.width, scene.height) == (12, 8)
        assert (scene.integrator.max_depth, scene.integrator.hide_emitters) == (3, True)
        assert scene.own.scale == 2
    # The same samples: what differs is that a built scene has its rotation in single precision.
    assert np.allclose(built.to_world, parsed.to_world, atol=1e-7)
    assert np.array_equal(built.alpha, parsed.alpha)
    assert np.allclose(built.render(own, spp=16), parsed.render(own, spp=16), rtol=1e-4)
    first, second = (envedit.LightTransport.build(scene, 8, 16, spp=16) for scene in (built, parsed))
    assert np.allclose(first.apply(own).numpy(), second.apply(own).numpy(), rtol=1e-3)
    ones = np.ones((8, 12, 3), np.float32)
    assert np.allclose(first.adjoint(ones).numpy().mean(axis=2), first.influence, rtol=1e-4)


@pytest.mark.parametrize("integrator", [
    {"type": "path", "rr_depth": 9}, {"type": "path", "max_depth": 6}, {"type": "direct"},
    {"type": "prb", "max_depth": 4, "rr_depth": 3},
    {"type": "prb", "max_depth": -1}, {"type": "direct_projective"}, {"type": "volpath", "max_depth": 3},
    {"type": "depth"}, {"type": "ptracer", "max_depth": 5},
])  # fmt: skip
def test_a_built_scene_s_integrator_asks_for_the_same_as_a_dict_s(integrator):
    made = ball(np.ones((4, 8, 3), np.float32)) | {"integrator": integrator}
    built, parsed = (envedit.load_scene(scene) for scene in (mi.load_dict(made), made))
    for name in ("max_depth", "rr_depth", "hide_emitters"):
        assert getattr(built.integrator, name) == getattr(parsed.integrator, name)
    assert len(built.notes) == len(parsed.notes)


def test_a_built_scene_that_cannot_be_used_is_refused():
    made = ball(np.ones((4, 8, 3), np.float32))
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    fog = {"ball": {"type": "sphere", "interior": {"type": "homogeneous"}}, "integrator": {"type": "volpath"}}
    for change, text in (
        (fog, "participating medium"),
        ({"sky": {"type": "constant"}}, "got environment ConstantBackgroundEmitter, expected an emitter"),
        ({"camera": {"type": "radiancemeter", "film": film}}, "sensor RadianceMeter makes no picture"),
        ({"other": made["camera"]}, "for a built scene with 2 sensors"),
        ({"sky": made["sky"] | {"scale": 0.0}}, "scale of the environment map is 0.0"),
        ({"sky": made["sky"] | {"to_world": mi.ScalarTransform4f().scale([1, 2, 1])}}, "is no rotation"),
    ):
        with pytest.raises(envedit.EnveditError, match=text):
            envedit.load_scene(mi.load_dict(made | change))


@pytest.mark.parametrize(
    ("given", "kind", "parts"),
    [
        (lambda: {"settings": 3}, ConfigError, ["settings: got 3, expected a Config, a dict of tables"]),
        (lambda: {"settings": {"scene": {"fil": "a"}}}, ConfigError, ["no key fil", "did you mean file?"]),
        (lambda: {"watch": 3}, ConfigError, ["watch: got 3, expected a Watch"]),
        (lambda: {"base": 3}, ConfigError, ["base: got 3, expected a path"]),
        (lambda: {"mask": np.ones((4, 4))}, ConfigError, ["mask: got one without a target"]),
        (lambda: {"target": np.ones(3), "target_map": np.ones(3)}, ConfigError, ["got both, expected one"]),
        (lambda: {"envmap": "sky.exr"}, InputError, ["envmap: got 'sky.exr', expected an array"]),
        (lambda: {"envmap": np.ones((8, 16))}, InputError, ["shape (8, 16)", "expected (H, 2 H, 3)"]),
        (lambda: {"envmap": np.ones((8, 8, 3))}, InputError, ["envmap: a lat-long map is 2:1"]),
        (lambda: {"envmap": np.full((8, 16, 3), np.nan)}, InputError, ["envmap: 128 texels are NaN"]),
        (lambda: {"target": np.full((64, 64, 3), np.nan)}, InputError, ["target: pixel at row 0, column 0"]),
        (lambda: {"envmap": MASKED}, InputError, ["envmap: 3 values are masked", "fill them"]),
        (lambda: {"scene": 3}, ConfigError, ["scene: got int, expected a file, a dict"]),
        (lambda: {"scene": "no_such.xml"}, InputError, ["no_such.xml: no such file"]),
        (lambda: {"scene": mi.load_dict({"type": "scene"})}, InputError, ["got environment none"]),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_by_name(given, kind, parts):
    arguments = {"settings": TINY} | given()
    with pytest.raises(kind) as info:
        envedit.edit(arguments.pop("settings"), **arguments)
    assert all(part in str(info.value) for part in parts), str(info.value)


@pytest.mark.slow
def test_codes_of_a_picture_as_radiance_are_warned_of():
    adjusted = TINY | {"target": {"kind": "none"}, "scene": {"width": 8}}
    codes = np.full((8, 16, 3), 200, np.uint8)
    said = envedit.edit(adjusted, envmap=codes).warnings
    assert said[0].startswith("envmap: got uint8 up to 200, taken as linear radiance as it is")
    assert not any("uint8" in line for line in envedit.edit(adjusted, envmap=codes / 255).warnings)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: config.Config(scen={}), "scen: unknown key; did you mean scene?"),
        (lambda: config.Config(scene={"widht": 3}), "scene.widht: unknown key; did you mean width?"),
        (lambda: config.Config(scene={3: 4}), "scene: got {3: 4}, expected a table"),
        (lambda: config.Scene("a", file="b"), "scene.file: got two values, expected one"),
        (lambda: config.Lights(1, 2, 3), "Lights: got 3 values, expected at most 2"),
        (lambda: config.from_dict(3), "config.toml: got 3, expected a table of tables"),
        (lambda: envedit.fit(np.ones((8, 16))), "image: got an array of shape (8, 16), expected (H, W, 3)"),
        (lambda: envedit.fit(MASKED), "image: 3 values are masked"),
        (lambda: envedit.load_scene("sphere", 8).render(MASKED, 1), "map: 3 values are masked"),
        (lambda: envedit.fit(np.ones((8, 16, 3)), {"hiden": 3}), "hiden: unknown key; did you mean hidden?"),
        (lambda: envedit.fit(np.ones((8, 16, 3)), settings={"epochs": -1}), "fit.epochs: got -1, expected"),
        (lambda: envedit.load_scene("sphere", width="a"), "scene.width: got 'a', expected an integer"),
        (lambda: envedit.load_scene("sphere", parameters={"a": []}), "scene.parameters: got {'a': []}"),
        (lambda: envedit.load_scene("sphere", parameters=3), "scene.parameters: got 3, expected a table"),
        (lambda: envedit.load_scene("sphere", sensors=0), "scene.sensors: got 0, expected"),
        (lambda: envedit.load_map("none.exr"), "none.exr"),
        (lambda: envedit.load_map(None), "got NoneType, expected the path of a file"),
        (lambda: envedit.load_map("none.exr", width=64.0), "width: got 64.0, expected an even integer"),
        (lambda: envedit.load_map("none.exr", width="64"), "width: got '64', expected an even integer"),
        (lambda: envedit.fit(np.ones((8, 16, 3)), seed=-1), "seed: got -1, expected an integer"),
        (lambda: envedit.fit(np.ones((8, 16, 3)), 3), "network: got 3, expected a Representation or a dict"),
        (lambda: envedit.fit(np.ones((8, 16, 3)), folder=3), "folder: got 3, expected a path"),
        (lambda: envedit.load_scene("sphere", base=3), "base: got 3, expected a path"),
        (lambda: envedit.Result.save(object(), None), "folder: got None, expected a path"),
        (lambda: envedit.Result.samples(object(), 1.5), "count: got 1.5, expected an integer"),
        (lambda: envedit.Result.samples(object(), 1, seed=-1), "seed: got -1, expected an integer"),
        (lambda: envedit.sunsky(63), "input.width: got 63, expected an even integer"),
        (lambda: envedit.LightTransport.build("sphere", spp="many"), "renderer.spp: got 'many', expected"),
        (lambda: envedit.LightTransport.build(3), "scene: got int, expected a file, a dict"),
        (lambda: envedit.LightTransport.build("sphere", 32.0), "height: got 32.0, expected an integer"),
        (lambda: envedit.LightTransport.build("sphere", seed="a"), "seed: got 'a', expected an integer"),
        (lambda: envedit.LightTransport.build("sphere", memory_gb="a"), "memory_gb: got 'a', expected a"),
    ],
)
def test_tables_and_other_functions_refuse_by_name_as_well(make, text):
    with pytest.raises(envedit.EnveditError) as info:
        make()
    assert text in str(info.value)


@pytest.mark.slow
def test_a_fit_takes_dicts():
    sky = envedit.sunsky(16)
    fitted = envedit.fit(sky, {"hidden": 8, "depth": 1}, {"epochs": 2, "cache": False})
    assert fitted.epochs == 2 and all(np.isfinite(values).all() for values in fitted.params.values())


# ---- the public surface ------------------------------------------------------------------------------------


def test_the_public_names_are_what_dir_shows_and_explain_themselves():
    assert dir(envedit) == sorted([*envedit.__all__, "__version__"])
    for name in envedit.__all__:
        public = getattr(envedit, name)
        text = inspect.getdoc(public)
        assert text and not text.startswith(f"{name}("), name
        if inspect.isfunction(public):
            sections = ("Parameters\n---", "Returns\n---", "Raises\n---")
            assert all(section in text for section in sections), name
            arguments = inspect.signature(public).parameters
            assert all(argument in text for argument in arguments), name
        elif not issubclass(public, Exception):
            assert "Attributes\n---" in text, name
            for member, found in inspect.getmembers(public, inspect.isroutine):
                if not member.startswith("_"):
                    assert inspect.getdoc(found), (name, member)


@pytest.mark.slow
@pytest.mark.parametrize(("given", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_importing_envedit_limits_the_threads_of_numpy_but_not_against_the_user(given, threads):
    code = f"import os, envedit; assert os.environ['OPENBLAS_NUM_THREADS'] == '{threads}'"
    rest = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, env=rest | given)


@pytest.mark.slow
def test_an_object_is_put_into_a_photograph_under_its_light(tmp_path, monkeypatch, here):
    """The example: the sun of the photograph is found, its curve too, and the box casts a shadow."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    found = runpy.run_path(str(ROOT / "docs" / "insert_in_python.py"))
    result = found["result"]

    # ---- Light and camera
    (sun,) = result.lights["after"]
    assert abs(sun["azimuth"] - 150) < 4 and abs(sun["elevation"] - 30) < 4
    camera = result.metrics["camera"]
    assert camera["curve"] == "filmic" and camera["outliers"] < 0.1
    assert abs(camera["exposure"] - found["phone"].stops) < 0.6
    assert result.metrics["render"]["psnr"] > 30 and not result.warnings
    maps = found["sky"], result.envmap
    before, after = (luminance(map_lights.irradiance(sky, list(map_lights.AXES.values()))) for sky in maps)
    assert np.log(after / before).mean() == pytest.approx(0, abs=1e-4)
    result.posterior = dataclasses.replace(result.posterior, sample=lambda rng: result.found.params)
    np.testing.assert_allclose(result.samples(1)[0], result.envmap, rtol=1e-5)

    # ---- What is written
    saved = images.read_stored(tmp_path / "matched" / "photograph.png")[0]
    assert saved.shape == (40, 3 * 40, 3)
    assert f"curve {camera['curve']}" in (tmp_path / "matched" / "report.html").read_text()
    assert 'kind = "photo"' in (tmp_path / "matched" / "config.toml").read_text()

    # ---- The object: its own pixels, a shadow beside it, and nothing far from it
    outline = found["outline"][..., 0]
    ratio = (found["composed"] / found["photo"].picture)[..., 1]
    assert 0.01 < (outline == 1).mean() < 0.1
    assert ratio[outline == 0].min() < 0.7
    assert abs(np.median(ratio[outline == 0]) - 1) < 0.05


def test_a_map_that_is_odd_is_loaded_with_a_warning(tmp_path):
    file = tmp_path / "odd.exr"
    texels = np.ones((4, 8, 3), np.float32)
    texels[1, 2] = -1
    images.write_exr(file, texels)
    with pytest.warns(UserWarning, match=r"odd\.exr: 1 texel is negative .* set to 0"):
        envmap = envedit.load_map(file)
    np.testing.assert_array_equal(envmap, np.maximum(texels, 0))
