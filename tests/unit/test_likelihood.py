"""How likely residuals are: independent values, the most likely noise, the mean of what was not painted."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from envedit.losses import display_curve
from envedit.solve import likelihood
from envedit.solve.likelihood import INDEPENDENT, PAINT_NOISE, SIGMA, STATEMENTS, VISIBLE, Likelihood
from envedit.targets.pixel_weights import pixel_weight
from envedit.targets.target import Target

FILM = (20, 24)


def of_stroke(rows=5, hold=0.3, film=FILM):
    """Return the likelihood of paint on the first rows, and what was painted."""
    coverage = np.zeros((*film, 1), np.float32)
    coverage[:rows] = 1
    weight = pixel_weight(coverage, np.zeros(film, bool), 1.0, hold)
    return Likelihood.of_paint(weight, coverage, *pictures(coverage)), coverage


def pictures(coverage, before=0.2, after=0.5):
    """Return what was painted on, and the painted picture."""
    initial = np.full((*coverage.shape[:2], 3), before, np.float32)
    return initial, np.where(coverage > 0, np.float32(after), initial)


def formula(one, residual, sigma):
    area, total = one.weight.size / one.independent, 0.0
    for w, r in zip(one.weight.ravel(), residual.reshape(-1, 3), strict=True):
        size = np.sqrt((r**2).mean())
        rho = size**2 if size <= sigma or one.painted else sigma * (2 * size - sigma)
        total += 3 * w * rho / (area * sigma**2)
    if one.rest is None:
        return total
    mean = (one.rest * residual).sum(axis=(0, 1)) / one.rest.sum()
    q = np.sqrt((mean**2).mean() * one.rest.sum() / (one.weight > 0).sum()) / VISIBLE
    return total + 3 * STATEMENTS * (q**2 if q <= 1 else 2 * q - 1)


@pytest.mark.parametrize("sigma", [0.02, 0.2])
@pytest.mark.parametrize(("painted", "mean"), [(False, 0.01), (True, 0.01), (True, 0.1)])
def test_misfit_is_that_of_the_formula(sigma, painted, mean, rng):
    one = of_stroke()[0] if painted else Likelihood(likelihood.on_average_one(rng.random((*FILM, 1))))
    residual = rng.normal(mean, 0.1, (*FILM, 3))
    assert one.misfit(residual, sigma) == pytest.approx(formula(one, residual, sigma), rel=1e-5)
    assert one.misfit(0 * residual, sigma) == 0
    assert one.painted == painted


@pytest.mark.parametrize("change", [0.2, 3.0])
def test_the_mean_is_scaled_to_have_the_gradient_of_its_loss(change):
    one, coverage = of_stroke()
    residual, h = VISIBLE * (1 - coverage) * change * np.array([1.0, -0.5, 0.2]), 1e-6
    share, mean = one.linear_mean(residual)
    for c in range(3):
        ends = [residual + sign * h * (np.arange(3) == c) * (1 - coverage) for sign in (1, -1)]
        slope = np.subtract(*(likelihood.of_mean(one.mean(end)) for end in ends)) / (2 * h)
        assert 2 * (share * (1 - coverage)).sum() * mean[c] == pytest.approx(slope, rel=1e-4, abs=1e-6)


def test_noise_of_squares_is_the_most_likely(rng):
    """No other sigma makes the residual likelier, and its square is the weighted mean square."""
    one = replace(of_stroke()[0], least_noise=1e-3)
    residual = rng.normal(0, 0.05, (*FILM, 3))
    found = one.noise(residual)
    assert found == pytest.approx(np.sqrt((one.weight * residual**2).mean()), rel=1e-5)

    def unlikeliness(sigma):
        return one.misfit(residual, sigma) + 6 * one.independent * np.log(sigma)

    assert one.at_best(residual) == pytest.approx(unlikeliness(found), rel=1e-9)
    assert min(unlikeliness(found * factor) for factor in (0.5, 0.95, 1.05, 2)) > unlikeliness(found)
    # What is known is not undercut.
    assert replace(one, least_noise=0.5).noise(residual) == 0.5
    assert one.noise(0 * residual) == 1e-3


@pytest.mark.parametrize(("noise", "least"), [(None, SIGMA), (0.001, SIGMA), (0.03, 0.03)])
def test_display_values_are_known_to_the_noise_of_the_target(noise, least):
    picture = np.full((*FILM, 3), 0.5, np.float32)
    of_pixels = None if noise is None else np.full(FILM, noise)
    assert (
        Likelihood.of_target(Target(picture, np.ones((*FILM, 1)), None, "", noise=of_pixels)).least_noise
        == least
    )


def test_noise_of_paint_is_at_most_a_share_of_the_change_that_is_seen():
    """However much is painted that changes nothing, as strokes that hold."""
    one, coverage = of_stroke()
    shown = display_curve.to_display(mi.TensorXf([0.2, 0.5])).numpy()
    most = pytest.approx(PAINT_NOISE * (shown[1] - shown[0]), rel=1e-5)
    residual = np.full((*FILM, 3), 0.5)
    assert one.noise(residual) == most
    assert one.at_best(residual) == pytest.approx(
        one.misfit(residual, one.paint_noise) + 6 * one.independent * np.log(one.paint_noise), rel=1e-9
    )
    all_painted = np.ones_like(coverage)
    assert Likelihood.of_paint(all_painted, all_painted, *pictures(coverage)).noise(residual) == most
    nothing = Likelihood.of_paint(one.weight, coverage, *pictures(coverage, 0.2, 0.2))
    assert nothing.noise(residual) == pytest.approx(PAINT_NOISE * VISIBLE)


@pytest.mark.parametrize(("before", "white"), [(0.0, 1.0), (0.2, 1.0), (4.0, 4.0)])
def test_white_is_what_most_of_the_picture_was_below_and_at_least_one(before, white):
    coverage = np.zeros((*FILM, 1), np.float32)
    coverage[:5] = 1
    initial, painted = pictures(coverage, before, white * np.e)
    initial[coverage[..., 0] > 0] = white  # a change from white to a brighter white
    weight = pixel_weight(coverage, np.zeros(FILM, bool), 1.0, 0.3)
    one = Likelihood.of_paint(weight, coverage, np.where(coverage > 0, initial, before), painted)
    assert one.white == pytest.approx(white)
    assert one.paint_noise == pytest.approx(PAINT_NOISE * display_curve.ABOVE_WHITE / 2.2, rel=1e-4)
    assert Likelihood(one.weight).white == np.inf


@pytest.mark.parametrize("film", [(6, 8), FILM, (64, 64)])
def test_noise_with_hubers_loss_makes_the_misfit_that_of_independent_values(film, rng):
    one = Likelihood(np.ones((*film, 1), np.float32), least_noise=1e-4)
    residual = rng.normal(0, 0.03, (*film, 3)) * np.where(rng.random((*film, 1)) < 0.1, 20, 1)
    found = one.noise(residual)
    assert one.misfit(residual, found) == pytest.approx(3 * INDEPENDENT, rel=1e-6)
    assert one.noise(4 * residual) == pytest.approx(4 * found)


@pytest.mark.parametrize("rows", [1, 5, 19, 20])
def test_all_paint_is_a_few_statements_whatever_its_size(rows):
    """Its residual of one sigma has the misfit of so many values, and the rest's of 0.3 times as many."""
    one, coverage = of_stroke(rows, film=(20, 240))
    residual = np.broadcast_to(0.1 * coverage, (*coverage.shape[:2], 3))
    assert one.misfit(residual, 0.1) == pytest.approx(3 * STATEMENTS, rel=1e-5)
    painted = 1 / 1.3 if rows < 20 else 1
    assert one.independent == pytest.approx(STATEMENTS / painted, rel=1e-5)
    assert (one.rest is None) == (rows == 20)
    assert likelihood.on_average_one(one.weight).mean() == pytest.approx(1, rel=1e-5)
    pattern = 0.1 * (1 - coverage) * (-1.0) ** np.arange(240)[:, None]
    found = one.misfit(np.broadcast_to(pattern, residual.shape), 0.1)
    assert found == pytest.approx(0.3 * 3 * STATEMENTS * (rows < 20), rel=1e-5)


def test_the_mean_of_the_rest_is_known_to_a_visible_change():
    """A change of all of it by that counts as one, times the share that was not painted; paint does not."""
    one, coverage = of_stroke(5)
    residual = VISIBLE * (1 - coverage) * np.array([1, -2, 0])
    assert one.mean(residual) == pytest.approx(np.sqrt(0.75) * np.array([1, -2, 0]), rel=1e-5)
    assert not one.mean(coverage * np.ones(3)).any()
    # Where all is painted there is none.
    all_painted, coverage = of_stroke(FILM[0])
    assert all_painted.rest is None and not all_painted.mean(coverage * np.ones(3)).any()


def test_pixels_that_do_not_count_are_not_of_the_rest(rng):
    coverage = np.zeros((*FILM, 1), np.float32)
    coverage[:5] = 1
    out = np.zeros(FILM, bool)
    out[10:] = True
    one = Likelihood.of_paint(pixel_weight(coverage, out, 1.0, 0.3), coverage, *pictures(coverage))
    residual = rng.normal(0, 0.1, (*FILM, 3))
    inside = np.where(out[..., None], 0, residual)
    assert one.misfit(residual, 0.1) == pytest.approx(one.misfit(inside, 0.1), rel=1e-9)
    mean = residual[5:10].mean(axis=(0, 1))
    assert one.mean(residual) == pytest.approx(np.sqrt(0.5) * mean / VISIBLE, rel=1e-4)
    # Where the rest has no weight its mean is not held either.
    without = Likelihood.of_paint(pixel_weight(coverage, out, 1.0, 0.0), coverage, *pictures(coverage))
    assert not without.mean(residual).any()
