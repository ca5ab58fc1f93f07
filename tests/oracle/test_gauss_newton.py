"""Gauss-Newton on layers: derivatives, the prior, a problem of known solution, extremes.

The transport is a dense matrix, the map 48 texels wide and the picture 12 pixels: a cell of the block
transport is then a texel and a block a pixel, and the Jacobian is exact.
"""

import dataclasses
import functools
from copy import copy as shallow_copy

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.errors import NumericalError
from envedit.core.rotations import rotated, rotation_between, rotation_vector
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK
from envedit.solve import gauss_newton, light_places, map_problem, search
from envedit.solve.derivatives import NARROW_ANGLE
from envedit.solve.gauss_newton import Run, solve
from envedit.solve.likelihood import Likelihood, on_average_one
from envedit.solve.map_problem import Problem
from envedit.solve.prior import Prior, of_paint
from envedit.solve.unknowns import with_light
from envedit.solve.white_sky import WhiteSky
from envedit.targets.photo import Camera, Photo
from envedit.targets.pixel_weights import pixel_weight
from tests.oracles.dense_transport import DenseTransport, node_shares
from tests.oracles.maps import angle
from tests.oracles.matrix_renderer import same
from tests.oracles.plain import plain_display

pytestmark = pytest.mark.usefixtures("own_core")

GRID, FILM = (24, 48), (10, 12)
SUN = (7, 20)
PRIOR = Prior()


def lamp(place=SUN, radiance=200.0):
    """A disc of 8 degrees on black."""
    d = latlong.directions(*GRID)
    away = angle(d, d[place])[..., None]
    return np.where(away < 8, radiance * np.array([1, 0.8, 0.6]), 0).astype(np.float32)


def clouds(rng):
    return (0.3 + 0.3 * rng.random((*GRID, 3))).astype(np.float32)


def shown(transport, image):
    return transport.apply(mi.TensorXf(np.asarray(image, np.float32))).numpy()


def problem_of(image, transport, target, likelihood=None, cycles=3, aureoles=True, **options):
    """Return a problem and the parameters to start from."""
    layers = Layers.of(image, cycles=cycles, aureoles=aureoles)
    params = layers.start()
    return Problem(layers, transport, image, target, likelihood, **options), params


def known_to(problem, sigma):
    """Return the problem with display values that are known to a standard error of ``sigma``."""
    problem = shallow_copy(problem)
    problem.likelihood = dataclasses.replace(problem.likelihood, least_noise=sigma)
    return problem


def copy(state):
    return {name: value.copy() for name, value in state.items()}


def moved(problem, state, unknowns, k, h):
    """Return a state with one unknown changed: channel by channel the nodes, then what ``unknowns`` names."""
    state, n = copy(state), problem.nodes
    if k < 3 * n:
        state["gain"][k % n, k // n] += h
        return state
    name, i, axis = unknowns[k - 3 * n]
    if name == "turn":
        there = rotated(problem.direction(state, i), h * axis)
        state["turn"][i] = rotation_vector(problem.layers.lights.centres[i], there)
    else:
        state[name][i, axis] += h
    return state


@pytest.fixture(scope="module")
def case():
    """A sky with a lamp, and a state where every unknown has moved."""
    return moved_case(lambda weight: Likelihood(on_average_one(weight)))


@pytest.fixture(scope="module")
def painted():
    """The same with paint on a quarter of the picture."""
    coverage = np.zeros((*FILM, 1), np.float32)
    coverage[2:7, 3:9] = 1
    weight = pixel_weight(coverage, np.zeros(FILM, bool), 1.0, 0.3)
    initial = np.full((*FILM, 3), 0.2, np.float32)
    case = moved_case(lambda _: Likelihood.of_paint(weight, coverage, initial, initial + 0.3 * coverage))
    case[0].white_sky = None  # of its own in another test
    return case


@pytest.fixture(scope="module")
def photographed():
    """The same with a camera's factor, and a quarter of the values clipped: some above, some below."""
    factor = np.array([0.4, 0.1, -0.3])
    clipped = np.zeros((*FILM, 3), bool)
    clipped[::2, ::2] = True
    photo = Photo(np.zeros((*FILM, 8)), Camera("linear", factor), ("linear",))
    problem, params, start, state = moved_case(
        lambda weight: Likelihood(on_average_one(weight)), photo=photo, clipped=clipped
    )
    return problem, params, start, state | {"camera": np.array([[0.3, -0.2, 0.1]])}


def moved_case(likelihood, **options):
    """Return a problem, its parameters, its start, and the state; ``likelihood`` is given weights."""
    rng = np.random.default_rng(0)
    image, transport = clouds(rng) + lamp(), DenseTransport.random(rng, FILM, GRID)
    target = shown(transport, image) * np.exp(rng.normal(0, 0.5, (*FILM, 3))).astype(np.float32)
    weight = 0.5 + rng.random((*FILM, 1))
    problem, params = problem_of(image, transport, target, likelihood(weight), aureoles=False, **options)
    assert len(problem.layers.separation.lights) == 1 and not problem.layers.lights.glowing
    start = problem.state(params)
    state, centre = copy(start), problem.layers.lights.centres[0]
    state["gain"] = rng.normal(0, 0.3, state["gain"].shape)
    state["flux"][0] += [0.1, -0.2, 0.3]
    state["size"][0] = 0.05
    # Off the texels' centres, where the derivative jumps.
    state["turn"][0] = rotation_vector(centre, rotated(centre, np.array([0.03, 0.05, -0.04])))
    return problem, params, start, state


# ---- derivatives -------------------------------------------------------------------------------------------

STEPS = {
    "gain": 0.01, "flux": 0.01, "turn": NARROW_ANGLE, "size": 0.002, "saturation": 0.02, "camera": 0.01
}  # fmt: skip
# Display values are good to 1e-7, differences of F over a step to 1e-4 of its slope. A light's direction is
# differentiated over 0.7 degrees, a twentieth of a texel, and its size forwards, over 10 %.
CLOSE = {"gain": 2e-3, "flux": 2e-3, "turn": 0.05, "size": 0.2, "camera": 2e-3}


def total(problem, state, start=None, sigma=1.0):
    """F of a state, or its misfit alone without a start."""
    point = problem.evaluate(state)
    if start is None:
        return problem.likelihood.misfit(point.residual, sigma)
    return problem.loss(point, start, sigma)


def differences(problem, state, unknowns, some, h, f):
    """Return f of each of some unknowns moved by h and by -h, (n, 2)."""
    return np.array([[f(moved(problem, state, unknowns, k, s * h)) for s in (1, -1)] for k in some])


def slopes(problem, state, unknowns, some, h, f):
    """Central differences of F / 2 by some of the unknowns, (n,)."""
    ahead, back = differences(problem, state, unknowns, some, h, f).T
    return (ahead - back) / (4 * h)


def names_of(problem, normal):
    return ["gain"] * (3 * problem.nodes) + [name for name, _, _ in normal.linear.named]


# Most residuals are in the linear part, some, none.
@pytest.mark.parametrize("sigma", [0.02, 0.1, 1.0])
def test_gradient_is_that_of_finite_differences(case, sigma):
    problem, _, start, state = case
    point = problem.evaluate(state)
    size = np.sqrt((point.residual**2).mean(axis=2))
    assert (size > sigma).mean() == pytest.approx({0.02: 0.97, 0.1: 0.87, 1.0: 0}[sigma], abs=0.05)
    assert_gradient(problem, start, state, sigma)


def test_gradient_of_a_photograph_is_that_of_finite_differences(photographed):
    problem, _, start, state = photographed
    clipped = problem.clipped
    residual = problem.evaluate(state).residual
    assert (residual[clipped] == 0).mean() == pytest.approx(0.5, abs=0.4) and (residual[~clipped] > 0).any()
    assert (residual[clipped] <= 0).all()
    assert_gradient(problem, start, state, 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.02, 0.2])
def test_gradient_of_paint_with_the_mean_of_the_rest_is_that_of_finite_differences(painted, sigma):
    """Of the misfit, beside which the prior is large here: paint, the pattern of the rest, and its mean."""
    problem, _, start, state = painted
    mean = problem.likelihood.mean(problem.evaluate(state).residual)
    assert np.abs(mean).max() > 1 and problem.likelihood.rest is not None
    assert_gradient(problem, start, state, sigma, of_prior=False)
    # Negative control: without the mean the gradient is another one.
    full = problem.likelihood
    problem.likelihood = dataclasses.replace(full, rest=None)
    alone = problem.normal(problem.evaluate(state), start, sigma)
    problem.likelihood = full
    with pytest.raises(AssertionError, match="gain"):
        assert_gradient(problem, start, state, sigma, of_prior=False, normal=alone)


def assert_gradient(problem, start, state, sigma, of_prior=True, normal=None):
    """Compare the gradient with finite differences of F, or of its misfit alone, by every kind of unknown."""
    normal = normal or problem.normal(problem.evaluate(state), start, sigma)
    names = names_of(problem, normal)
    kinds = [kind for kind in CLOSE if kind != "camera" or problem.photographed]
    assert sorted(set(names)) == sorted(kinds)
    gradient = normal.gradient
    if not of_prior:
        gradient = gradient - normal.precision @ problem._from_prior(state, start, normal.linear.named)

    def f(x):
        return total(problem, x, start if of_prior else None, sigma)

    for kind in kinds:
        some = [k for k, name in enumerate(names) if name == kind][:: 4 if kind == "gain" else 1]
        slope = slopes(problem, state, normal.linear.named, some, STEPS[kind], f)
        np.testing.assert_allclose(
            gradient[some], slope, rtol=0, atol=CLOSE[kind] * np.abs(slope).max(), err_msg=kind
        )
        assert np.abs(slope).max() > 0


@pytest.mark.slow
def test_hessian_is_that_of_the_jacobian_and_the_prior(case):
    problem, _, start, state = case
    sigma, n = 0.1, problem.nodes
    point = problem.evaluate(state)
    normal = problem.normal(point, start, sigma)
    names = names_of(problem, normal)
    columns, radiance = [], np.float64(point.rendering)
    slope = (plain_display(radiance * (1 + 1e-6)) - plain_display(radiance * (1 - 1e-6))) / (2e-6 * radiance)
    for k, name in enumerate(names):
        if name == "size":  # likewise forwards
            ends, width = (moved(problem, state, normal.linear.named, k, 0.1), state), 0.1
        else:
            h = STEPS[name]
            ends, width = [moved(problem, state, normal.linear.named, k, s * h) for s in (1, -1)], 2 * h
        ends = [np.float64(problem.evaluate(end).rendering) for end in ends]
        columns.append((slope * (ends[0] - ends[1]) / width).ravel())
    jacobian = np.stack(columns, axis=1)
    size = np.sqrt((point.residual**2).mean(axis=2, keepdims=True))
    # A picture of fewer than 256 pixels: A = 1.
    huber = np.where(size <= sigma, 1, sigma / size) * problem.likelihood.weight / sigma**2
    huber = np.broadcast_to(huber, point.residual.shape).ravel()
    expected = jacobian.T @ (huber[:, None] * jacobian) + plain_precision(problem, names)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(normal.hessian - expected) / scale).max() < 2e-3
    np.testing.assert_allclose(normal.hessian, normal.hessian.T, rtol=1e-5, atol=1e-5 * normal.hessian.max())
    # Negative control: data and prior both matter.
    assert np.abs(np.diag(expected) / np.diag(plain_precision(problem, names)) - 1).max() > 1
    assert (np.diag(plain_precision(problem, names))[: 3 * n] > 0.1 * np.diag(expected)[: 3 * n]).any()


@pytest.mark.slow
def test_the_mean_of_the_rest_is_three_more_residuals_of_the_hessian(painted):
    """Of rank three: J' J of finite differences of q, which is without a sigma."""
    problem, _, start, state = painted
    point, full = problem.evaluate(state), problem.likelihood
    with_mean = problem.normal(point, start, 0.1)
    problem.likelihood = dataclasses.replace(full, rest=None)
    without = problem.normal(point, start, 0.1)
    problem.likelihood = full
    share, mean = full.linear_mean(point.residual)
    part = with_mean.hessian - without.hessian
    values = np.linalg.eigvalsh(part)
    assert values[-3] > 1e-3 * values[-1] and np.abs(values[:-3]).max() < 1e-8 * values[-1]
    names, columns = names_of(problem, with_mean), []
    for k, name in enumerate(names):
        steps = (0.1, 0.0) if name == "size" else (STEPS[name], -STEPS[name])
        ends = [problem.evaluate(moved(problem, state, with_mean.linear.named, k, h)) for h in steps]
        means = [(share * end.residual).sum(axis=(0, 1)) for end in ends]
        columns.append((means[0] - means[1]) / (steps[0] - steps[1]))
    jacobian = np.stack(columns, axis=1)
    close = np.array([{"gain": 5e-3, "flux": 5e-3}.get(name, 0.2) for name in names])
    found = with_mean.mean_by_unknowns
    for kind in sorted({*names}):
        some = [k for k, name in enumerate(names) if name == kind]
        largest = np.abs(jacobian[:, some]).max()
        assert (np.abs(found - jacobian)[:, some] < close[some] * largest).all(), kind
    np.testing.assert_allclose(part, found.T @ found, rtol=0, atol=1e-8 * values[-1])
    np.testing.assert_allclose(with_mean.mean, mean)


@pytest.mark.slow
def test_texture_within_a_block_is_in_the_derivatives(rng):
    """Blocks of four pixels that see the same sky, with albedos of their own: as exact as single pixels."""
    height, width = film = (8, 64)
    block = np.add.outer(np.arange(height) // 2 * (width // 2), np.arange(width) // 2).ravel()
    seen = DenseTransport.random(rng, (height // 2, width // 2), GRID, even=0.8).weights[0]
    albedo = rng.uniform(0.05, 1.0, (3, height * width, 1))
    image, transport = clouds(rng) + lamp(), DenseTransport(albedo * seen[block], film, GRID)
    target = shown(transport, image) * np.exp(rng.normal(0, 0.3, (*film, 3))).astype(np.float32)
    problem, params = problem_of(image, transport, target)
    state, n = problem.state(params), problem.nodes
    start = copy(state)
    state["gain"] = rng.normal(0, 0.3, state["gain"].shape)
    point, sigma = problem.evaluate(state), 1.0
    assert problem.blocks.count == height * width // 4
    normal, h = problem.normal(point, start, sigma), STEPS["gain"]
    some = list(range(0, 3 * n, 7))
    slope = slopes(problem, state, normal.linear.named, some, h, lambda x: total(problem, x, start))
    np.testing.assert_allclose(normal.gradient[some], slope, rtol=0, atol=5e-3 * np.abs(slope).max())
    k = some[int(np.abs(slope).argmax())]
    ((ahead, back),) = differences(
        problem, state, normal.linear.named, [k], h, lambda x: np.float64(problem.evaluate(x).rendering)
    )
    column = normal.slope * (ahead - back) / (2 * h)
    lights = normal.linear.pictures * normal.slope
    mixed = (lights * normal.robust * column).sum(axis=(1, 2, 3))
    np.testing.assert_allclose(normal.hessian[3 * n :, k], mixed, rtol=0, atol=5e-3 * np.abs(mixed).max())
    own = (normal.robust * column**2).sum()
    assert (normal.hessian - normal.precision)[k, k] == pytest.approx(own, rel=5e-3)
    # Negative control: without the profile the sum is that of the blocks' means.
    even = problem.blocks.profile(np.ones((*film, 3)))
    assert np.array_equal(even, np.ones_like(even)) and np.ptp(normal.linear.profile) > 1


def plain_precision(problem, names, prior=PRIOR):
    """Return K, written node by node."""
    n = problem.nodes
    matrix, node = np.zeros((len(names), len(names))), 0
    axes = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
    for level, (rows, columns) in enumerate(problem.sizes):
        sd = np.array([np.sqrt(3) * prior.luminance, prior.chroma, prior.tint]) / 2**level
        block = axes.T @ np.diag(sd**-2) @ axes
        for _ in range(rows * columns):
            at = node + n * np.arange(3)
            matrix[np.ix_(at, at)] = block
            node += 1
    k = 3 * n
    while k < len(names):
        if names[k] == "flux":  # three channels, one after the other
            sd = np.array([np.sqrt(3) * prior.flux, prior.flux_chroma, prior.tint])
            matrix[k : k + 3, k : k + 3] = axes.T @ np.diag(sd**-2) @ axes
            k += 3
        else:
            matrix[k, k] = getattr(prior, names[k]) ** -2.0
            k += 1
    return matrix


def test_state_and_params_are_inverse(case):
    problem, _, _, state = case
    again = problem.state(problem.params(state))
    for name in state:
        np.testing.assert_allclose(again[name], state[name], rtol=1e-6, atol=1e-7)
    assert problem.shining(state) == [0]  # spare ones are dark


# ---- F -----------------------------------------------------------------------------------------------------


def of_prior(case, prior):
    layers, transport, envmap = case[0].layers, case[0].transport, case[0].envmap
    return Problem(layers, transport, envmap, case[0].picture, prior=prior)


@pytest.mark.parametrize("prior", [PRIOR, of_paint(0.5)], ids=["rendering", "paint"])
def test_penalty_is_that_of_the_precision(case, prior, rng):
    """x' K x, and its half gradient; of a light that is not there nothing."""
    _, _, start, state = case
    problem = of_prior(case, prior)
    normal = problem.normal(problem.evaluate(state), start, 1.0)
    x = problem._from_prior(state, start, normal.linear.named)
    assert problem.from_start(state, start) == pytest.approx(x @ normal.precision @ x, rel=1e-9)
    pull, some = normal.precision @ x, rng.choice(3 * problem.nodes, 5, replace=False)
    found = slopes(
        problem, state, normal.linear.named, some, 1e-4, lambda end: problem.from_start(end, start)
    )
    np.testing.assert_allclose(pull[some], found, rtol=1e-4)
    spare = copy(start)
    spare["flux"][1], spare["turn"][1], spare["size"][1] = DARK + 0.3, 0.1, 0.2
    assert problem.from_start(start, start) == problem.from_start(spare, start) == 0


def test_white_sky_counts_where_more_is_white(case):
    """Its gradient is that of finite differences; nothing where less is white, and at no edit."""
    _, _, start, state = case
    problem = of_prior(case, of_paint(0.5))
    problem.white_sky = white_sky = WhiteSky.of(problem.envmap, 0.8)
    whiter = state | {"gain": state["gain"] + 0.3}
    point = problem.evaluate(whiter)
    normal = problem.normal(point, start, 1.0)
    assert white_sky.loss(point.edited) > 10
    problem.white_sky = None
    gradient = normal.gradient - problem.normal(point, start, 1.0).gradient
    some = range(0, 3 * problem.nodes, 4)
    found = slopes(
        problem, whiter, normal.linear.named, some, 0.003, lambda end: white_sky.loss(edited(problem, end))
    )
    np.testing.assert_allclose(gradient[some], found, rtol=0, atol=1e-2 * np.abs(found).max())
    assert white_sky.loss(edited(problem, start)) == 0
    # Where a step would lead beyond, it counts before: the square of a linear function, which is 0 there.
    problem.white_sky = white_sky
    unedited = problem.evaluate(start)
    free, bounded = (problem.normal(unedited, start, 1.0, bounded=one) for one in (False, True))
    np.testing.assert_allclose(bounded.gradient, free.gradient, atol=1e-6 * np.abs(free.gradient).max())
    rank_one = bounded.hessian - free.hessian
    slope = rank_one[0] / np.sqrt(rank_one[0, 0])
    np.testing.assert_allclose(rank_one, np.outer(slope, slope), atol=1e-6 * np.abs(rank_one).max())
    assert slope[0] > 0
    assert WhiteSky.of(problem.envmap, 0.0).loss(point.edited) == 0
    assert white_sky.loss(edited(problem, start | {"gain": start["gain"] - 1})) == 0


def test_derivatives_of_the_map_by_lights(case, rng):
    problem, _, _, state = case
    linear = problem.derivatives.at(problem.evaluate(state))
    weights = rng.random((*GRID, 3))[problem.rows]
    for k, (derivative, (name, _, _)) in enumerate(
        zip(linear.by_lights(weights), linear.named, strict=True), 3 * problem.nodes
    ):

        def f(end):
            return float((weights * np.float64(edited(problem, end)[problem.rows])).sum())

        (found,) = 2 * slopes(problem, state, linear.named, [k], STEPS[name], f)
        assert derivative == pytest.approx(found, rel=CLOSE[name], abs=0.05 if name == "turn" else 0), name


def edited(problem, state):
    return problem.evaluate(state).edited


# ---- a problem of known solution ---------------------------------------------------------------------------


@pytest.mark.slow
def test_linear_problem_has_its_closed_solution(rng, monkeypatch):
    """A grey sky so dark that display values are linear, and asked to change by a thousandth."""
    monkeypatch.setattr(gauss_newton, "LEAST_DECREASE", 1e-9)  # damped steps come close one after the other
    level, sigma = 4e-4, 1e-3
    slope = 1e-3 ** (1 / 2.2) / 1e-3
    transport = DenseTransport.random(rng, FILM, GRID)
    image = np.full((*GRID, 3), level, np.float32)
    target = np.float32(shown(transport, image) * (1 + 1e-3 * rng.normal(0, 1, (*FILM, 3))))
    problem, params = problem_of(image, transport, target)
    residual = slope * (np.float64(target) - shown(transport, image))
    assert target.max() < 1e-3 and np.sqrt((residual**2).mean(axis=2)).max() < sigma

    # exp(g) = 1 + g: a node's share of every texel, times what a pixel sees of it.
    hats = np.concatenate(node_shares(problem), axis=1)
    jacobian = slope * level * np.float64(transport.weights[0]) @ hats
    jacobian = np.kron(np.eye(3), jacobian)
    precision = plain_precision(problem, ["gain"] * (3 * problem.nodes))
    by_channel = residual.reshape(-1, 3).T.ravel()
    hessian = jacobian.T @ jacobian / sigma**2 + precision
    expected = np.linalg.solve(hessian, jacobian.T @ by_channel / sigma**2)

    problem = known_to(problem, sigma)
    solution = solve(problem, params, iterations=60, sparing=False)
    got = problem.state(solution.params)["gain"].T.ravel()
    # exp is linear to a hundredth, and the map rounded to 1e-4 of its change: flat directions of F show it.
    least = ((jacobian @ expected - by_channel) ** 2).sum() / sigma**2 + expected @ precision @ expected
    assert (got - expected) @ hessian @ (got - expected) < 1e-4 * least
    assert np.linalg.norm(got - expected) < 0.04 * np.linalg.norm(expected)
    assert solution.run.history[-1]["loss"] == pytest.approx(least, rel=2e-3)
    # What the first step promises is that, and the last one nothing.
    start = problem.state(params)
    first, last = (
        problem.normal(point, start, sigma)
        for point in (problem.evaluate(start), gauss_newton.reached(problem, solution.run))
    )
    assert first.decrement == pytest.approx((residual**2).sum() / sigma**2 - least, rel=5e-3)
    assert last.decrement < 1e-3 * first.decrement
    # As noise would let steps do: what is asked for is noise.
    kept = solve(problem, params, iterations=60)
    assert kept.note and not problem.state(kept.params)["gain"].any()
    without = np.linalg.lstsq(jacobian, by_channel, rcond=None)[0]
    assert np.linalg.norm(without - expected) > 0.1 * np.linalg.norm(expected)  # the prior has its say
    assert np.linalg.norm(expected) > 1e-3

    # What is left unknown: the diagonal of hats (J'J / s^2 + K)^-1 hats', of the mean over channels.
    mean = np.kron(np.full((1, 3), 1 / 3), hats)
    variance = np.einsum("tn,nm,tm->t", mean, np.linalg.inv(hessian), mean, optimize=True)
    np.testing.assert_allclose(solution.posterior.deviation.ravel(), np.sqrt(variance), rtol=1e-2)


# ---- standard deviation ------------------------------------------------------------------------------------


def prior_deviation(problem, prior=PRIOR):
    variance = sum(
        (share**2).sum(axis=1) * (prior.luminance / 2**level) ** 2
        for level, share in enumerate(node_shares(problem))
    )
    return np.sqrt(variance).reshape(GRID)


def test_deviation_is_the_priors_where_nothing_is_seen(rng):
    image, target = clouds(rng), np.full((*FILM, 3), 0.5, np.float32)
    blind = DenseTransport(np.zeros((FILM[0] * FILM[1], GRID[0] * GRID[1])), FILM, GRID)
    for prior in (PRIOR, dataclasses.replace(PRIOR, luminance=0.3)):
        problem, params = problem_of(image, blind, target, prior=prior)
        solution = solve(problem, params)
        np.testing.assert_allclose(solution.posterior.deviation, prior_deviation(problem, prior), rtol=1e-4)
        assert solution.posterior.deviation.dtype == np.float32
        assert not problem.state(solution.params)["gain"].any()


# ---- steps -------------------------------------------------------------------------------------------------


def followed(problem, params, **options):
    """Solve, and check that no step raises F, that what is told is so, and that all is finite."""
    points, damping = [], []

    def note(run, point):
        points.append(point)
        damping.append(run.damping)

    solution = solve(problem, params, after_step=note, **options)
    start = problem.state(params)
    before, scale = problem.evaluate(start), np.inf
    sigma = problem.likelihood.least_noise
    for row, point in zip(solution.run.history, points, strict=False):
        f, earlier = (problem.loss(one, start, row["sigma"]) for one in (point, before))
        assert f == pytest.approx(row["loss"], rel=1e-9) == row["data"] + row["prior"]
        assert f < earlier
        assert sigma <= row["sigma"] <= max(scale, sigma)
        before, scale = point, row["sigma"]
    assert [row["iteration"] for row in solution.run.history] == list(range(len(solution.run.history)))
    assert all(np.isfinite(list(row.values())).all() for row in solution.run.history)
    assert all(np.isfinite(value.numpy()).all() for value in solution.params.values())
    assert np.isfinite(solution.posterior.deviation).all()
    last = problem.evaluate(problem.state(solution.params))
    assert np.isfinite(last.edited).all() and (last.edited >= 0).all()
    return solution, last


def test_scale_is_that_of_the_residual_and_falls_by_half_at_most(case):
    problem, params, start, _ = case
    problem = known_to(problem, 0.05)
    solution, last = followed(problem, params, iterations=30)
    scales = [row["sigma"] for row in solution.run.history]
    residual = problem.evaluate(start).residual
    assert scales[0] == problem.likelihood.noise(residual)
    assert all(b >= a / 2 * (1 - 1e-12) for a, b in zip(scales, scales[1:], strict=False))
    assert scales[-1] == pytest.approx(problem.likelihood.noise(last.residual), rel=0.02)


def test_a_step_that_raises_f_is_damped(case, monkeypatch):
    """Steps three times too long overshoot: they are taken back until the damping shortens them."""
    problem, params, _, _ = case
    step, dampings = Problem.step, []

    def far(self, state, normal, damping):
        dampings.append(damping)
        found, times = step(self, state, normal, damping), 6 if damping < 0.5 else 1
        return {name: state[name] + times * (found[name] - state[name]) for name in found}

    monkeypatch.setattr(Problem, "step", far)
    solution, _ = followed(known_to(problem, 0.1), params)
    assert len(dampings) > len(solution.run.history) > 1 and max(dampings) >= 0.5
    rises = [b / a for a, b in zip(dampings, dampings[1:], strict=False) if b > a]
    assert rises and min(rises) >= 10 * (1 - 1e-9)


def test_no_step_is_longer_than_its_limit(case):
    problem, _, start, state = case
    normal = problem.normal(problem.evaluate(state), start, 0.01)
    far = dataclasses.replace(normal, gradient=1e6 * normal.gradient)
    found = problem.step(state, far, 1e-3)
    largest = map_problem.LARGEST_STEP
    for name in ("gain", "flux", "size"):
        change = np.abs(found[name] - state[name])
        assert 0.99 * largest[name] < change.max() <= largest[name] * (1 + 1e-9), name
    turned = rotation_between(problem.direction(state, 0), problem.direction(found, 0))
    assert np.linalg.norm(turned) == pytest.approx(largest["turn"], rel=1e-6)
    np.testing.assert_array_equal(found["flux"][1:], state["flux"][1:])


@pytest.mark.slow
def test_no_step_takes_a_light_below_the_horizon(rng):
    """Of a map whose lower half keeps its values: pushed down, a light stays at the edge of the sky."""
    image, transport = clouds(rng) + lamp(), DenseTransport.random(rng, FILM, GRID)
    layers = Layers.of(image[: GRID[0] // 2], (0, GRID[0]), cycles=3)
    params = layers.start()
    problem = Problem(layers, transport, image, shown(transport, image))
    start = state = problem.state(params)
    heights = [problem.direction(start, 0)[1]]
    for _ in range(10):
        normal = problem.normal(problem.evaluate(state), start, 0.01)
        down = np.zeros_like(normal.gradient)
        for k, (name, _, axis) in enumerate(normal.linear.named, 3 * problem.nodes):
            if name == "turn":
                lower = problem.direction(state, 0) + 0.01 * np.cross(axis, problem.direction(state, 0))
                down[k] = 1e9 * np.sign(lower[1] - problem.direction(state, 0)[1])
        state = problem.step(state, dataclasses.replace(normal, gradient=down), 1e-3)
        heights.append(problem.direction(state, 0)[1])
    assert heights[0] > 0.2 and min(heights) > -1e-9 and heights[-1] == pytest.approx(0, abs=1e-6)


def marquardt(normal, damping):
    """Return the step that is damped by the diagonal of the whole Hessian."""
    damped = normal.hessian + damping * np.diag(np.diag(normal.hessian))
    return -np.linalg.solve(damped, normal.gradient)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 1.0])
def test_of_a_rendering_the_step_is_marquardts(case, damping):
    problem, _, start, state = case
    normal = problem.normal(problem.evaluate(state), start, 1.0)
    expected = marquardt(normal, damping)[: 3 * problem.nodes]
    gain = (problem.step(state, normal, damping)["gain"] - state["gain"]).T.ravel()
    assert np.abs(expected).max() < map_problem.LARGEST_STEP["gain"]
    np.testing.assert_allclose(gain, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_damping_lets_the_whole_sky_change_in_one_step(rng):
    """Where nodes go together a diagonal would hold what all of them do: a factor costs next to nothing."""
    image, transport = clouds(rng), DenseTransport.random(rng, FILM, GRID, even=0.8)
    problem, params = problem_of(image, transport, shown(transport, 1.3 * image), prior=of_paint(0.02))
    start = problem.state(params)
    normal = problem.normal(problem.evaluate(start), start, 0.05)
    first = sum(rows * columns for rows, columns in problem.sizes[:-1])
    free, damped = (problem.step(start, normal, d)["gain"][first:].mean() for d in (0.0, 0.01))
    assert free == pytest.approx(np.log(1.3), abs=0.05) and damped == pytest.approx(free, rel=0.05)
    diagonal = marquardt(normal, 0.01)[: 3 * problem.nodes].reshape(3, -1)[:, first:].mean()
    assert diagonal < 0.5 * free
    # It is damped none the less: at last no step is made.
    assert abs(problem.step(start, normal, 1e6)["gain"]).max() < 1e-3


def test_fewest_steps(case):
    problem, params, start, _ = case
    none = solve(problem, params, iterations=0)
    assert none.run.history == [] and same(problem.state(none.params), start)
    assert len(solve(problem, params, iterations=1).run.history) == 1


# ---- extremes ----------------------------------------------------------------------------------------------


def extreme(rng, image, target, **options):
    transport = DenseTransport.random(rng, FILM, GRID)
    problem, params = problem_of(np.asarray(image, np.float32), transport, target(transport), **options)
    return problem, *followed(problem, params)


def test_a_target_that_is_there_already_changes_nothing(rng):
    image = clouds(rng) + lamp()
    problem, solution, last = extreme(rng, image, lambda t: shown(t, image))
    assert np.abs(last.state["gain"]).max() < 1e-6
    np.testing.assert_allclose(last.edited, image, rtol=1e-5)


@pytest.mark.slow
def test_a_single_light_takes_its_flux(rng):
    image = lamp()
    problem, _, last = extreme(rng, image, lambda t: 4 * shown(t, image))
    np.testing.assert_allclose(last.state["flux"][0], np.log(4), atol=0.1)
    assert problem.shining(last.state) == [0]


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 1e30])
def test_targets_of_any_radiance(rng, value):
    image = clouds(rng) + lamp()
    problem, solution, last = extreme(rng, image, lambda t: np.full((*FILM, 3), value, np.float32))
    before = shown(problem.transport, image).mean()
    assert solution.run.history and (last.rendering.mean() > before) == (value > before)


@pytest.mark.slow
def test_maps_of_any_radiance(rng):
    image = clouds(rng) + lamp(radiance=1e30)
    problem, solution, last = extreme(rng, image, lambda t: 2 * shown(t, image))
    assert np.abs(last.residual).mean() < 0.3


def test_a_target_that_no_light_can_make(rng):
    image = clouds(rng)
    noise = np.where(rng.random((*FILM, 1)) < 0.5, 1e4, 0) * rng.random((*FILM, 3))
    _, solution, last = extreme(rng, image, lambda t: np.float32(noise))
    assert np.abs(last.residual).mean() > 0.2
    assert np.abs(last.state["gain"]).max() < 12


@pytest.mark.slow
def test_pixels_that_nothing_explains_have_little_say(rng):
    image = clouds(rng)
    transport = DenseTransport.random(rng, FILM, GRID, even=0.6)
    bright = shown(transport, np.float32(1.5 * image))
    spoiled = bright.copy()
    spoiled.reshape(-1, 3)[::10] = 50.0
    found = []
    for target in (bright, spoiled):
        problem, params = problem_of(image, transport, target)
        found.append(followed(problem, params)[1])
    clean = np.ones(FILM[0] * FILM[1], bool)
    clean[::10] = False
    error = [
        np.median(np.abs(f.rendering.reshape(-1, 3)[clean] / bright.reshape(-1, 3)[clean] - 1)) for f in found
    ]
    assert error[0] < 0.01 and error[1] < 0.08


def test_a_start_whose_rendering_is_not_finite_is_refused(rng):
    image = np.full((*GRID, 3), 1e30, np.float32)
    transport = DenseTransport(np.full((FILM[0] * FILM[1], GRID[0] * GRID[1]), 1e8), FILM, GRID)
    problem, params = problem_of(image, transport, np.ones((*FILM, 3), np.float32))
    with pytest.raises(NumericalError, match="the initial map is not finite"):
        solve(problem, params)


def test_steps_to_what_is_not_finite_are_not_taken(case, monkeypatch):
    problem, params, *_ = case
    step, calls = Problem.step, []

    def spoiled(self, state, normal, damping):
        found = step(self, state, normal, damping)
        calls.append(damping)
        if len(calls) % 2:
            found["gain"][0] = np.nan
        return found

    monkeypatch.setattr(Problem, "step", spoiled)
    solution, last = followed(known_to(problem, 0.05), params)
    assert len(solution.run.history) > 1 and len(calls) > len(solution.run.history)
    assert last.residual is not None


# ---- lights that are moved and added -----------------------------------------------------------------------


def searched(image, transport, target):
    """Return the problem, the likeliest explanation, and its lights."""
    problem, params = problem_of(image, transport, target)
    problem = known_to(problem, 0.01)
    found = search.search(problem, problem.state(params))
    return problem, found, problem.shining(found.run.state)


def degrees_off(problem, state, place, k=None):
    """Angle between a place and a light, the strongest if none is named."""
    if k is None:
        flux = problem.layers.lights.flux * np.exp(state["flux"])
        k = max(problem.shining(state), key=lambda one: flux[one].sum())
    return angle(problem.direction(state, k), latlong.directions(*GRID)[place])


@pytest.mark.slow
def test_the_maps_light_moves_where_no_step_leads(rng):
    """Or goes out there for one that is added; steps alone do not get there."""
    image, transport, place = clouds(rng), DenseTransport.random(rng, FILM, GRID, even=0.8), (9, 34)
    target = shown(transport, image + lamp(place))
    problem, found, _ = searched(image + lamp(), transport, target)
    assert degrees_off(problem, found.run.state, place) < 8  # half a texel
    problem, params = problem_of(image + lamp(), transport, target)
    alone = problem.state(solve(known_to(problem, 0.01), params).params)
    assert degrees_off(problem, alone, place, 0) > 20


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_no_light_is_added_or_moved_where_one_factor_makes_the_target(rng, factor):
    image, transport = clouds(rng) + lamp(), DenseTransport.random(rng, FILM, GRID)
    _, found, lit = searched(image, transport, np.float32(factor * shown(transport, image)))
    assert found.name == "lights left where they are" and lit == [0]


@pytest.mark.slow
@pytest.mark.parametrize(("errors", "stays"), [((1.0, 0.97), True), ((1.0, 0.9), False)])
def test_a_near_start_stays_unless_path_tracing_says_that_the_solution_is_closer(rng, errors, stays):
    image, transport = clouds(rng), DenseTransport.random(rng, FILM, GRID)
    target = shown(transport, 1.3 * image) * np.exp(rng.normal(0, 0.3, (*FILM, 3)))
    problem, params = problem_of(image, transport, np.float32(target))
    asked = []

    def judge(envmap):
        asked.append(envmap)
        return errors[len(asked) - 1]

    found = solve(known_to(problem, 0.02), params, judge=judge)
    assert stays == (not problem.state(found.params)["gain"].any())
    np.testing.assert_array_equal(asked[0], image)
    assert len(asked) == 2 and ("path-traced" in found.note) == stays


@pytest.mark.parametrize("of", ["case", "painted"])
def test_how_far_a_light_lowers_f_is_what_the_normal_equations_say(of, request):
    """Against the larger system, with the light's strength as one more unknown; also beside held means."""
    problem, _, start, state = request.getfixturevalue(of)
    point, sigma = problem.evaluate(state), 0.1
    normal = problem.normal(point, start, sigma)
    new = next(k for k in range(problem.layers.lights.count) if k not in problem.shining(state))
    found = light_places.Places(problem, point, normal).best(new)[0]
    d = latlong.directions(*GRID)
    row, column = np.unravel_index(np.argmax(d @ found.direction), GRID)
    atom = problem.transport.probe(np.array([row * GRID[1] + column]))[0] * problem.layers.lights.flux[new]
    atom = atom / latlong.lookup_solid_angles(*GRID)[row]
    slope, weights = normal.slope.reshape(-1, 3), (normal.slope**2 * normal.robust).reshape(-1, 3)
    pulled = (normal.slope * normal.robust * point.residual).reshape(-1, 3)
    share, mean_now = problem.likelihood.linear_mean(point.residual)

    def mean_of(one):
        return (slope * share.reshape(-1, 1) * one).sum(axis=0)

    def pull_of(one):
        return (pulled * one).sum() + mean_now @ mean_of(one)

    def mixed_with(one):
        in_blocks = problem.blocks.summed((one * weights).reshape(*FILM, 3))
        of_sky = [j.T @ w for j, w in zip(normal.linear.jacobian, in_blocks.T, strict=True)]
        of_lights = normal.linear.pictures.reshape(len(normal.linear.pictures), -1) @ (one * weights).ravel()
        return np.concatenate([*of_sky, of_lights]) + mean_of(one) @ normal.mean_by_unknowns

    mean, mixed = mean_of(atom), mixed_with(atom)
    assert mean.any() == (of == "painted")
    power = (weights * atom**2).sum() + mean @ mean
    larger = np.block([[normal.hessian, mixed[:, None]], [mixed[None], np.array([[power]])]])
    pull = np.append(normal.gradient, pull_of(atom))
    strength = -np.linalg.solve(larger, pull)[-1]
    # ---- one strength a channel
    apart = atom * np.eye(3)[:, None]
    columns = np.array([mixed_with(one) for one in apart])
    own = [(weights * one**2).sum() + np.square(mean_of(one).sum()) for one in apart]
    damped = np.diag(own) * (1 + light_places.LEAST_UNEXPLAINED)
    of_channels = np.block([[normal.hessian, columns.T], [columns, damped]])
    pulls = [pull_of(one) for one in apart]
    strengths = -np.linalg.solve(of_channels, np.append(normal.gradient, pulls))[-3:]
    np.testing.assert_allclose(
        np.exp(found.log_flux), np.maximum(strengths, 1e-3 * strengths.max()), rtol=3e-3
    )
    fall = pull @ np.linalg.solve(larger, pull) - normal.gradient @ np.linalg.solve(
        normal.hessian, normal.gradient
    )
    assert found.promise == pytest.approx(fall, rel=1e-3)
    # The same of the light's picture, as of one that is there.
    there = point.rendering + np.float32(strength * atom).reshape(*FILM, 3)
    assert light_places.Places(problem, point, normal).fall(there) == pytest.approx(fall, rel=2e-3)


# ---- glow and rows that follow ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("added", [False, True])
def test_the_glow_is_in_the_derivative_by_a_lights_flux_and_place(added, rng):
    """Where every texel is a cell; a picture that sees no core."""
    d = latlong.directions(*GRID)
    away = angle(d, d[SUN])[..., None]
    image = np.float32((0.4 + 0.05 * rng.random((*GRID, 3))) * (1 + 4 * np.exp(-away / 20)) + lamp())
    transport = DenseTransport.random(rng, FILM, GRID, even=0.8)
    problem, params = problem_of(image, transport, shown(transport, image))
    assert problem.layers.lights.glowing and len(problem.layers.separation.lights) == 1
    start = problem.state(params)
    state = copy(start)
    state["flux"][0] = -0.2
    if added:
        assert problem.layers.lights.glows[1] is not None
        there = rotated(d[SUN], np.array([0.1, 0.9, 0.2]))
        state["turn"][1] = rotation_vector(problem.layers.lights.centres[1], there)
        state["flux"][1] = [-0.4, -0.7, -0.2]
    point = problem.evaluate(state)
    normal, n = problem.normal(point, start, 1.0), problem.nodes
    linear = problem.derivatives.at(point)
    weights = rng.random((*GRID, 3))[problem.rows]
    by_lights = linear.by_lights(weights)
    for k, (name, _, _) in enumerate(linear.named):
        if name == "size":
            continue
        h = STEPS[name]
        there = (moved(problem, state, normal.linear.named, 3 * n + k, sign * h) for sign in (1, -1))
        ends = [problem.evaluate(one) for one in there]
        slope = (ends[0].rendering - ends[1].rendering) / (2 * h)
        # Cells are some texels, and the glow's own peak is narrower.
        assert np.abs(linear.pictures[k] - slope).max() < 0.15 * np.abs(slope).max(), name
        first, last = ((weights * np.float64(end.edited[problem.rows])).sum() for end in ends)
        assert by_lights[k] == pytest.approx((first - last) / (2 * h), rel=0.02, abs=0.05), name


@pytest.mark.parametrize("horizon", ["free", "mirror"])
def test_a_light_in_a_new_place_has_its_glow_there(horizon, rng):
    """Of the map's light and of one that is added, in pictures of cells: as the composed map has it there."""
    d = latlong.directions(*GRID)
    near = 4 * np.exp(-angle(d, d[SUN]) / 15)[..., None]
    image = np.float32((0.4 + 0.05 * rng.random((*GRID, 3))) * (1 + near) + lamp(radiance=40.0))
    transport = DenseTransport.random(rng, FILM, GRID, even=0.5)
    layers = Layers.of(image, cycles=3, horizon=horizon)
    lights = layers.lights
    assert lights.own == 1 and all(glow is not None for glow in lights.glows)
    problem = Problem(layers, transport, image, shown(transport, image))
    start = problem.state(layers.start())
    dark = start | {"flux": np.full_like(start["flux"], DARK)}
    size = np.bincount(problem.blocks.block_of)[:, None]
    _, cells = problem.blocks.sky
    far = np.flatnonzero(cells @ lights.centres[0] < np.cos(np.radians(40)))
    for k, without in ((0, dark), (1, start)):
        before = problem.evaluate(without)
        slope = layers.glow_slope(problem.params(without), before.sky)
        of_cells = problem.blocks.glows(slope, functools.partial(lights.glow_around, k))
        for at in rng.choice(far, 5):
            at -= at % 2  # cells that are side by side have one glow
            turn = rotation_vector(lights.centres[k], cells[at])
            change = problem.evaluate(with_light(without, k, turn=turn, flux=0.0)).sky - before.sky
            expected = problem.blocks.summed(shown(transport, change)) / size
            got = np.stack([of_channel.numpy()[:, at] for of_channel in of_cells], axis=1)
            # A mirror blurs, cells do not.
            off = 0.2 if horizon == "mirror" else 0.05
            assert np.linalg.norm(got - expected) < off * np.linalg.norm(expected)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", ["mirror", "keep"])
def test_gradient_where_rows_below_the_horizon_follow(horizon, rng):
    """The blur of a mirror, and what falls on ground: by the sky, and by a light's flux and place."""
    image, transport = clouds(rng) + lamp(), DenseTransport.random(rng, FILM, GRID)
    layers = Layers.of(image, cycles=3, horizon=horizon)
    params = layers.start()
    assert (layers.below.light is not None) == (horizon == "keep")
    target = shown(transport, image) * np.exp(rng.normal(0, 0.3, (*FILM, 3))).astype(np.float32)
    problem = Problem(layers, transport, image, target, saturates=True)
    start = problem.state(params)
    state = copy(start)
    state["gain"] = rng.normal(0, 0.3, state["gain"].shape)
    state["saturation"][:] = -0.4
    off_centre = rotated(layers.lights.centres[0], np.array([0.03, 0.05, -0.04]))
    state["turn"][0] = rotation_vector(layers.lights.centres[0], off_centre)
    point = problem.evaluate(state)
    normal = problem.normal(point, start, 1.0)
    names = names_of(problem, normal)

    n, grids = problem.nodes, sum(rows * columns for rows, columns in problem.sizes)
    assert n == grids + (horizon == "keep") and ("ground" in params) == (horizon == "keep")
    for kind in ("gain", "flux", "turn", "saturation"):
        some = [k for k, name in enumerate(names) if name == kind]
        if kind == "gain":  # and the last node, which is the ground's
            some = some[::4] + [n - 1, 2 * n - 1, 3 * n - 1]
        named, h = normal.linear.named, STEPS[kind]
        slope = slopes(problem, state, named, some, h, lambda x: total(problem, x, start))
        close = {"gain": 2e-3, "flux": 0.05, "turn": 0.05, "saturation": 2e-3}[kind] * np.abs(slope).max()
        np.testing.assert_allclose(normal.gradient[some], slope, rtol=0, atol=close, err_msg=kind)


def test_a_light_in_a_new_place_lights_the_ground_in_its_picture_too(rng):
    """Of a flux in a texel, the rendering changes by it and by ground as much brighter as its irradiance."""
    image, transport = clouds(rng) + lamp(), DenseTransport.random(rng, FILM, GRID, even=0.9)
    layers = Layers.of(image, cycles=3, horizon="keep")
    problem = Problem(layers, transport, image, shown(transport, image))
    state = problem.state(layers.start())
    state["flux"][0] = -30
    point = problem.evaluate(state)
    ground = light_places.lit_ground(problem, point)
    flux, up = np.array([3.0, 2.0, 1.0]), layers.shape[0]
    omega = latlong.lookup_solid_angles(*GRID)
    texels, pictures = light_places.probed(
        problem, point.transport, 4, 30, flux, spacing=2, reach=1, ground=ground
    )
    of_cells = [m.numpy() for m in problem.blocks.cells(ground).of(flux)]
    size = np.bincount(problem.blocks.block_of)[:, None]
    assert len(texels) == 9
    for texel, picture in zip(texels, pictures, strict=True):
        row, column = divmod(int(texel), GRID[1])
        more = point.edited.copy()
        more[row, column] += flux / omega[row]
        before, after = (layers.ground_light.irradiance(one[:up]) for one in (point.edited, more))
        more[up:] *= 1 + layers.lit[up:, None, None] * (after / before - 1)
        change = shown(transport, more) - shown(transport, point.edited)
        np.testing.assert_allclose(picture.reshape(*FILM, 3), change, rtol=1e-3, atol=1e-4 * change.max())
        alone = np.zeros_like(more)
        alone[row, column] = flux / omega[row]
        unlit = shown(transport, alone)
        assert not np.allclose(unlit, change, rtol=1e-2, atol=1e-3 * change.max())  # negative control
        _, directions = problem.blocks.sky
        nearest = int(np.argmax(directions @ latlong.directions(*GRID)[row, column]))
        by_blocks = problem.blocks.summed(change) / size
        got = np.stack([channel[:, nearest] for channel in of_cells], axis=1)
        np.testing.assert_allclose(got.mean(axis=0), by_blocks.mean(axis=0), rtol=0.15)


@pytest.mark.slow
def test_gradient_by_the_sky_is_exact_where_a_block_is_not(rng):
    """Pixels of a block that each see another sky: the gradient goes through T, not through their mean."""
    film, sigma = (8, 64), 0.2
    image, transport = clouds(rng), DenseTransport.random(rng, film, GRID)
    target = shown(transport, image) * np.exp(rng.normal(0, 0.5, (*film, 3))).astype(np.float32)
    problem, params = problem_of(image, transport, target)
    start = problem.state(params)
    state = copy(start)
    state["gain"] = rng.normal(0, 0.3, state["gain"].shape)
    normal = problem.normal(problem.evaluate(state), start, sigma)
    assert problem.blocks.count == 8 * 64 // 4

    some = range(0, 3 * problem.nodes, 5)
    slope = slopes(problem, state, [], some, STEPS["gain"], lambda x: total(problem, x, sigma=sigma))
    prior = normal.precision @ problem._from_prior(state, start, normal.linear.named)
    got = (normal.gradient - prior)[some]
    np.testing.assert_allclose(got, slope, rtol=0, atol=5e-3 * np.abs(slope).max())
    # Negative control: the block transport's own gradient is another one.
    columns = [j.T @ normal.pulled[:, c] for c, j in enumerate(normal.linear.jacobian)]
    assert np.abs(np.concatenate(columns)[some] - slope).max() > 0.05 * np.abs(slope).max()


# ---- saturation --------------------------------------------------------------------------------------------


def colourful(rng):
    """Clouds of luminance as :func:`clouds`, blue and amber side by side."""
    hue = np.where(rng.random((*GRID, 1)) < 0.5, [0.3, 0.8, 2.0], [1.6, 1.0, 0.4])
    return (clouds(rng) * hue).astype(np.float32)


def saturating(rng, kept):
    """A problem whose target is the sky with its colours' saturation times ``kept``, and its start."""
    image, transport = colourful(rng), DenseTransport.random(rng, FILM, GRID)
    layers = Layers.of(image, cycles=3)
    params = layers.start()
    grey = params | {"saturation": mi.TensorXf(np.full((1, 1), np.log(kept), np.float32))}
    target = shown(transport, layers.decode(grey).numpy())
    return Problem(layers, transport, image, target, saturates=True), params


@pytest.mark.slow
def test_saturation_of_the_target_is_found(rng):
    problem, params = saturating(rng, 0.3)
    found = solve(known_to(problem, 0.002), params)
    kept = np.exp(found.params["saturation"].numpy()[0, 0])
    assert kept == pytest.approx(0.3, abs=0.05)
    assert np.abs(found.params["gain.0"].numpy()).max() < 0.1
    # Without the unknown a gain has to make up for it.
    problem.saturates = False
    other = solve(known_to(problem, 0.002), params)
    assert "saturation" not in other.params
    assert other.run.history[-1]["loss"] > 2 * found.run.history[-1]["loss"]


def test_a_sky_gets_no_more_saturated_and_the_rest_of_a_step_makes_up_for_it(rng):
    problem, params = saturating(rng, 2.0)
    state = problem.state(params)
    point = problem.evaluate(state)
    normal = problem.normal(point, state, 0.1)
    k = len(normal.gradient) - 1
    assert normal.linear.named[-1] == ("saturation", 0, 0)
    assert np.linalg.solve(normal.hessian, -normal.gradient)[k] > 0.05  # it would
    moved_by = problem.step(state, normal, 0.0)
    assert moved_by["saturation"][0, 0] == 0
    gain = moved_by["gain"].T.ravel()
    left = normal.hessian[: len(gain), : len(gain)] @ gain + normal.gradient[: len(gain)]
    np.testing.assert_allclose(left, 0, atol=1e-6 * np.abs(normal.gradient).max())
    found = solve(problem, params)
    assert "saturation" not in found.params


def test_saturation_comes_back_from_a_checkpoint_of_its_state(rng):
    problem, params = saturating(rng, 0.3)
    state = problem.state(params)
    assert state["saturation"].tolist() == [[0.0]] and "saturation" not in problem.solution_params(state)
    state["saturation"][:] = -0.7
    again = problem.state(problem.params(state))
    np.testing.assert_allclose(again["saturation"], -0.7, rtol=1e-6)
    run = Run.of_arrays(Run(state, state).arrays(), [])
    assert run.state["saturation"].tolist() == state["saturation"].tolist()


@pytest.mark.slow
def test_draws_vary_as_much_as_is_open(rng):
    """Their standard deviation is the posterior's, to the noise of 200; a seed has one draw."""
    image, transport = clouds(rng), DenseTransport.random(rng, FILM, GRID)
    problem, params = problem_of(image, transport, shown(transport, image))
    start = problem.state(params)
    posterior = problem.posterior(start, problem.normal(problem.evaluate(start), start, 0.02))
    draws = [problem.layers.log_gain(posterior.sample(rng)).mean(axis=2) for _ in range(200)]
    rows = problem.rows
    measured, stated = np.std(draws, axis=0), posterior.deviation[rows]
    np.testing.assert_allclose(measured.mean(), stated.mean(), rtol=0.1)
    assert np.corrcoef(measured.ravel(), stated.ravel())[0, 1] > 0.9
    first, again = (posterior.sample(np.random.default_rng(5)) for _ in range(2))
    assert all(np.array_equal(first[name].numpy(), again[name].numpy()) for name in first)
