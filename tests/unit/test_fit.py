"""The fit: normalisation and objective against formulas, perturbation by its definition, fits on disk."""

import dataclasses
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit import config
from envedit.core.errors import InputError, NumericalError
from envedit.losses import metrics, ssim
from envedit.representations.siren import fit
from envedit.representations.siren import network as siren
from tests.oracles.kernels import launched
from tests.oracles.matrix_renderer import arrays, same
from tests.oracles.plain import plain_ssim_loss

NETWORK = config.Representation(hidden=12, depth=1, coordinates="sphere")
QUICK = config.Fit(epochs=4, lr=5e-3, awp_gamma=0.0)


def sky(rng, height=16, width=32, peak=50.0):
    row, column = np.mgrid[:height, :width]
    base = 0.4 + 0.3 * np.cos(2 * np.pi * column / width) * np.sin(np.pi * (row + 0.5) / height)
    sun = peak * np.exp(-((row - height * 0.3) ** 2 + (column - width * 0.6) ** 2) / 4)
    grain = 0.01 * rng.random((height, width, 3))
    return ((base + sun)[..., None] * [1.0, 0.9, 0.7] + grain).astype(np.float32)


def picture(fitted, network, shape, rows=None):
    x = fit.points(network, shape, rows)
    params = {name: mi.TensorXf(np.float32(value)) for name, value in fitted.params.items()}
    return fit.evaluate(params, fitted.normalisation, x, shape, network.omega).numpy()


def facts(fitted):
    found = dataclasses.asdict(fitted)
    return {key: found[key] for key in ("normalisation", "log_psnr", "peak_ratio", "epochs")}


# ---- normalisation (Eq. 1-3) -----------------------------------------------------------------------------
@pytest.mark.parametrize("value", [0.0, 0.3, 1e38])
def test_constant_map_lies_in_the_middle_of_a_range_of_one(value):
    image = np.full((2, 4, 3), value, np.float32)
    normalisation = fit.Normalisation.of(image)
    values = normalisation.encode(image)
    np.testing.assert_allclose(values, 0.5)
    decoded = normalisation.decode(mi.TensorXf(values.astype(np.float32))).numpy()
    np.testing.assert_allclose(decoded, image, rtol=2e-5, atol=1e-8)


@pytest.mark.parametrize("headroom", [0.0, 0.05, 0.45])
def test_normalisation_is_equation_1_between_ends_that_are_left_free(headroom, rng):
    few = np.float32([[[0, 1e-30, 1e6]]]), np.float32([[[1, 1, 1.01]]])
    for image in (sky(rng), sky(rng, peak=1e6), *few):
        normalisation = fit.Normalisation.of(image, headroom)
        values = normalisation.encode(image)
        logs = np.log(image.astype(np.float64) + 0.01)
        shares = (logs - logs.min()) / np.ptp(logs)
        np.testing.assert_allclose(values, headroom + (1 - 2 * headroom) * shares, atol=1e-12)
        decoded = normalisation.decode(mi.TensorXf(values.astype(np.float32))).numpy()
        # A value rounds at 6e-8, and the exponent by as much of the span, at most 185 here.
        np.testing.assert_allclose(decoded, image, rtol=3e-5, atol=1e-6)
        free = headroom / (1 - 2 * headroom) * np.ptp(logs)
        ends = np.exp(np.minimum([logs.min() - free, logs.max() + free], 88)) - 0.01
        decoded = normalisation.decode(mi.TensorXf(np.float32([0, 1]))).numpy()
        np.testing.assert_allclose(decoded, np.maximum(ends, 0), rtol=1e-4, atol=1e-6)


# ---- objective (Eq. 4) -----------------------------------------------------------------------------------
def rows(image):
    return np.ascontiguousarray(np.asarray(image).reshape(-1, 3))


def plain_objective(y, image, normalisation, settings):
    """Eq. 4 in float64, norms as the losses say they are read."""
    values, logs = y.reshape(image.shape), normalisation.encode(image)
    ssim = plain_ssim_loss(values, logs, np.ones(()))
    radiance = np.exp(values * normalisation.span + normalisation.low) - fit.EPSILON
    squared, absolute = np.mean((values - logs) ** 2), np.mean(np.abs(radiance - image))
    return settings.log_mse * squared + settings.log_ssim * ssim + settings.hdr * absolute


@pytest.mark.parametrize("terms", [(0.85, 0.25, 0.01), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_objective_is_equation_4_and_its_gradient_the_finite_difference(terms, rng):
    settings = config.Fit(log_mse=terms[0], log_ssim=terms[1], hdr=terms[2])
    image = sky(rng, 12, 16, peak=5.0)
    normalisation = fit.Normalisation.of(image)
    y = np.clip(rows(normalisation.encode(image)) + 0.1 * rng.normal(size=(192, 3)), 0.01, 0.99)
    y = y.astype(np.float32).astype(np.float64)
    objective = fit.Objective(image, normalisation, settings)
    if terms == (0, 1, 0):  # as for the perturbation
        objective = fit.Objective(image, normalisation, config.Fit())
    loss, gradient = objective.gradient(mi.TensorXf(np.float32(y)), only_ssim=terms == (0, 1, 0))
    np.testing.assert_allclose(loss[0], plain_objective(y, image, normalisation, settings), rtol=1e-5)
    g, h = np.array(gradient, np.float64), 1e-6
    for direction in (g / np.linalg.norm(g), rng.normal(size=y.shape)):
        ends = [plain_objective(y + s * h * direction, image, normalisation, settings) for s in (1, -1)]
        slope = np.sum(g * direction)
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-3, atol=1e-6)


# ---- adversarial weight perturbation (Eq. 5) -------------------------------------------------------------
def step_of_perturbation(rng, gamma=0.01, lr=1e-4):
    image = sky(rng)
    params, x = siren.init(0, 16, 2, 30.0), siren.coordinates(16, 32)
    objective = fit.Objective(image, fit.Normalisation.of(image), config.Fit())
    y, tape = siren.forward(params, x, 30.0)
    before, slope = objective.gradient(y, only_ssim=True)
    moved = fit.perturbed(params, fit.ascent(siren.backward(params, tape, slope), lr), gamma)
    after, _ = objective.gradient(siren.forward(moved, x, 30.0)[0], only_ssim=True)
    return params, moved, before[0], after[0]


@pytest.mark.parametrize("gamma", [1e-3, 0.01, 0.1])
def test_perturbation_moves_each_weight_matrix_by_gamma_of_its_norm(gamma, rng):
    params, moved, _, _ = step_of_perturbation(rng, gamma)
    assert list(moved) == list(params)
    for name in params:
        old, new = (np.array(p[name], np.float64) for p in (params, moved))
        if name.endswith("bias"):
            np.testing.assert_array_equal(old, new)
        else:
            # The difference of two weights of size w keeps 6e-8 w / (gamma w) of itself.
            np.testing.assert_allclose(np.linalg.norm(new - old), gamma * np.linalg.norm(old), rtol=1e-3)


def test_perturbation_makes_the_ssim_worse(rng):
    _, _, before, after = step_of_perturbation(rng, gamma=1e-3)
    assert after > before
    _, _, _, further = step_of_perturbation(rng, gamma=2e-3)
    assert further > after


def test_perturbation_by_what_is_zero_or_not_finite_is_none(rng):
    params = siren.init(0, 8, 1)
    params["1.weight"] = dr.zeros(mi.TensorXf, (8, 8))
    grads = {name: mi.TensorXf(rng.normal(size=p.shape).astype(np.float32)) for name, p in params.items()}
    grads["2.weight"] = dr.opaque(mi.TensorXf, 0, (3, 8))
    moved = fit.perturbed(params, fit.ascent(grads, 1e-4), 0.01)
    assert np.any(moved["0.weight"].numpy() != params["0.weight"].numpy())
    for name in ("1.weight", "2.weight"):
        np.testing.assert_array_equal(moved[name].numpy(), params[name].numpy())
    grads["1.weight"] = dr.opaque(mi.TensorXf, math.nan, (8, 8))
    params = siren.init(0, 8, 1)
    assert same(arrays(fit.perturbed(params, fit.ascent(grads, 1e-4), 0.01)), arrays(params))


# ---- the fit ---------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_small_fit_reaches_a_good_picture(rng):
    image = sky(rng)
    settings = config.Fit(epochs=150, lr=5e-3, awp_gamma=0.0)
    network = config.Representation(hidden=32, depth=1, coordinates="sphere")
    fitted = fit.fit(image, network, settings)
    # 43.5 to 44.0 dB and 0.99 for four seeds where this was written; an untrained network has 10 dB.
    assert fitted.log_psnr > 40 and 0.9 < fitted.peak_ratio < 1.1
    assert fitted.epochs == 150 and not fitted.cached
    got = picture(fitted, network, (16, 32))
    assert metrics.log_psnr(got, image) == fitted.log_psnr
    assert metrics.peak_ratio(got, image) == fitted.peak_ratio


@pytest.mark.slow
def test_robust_fit_loses_less_to_noise_in_its_weights(rng):
    """What the perturbation is for (paper, Sec. 4): moving the weights moves the picture less."""
    image, network = sky(rng), config.Representation(hidden=32, depth=1)
    drops = []
    for gamma in (0.0, 0.03):
        fitted = fit.fit(image, network, config.Fit(epochs=120, lr=5e-3, awp_gamma=gamma))
        noise = np.random.default_rng(1)
        scores = []
        for _ in range(8):
            moved = {}
            for name, w in fitted.params.items():
                d = noise.normal(size=w.shape)
                moved[name] = w + 0.03 * np.linalg.norm(w) / np.linalg.norm(d) * d
            got = picture(dataclasses.replace(fitted, params=moved), network, (16, 32))
            scores.append(metrics.log_psnr(got, image))
        drops.append(fitted.log_psnr - np.mean(scores))
    # 19.2 to 21.5 and 5.7 to 6.6 dB for four seeds where this was written.
    assert drops[1] < drops[0] - 8


def sunny(height=24, width=48, sun=1e4):
    """Make a sky of about 1 with a sun of one texel, which holds nine tenths of the light."""
    row, column = np.mgrid[:height, :width]
    base = 0.7 + 0.4 * np.cos(2 * np.pi * column / width) * np.sin(np.pi * (row + 0.5) / height)
    grain = 0.05 * np.random.default_rng(0).random((height, width, 3))
    image = (base[..., None] * [0.8, 0.9, 1.0] + grain).astype(np.float32)
    image[height // 2, width // 3] = sun
    return image


@pytest.mark.slow
def test_the_recipe_keeps_the_light_of_a_sun_of_one_texel():
    image, network, rows = sunny(), config.Representation(hidden=48, depth=2), (0, 48)
    ratios = []
    for light in (1.0, 0.0):
        fitted = fit.fit(image, network, config.Fit(epochs=200, light=light), rows=rows)
        got = picture(fitted, network, (24, 48), rows)
        ratios.append((metrics.peak_ratio(got, image), metrics.mean_luminance_ratio(got, image)))
    (peak, mean), (peak_before, mean_before) = ratios
    assert abs(peak - 1) < 0.1 and abs(mean - 1) < 0.03
    # Gradient descent alone comes last to the sun: 0.66 and 0.68 where this was written, 0.69 and 0.71
    # with another seed.
    assert peak_before < 0.85 and mean_before < 0.85


def test_no_epochs_leaves_the_initial_weights(rng):
    initial = arrays(siren.init(3, 12, 1, 30.0, inputs=3))
    settings = dataclasses.replace(QUICK, epochs=0, light=0.0)
    assert same(fit.fit(sky(rng), NETWORK, settings, seed=3).params, initial)


@pytest.mark.parametrize("gamma", [0.0, 0.01])
def test_same_seed_same_bytes(gamma, rng):
    image, settings = sky(rng), dataclasses.replace(QUICK, awp_gamma=gamma)
    a, b, c = (fit.fit(image, NETWORK, settings, seed) for seed in (1, 1, 2))
    assert same(a.params, b.params) and not same(a.params, c.params)


# ---- perturbation for a while, grids, Adam ---------------------------------------------------------------


@pytest.mark.parametrize(("height", "width", "stride", "count"), [
    (16, 32, 1, 1), (23, 35, 2, 4), (33, 34, 3, 9), (21, 64, 2, 1), (64, 21, 2, 1), (1, 2, 2, 1),
])  # fmt: skip
def test_every_texel_belongs_to_one_grid_with_its_point(height, width, stride, count):
    """Of an image whose first channel numbers its texels."""
    image = np.ones((height, width, 3), np.float32)
    image[..., 0] = np.arange(height * width).reshape(height, width)
    normalisation = fit.Normalisation.of(image)
    x = fit.points(NETWORK, (height, width), (3, height + 5))
    grids = fit._grids(image, normalisation, x, config.Fit(stride=stride))
    assert len(grids) == count
    x, seen = x.numpy(), []
    for objective, points in grids:
        part = objective.radiance.numpy()
        texels = part[..., 0].astype(int)
        assert objective.shape == texels.shape and points.shape == (texels.size, 3)
        # A picture itself: rows and columns a stride apart, and no smaller than the window of the SSIM.
        step = stride if count > 1 else 1
        assert (np.diff(texels, axis=1) == step).all() and (np.diff(texels, axis=0) == step * width).all()
        assert count == 1 or min(texels.shape) >= ssim.WINDOW
        np.testing.assert_array_equal(part, image.reshape(-1, 3)[texels])
        np.testing.assert_array_equal(points.numpy(), x[texels.ravel()])
        seen += texels.ravel().tolist()
    assert sorted(seen) == list(range(height * width))


# ---- schedules -------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("gamma", [0.0, 0.01])
@pytest.mark.parametrize("stride", [1, 2])
def test_no_new_kernel_after_every_grid_had_a_turn(stride, gamma, rng):
    """Odd sizes: the grids differ in size, but no kernel depends on it."""
    image = sky(rng, 23, 31)
    few = 3 if stride == 1 else 8
    settings = dataclasses.replace(QUICK, awp_gamma=gamma, awp_until=1.0, stride=stride)
    short, long = (dataclasses.replace(settings, epochs=epochs) for epochs in (few, 2 * few + 1))
    first = launched(lambda: fit.fit(image, NETWORK, short))
    assert first and launched(lambda: fit.fit(image, NETWORK, long)) <= first


@pytest.mark.parametrize(("schedule", "expected"), [
    ("constant", [1, 1, 1, 1, 1]), ("cosine", [1, 0.853553, 0.5, 0.146447, 0]),
    ("warm-restarts", [1, 0.5, 1, 0.5, 1]),
])  # fmt: skip
def test_learning_rate_follows_the_schedule(schedule, expected):
    settings = config.Fit(epochs=4, schedule=schedule, restart_period=2)
    rates = [fit.learning_rate(settings, 2e-3, epoch) / 2e-3 for epoch in range(5)]
    np.testing.assert_allclose(rates, expected, atol=1e-6)


# ---- fits on disk ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("black", [False, True])
def test_a_fit_is_read_back_as_it_was_and_a_damaged_one_made_again(tmp_path, black, rng):
    image = sky(rng) * (not black)
    fit.fit(image, NETWORK, dataclasses.replace(QUICK, cache=False), folder=tmp_path)
    made = fit.fit(image, NETWORK, QUICK, folder=tmp_path)  # the first that is kept
    found = fit.fit(image, NETWORK, QUICK, folder=tmp_path)
    assert (made.cached, found.cached) == (False, True)
    assert same(made.params, found.params) and list(made.params) == list(found.params)
    assert facts(found) == facts(made)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-100])
    again = fit.fit(image, NETWORK, QUICK, folder=tmp_path)
    assert not again.cached and same(again.params, made.params)


@pytest.mark.slow
def test_other_settings_are_another_fit(tmp_path, rng):
    image = sky(rng)
    quick = dataclasses.replace(QUICK, epochs=1)
    fit.fit(image, NETWORK, quick, folder=tmp_path)
    brighter = image.copy()
    brighter[0, 0, 0] += 1e-6
    of_network = {"hidden": 13, "depth": 2, "omega": 29.0, "coordinates": "plane"}
    of_fit = {"lr": 4e-3, "schedule": "constant", "hdr": 0.02, "awp_gamma": 0.01, "awp_until": 0.5}
    of_fit |= {"beta2": 0.98, "stride": 1, "headroom": 0.1, "light": 0.5}
    others = [(brighter, NETWORK, quick, 0), (image.reshape(32, 16, 3), NETWORK, quick, 0)]
    others += [(image, dataclasses.replace(NETWORK, **{k: v}), quick, 0) for k, v in of_network.items()]
    others += [(image, NETWORK, dataclasses.replace(quick, **{k: v}), 0) for k, v in of_fit.items()]
    others += [(image, NETWORK, quick, *more) for more in ((0, (0, 17)), (0, (1, 17)), (1,))]
    for other in others:
        assert not fit.fit(*other, folder=tmp_path).cached
    assert len(list(tmp_path.iterdir())) == 1 + len(others)
    for rows in (None, (0, 16)):  # a whole map, both
        assert fit.fit(image, NETWORK, quick, 0, rows, folder=tmp_path).cached


class Killed(Exception):
    pass


def killed_at(epoch, told=None):
    """Make a progress function that ends a fit as if it were killed; it is called after every 20 epochs."""

    def progress(done, total, loss):
        if told is not None:
            told.append(done)
        if done >= epoch:
            raise Killed

    return progress


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [0.0, 0.01])
@pytest.mark.parametrize("begun", ["whole", "damaged", "none"])
def test_a_killed_fit_goes_on_to_the_same_weights(tmp_path, monkeypatch, gamma, begun, rng):
    settings = config.Fit(epochs=60, lr=5e-3, awp_gamma=gamma, awp_every=3, stride=2, awp_until=0.9)
    image = sky(rng, 24, 48)
    undisturbed = fit.fit(image, NETWORK, settings)
    monkeypatch.setattr(fit, "SAVED_EVERY", math.inf if begun == "none" else 0.0)
    with pytest.raises(Killed):
        fit.fit(image, NETWORK, settings, folder=tmp_path, progress=killed_at(41))
    if begun == "none":
        assert not list(tmp_path.iterdir())
    if begun == "damaged":
        (path,) = tmp_path.iterdir()
        path.write_bytes(path.read_bytes()[:-100])
    epochs = []
    continued = fit.fit(image, NETWORK, settings, folder=tmp_path, progress=killed_at(math.inf, epochs))
    # The progress of epoch 41 came before its state would have been kept: 39 were, a multiple of 3.
    assert epochs == ([41, 60] if begun == "whole" else [1, 21, 41, 60])
    assert not continued.cached and same(continued.params, undisturbed.params)
    assert facts(continued) == facts(undisturbed)
    assert len(list(tmp_path.iterdir())) == 1 and fit.fit(image, NETWORK, settings, folder=tmp_path).cached


def test_a_fit_that_ends_in_nan_or_begins_with_it_is_refused_as_what_it_is(rng):
    image = sky(rng)
    with pytest.raises(NumericalError, match=r"not finite; lower \[fit\] lr"):
        fit.fit(image, NETWORK, config.Fit(epochs=4, lr=1e37, awp_gamma=0.0))
    image[2, 3, 1] = np.nan
    with pytest.raises(InputError, match="row 2, column 3"):
        fit.fit(image, NETWORK, QUICK)
