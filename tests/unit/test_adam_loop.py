"""The loop under a renderer that is a known matrix: its answer, its bad steps, its continuation, its cost."""

import dataclasses
import json
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit import config, representations
from envedit.losses import losses, optimizer
from envedit.losses.ssim import Ssim
from envedit.solve import adam_loop
from tests.oracles.matrix_renderer import WIDTH, arrays, case, same, sky, without_times
from tests.oracles.plain import double, gradient, plain_display, single


# ---- rows ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("first", "rows"), [(0, 3), (2, 3), (3, 3), (5, 1), (0, 6)])
def test_rows_are_placed_and_all_others_keep_their_bits(first, rows, rng):
    original, crop = sky(rng), sky(rng)[:rows]
    original[4, 2] = [1e-42, 65504, 3e38]  # a denormal keeps its bits as well
    expected = original.copy()
    expected[first : first + rows] = crop
    placed = adam_loop.place_rows(mi.TensorXf(original), mi.TensorXf(crop), first)
    assert placed.shape == original.shape and placed.numpy().tobytes() == expected.tobytes()


@pytest.mark.parametrize(("first", "rows"), [(0, 3), (2, 3), (0, 6)])
def test_gradient_reaches_the_placed_rows_only(first, rows, rng):
    original, crop, weight = mi.TensorXf(sky(rng)), mi.TensorXf(sky(rng)[:rows]), sky(rng)
    dr.enable_grad(original, crop)
    dr.backward(dr.sum((adam_loop.place_rows(original, crop, first) * mi.TensorXf(weight)).array))
    np.testing.assert_array_equal(np.array(dr.grad(crop)), weight[first : first + rows])
    outside = np.array(dr.grad(original))
    assert not outside[first : first + rows].any()


# ---- objective -------------------------------------------------------------------------------------------
def test_objective_is_the_weighted_sum_of_its_losses(rng):
    picture, rendering = (rng.random((12, 14, 3)).astype(np.float32) for _ in range(2))
    original, crop = sky(rng)[:3], sky(rng)[:3]
    weights = config.Loss(ssim=2.0, luminance=0.01, l1=0.003, tv=0.5, image_l1=0.7, image_l2=3.0)
    objective = adam_loop.Objective(weights, picture, np.ones_like(picture[..., :1]), original, 10)
    total, terms = objective(single(rendering), single(crop), 4)
    target, shown = (double(plain_display(np.float64(x))) for x in (picture, rendering))
    expected = {
        "ssim": 2.0 * Ssim(target)(shown)[0],
        "luminance": 0.01 * losses.luminance(double(crop), double(original))[0],
        "l1": 0.003 * losses.l1(double(crop))[0],
        "tv": 0.5 * losses.tv(double(crop))[0],
        "image_l1": 0.7 * losses.image_l1(shown, target)[0],
        "image_l2": 3.0 * losses.image_l2(shown, target)[0],
    }
    assert terms.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(terms[name][0], value, rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(total[0], sum(expected.values()), rtol=1e-5)


@pytest.mark.parametrize(("step", "ssim", "luminance"), [(0, 1, 1e-4), (5, 100, 1e-6), (10, 1e4, 1e-8)])
def test_weights_walk_from_start_to_end_of_the_run(step, ssim, luminance, rng):
    """Sec. 6.2: regularisers down, SSIM up; geometric, so that the middle is the geometric mean."""
    picture, rendering = (mi.TensorXf(rng.random((12, 14, 3)).astype(np.float32)) for _ in range(2))
    original, crop = sky(rng)[:3], mi.TensorXf(sky(rng)[:3])
    even = np.ones((12, 14, 1), np.float32)
    ramped = config.Loss(ssim=(1.0, 1e4), luminance=(1e-4, 1e-8))
    _, terms = adam_loop.Objective(ramped, picture.numpy(), even, original, 11)(rendering, crop, step)
    plain = config.Loss(ssim=1.0, luminance=1.0)
    _, raw = adam_loop.Objective(plain, picture.numpy(), even, original, 11)(rendering, crop, step)
    np.testing.assert_allclose(terms["ssim"][0] / raw["ssim"][0], ssim, rtol=1e-5)
    np.testing.assert_allclose(terms["luminance"][0] / raw["luminance"][0], luminance, rtol=1e-5)


def test_terms_without_weight_and_dists_are_left_out(rng):
    weights = config.Loss(ssim=1.0, luminance=0.0, l1=0.0, dists=0.6, tv=0.0, image_l1=0.0, image_l2=0.0)
    objective = adam_loop.Objective(weights, rng.random((12, 14, 3)), np.ones((12, 14, 1)), sky(rng)[:3], 5)
    _, terms = objective(single(rng.random((12, 14, 3))), single(sky(rng)[:3]), 0)
    assert terms.keys() == {"ssim"}


def test_pixels_without_weight_do_not_count(rng):
    picture = rng.random((24, 30, 3)).astype(np.float32)
    weight = np.zeros((24, 30, 1), np.float32)
    weight[:, :12] = 1
    objective = adam_loop.Objective(config.Loss(ssim=1.0, image_l1=1.0), picture, weight, sky(rng)[:3], 5)
    rendering = rng.random((24, 30, 3)).astype(np.float32)
    other = rendering.copy()
    other[:, 12 + 5 :] += 3  # further away than half an SSIM window
    crop, totals = mi.TensorXf(sky(rng)[:3]), []
    for image in (rendering, other):
        total, slope = gradient(lambda x: objective(x, crop, 0)[0], mi.TensorXf(image))
        assert slope[:, :12].any() and not slope[:, 12 + 5 :].any()
        totals.append(total)
    assert totals[0] == totals[1] > 0


# ---- the loop --------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pixels", "log-pixels"])
def test_edit_finds_the_map_behind_the_picture(kind, rng):
    """The picture decides the map: the true one is the only minimum, at 0."""
    (_, _, renderer, objective, original, first, _), true = case(rng, iterations=400)
    representation = representations.make(config.Config(representation=config.Representation(kind=kind)))
    settings = config.Optimizer(iterations=400, lr=0.03, schedule="cosine")
    params = representation.encode(original[:3])
    params, state = adam_loop.optimise(representation, params, renderer, objective, original, first, settings)
    assert np.abs(original[:3] - true[:3]).max() > 0.5
    np.testing.assert_allclose(representation.decode(params).numpy(), true[:3], atol=0.01)
    assert state.step == 400 and state.bad_steps == 0
    assert state.history[-1]["loss"] < 0.01 * state.history[0]["loss"]


def test_texels_that_are_not_free_keep_their_bits_and_pull_nothing(rng):
    """Neither renderer nor regularisers see what the parameters of a kept texel say."""
    free = rng.random((3, WIDTH)) < 0.5
    arguments, _ = case(rng, iterations=6, weights=config.Loss(tv=0.1, l1=0.1, luminance=0.1))
    representation, params, renderer, objective, original, *_ = arguments
    original[0, 0] = [1e-42, 65504, 0.5]
    free[0, 0] = False
    seen, crops = [], []

    class Watching:
        def render(self, env, step):
            seen.append(env.numpy())
            return renderer.render(env, step)

    class Listening:
        def __call__(self, rendering, crop, step):
            crops.append(crop.numpy())
            return objective(rendering, crop, step)

    start = params["log_radiance"].numpy()
    watched = representation, params, Watching(), Listening(), original, 0, arguments[-1]
    changed, state = adam_loop.optimise(*watched, free=free)
    for image, crop in zip(seen, crops, strict=True):
        assert image[:3][~free].tobytes() == original[:3][~free].tobytes() == crop[~free].tobytes()
        assert image[3:].tobytes() == original[3:].tobytes()
    moved = changed["log_radiance"].numpy() != start
    assert moved[free].all() and not moved[~free].any()
    assert len(seen) == 6 and state.bad_steps == 0


def test_history_has_a_row_for_every_iteration_with_its_learning_rate(rng):
    arguments, _ = case(rng, iterations=23, lr=0.04, schedule="cosine")
    _, state = adam_loop.optimise(*arguments)
    assert [row["iteration"] for row in state.history] == list(range(23))
    for row in state.history:
        assert list(row) == ["iteration", "loss", "ssim", "image_l1", "image_l2", "lr", "step_ms"]
        assert all(math.isfinite(value) for value in row.values())
        np.testing.assert_allclose(row["loss"], row["ssim"] + row["image_l1"] + row["image_l2"], rtol=1e-5)
    cosine = [0.04 * (1 + math.cos(math.pi * i / 23)) / 2 for i in range(23)]
    np.testing.assert_allclose([row["lr"] for row in state.history], cosine, rtol=1e-6)
    json.dumps(state.history)  # plain numbers, as the checkpoint needs


def test_learning_rate_may_be_left_to_the_representation(rng):
    arguments, _ = case(rng, iterations=2, lr="auto")
    _, state = adam_loop.optimise(*arguments)
    assert state.history[0]["lr"] == representations.LogPixels.lr


def test_no_iterations_leave_the_parameters(rng):
    arguments, _ = case(rng, iterations=0)
    params, state = adam_loop.optimise(*arguments)
    assert same(arrays(params), arrays(arguments[1])) and state == adam_loop.State()


def test_observer_is_told_of_every_row_and_may_end_the_run(rng):
    arguments, _ = case(rng, iterations=25)
    seen = []
    adam_loop.optimise(*arguments, after_step=lambda s, adam: seen.append((s.step, len(s.history))))
    assert seen[-1] == (25, 25) and len(seen) >= 3 and all(step == rows for step, rows in seen)
    arguments, _ = case(rng)

    def stop(state, adam):
        if state.step == 3:
            raise KeyboardInterrupt

    state = adam_loop.State()
    with pytest.raises(KeyboardInterrupt):
        adam_loop.optimise(*arguments, state=state, after_step=stop)
    assert state.step == 3


# ---- steps that are not finite ---------------------------------------------------------------------------
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_bad_renderings_are_counted_taken_back_and_halve_the_rate(value, rng):
    """The step that led to a bad rendering is undone, and good steps win the rate back, ten for a halving."""
    arguments, _ = case(rng, iterations=8, lr=0.02, bad={2, 3, 6}, value=value)
    seen = [arrays(arguments[1])]
    params, state = adam_loop.optimise(*arguments, after_step=lambda _, a: seen.append(arrays(a.params)))
    assert same(seen[3], seen[1]) and same(seen[4], seen[1]) and same(seen[7], seen[5])
    assert not any(same(seen[i], seen[i + 1]) for i in (0, 1, 2, 4, 5, 6, 7))
    assert (state.bad_steps, state.bad_in_a_row) == (3, 0)
    won = 2 ** (1 / 10)
    expected = [0.02, 0.02, 0.02, 0.01, 0.005, 0.005 * won, 0.005 * won**2, 0.0025 * won**2]
    np.testing.assert_allclose([row["lr"] for row in state.history], expected, rtol=1e-12)
    assert math.isclose(state.slowdown, 0.125 * won**3)
    assert len(state.history) == 8 and np.isfinite(params["log_radiance"].numpy()).all()


def test_nineteen_bad_steps_in_a_row_are_survived(rng):
    arguments, _ = case(rng, iterations=45, bad=set(range(3, 22)) | set(range(23, 42)))
    _, state = adam_loop.optimise(*arguments)
    assert (state.step, state.bad_steps, state.bad_in_a_row) == (45, 38, 0)


# ---- continuing, repeating, cost -------------------------------------------------------------------------
@pytest.mark.parametrize("cut", [1, 4, 7, 10, 15])
def test_a_run_that_is_cut_and_continued_gives_the_same_bits(cut, rng):
    """Also where the next step is a bad one, and the step before the cut has to be taken back."""

    def fresh():
        weights = config.Loss(ssim=(0.1, 10.0), luminance=(1e-2, 1e-4))
        seeded = np.random.default_rng(3)
        return case(seeded, iterations=16, weights=weights, schedule="cosine", bad={4, 9})[0]

    expected, whole = adam_loop.optimise(*fresh())
    kept = {}

    def kill(state, adam):
        if state.step == cut:
            kept["state"] = json.dumps(dataclasses.asdict(state))
            kept["adam"] = adam.state_dict()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adam_loop.optimise(*fresh(), after_step=kill)
    arguments = fresh()
    adam = optimizer.Adam(arguments[1], arguments[6].lr, (0.9, arguments[6].beta2))
    adam.load_state_dict(kept["adam"])
    state = adam_loop.State(**json.loads(kept["state"]))
    params, state = adam_loop.optimise(*arguments, adam=adam, state=state)
    assert same(arrays(params), arrays(expected))
    assert json.dumps(without_times(state.history)) == json.dumps(without_times(whole.history))
    assert (state.bad_steps, state.slowdown) == (whole.bad_steps, whole.slowdown)
    assert whole.bad_steps == 2 and math.isclose(whole.slowdown, 0.5)  # halved twice, ten good steps
