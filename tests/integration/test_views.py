"""Several views of a scene, which one map explains."""

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit import config, pipeline
from envedit.core import latlong
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from envedit.scene import scene
from envedit.solve import search
from envedit.targets import target
from envedit.transport.light_transport import LightTransport
from tests.oracles import runs
from tests.oracles.builders import LIGHT, sky, write_scene

GLOSSY = '<shape type="sphere"><bsdf type="roughplastic"><float name="alpha" value="0.2"/></bsdf></shape>'
NAMES = "front", "behind"


def camera(name, z, height, width=40, rfilter=""):
    """A sensor with a name, or without one, on the z axis; the film has Mitsuba's Gaussian filter."""
    return f"""<sensor type="perspective" {f'id="{name}"' if name else ""}><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="0,1,{z}" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/>
    {rfilter}</film></sensor>"""


TWO = camera("front", 5, 20), camera("behind", -4, 30), GLOSSY, LIGHT


@pytest.fixture
def two(tmp_path):
    return write_scene(tmp_path, *TWO, name="scene.xml")


def settings_of(two, **tables):
    given = {
        "input": {"envmap": "sunsky", "width": 64},
        "scene": {"file": str(two), "width": 40, "sensors": "all"},
        "target": {"rotate_degrees": 120.0},
        "representation": {"turn": False, "cycles": 6},
    }
    return config.from_dict({"preset": "draft"} | runs.merged(given, tables), two.parent)


# ---- the scene ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_renderings_stand_below_each_other_in_the_order_asked_for(two, rng):
    """Each is the one that plain Mitsuba makes of that sensor, also by T, and up to the seam."""
    image = sky(rng, 16, 32) + 0.1
    both = scene.load(two, sensors="all")
    assert [(view.name, view.rows) for view in both.views] == [
        ("front", slice(0, 20)),
        ("behind", slice(20, 50)),
    ]
    assert (both.width, both.height) == (40, 50) and both.notes == (
        "2 of 2 sensors used: perspective front, perspective behind",
    )
    first = scene.load(two)
    np.testing.assert_array_equal(both.render(image, 16, 5)[:20], first.render(image, 16, 5))
    images.write_exr(two.parent / "map.exr", image)
    light = (
        '<integrator type="path"/><emitter type="envmap"><string name="filename" value="map.exr"/></emitter>'
    )
    plain = mi.load_file(str(write_scene(two.parent, *TWO[:3], light, name="plain.xml")))
    plain = [np.array(mi.render(plain, sensor=k, spp=1024, seed=k))[..., :3] for k in (0, 1)]
    other = scene.load(two, sensors=["behind", 0])
    assert other.digest != both.digest and [view.name for view in other.views] == ["behind", "front"]
    other_order = [other.render(image, 256)[view.rows] for view in reversed(other.views)]
    transport = LightTransport.build(both, 16, 32, spp=256)
    traced = transport.apply(mi.TensorXf(image)).numpy()
    for k, view in enumerate(both.views):
        for found in (other_order[k], traced[view.rows]):
            np.testing.assert_allclose(found.mean((0, 1)), plain[k].mean((0, 1)), rtol=0.01)
            for edge in (0, -1):  # where the other view begins
                np.testing.assert_allclose(found[edge].mean(0), plain[k][edge].mean(0), rtol=0.02)


@pytest.mark.slow
def test_views_that_cannot_be_are_refused(tmp_path, two):
    def refused(parts, sensors, **keys):
        path = write_scene(tmp_path, *parts, GLOSSY, LIGHT, name="refused.xml")
        with pytest.raises((ConfigError, InputError)) as info:
            scene.load(path, sensors=sensors, **keys)
        return str(info.value)

    unnamed = camera("", 5, 20), camera("", -4, 20, width=30)
    wide = "scene.sensors: sensor 0 is 40 pixels wide and sensor 1 is 30"
    assert wide in refused(unnamed, "all")
    assert len(scene.load(tmp_path / "refused.xml", 24, sensors="all").views) == 2
    assert "scene.sensors: got 2, expected one of 0 (perspective), 1" in refused(unnamed, [2])
    assert "scene.sensors: got 'left', expected one of 0 (perspective front)" in refused(TWO[:2], ["left"])
    assert "expected each sensor once" in refused(TWO[:2], [0, "front"])
    meter = '<sensor type="radiancemeter"><film type="hdrfilm"/></sensor>'
    assert "sensor radiancemeter makes no picture" in refused((*unnamed, meter), "all")
    with pytest.raises(ConfigError, match=r'renderer.kind: got "path" with 2 views'):
        pipeline.run(settings_of(two, renderer={"kind": "path"}))
    with pytest.raises(ConfigError, match=r"target.strokes\[0\].view: got view 'left', expected one of 0"):
        stroke = {"type": "light", "view": "left", "ellipse": [0.5, 0.5, 0.2, 0.2]}
        pipeline.run(settings_of(two, target={"kind": "strokes", "strokes": [stroke]}))


@pytest.mark.parametrize("given", ["[]", "['a', 'a']", "'front'", "[-1]", "[true]", "0"])
def test_lists_of_sensors_that_say_nothing(given):
    with pytest.raises(ConfigError, match=r'scene.sensors: got .*, expected "all", or a list'):
        config.loads(f"[scene]\nsensors = {given}")


# ---- targets -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("own_cache")
def test_what_is_painted_belongs_to_a_view_and_the_others_hold(two):
    """From files, one or several, and as strokes; masks likewise."""
    lit, envmap = scene.load(two, 40, sensors="all"), np.ones((8, 16, 3), np.float32)
    strokes = [
        {"type": "light", "view": "behind", "ellipse": [0.5, 0.5, 0.2, 0.2], "amount": 2.0},
        {"type": "light", "view": 1, "ellipse": [9.0, 9.0, 0.1, 0.1]},
    ]
    made = target.make(settings_of(two, target={"kind": "strokes", "strokes": strokes}), lit, envmap)
    assert made.coverage[20:].any() and not made.coverage[:20].any()
    np.testing.assert_array_equal(made.picture[:20], made.initial[:20])
    first, white = made.warnings
    assert first.startswith("target.strokes[1] (light): lies outside the 40x30 picture")
    assert "of its pixels are white under the tonemap" in white

    for k, rows in enumerate(lit.rows):
        images.write_exr(two.parent / f"p{k}.exr", made.initial[rows] * 1.5, panorama=False)
        black = np.zeros((rows.stop - rows.start, 40, 3))
        black[:4] = 1
        images.write_png(two.parent / f"m{k}.png", black)
    painted = {"kind": "image", "file": "p1.exr", "view": "behind"}
    found = target.make(settings_of(two, target=painted), lit, envmap)
    assert (found.coverage[20:] > 0).mean() > 0.9 and not found.coverage[:20].any()
    np.testing.assert_array_equal(found.picture[:20], found.initial[:20])
    painted = {"kind": "image", "file": ["p1.exr", "p0.exr"], "view": [1, 0], "mask": ["m1.png", "m0.png"]}
    found = target.make(settings_of(two, target=painted), lit, envmap)
    rows = np.flatnonzero(found.coverage.any(axis=(1, 2)))
    np.testing.assert_array_equal(rows, [0, 1, 2, 3, 20, 21, 22, 23])
    with pytest.raises(InputError, match="p0.exr: is 40x20 pixels, the rendering is 40x30"):
        target.make(settings_of(two, target={"kind": "image", "file": "p0.exr", "view": 1}), lit, envmap)
    with pytest.raises(ConfigError, match="by index and by name"):
        twice = {"kind": "image", "file": ["p1.exr", "p1.exr"], "view": [1, "behind"]}
        target.make(settings_of(two, target=twice), lit, envmap)
    found = target.make(settings_of(two, target={"mask": "m1.png", "view": 1}), lit, envmap)
    assert (found.weight[:24] == 1).all() and not found.weight[24:].any()
    with pytest.raises(ConfigError, match="by index and by name"):
        twice = {"mask": ["m0.png", "m1.png"], "view": [1, "behind"]}
        target.make(settings_of(two, target=twice), lit, envmap)
    for kind in ({"kind": "image", "file": ["p0.exr", "p1.exr"]}, {"rotate_degrees": 60}):
        chosen = settings_of(two, target=kind | {"mask": ["m0.png", ""], "view": [0, 1]})
        assert chosen.target.masks[1] == ""  # of a view without one every pixel counts, or is compared
        found = target.make(chosen, lit, envmap)
        counts = found.weight if found.coverage is None else found.coverage
        assert not counts[4:20].any() and counts[24:].any()


@pytest.mark.parametrize("keys, what", [
    ('file = ["a.exr", "b.exr"]', "target.file: got a list"),
    ('kind = "image"\nfile = "a.exr"\nview = [0, 1]', "target.view: got 2 views, expected 1"),
    ('kind = "image"\nfile = ["a.exr", "b.exr"]\nview = [1, 1]', "target.view: got a view twice"),
    ('kind = "image"\nfile = ["a.exr", "b.exr"]\nmask = "c.png"', "target.mask: got 1 masks, expected 2"),
    ('kind = "strokes"\nstrokes = [{ type = "blur", radius = 1 }]\nview = 1', "target.view: got one"),
    ("view = -1", "the index of a view from 0, or a list of them"),
])  # fmt: skip
def test_targets_that_fit_no_views(keys, what):
    with pytest.raises(ConfigError, match=what):
        config.loads(f"[target]\n{keys}")


# ---- runs --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("isolated")
def test_two_views_determine_more_sky_than_each_alone(two, capsys, monkeypatch):
    """The posterior says so, where the sky alone explains the picture; the files are of each view."""
    out = two.parent / "out"
    small = {"input": {"width": 32}, "target": {"rotate_degrees": 20.0}, "optimizer": {"iterations": 6}}
    (two.parent / "c.toml").write_text(config.to_toml(settings_of(two, **small)))
    monkeypatch.setattr(search, "_moves", lambda *_: [])
    assert runs.call(two.parent / "c.toml", "--out", out) == 0
    assert "2 of 2 sensors used" in capsys.readouterr().out
    metrics = runs.measured(out)
    assert [view["name"] for view in metrics["views"]] == list(NAMES)
    mse = [view["render"]["mse"] for view in metrics["views"]]
    assert metrics["render"]["mse"] == pytest.approx((20 * mse[0] + 30 * mse[1]) / 50)
    for name in ("initial", "target", "edited"):
        shapes = [runs.pixels(out / f"render_{name}{k}.exr").shape for k in ("", "_0", "_1")]
        assert shapes == [(20, 40, 3), (20, 40, 3), (30, 40, 3)]
        np.testing.assert_array_equal(*(runs.pixels(out / f"render_{name}{k}.exr") for k in ("", "_0")))
    report = (out / "report.html").read_text()
    assert "edited, rendering of view 1 (behind)" in report and "<h2>Views</h2>" in report
    assert (out / "edited.xml").read_text().count("<sensor") == 2
    omega = latlong.solid_angles(16, 32)[:, None] / (4 * np.pi)
    alone = [pipeline.run(settings_of(two, scene={"sensors": [k]}, **small)) for k in NAMES]
    deviation = OpenEXR.File(str(out / "edited_layers.exr"), separate_channels=True).channels()
    both = float((deviation["deviation.Y"].pixels * omega).sum())
    assert both < 0.97 * min((one.posterior.deviation * omega).sum() for one in alone)
    assert metrics["render"]["psnr"] > metrics["initial"]["psnr"] + 1
    # A run of one view in the same folder leaves no numbered files of this one.
    one_view = runs.changed(scene__sensors=[0], target__kind="none")
    assert runs.call(two.parent / "c.toml", "--out", out, *one_view) == 0
    assert not list(out.glob("render_*_*.exr")) and list(out.glob("earlier-1/render_edited_1.exr"))


@pytest.mark.slow
@pytest.mark.usefixtures("own_cache")
def test_adam_edits_two_views(two):
    settings = settings_of(
        two, input={"width": 16}, scene={"width": 24}, target={"spp": 16, "rotate_degrees": 20.0},
        output={"spp": 16}, optimizer={"kind": "adam", "iterations": 6}, loss={"ssim": 1.0},
        representation={"cycles": 4}, renderer={"spp": 32, "max_depth": 2},
    )  # fmt: skip
    found = pipeline.run(settings).metrics
    assert found["render"]["psnr"] > found["initial"]["psnr"]


@pytest.mark.slow
@pytest.mark.usefixtures("isolated")
def test_pictures_to_paint_on_are_exported_of_every_view(two, capsys):
    (two.parent / "c.toml").write_text(config.to_toml(settings_of(two, target={"spp": 4})))
    assert runs.call(two.parent / "c.toml", "--export-initial", two.parent / "paint.exr") == 0
    said = capsys.readouterr().out
    assert "paint_1.exr: 40x30, linear" in said and "view = 1" in said
    assert runs.pixels(two.parent / "paint_0.exr").shape == (20, 40, 3)
    assert runs.call(two.parent / "c.toml", "--export-initial", two.parent / "paint.exr") == 3
    assert "paint_0.exr: exists" in capsys.readouterr().err
