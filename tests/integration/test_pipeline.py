"""A run without a command line: what it returns, and that stopping and continuing changes no bit of it."""

import dataclasses
import json
import signal
import tomllib
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from envedit import api, config, inputs, pipeline
from envedit.core import color, interrupts, latlong
from envedit.core.errors import InputError
from envedit.core.rotations import Orientation
from envedit.images import analytic_sky, images
from envedit.losses.perceptual import installed
from envedit.representations.layers import gain
from envedit.representations.layers.placed_lights import angles, direction
from envedit.representations.layers.unseen import unseen_kept
from envedit.scene import scene
from envedit.solve import checkpoint, gauss_newton, likelihood, search
from envedit.targets.target import Target
from envedit.transport import sampling_plan
from tests.oracles.builders import BALL, LIGHT, SENSOR, sky, write_scene
from tests.oracles.matrix_renderer import without_times
from tests.oracles.runs import HEIGHT, WIDTH, interrupting, merged, settings_of, smooth, sunny

pytestmark = pytest.mark.usefixtures("own_cache", "own_core")

PIXELS = {"representation": {"kind": "pixels"}}
STROKES = [{"type": "light", "ellipse": [0.45, 0.4, 0.15, 0.15], "amount": 2.0}]
PAINTED = {"target": {"spp": 16, "kind": "strokes", "strokes": STROKES}}


def without_timing(measured):
    """Return metrics without what may differ between a run and its repetition."""
    parts = {
        part: measured[part] and {key: value for key, value in measured[part].items() if key != "cached"}
        for part in ("fit", "transport")
    }
    return {**measured, "timing": None, **parts}


def assert_same(resumed, whole):
    """Compare all but times of a resumed run and one that was not interrupted."""
    assert resumed.envmap.tobytes() == whole.envmap.tobytes()
    assert all(resumed.renders[key].tobytes() == whole.renders[key].tobytes() for key in whole.renders)
    assert without_times(resumed.history) == without_times(whole.history)
    assert without_timing(resumed.metrics) == without_timing(whole.metrics)


# ---- what comes back -------------------------------------------------------------------------------------


def test_a_run_without_a_folder_writes_nothing_and_returns_everything(tmp_path, rng, monkeypatch):
    optimizer = {"iterations": 3, "checkpoint_s": 0.0}
    settings = settings_of(tmp_path, sunny(rng), optimizer=optimizer, renderer={"cache": False})
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    before = {path.name for path in tmp_path.iterdir()}
    found = pipeline.run(settings)
    assert {path.name for path in tmp_path.iterdir()} == before
    assert list((tmp_path / "here").iterdir()) == []
    assert found.envmap.shape == (HEIGHT, WIDTH, 3) and found.envmap.dtype == np.float32
    assert found.render is found.renders["edited"]
    assert set(found.renders) == set(found.maps) == {"initial", "target", "edited"}
    assert all(picture.shape == (18, 24, 3) for picture in found.renders.values())
    assert found.influence.shape == (HEIGHT, WIDTH) and found.influence.max() > 0
    assert len(found.history) == found.metrics["iterations"] == 3
    assert all("no effect: needs" in line for line in found.warnings)
    assert any("60 degrees" in note for note in found.notes)
    assert any("light transport" in note for note in found.notes)


@pytest.mark.parametrize("height", [3, 7, 8])
def test_upper_rows_end_at_the_last_one_not_below_the_horizon(height):
    elevation = 90 - 180 * np.arange(height) / (height - 1)
    found = inputs.active_rows("upper", height)
    assert (found.first, found.last) == (0, np.flatnonzero(elevation >= 0)[-1])


PLATE = """<sensor type="perspective"><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="4,0,0" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
    <rfilter type="box"/></film></sensor>
    <shape type="rectangle"><transform name="to_world"><rotate y="1" angle="90"/><scale value="2"/>
    </transform></shape>"""


def plated(folder, picture, **tables):
    """Return the configuration of a run on all rows of a 64 x 32 map whose plate sees the half with x > 0."""
    given = {"input": {"rows": "all", "width": 64}, "renderer": {"spp": 256, "max_depth": 3}} | tables
    settings = settings_of(folder, picture, **given)
    write_scene(folder, PLATE, LIGHT, name="scene.xml")
    return settings


@pytest.mark.slow
def test_texels_behind_the_only_surface_keep_their_value(tmp_path, rng):
    """A plate that faces +x fills the picture: of the map it sees the half with x > 0."""
    picture = 0.2 * sky(rng, 32, 64) + 0.3
    images.write_exr(tmp_path / "brighter.exr", 2 * picture)
    settings = plated(
        tmp_path, picture, input={"rows": "all", "horizon": "free", "width": 64},
        representation={"kind": "siren", "hidden": 16, "depth": 1}, target={"file": "brighter.exr"},
        optimizer={"kind": "adam", "iterations": 5, "lr": 1e-2},
    )  # fmt: skip
    found = pipeline.run(settings)
    original, x = found.maps["initial"], latlong.directions(32, 64)[..., 0]
    assert not found.frozen[x > 0].any() and found.frozen[x < -0.5].all()
    assert found.envmap[found.frozen].tobytes() == original[found.frozen].tobytes()
    assert (found.envmap != original)[x > 0.1].any(axis=-1).mean() > 0.9
    share = found.metrics["transport"]["frozen"]
    assert share == pytest.approx(found.frozen.mean()) and 0.2 < share < 0.5
    assert any("active texels keep their value" in line for line in found.metrics["choices"])

    # Without the threshold, or where the influence is not known, every texel may change.
    for renderer in ({"influence_threshold": 0.0}, {"kind": "path", "spp": 4}):
        other = dataclasses.replace(settings.renderer, **renderer)
        free = pipeline.run(dataclasses.replace(settings, renderer=other))
        assert free.frozen is None or not free.frozen.any()
        assert (free.envmap != original)[x < -0.5].any()
        assert not any("keep their value" in line for line in free.metrics["choices"])


@pytest.mark.slow
def test_what_this_view_does_not_determine_changes_less(tmp_path):
    """The sun goes from one place that the plate sees to another; behind it the prior holds the sky.

    A plate tells how much light falls on it, not from where: the sun may stay, and the sky become darker.
    """
    picture = np.full((32, 64, 3), 0.3, np.float32)
    wanted = picture.copy()
    picture[10, 12], wanted[14, 20] = 300, 300
    images.write_exr(tmp_path / "wanted.exr", wanted)
    target = {"file": "wanted.exr", "rotate_degrees": 0.0, "spp": 256}
    tables = {"target": target, "optimizer": {"iterations": 5}, "output": {"spp": 1024}}
    found = pipeline.run(plated(tmp_path, picture, **tables))
    assert not found.frozen.any() and len(found.separation.lights) == 1
    x = latlong.directions(32, 64)[:16, :, 0]  # the ground follows what lights it on either side
    change = np.abs(np.log(found.envmap / found.maps["initial"])).max(axis=2)[:16]
    assert change[x < -0.5].mean() < 0.9 * change[x > 0.5].mean()
    known = found.posterior.identified[:16]
    assert known[x < -0.5].mean() < 0.8 * known[x > 0.5].mean()
    assert any("bit for bit" in line for line in found.metrics["choices"])
    assert found.metrics["render"]["psnr"] > found.metrics["initial"]["psnr"] + 8


@pytest.mark.slow
def test_paint_is_explained_by_lights_where_adam_is_to_make_no_step(tmp_path, rng):
    adam = {"optimizer": {"iterations": 0, "kind": "adam"}}
    found = pipeline.run(settings_of(tmp_path, sunny(rng), **PAINTED, **adam))
    assert np.isfinite(found.envmap).all() and not found.history
    assert any(line.startswith("likeliest explanation of the paint: ") for line in found.notes)


@pytest.mark.slow
def test_layers_follow_a_painted_picture_and_its_mask(tmp_path):
    """Painted: the ball under a sun elsewhere, a black bar across it, which the mask leaves out."""
    picture, wanted = np.full((16, 32, 3), 0.3, np.float32), np.full((16, 32, 3), 0.3, np.float32)
    picture[4, 20], wanted[4, 4] = 60, 60
    tables = {
        "input": {"width": 32, "rows": "all"}, "scene": {"width": 48},
        "renderer": {"spp": 256, "max_depth": 3}, "output": {"spp": 256},
    }  # fmt: skip
    lit = scene.load(settings_of(tmp_path, picture, **tables).scene.file, 48, 36)
    painted, counted = lit.render(wanted, spp=1024, seed=5), np.ones((36, 48, 3), np.float32)
    painted[8:13], counted[8:13] = 0, 0
    images.write_exr(tmp_path / "painted.exr", painted)
    images.write_exr(tmp_path / "mask.exr", counted)
    target = {"kind": "image", "file": "painted.exr", "mask": "mask.exr", "hold": 0.0}
    found = pipeline.run(settings_of(tmp_path, picture, target=target, **tables))
    rest = counted[..., 0] > 0

    def error(name):
        return np.square(found.renders[name] - painted)[rest].mean()

    assert error("edited") < 0.1 * error("initial")
    assert found.metrics["envmap"] is None
    peak = np.unravel_index(found.envmap.sum(axis=2).argmax(), (16, 32))
    assert abs(peak[0] - 4) <= 2 and abs(peak[1] - 4) <= 2
    assert_variants(found, tmp_path, settings_of(tmp_path, picture, target=target, **tables))


def assert_variants(found, folder, settings):
    """Other explanations are measured, written and shown, and an edit goes on from one."""
    assert found.variants
    assert found.metrics["variants"] == [one.measures for one in found.variants]
    said = [line for line in found.notes if line.startswith("other explanations: ")]
    assert len(said) == 1 and all(one.name in said[0] for one in found.variants)
    found.save(folder / "out")
    kept = folder / "out" / "variants"
    assert (kept / "variants.png").exists() and len(list(kept.glob("*.npz"))) == len(found.variants)
    assert "Other explanations" in (folder / "out" / "report.html").read_text()
    first = found.variants[0]
    np.testing.assert_array_equal(images.read(kept / "1.exr")[0], first.envmap)
    assert np.isfinite(first.envmap).all() and not np.array_equal(first.envmap, found.envmap)
    optimizer = dataclasses.replace(settings.optimizer, start=str(kept / "1.npz"), iterations=1)
    again = pipeline.run(dataclasses.replace(settings, optimizer=optimizer))
    assert not again.variants and again.metrics["painted"]["towards"] is not None
    found.save(folder / "out")  # what is there is moved away as a whole
    assert (folder / "out" / "earlier-1" / "variants" / "1.npz").exists() and (kept / "1.npz").exists()


@pytest.mark.slow
def test_a_highlight_that_matte_ground_cannot_show_leaves_the_mean_of_the_rest(tmp_path):
    """As bright as painted, the ground takes a sky that makes all of it bright; what is to stay stays."""
    spot = {"type": "light", "ellipse": [0.5, 0.4, 0.06, 0.06, 0.0], "amount": 3.0, "units": "fraction"}
    tables = {
        "input": {"width": 64, "rows": "all"}, "scene": {"width": 32}, "output": {"spp": 64},
        "renderer": {"spp": 64, "max_depth": 3}, "optimizer": {"iterations": 60},
    }  # fmt: skip
    picture = analytic_sky.sunsky(64, 240.0, 45.0)
    for chosen in ("follow", "keep"):
        target = {"kind": "strokes", "strokes": [spot], "rest": chosen}
        found = pipeline.run(settings_of(tmp_path, picture, target=target, **tables))
        shown = {name: color.tonemap(found.renders[name]) for name in ("initial", "target", "edited")}
        rest = (shown["initial"] == shown["target"]).all(axis=2)
        change = (shown["edited"] - shown["initial"])[rest]
        assert np.abs(change.mean(axis=0)).max() < 1.5 * likelihood.VISIBLE
        if chosen == "keep":
            assert np.abs(change).mean() < 0.025


@pytest.mark.slow
def test_a_sun_at_the_horizon_that_rises_loses_its_colour_and_not_the_sky(tmp_path):
    """The low sun has no blue: were its colour held as that of the sky, the sky would turn blue for it."""

    def made(row, sun, glow):
        d = latlong.directions(32, 64)
        angle = np.degrees(np.arccos(np.clip(d @ d[row, 40], -1, 1)))
        picture = 0.2 * np.ones(3) + glow * np.exp(-((angle / 20) ** 2))[..., None] * [1, 0.6, 0.3]
        picture[16:] = 0.1
        picture[row, 40] = sun
        return picture.astype(np.float32)

    images.write_exr(tmp_path / "day.exr", made(11, [2000, 1800, 1600], 0))
    settings = settings_of(
        tmp_path, made(15, [400, 60, 0], 3), input={"width": 64, "rows": "all"},
        target={"file": "day.exr", "rotate_degrees": 0.0, "spp": 256}, scene={"file": "sphere", "width": 48},
        renderer={"spp": 64}, optimizer={"iterations": 60}, output={"spp": 256},
    )  # fmt: skip
    found = pipeline.run(settings).metrics
    assert found["render"]["psnr"] > 36
    assert found["natural"]["colours_outside"] < 0.1


@pytest.mark.slow
def test_a_setting_sun_without_blue_is_replaced_by_a_white_one(tmp_path):
    """No factor makes its light white; an added light that had its colour would leave the blue to the sky."""

    def made(row, column, sun, colour):
        picture = np.broadcast_to(np.float32(colour), (32, 64, 3)).copy()
        picture[16:] = 0.1
        picture[row, column] = sun
        return picture

    images.write_exr(tmp_path / "day.exr", made(8, 20, [2000, 1900, 1800], [0.3, 0.4, 0.6]))
    settings = settings_of(
        tmp_path, made(14, 40, [200, 30, 0], [0.4, 0.35, 0.3]), input={"width": 64, "rows": "all"},
        target={"file": "day.exr", "rotate_degrees": 0.0, "spp": 256}, scene={"file": "pair", "width": 20},
        renderer={"spp": 64}, representation={"turn": False}, output={"spp": 256},
        optimizer={"iterations": 60},
    )  # fmt: skip
    found = pipeline.run(settings)
    (light,) = found.lights["after"]
    assert (
        light["azimuth"] == pytest.approx(360 * 20.5 / 64, abs=3)
        and light["flux"][2] > 0.8 * light["flux"][0]
    )
    assert found.metrics["render"]["psnr"] > found.metrics["ceiling"]["psnr"] - 3


@pytest.mark.slow
def test_paint_that_asks_for_another_brightness_leaves_the_sky_its_colours():
    """With a rendered target's prior, 30 % of this sky turn a darker blue; a colour that is painted comes."""
    edits, towards = Path(__file__).parents[2] / "scenes" / "edits", {}
    for edit, outside in (("enhance_shadow", 0.05), ("warmer", 1.0)):
        tables = tomllib.loads((edits / f"{edit}.toml").read_text(encoding="utf-8"))
        tables |= {"output": {"spp": 64}, "renderer": {"spp": 64}, "representation": {"cycles": 6}}
        tables["input"]["width"], tables["scene"] = 64, tables.get("scene", {}) | {"width": 48}
        found = pipeline.run(config.from_dict(tables)).metrics
        assert found["natural"]["colours_outside"] <= outside
        towards[edit] = found["painted"]["towards"] / found["painted"]["reachable"]
    assert towards["enhance_shadow"] > 0.5 and towards["warmer"] > 0.8


@pytest.mark.slow
def test_rows_that_fill_no_cell_of_the_block_transport_can_be_edited(tmp_path, rng):
    rows = [10, 10]
    picture = (0.1 + 0.3 * rng.random((128, 256, 1)) * np.ones(3)).astype(np.float32)
    found = pipeline.run(settings_of(tmp_path, picture, input={"rows": rows, "width": 256}))
    assert np.isfinite(found.envmap).all() and found.metrics["active_rows"] == rows
    others = np.delete(np.arange(128), 10)
    assert found.envmap[others].tobytes() == picture[others].tobytes()


class Stub:
    """A measure that is the mean squared difference of display values."""

    backbone = types.SimpleNamespace(least_size=5)

    def against(self, reference):
        return lambda x: dr.mean(dr.square(x.array - reference.array))

    def __call__(self, a, b):
        return float(np.mean(np.abs(a - b)))


@pytest.mark.slow
def test_a_siren_says_how_to_get_weights_and_has_dists_where_they_are(tmp_path, rng, monkeypatch):
    few = {"representation": {"kind": "siren", "hidden": 16, "depth": 1}, "fit": {"epochs": 20}}
    few["optimizer"] = {"iterations": 2}
    found = pipeline.run(settings_of(tmp_path, sunny(rng), **few))
    said = [line for line in found.notes if "DISTS is off" in line]
    assert len(said) == 1 and "`envedit weights" in said[0] and "\n" not in said[0]
    assert not any("dists" in line.lower() for line in found.warnings)
    assert found.settings.loss.dists == 0 and "dists" not in found.history[0]
    asked = pipeline.run(settings_of(tmp_path, sunny(rng), **few, loss={"dists": 0.6}))
    assert any("DISTS" in line and "loss.dists" in line for line in asked.warnings)
    monkeypatch.setattr(
        installed,
        "load",
        lambda settings: installed.Networks(installed.settled(settings), Stub(), Stub(), ""),
    )
    (tmp_path / "weights").mkdir()
    there = {"perceptual": {"weights": str(tmp_path / "weights"), "dists_every": 1}}
    found = pipeline.run(settings_of(tmp_path, sunny(rng), **few, **there))
    assert found.settings.loss.dists == 0.1 and found.history[-1]["dists"] > 0
    assert found.settings.optimizer.iterations == 2 and not any("DISTS" in line for line in found.notes)
    assert found.metrics["render"]["lpips"] > 0 and found.metrics["initial"]["lpips"] > 0
    assert found.metrics["envmap"]["lpips"] is None  # 4 rows are too few for the network


@pytest.mark.slow
def test_a_siren_reaches_a_sky_brighter_than_any_texel_of_the_map(tmp_path, rng):
    """Its output is between the map's darkest and brightest: the sky begins with a factor."""
    picture = 0.1 * smooth(rng)
    active = slice(0, HEIGHT // 2)
    brighter = picture.copy()
    brighter[active] *= 4
    images.write_exr(tmp_path / "brighter.exr", brighter)
    few = {"representation": {"kind": "siren", "hidden": 32, "depth": 1}, "fit": {"epochs": 200}}
    wanted = {"target": {"file": "brighter.exr"}, "optimizer": {"iterations": 20}}
    found = pipeline.run(settings_of(tmp_path, picture, **few, **wanted))
    assert any("the sky begins" in line for line in found.notes)
    assert found.envmap[active].mean() / picture[active].mean() == pytest.approx(4, rel=0.1)
    assert found.metrics["render"]["psnr"] > found.metrics["initial"]["psnr"] + 10


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ({"perceptual": {"weights": "here"}}, r"_features\.npz: no such file"),
        ({"perceptual": {"backbone": "alexnet.npz", "heads": "heads.npz"}}, r"alexnet\.npz"),
        ({"renderer": {"spp": 4096, "memory_gb": 0.01}}, "memory_gb allows 0.01"),
    ],
)
def test_what_a_run_lacks_is_told_before_anything_is_rendered(tables, says, tmp_path, rng, monkeypatch):
    monkeypatch.setattr(pipeline, "make_target", None)
    (tmp_path / "here").mkdir()
    with pytest.raises(InputError, match=says):
        pipeline.run(settings_of(tmp_path, sunny(rng), **tables))


# ---- stopping and continuing -----------------------------------------------------------------------------

SIREN = {"representation": {"kind": "siren", "hidden": 16, "depth": 1}}
CASES = {
    "siren, columns": SIREN,
    "pixels, transport recorded afresh": PIXELS | {"renderer": {"spp": 32, "max_depth": 3, "refresh": 6}},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_an_interrupted_run_ends_with_the_same_bits(name, tmp_path, rng):
    """Interrupted after 13 and all 20 steps; 13 is no multiple of what the transport counts in."""
    picture = sunny(rng)
    settings = settings_of(tmp_path, picture, **CASES[name])
    whole = pipeline.run(settings)
    assert (whole.envmap != picture).any()
    stopped, resumed, last = stopped_and_resumed(settings, tmp_path, (13, 20))
    if "columns" in name:
        assert len(stopped["renderer/columns"]) > 1  # one is traced in any case, in the first step
    assert_same(resumed, whole)
    assert last.tobytes() == whole.envmap.tobytes()


def stopped_and_resumed(settings, folder, steps):
    """Interrupt a run after some steps; return its checkpoint, what it ends with, and its map so far."""
    folder = folder / "run"
    folder.mkdir()
    for step in steps:
        with pytest.raises(pipeline.Interrupted, match=f"iteration {step}") as stop:
            pipeline.run(settings, folder=folder, resume=True, watch=interrupting(step=step))
        assert stop.value.step == step and np.isfinite(stop.value.envmap).all()
        assert [path.name for path in folder.iterdir()] == [checkpoint.NAME]
        with np.load(folder / checkpoint.NAME) as stored:
            stopped = dict(stored)
        assert json.loads(stopped["meta"].tobytes())["state"]["step"] == step
    return stopped, pipeline.run(settings, folder=folder, resume=True), stop.value.envmap


@pytest.mark.slow
def test_an_interrupted_gauss_newton_run_ends_with_the_same_bits(tmp_path, rng, monkeypatch):
    """Interrupted in the first step, in the middle, in the last, and where nothing is left to do."""
    monkeypatch.setattr(gauss_newton, "COMPARED_NOISE_RATIO", 0)  # a solution that is no better stays, too
    settings = settings_of(tmp_path, sunny(rng), **PAINTED)
    whole = pipeline.run(settings)
    steps = len(whole.history)
    tried = min(steps, search.EXPLANATION_STEPS)  # from where the best explanation goes on
    assert steps >= 3
    stops = sorted({tried, max(tried, steps // 2), steps})
    _, resumed, last = stopped_and_resumed(settings, tmp_path, stops)
    assert unseen_kept(whole.maps["initial"], last).tobytes() == whole.envmap.tobytes()
    assert resumed.posterior.deviation.tobytes() == whole.posterior.deviation.tobytes()
    assert_same(resumed, whole)


MIRROR = {
    "input": {"width": 64},
    "scene": {"file": "mirror", "width": 48},
    "representation": {"cycles": "auto"},
}


def detailed(rng):
    return np.exp(rng.normal(0, 0.5, (32, 64, 1)) + rng.normal(0, 0.1, (32, 64, 3))).astype(np.float32)


@pytest.mark.slow
def test_a_mirror_gets_finer_grids_and_more_samples_and_goes_on_where_it_stopped(tmp_path, rng, monkeypatch):
    monkeypatch.setattr(sampling_plan, "PATHS", 32 * 48**2)
    monkeypatch.setattr(sampling_plan, "MOST_SPP", 128)
    picture = detailed(rng)
    renderer = {"spp": "auto", "pixels": 36 * 32}  # detail is solved for on every pixel
    settings = settings_of(tmp_path, picture, target={"rotate_degrees": 90}, renderer=renderer, **MIRROR)
    whole = pipeline.run(settings)
    assert not any("solved on" in note for note in whole.notes)
    assert whole.metrics["transport"]["samples"] == 128
    assert any("128 paths" in note and " 32" in note for note in whole.notes)
    assert any("light transport" in note and "128 paths" in note for note in whole.notes)
    levels = [name for name in whole.found.params if name.startswith("gain.")]
    assert len(levels) > gain.LEVELS
    assert all(np.abs(whole.found.params[name].numpy()).max() > 0 for name in levels)
    _, resumed, _ = stopped_and_resumed(settings, tmp_path, (7,))
    assert_same(resumed, whole)


@pytest.mark.slow
def test_a_mirror_gets_no_finer_grids_where_coarse_ones_explain_the_target(tmp_path, rng):
    picture = detailed(rng)
    images.write_exr(tmp_path / "brighter.exr", 1.3 * picture)
    target = {"file": str(tmp_path / "brighter.exr")}
    settings = settings_of(tmp_path, picture, target=target, renderer={"pixels": 36 * 32}, **MIRROR)
    brighter = pipeline.run(settings)
    assert any("identifiable detail: " in note and "24 cycles" in note for note in brighter.notes)
    assert any("coarse grids explain the target" in note for note in brighter.notes)
    assert not any("kept the initialisation" in note for note in brighter.notes)
    assert len([name for name in brighter.found.params if name.startswith("gain.")]) == gain.LEVELS
    seen = brighter.influence > np.median(brighter.influence)
    assert np.median(brighter.envmap[seen] / picture[seen]) == pytest.approx(1.3, abs=0.05)


@pytest.mark.slow
def test_an_interrupted_run_of_the_path_tracer_goes_on_where_it_stopped(tmp_path, rng, monkeypatch):
    """Mitsuba adds the gradients of a texel in any order: its runs agree but for the last bits."""
    renderer = {"kind": "path", "spp": 4, "max_depth": 3}
    settings = settings_of(tmp_path, smooth(rng), renderer=renderer, optimizer={"iterations": 10}, **PIXELS)
    whole = pipeline.run(settings)
    _, resumed, _ = stopped_and_resumed(settings, tmp_path, (7,))
    losses = [[row["loss"] for row in found.history] for found in (resumed, whole)]
    # Two undisturbed runs differ by 1e-7 at most; with another seed the losses differ by up to 0.25.
    np.testing.assert_allclose(*losses, rtol=1e-4)
    np.testing.assert_allclose(resumed.envmap, whole.envmap, atol=1e-3)


@pytest.mark.slow
def test_what_is_only_tried_is_not_the_map_so_far(tmp_path, rng):
    """Ctrl-C while lights are tried, before and after there is a checkpoint, which stays as it is."""
    folder = tmp_path / "run"
    folder.mkdir()
    tables = {"target": {"rotate_degrees": 150.0}, "representation": {"turn": False}}
    settings = settings_of(tmp_path, sunny(rng), **tables)
    with pytest.raises(KeyboardInterrupt):
        pipeline.run(settings, folder=folder, watch=interrupting("searching for lights"))
    assert not list(folder.iterdir())
    with pytest.raises(pipeline.Interrupted):
        pipeline.run(settings, folder=folder, watch=interrupting())
    stored = (folder / checkpoint.NAME).read_bytes()
    with pytest.raises(KeyboardInterrupt):
        pipeline.run(settings, folder=folder, resume=True, watch=interrupting("searching for lights"))
    assert [file.name for file in folder.iterdir()] == [checkpoint.NAME]
    assert (folder / checkpoint.NAME).read_bytes() == stored


def assert_refused(settings, folder):
    with pytest.raises(InputError, match="another configuration or other input files"):
        pipeline.run(settings, folder=folder, resume=True)


@pytest.mark.slow
def test_a_checkpoint_of_something_else_is_refused(tmp_path, rng):
    """Where the target is painted nothing but the file of the mask itself tells that it has changed."""
    folder = tmp_path / "run"
    folder.mkdir()
    picture, mask = sunny(rng), np.ones((18, 24, 3), np.float32)
    images.write_exr(tmp_path / "painted.exr", 0.5 * mask)
    images.write_exr(tmp_path / "mask.exr", mask)
    painted = {"kind": "image", "file": "painted.exr", "mask": "mask.exr"}
    tables = PIXELS | {"target": painted, "optimizer": {"iterations": 3}}
    settings = settings_of(tmp_path, picture, **tables)
    with pytest.raises(pipeline.Interrupted):
        pipeline.run(settings, folder=folder, watch=interrupting())
    stored = (folder / checkpoint.NAME).read_bytes()

    more = settings_of(tmp_path, picture, **tables | {"optimizer": {"iterations": 4}})
    assert_refused(more, folder)
    assert_refused(settings_of(tmp_path, np.flip(picture, 1).copy(), **tables), folder)  # of the same name
    images.write_exr(tmp_path / "mask.exr", np.concatenate([0 * mask[:9], mask[9:]]))
    assert_refused(settings_of(tmp_path, picture, **tables), folder)
    images.write_exr(tmp_path / "mask.exr", mask)
    write_scene(tmp_path, SENSOR, BALL.replace("0.2, 0.4, 0.6", "0.6, 0.4, 0.2"), LIGHT, name="scene.xml")
    assert_refused(settings, folder)
    assert (folder / checkpoint.NAME).read_bytes() == stored
    pipeline.run(more, folder=folder)  # without resume it is not looked at


@pytest.mark.slow
def test_a_run_is_resumed_although_mitsuba_renders_the_target_anew(tmp_path, rng, monkeypatch):
    """Mitsuba adds samples in any order where the pixel filter is wider than a box, as its default is.

    Its pictures then agree to 1e-6 only; here every picture is a little brighter than the one before.
    """
    settings = settings_of(tmp_path, sunny(rng), **PIXELS)
    whole = pipeline.run(settings)
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(pipeline.Interrupted):
        pipeline.run(settings, folder=folder, watch=interrupting(step=7))
    render, calls = scene.Scene.render, []

    def render_again(*arguments, **keys):
        calls.append(1)
        return render(*arguments, **keys) * np.float32(1 + 1e-6 * len(calls))

    monkeypatch.setattr(scene.Scene, "render", render_again)
    resumed = pipeline.run(settings, folder=folder, resume=True)
    assert calls and resumed.envmap.tobytes() == whole.envmap.tobytes()


def test_ctrl_c_is_given_back_and_a_second_one_is_not_waited_for():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interrupts.ctrl_c() as event:
        signal.raise_signal(signal.SIGINT)
        assert event.is_set()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before

    def enter():
        with interrupts.ctrl_c() as event:
            return event.is_set()

    with ThreadPoolExecutor(1) as thread:  # where signals cannot be handled
        assert not thread.submit(enter).result()


@pytest.mark.slow
def test_paint_on_a_black_map_is_followed(tmp_path):
    painted = {"kind": "strokes", "strokes": STROKES, "hold": 1.0}
    black = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    settings = settings_of(
        tmp_path, black, target=painted, input={"rows": "all"}, optimizer={"iterations": 30}
    )
    result = pipeline.run(settings)
    assert result.envmap.max() > 0 and result.metrics["painted"]["towards"] > 0.5


def test_a_configuration_s_files_are_looked_for_beside_it_from_python_too(tmp_path, monkeypatch):
    (tmp_path / "c.toml").write_text('[input]\nenvmap = "sunsky"\n')
    monkeypatch.setattr(api, "run", lambda settings, **named: named)
    assert api.edit(tmp_path / "c.toml")["base"] == tmp_path
    assert api.edit(tmp_path / "c.toml", base=tmp_path / "other")["base"] == tmp_path / "other"
    assert api.edit(config.load(tmp_path / "c.toml"))["base"] is None


# ---- the whole sky -----------------------------------------------------------------------------------------


def turned_world(tmp_path, rng, **tables):
    """Return settings that ask for a sky of clouds and a sun turned by a quarter, all rows."""
    d = latlong.directions(16, 32)
    clouds = np.exp(0.5 * np.sin(3 * d[..., :1]) + 0.4 * np.sin(2 * d[..., 2:])) * [0.5, 0.7, 1.0]
    picture = np.float32(clouds * (1 + 0.1 * rng.random((16, 32, 1))))
    picture[4, 9] = 200
    asked = {
        "input": {"rows": "all", "width": 32},
        "target": {"rotate_degrees": 90.0, "spp": 256},
        "representation": {"turn": "auto"},
        "renderer": {"spp": 128, "max_depth": 3},
    }
    return settings_of(tmp_path, picture, **merged(asked, tables)), picture


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["layers", "pixels"])
def test_a_turned_sky_is_turned_back_to_the_bit(kind, tmp_path, rng):
    kinds = {"turn": "auto", "kind": kind}
    settings, picture = turned_world(tmp_path, rng, representation=kinds, optimizer={"iterations": 5})
    found = pipeline.run(settings)
    assert found.metrics["turn_degrees"] == pytest.approx(90) and found.found.turn_degrees == 90
    assert any("turned by 90" in line for line in found.notes)
    assert found.metrics["envmap"]["psnr"] > found.metrics["initial_envmap"]["psnr"] + 10
    if kind == "layers":
        assert found.envmap.tobytes() == latlong.rotate(picture, 90).tobytes()
    # Initial and edited map stand in the user's frame.
    assert found.maps["initial"].tobytes() == picture.tobytes()
    kept, _ = turned_world(
        tmp_path, rng, representation={"turn": False, "kind": kind}, optimizer={"iterations": 3}
    )
    assert pipeline.run(kept).metrics["turn_degrees"] == 0


@pytest.mark.slow
def test_lights_before_are_those_of_the_file(tmp_path, rng):
    """Not as they were placed and turned by hand, which is part of how far they have moved."""
    moved = {"light": 1, "azimuth": 200.0, "elevation": 40.0}
    levelled, _ = angles(Orientation(horizon=-10.0).matrix @ direction(200.0, 40.0))
    for by_hand, azimuth in (
        ({"rotate_degrees": 90.0}, 360 * 9.5 / 32 - 90),
        ({"lights": [moved], "horizon_degrees": -10.0}, levelled),
    ):
        settings, _ = turned_world(tmp_path, rng, target={"kind": "none"}, input=by_hand)
        found = pipeline.run(settings)
        (before,), (after,) = (found.lights[name] for name in ("before", "after"))
        assert before["azimuth"] == pytest.approx(360 * 9.5 / 32, abs=1) and not before["removed"]
        assert after["azimuth"] == pytest.approx(azimuth % 360, abs=3) and after["moved_degrees"] > 20
        assert any("light 1 at azimuth 107, elevation 42 moved by" in line for line in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize(
    "tables",
    [
        {"target": {"rotate_degrees": 0.0}},
        {"target": {"rotate_degrees": 360.0}, "representation": {"kind": "pixels"}},
        {"target": {"rotate_degrees": -360.0}, "renderer": {"kind": "path"}},
        {"target": {"file": "map.exr"}, "representation": {"kind": "siren"}, "input": {"rows": "upper"}},
    ],
    ids=["layers", "pixels", "path", "siren"],
)
def test_no_request_is_no_change(tables, tmp_path, rng):
    """However noisy the target is, and without tracing or fitting anything."""
    target = {"rotate_degrees": 0.0, "spp": 1} | tables["target"]
    settings, picture = turned_world(tmp_path, rng, **(tables | {"target": target, "output": {"spp": 1}}))
    found = pipeline.run(settings)
    assert found.envmap.tobytes() == picture.tobytes() and not found.history
    assert any("is the input map, bit for bit: nothing is solved" in line for line in found.notes)
    assert found.metrics["render"] == found.metrics["initial"] == found.metrics["ceiling"]
    assert found.metrics["transport"] is None and found.metrics["worse"] is False


@pytest.mark.slow
def test_what_renders_alike_within_the_noise_comes_back_bit_for_bit(tmp_path, rng):
    """By the noise of renderings with as many samples as the target had; a brighter map is told from it."""
    asked = {"file": "other.exr", "rotate_degrees": 0.0, "spp": 256}
    settings, picture = turned_world(
        tmp_path, rng, target=asked, scene={"width": 48, "height": 36}, optimizer={"iterations": 3}
    )
    images.write_exr(tmp_path / "other.exr", picture * np.float32(1 + 1e-4 * rng.random((16, 32, 1))))
    found = pipeline.run(settings)
    assert found.envmap.tobytes() == picture.tobytes()
    assert any("nothing changed: the map already renders to the target" in line for line in found.notes)
    assert found.metrics["render"] == found.metrics["initial"] and found.metrics["worse"] is False
    images.write_exr(tmp_path / "other.exr", 1.3 * picture)
    assert pipeline.run(settings).history


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["light in the row of the pole", "below the least normal number"])
def test_light_that_makes_no_picture_comes_back_bit_for_bit(kind, tmp_path):
    picture = np.zeros((16, 32, 3), np.float32)
    if "pole" in kind:
        picture[0] = [100, 90, 80]
    else:
        picture[:] = 1e-40
    itself = {"file": "map.exr", "spp": 256}
    asked = {"input": {"rows": "all", "width": 32}, "target": itself, "renderer": {"spp": 256}}
    found = pipeline.run(settings_of(tmp_path, picture, **asked))
    assert found.envmap.tobytes() == picture.tobytes()
    assert (found.renders["target"].max() > 0.01) == ("pole" in kind)


@pytest.mark.slow
def test_noise_of_the_target_does_not_spoil_a_turn(tmp_path, rng):
    settings, picture = turned_world(tmp_path, rng, target={"spp": 4})
    found = pipeline.run(settings)
    assert found.envmap.tobytes() == latlong.rotate(picture, 90).tobytes()
    assert any("the rest is noise, nothing else changed" in line for line in found.notes)
    assert f"dB before, {found.metrics['render']['psnr']:.1f} dB after 0 steps" in repr(found)
    # What remains is noise: the right map leaves as much.
    assert found.metrics["ceiling"]["psnr"] == pytest.approx(found.metrics["render"]["psnr"], abs=1e-6)


@pytest.mark.slow
def test_the_map_does_not_make_up_for_what_the_transport_misses(monkeypatch):
    """Few samples, and a large bright window: T errs by far more than the target's noise."""
    monkeypatch.setattr(search, "_moves", lambda *_: [])
    before = np.full((16, 32, 3), 0.3, np.float32)
    after = before.copy()
    before[5:7, 15:20] = 8
    after[5:7, 12:17] = 8
    settings = {
        "scene": {"file": "sphere", "width": 32},
        "renderer": {"spp": 16},
        "representation": {"turn": False, "cycles": 6},
        "target": {"spp": 1024},
        "output": {"spp": 1024},
    }
    psnr = api.edit(settings, envmap=before, target_map=after).metrics["render"]["psnr"]
    monkeypatch.setattr(Target, "seen_as", lambda wanted, *_: wanted)
    without = api.edit(settings, envmap=before, target_map=after).metrics["render"]["psnr"]
    assert psnr > without + 0.5  # 0.7 to 3 dB in nine of nine such edits
