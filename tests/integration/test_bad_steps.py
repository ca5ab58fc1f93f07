"""Values that are not finite, put in at every stage of an edit: what is skipped, counted, stopped, kept."""

import dataclasses
import math
import types

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit import config, pipeline, representations
from envedit.core.errors import NumericalError
from envedit.core.primaries import ACES_AP1
from envedit.core.seeds import Seeds
from envedit.export import adjustments
from envedit.images import images
from envedit.losses import losses, optimizer
from envedit.renderers import StoredRenderer
from envedit.scene import scene
from envedit.solve import adam_loop
from envedit.transport.light_transport import LightTransport
from tests.oracles import users_scenes
from tests.oracles.matrix_renderer import arrays, case, same
from tests.oracles.runs import TINY, call, changed, measured, names, pixels, settings_of, sunny, world

pytestmark = pytest.mark.usefixtures("isolated", "own_cache")

TERMS = ("ssim", "luminance", "l1", "tv", "image_l1", "image_l2")


class Hole(dr.CustomOp):
    """A tensor as it is, whose gradient has one bad element."""

    def eval(self, x, value):
        self.value = value
        return mi.TensorXf(x)

    def backward(self):
        slope = self.grad_out()
        here = dr.arange(mi.UInt32, len(slope.array)) == 40
        self.set_grad_in("x", mi.TensorXf(dr.select(here, self.value, slope.array), slope.shape))


class Spoiler:
    """Spoil what a function returns at some of its calls, which are counted."""

    def __init__(self, function, calls, value, how="value"):
        self.function, self.calls, self.value, self.how, self.count = function, calls, value, how, 0

    def __call__(self, *arguments, **keys):
        out = self.function(*arguments, **keys)
        bad, self.count = self.count in self.calls, self.count + 1
        if not bad:
            return out
        if self.how == "slope":
            return dr.custom(Hole, out, self.value)
        if not dr.is_tensor_v(out):
            return out + self.value
        here = dr.arange(mi.UInt32, len(out.array)) == 40
        return mi.TensorXf(dr.select(here, self.value, out.array), out.shape)


class FakeDists:
    """Stands for DISTS: the squared difference of display values."""

    def against(self, reference):
        return lambda shown: dr.mean(dr.square(shown.array - reference.array))


def spoiled(stage, calls, value, monkeypatch):
    """Return what ``optimise`` takes, with one stage spoiled at some steps."""
    weights = config.Loss(**dict.fromkeys(TERMS, 0.1), dists=0.1)
    arguments, _ = case(np.random.default_rng(1), weights=weights, iterations=40)
    representation, params, renderer, objective, original, *rest = arguments
    picture = objective._target.numpy()
    objective = adam_loop.Objective(
        weights, picture, np.ones_like(picture[..., :1]), original[:3], 40, FakeDists()
    )
    assert objective.ramps.keys() == {*TERMS, "dists"}
    where, how = stage.removeprefix("slope of "), "slope" if stage.startswith("slope") else "value"
    if where == "map":
        representation.decode = Spoiler(representation.decode, calls, value, how)
    elif where == "picture":
        renderer.render = Spoiler(renderer.render, calls, value, how)
    elif where == "ssim":
        objective._ssim = Spoiler(objective._ssim, calls, value)
    elif where == "dists":
        objective._dists = Spoiler(objective._dists, calls, value)
    else:
        monkeypatch.setitem(losses.LOSSES, where, Spoiler(losses.LOSSES[where], calls, value))
    return representation, params, renderer, objective, original, *rest


STAGES = ("map", "picture", "slope of map", "slope of picture", *TERMS, "dists")


# ---- the loop --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_bad_steps_at_any_stage_are_counted_and_survived(stage, monkeypatch):
    arguments, seen = spoiled(stage, {5, 6, 12}, math.nan, monkeypatch), []
    seen.append(arrays(arguments[1]))
    params, state = adam_loop.optimise(
        *arguments, after_step=lambda _, adam: seen.append(arrays(adam.params))
    )
    assert (state.step, state.bad_steps, state.bad_in_a_row) == (40, 3, 0)
    assert same(seen[6], seen[4]) and same(seen[7], seen[4]) and same(seen[13], seen[11])
    rates = [row["lr"] for row in state.history]
    assert rates[6] == rates[5] / 2 and rates[7] == rates[5] / 4 and rates[13] < 0.51 * rates[12]
    assert rates[39] == rates[0]  # won back
    assert all(np.isfinite(values).all() for values in arrays(params).values())
    assert state.history[-1]["loss"] < state.history[0]["loss"]
    slope = stage.startswith("slope")
    for row in state.history:
        assert math.isfinite(row["loss"]) == (slope or row["iteration"] not in (5, 6, 12))


@pytest.mark.slow
@pytest.mark.parametrize(("part", "value"), [("_m", math.nan), ("_v", math.inf)])
def test_moments_that_are_not_finite_reach_no_parameter(part, value):
    """One bad element, as a faulty memory makes it. An infinite v alone would give steps of zero for ever."""
    arguments, _ = case(np.random.default_rng(0), iterations=60)
    adam, state = optimizer.Adam(arguments[1], 0.02, (0.9, arguments[6].beta2)), adam_loop.State()

    def spoil(state, adam):
        if state.step == 5:
            moments = getattr(adam, part)
            bad = moments["log_radiance"].numpy()
            bad[1, 2, 0] = value
            moments["log_radiance"] = dr.opaque(mi.TensorXf(bad))

    with pytest.raises(NumericalError, match="iteration 24"):
        adam_loop.optimise(*arguments, adam=adam, state=state, after_step=spoil)
    assert state.bad_steps == 20
    assert all(np.isfinite(values).all() for values in arrays(adam.params).values())


def test_a_step_to_parameters_that_are_not_finite_is_refused():
    adam = optimizer.Adam({"p": mi.TensorXf([1.0, 3e38])}, lr=1.0)
    good = {"p": mi.TensorXf([1.0, 1.0])}
    before = adam.state_dict()
    assert not adam.step({"p": mi.TensorXf([1.0, -1.0])}, lr=3e38)  # 3e38 + 3e38 is infinite
    assert all(np.array_equal(before[key], value) for key, value in adam.state_dict().items())
    assert adam.step(good) and np.isfinite(np.array(adam.params["p"])).all()


def test_a_step_that_is_taken_back_leaves_the_moments():
    adam = optimizer.Adam({"p": mi.TensorXf([1.0, 2.0])}, lr=0.1)
    slope = {"p": mi.TensorXf([1.0, -1.0])}
    adam.step(slope)
    first = adam.state_dict()
    adam.step(slope)
    moved = adam.state_dict()
    adam.take_back()
    state = adam.state_dict()
    assert np.array_equal(state["params/p"], first["params/p"])
    assert all(np.array_equal(state[key], moved[key]) for key in ("m/p", "v/p", "step"))


# ---- an edit in progress ---------------------------------------------------------------------------------


@pytest.fixture
def recorded(monkeypatch):
    """Record the parameters that ``Pixels`` decodes; those listed in ``recorded.bad`` decode to NaN."""
    decode, seen = representations.Pixels.decode, types.SimpleNamespace(all=[], bad=set())

    def noted(self, params):
        values = np.array(dr.detach(params["radiance"]))
        seen.all.append(values)
        crop = decode(self, params)
        return crop * math.nan if values.tobytes() in seen.bad else crop

    monkeypatch.setattr(representations.Pixels, "decode", noted)
    return seen


PIXELS = {"representation": {"kind": "pixels"}, "optimizer": {"iterations": 6}}


@pytest.mark.slow
def test_a_last_step_that_leads_to_no_map_is_taken_back(tmp_path, rng, recorded):
    settings = settings_of(tmp_path, sunny(rng), **PIXELS)
    whole = pipeline.run(settings)
    assert whole.metrics["non_finite_steps"] == 0
    steps = recorded.all[:6]
    recorded.bad.add(recorded.all[6].tobytes())
    found = pipeline.run(settings)
    assert found.metrics["non_finite_steps"] == 1 and found.metrics["iterations"] == 6
    assert np.array_equal(found.envmap[:4], np.maximum(steps[-1], 0))
    assert np.array_equal(found.envmap[4:], whole.envmap[4:])


@pytest.mark.slow
def test_a_map_that_is_never_finite_leaves_the_original(tmp_path, rng, monkeypatch):
    original, decode = sunny(rng), representations.Pixels.decode
    monkeypatch.setattr(
        representations.Pixels, "decode", lambda self, params: decode(self, params) * math.nan
    )
    settings = settings_of(tmp_path, original, **PIXELS)
    for iterations, message in (
        (40, "20 steps in a row"),
        (6, "not finite at row 0, column 0"),
        (0, "row 0"),
    ):
        few = dataclasses.replace(settings, optimizer=config.Optimizer(iterations=iterations))
        with pytest.raises(pipeline.Stopped, match=message) as stop:
            pipeline.run(few)
        assert stop.value.exit_code == 5 and stop.value.envmap.tobytes() == original.tobytes()


@pytest.mark.slow
def test_the_path_tracer_hides_no_bad_slope(tmp_path, rng, monkeypatch):
    """It adds gradients with atomics, which drop NaN on LLVM: the parameters' gradients are all finite."""
    weigh = adam_loop.Objective.__call__

    def with_hole(self, rendering, crop, step):
        return weigh(self, dr.custom(Hole, rendering, math.nan) if step == 2 else rendering, crop, step)

    monkeypatch.setattr(adam_loop.Objective, "__call__", with_hole)
    tables = PIXELS | {"renderer": {"kind": "path", "spp": 4, "max_depth": 3}}
    found = pipeline.run(settings_of(tmp_path, sunny(rng), **tables))
    assert found.metrics["non_finite_steps"] == 1 and np.isfinite(found.envmap).all()


# ---- the command line ------------------------------------------------------------------------------------


def spoil_renderer(monkeypatch, steps):
    render = StoredRenderer.render

    def spoiled(self, envmap, step):
        return render(self, envmap, step) * dr.opaque(mi.Float, math.nan if step in steps else 1)

    monkeypatch.setattr(StoredRenderer, "render", spoiled)


@pytest.mark.slow
def test_what_is_not_finite_is_told_in_metrics_and_history(tmp_path, rng, monkeypatch, capsys):
    spoil_renderer(monkeypatch, {1, 4})
    compare = pipeline.metrics.compare
    monkeypatch.setattr(pipeline.metrics, "compare", lambda *a: compare(*a) | {"ssim": math.nan})
    path, out = world(tmp_path, rng, representation={"kind": "pixels"}), tmp_path / "c_out"
    assert call(path, "--quiet", *changed(optimizer__iterations=6, optimizer__kind="adam")) == 0
    found = measured(out)
    assert found["non_finite_steps"] == 2 and found["iterations"] == 6 and found["render"]["ssim"] is None
    assert "metrics.json: render.ssim was not finite and is null" in capsys.readouterr().err
    lines = (out / "history.csv").read_text().splitlines()
    empty = [i for i, line in enumerate(lines[1:]) if line.split(",")[1] == ""]
    assert empty == [1, 4] and (out / "report.html").stat().st_size > 0
    assert np.isfinite(pixels(out / "edited.exr")).all()


@pytest.mark.slow
def test_an_edit_that_stops_leaves_its_last_good_map(tmp_path, rng, monkeypatch, capsys, recorded):
    spoil_renderer(monkeypatch, range(5, 1000))
    path, out = world(tmp_path, rng, representation={"kind": "pixels"}), tmp_path / "c_out"
    assert call(path, "--quiet", *changed(optimizer__iterations=60)) == 5
    said = capsys.readouterr().err
    assert "20 steps in a row" in said and "last good map is kept" in said and len(said.splitlines()) <= 2
    last_good = np.maximum(recorded.all[4], 0)  # decoded for step 4, the last with a finite loss
    assert not np.array_equal(recorded.all[4], recorded.all[3])
    assert np.array_equal(pixels(out / "edited.exr")[:4], last_good)
    assert names(out) == {"edited.exr"}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "iterations"), [("siren", 1), ("pixels", 1), ("pixels", 30)])
def test_a_rate_that_leads_nowhere_is_blamed_and_leaves_the_first_map(
    kind, iterations, tmp_path, rng, capsys, recorded
):
    path, out = world(tmp_path, rng, representation={"kind": kind}), tmp_path / "c_out"
    asked = {"optimizer__iterations": iterations, "optimizer__kind": "adam"}
    assert call(path, "--quiet", *changed(**asked, optimizer__lr=1e38)) == 5
    said = capsys.readouterr().err
    assert "optimizer.lr = 1e+38 is too high" in said and "material" not in said
    assert len(said.splitlines()) == 1
    if kind == "pixels":  # whose start is the input
        assert pixels(out / "edited.exr").tobytes() == pixels(tmp_path / "map.exr").tobytes()
    assert call(path, "--quiet", *changed(**asked)) == 0


def fails(*arguments, **keys):
    raise NumericalError("not finite at row 1, column 2")


@pytest.mark.slow
def test_what_fails_after_the_loop_leaves_the_map(tmp_path, rng, monkeypatch, capsys):
    path = world(tmp_path, rng, representation={"kind": "pixels"})
    assert call(path, "--quiet", "--out", tmp_path / "whole") == 0
    capsys.readouterr()

    sampled = scene.Scene.sampled

    def judged_fails(self, envmap, spp, seed, *rest):
        return fails() if seed == Seeds(0).judged else sampled(self, envmap, spp, seed, *rest)

    for k, (owner, name, replacement) in enumerate(
        (
            (pipeline.adjustments, "adjust", fails),
            (scene.Scene, "sampled", judged_fails),
            (pipeline.metrics, "compare", fails),
            (LightTransport, "coarse_error", fails),
        )
    ):
        out = tmp_path / f"out-{k}"
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, replacement)
            assert call(path, "--quiet", "--out", out) == 5
        said = capsys.readouterr().err
        assert "row 1, column 2" in said and len(said.splitlines()) <= 2
        assert pixels(out / "edited.exr").tobytes() == pixels(tmp_path / "whole" / "edited.exr").tobytes()
        assert names(out) == {"edited.exr", "checkpoint.npz"}


@pytest.mark.slow
def test_what_is_done_with_a_map_is_no_part_of_its_checkpoint(tmp_path, rng, monkeypatch, capsys):
    """An exposure that leaves float32 costs the run, and not the edit: with another one it goes on."""
    path, out = world(tmp_path, rng, representation={"kind": "pixels"}), tmp_path / "c_out"
    assert call(path, "--quiet", "--out", tmp_path / "whole") == 0
    adjust = adjustments.adjust

    def brighter(envmap, lights, output, scale):
        return adjust(envmap * np.float32(1e9 if output.exposure == 100 else 1), lights, output, scale)

    monkeypatch.setattr(pipeline.adjustments, "adjust", brighter)
    assert call(path, "--quiet", *changed(output__exposure=100)) == 5
    assert "lower output.exposure" in capsys.readouterr().err.splitlines()[-1]
    whole = pixels(tmp_path / "whole" / "edited.exr")
    assert pixels(out / "edited.exr").tobytes() == whole.tobytes()
    steps = []
    monkeypatch.setattr(adam_loop.Objective, "__call__", lambda *a: steps.append(a))
    assert call(path, "--quiet", "--resume", *changed(output__exposure=1)) == 0
    assert not steps and np.array_equal(pixels(out / "edited.exr"), 2 * whole)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_a_map_that_is_kept_is_in_the_units_and_colours_of_its_file(
    scale, tmp_path, rng, monkeypatch, capsys
):
    """Where a scene's scale is so small that the map leaves float32, it is cut and not lost."""
    parts = users_scenes.PATH, users_scenes.SENSOR, users_scenes.BALL, users_scenes.light(scale)
    path, out = users_scenes.write(tmp_path, parts), tmp_path / "out"
    own = pixels(tmp_path / "own.exr")
    images.write_exr(tmp_path / "own.exr", own, chromaticities=ACES_AP1)

    monkeypatch.setattr(pipeline.metrics, "compare", fails)
    keys = {f"{table}__{key}": value for table, keys in TINY.items() for key, value in keys.items()}
    if scale < 1:
        monkeypatch.setattr(
            pipeline.adjustments, "adjust", lambda envmap, *rest: (np.full_like(envmap, 3e38), [])
        )
    assert call(path, "--quiet", "--out", out, *changed(**keys)) == 5
    with OpenEXR.File(str(out / "edited.exr"), separate_channels=True) as file:
        assert np.allclose(file.header()["chromaticities"], ACES_AP1)
        edited = np.stack([file.channels()[c].pixels for c in "RGB"], axis=2)
    assert np.isfinite(edited).all() and edited.shape == own.shape
    if scale == 1:
        assert edited[4:].tobytes() == own[4:].tobytes()
    else:
        assert edited.max() > 1e29


def test_dists_is_evaluated_now_and_then_and_counts_as_often(rng):
    """Its gradient is that of the steps it stands for; a run that is resumed goes on with its last value."""
    calls = []

    class Counted(FakeDists):
        def against(self, reference):
            distance = super().against(reference)
            return lambda shown: (calls.append(1), distance(shown))[1]

    picture, original = rng.random((4, 4, 3)), np.float32(rng.random((3, 6, 3)))
    weights = config.Loss(ssim=0.0, image_l1=0.0, image_l2=1.0, dists=0.5)

    def seen(objective, step):
        crop = mi.TensorXf(original + np.float32(0.1 * (step + 1)))
        dr.enable_grad(crop)
        total, terms = objective(mi.TensorXf(np.float32(picture)), crop, step)
        if dr.grad_enabled(total):
            dr.backward(total)
        return float(total[0]), float(terms["dists"][0]), dr.grad(crop).numpy()

    often = adam_loop.Objective(weights, picture, np.ones_like(picture[..., :1]), original, 8, Counted())
    rarely = adam_loop.Objective(
        weights, picture, np.ones_like(picture[..., :1]), original, 8, Counted(), every=4
    )
    every = [seen(often, step) for step in range(8)]
    assert len(calls) == 8
    found = [seen(rarely, step) for step in range(8)]
    assert len(calls) == 10
    for step in range(8):
        total, term, gradient = found[step]
        last = every[step - step % 4]
        assert total == pytest.approx(last[0], rel=1e-6) and term == pytest.approx(last[1], rel=1e-6)
        np.testing.assert_allclose(gradient, 4 * last[2] if step % 4 == 0 else 0 * gradient, rtol=1e-5)

    resumed = adam_loop.Objective(
        weights, picture, np.ones_like(picture[..., :1]), original, 8, Counted(), every=4
    )
    resumed.resume([{"dists": found[4][1]}])
    assert seen(resumed, 5)[:2] == found[5][:2] and len(calls) == 10


def test_a_bad_value_of_dists_spoils_one_step_alone(rng):
    values = iter([1.0, math.nan, 2.0])

    class Fake:
        def against(self, reference):
            return lambda shown: dr.mean(shown.array) * 0 + next(values)

    picture, original = rng.random((4, 4, 3)), np.float32(rng.random((3, 6, 3)))
    objective = adam_loop.Objective(
        config.Loss(dists=1.0), picture, np.ones_like(picture[..., :1]), original, 6, Fake(), every=2
    )
    shown, crop = mi.TensorXf(np.float32(picture)), mi.TensorXf(original)
    terms = [float(objective(shown, crop, step)[1]["dists"][0]) for step in range(6)]
    assert terms[:2] == [1, 1] and math.isnan(terms[2]) and terms[3:] == [1, 2, 2]
