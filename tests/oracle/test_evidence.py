"""-2 log evidence by Laplace's approximation, against a linear problem's, which is Gaussian.

The transport is a dense matrix and the sky so dark that display values are linear: a residual J x - y with
weights W and x of precision K. Its evidence is that of y, with the covariance M = 1 / W + J K^-1 J'.
"""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import SPARE
from envedit.solve import search
from envedit.solve.gauss_newton import Run
from envedit.solve.likelihood import VISIBLE, Likelihood
from envedit.solve.map_problem import Problem
from envedit.solve.prior import of_paint
from envedit.targets.pixel_weights import pixel_weight
from tests.oracles.dense_transport import DenseTransport, node_shares

pytestmark = pytest.mark.usefixtures("own_core")

GRID, FILM, LEVEL = (24, 48), (10, 12), 4e-4
SIGMA = {"rendered": 1e-4, "painted": 2e-5}
"""Of a rendering so large that no residual is where Huber's loss is not a square."""
SLOPE = 1e-3 ** (1 / 2.2) / 1e-3


def gaussian(rng, freedom, kind="rendered"):
    """Return a problem, its start, its score at its solution, and the closed form of that."""
    transport = DenseTransport.random(np.random.default_rng(1), FILM, GRID, even=0.8)
    image = np.full((*GRID, 3), LEVEL, np.float32)
    before = np.float64(transport.apply(mi.TensorXf(image)).numpy())
    change = 1e-3 * (1 + rng.normal(0, 1, (*FILM, 3)))
    picture = np.float32(before * (1 + change))
    sigma = SIGMA[kind]
    coverage = np.zeros((*FILM, 1), np.float32)
    coverage[:4] = 1
    likelihood = Likelihood(np.ones((*FILM, 1), np.float32), least_noise=sigma)
    if kind == "painted":
        weight = pixel_weight(coverage, np.zeros(FILM, bool), 1.0, 0.3)
        likelihood = Likelihood.of_paint(weight, coverage, before, picture)
        likelihood = replace(likelihood, least_noise=sigma, paint_noise=sigma)
    layers = Layers.of(image, cycles=3)
    problem = Problem(layers, transport, image, picture, likelihood, of_paint(freedom))
    start = problem.state(layers.start())

    # ---- J, W and y: pixels, channel after channel; the mean of the rest, in units of what is visible
    of_nodes = np.concatenate(node_shares(problem), axis=1)
    of_channel = SLOPE * LEVEL * np.float64(transport.weights[0]) @ of_nodes
    y = SLOPE * (np.float64(picture) - before).reshape(-1, 3).T
    of_pixel = likelihood.weight.ravel() / (likelihood.area * sigma**2)
    if kind == "painted":
        rest = (coverage.ravel() == 0) / (VISIBLE * np.sqrt((coverage == 0).sum() * coverage.size))
        of_channel = np.concatenate([of_channel, rest[None] @ of_channel])
        y = np.concatenate([y, y @ rest[:, None]], axis=1)
        of_pixel = np.append(of_pixel, 1.0)
    jacobian = np.kron(np.eye(3), of_channel)
    y = y.ravel()
    weights = np.tile(of_pixel, 3)
    normal = problem.normal(problem.evaluate(start), start, sigma)
    covariance = np.linalg.inv(normal.precision)

    # ---- The evidence, and the score at the solution
    of_y = np.diag(1 / weights) + jacobian @ covariance @ jacobian.T
    expected = y @ np.linalg.solve(of_y, y) + np.linalg.slogdet(of_y)[1] + np.log(weights).sum()
    x = covariance @ jacobian.T @ np.linalg.solve(of_y, y)
    state = start | {"gain": x.reshape(3, -1).T}
    point = problem.evaluate(state)
    found = search.score(problem, Run(state, start), point)
    assert y @ np.linalg.solve(of_y, y) > 3  # the paint has its say
    if kind == "painted":  # what the score of paint leaves out
        normal = problem.curvature(point, start)
        found += np.linalg.slogdet(normal.hessian)[1] - np.linalg.slogdet(normal.precision)[1]
        return problem, start, found, expected
    return problem, start, found, expected + 6 * likelihood.independent * np.log(sigma)


@pytest.mark.parametrize("kind", SIGMA)
@pytest.mark.parametrize("freedom", [0.1, 1.0])
def test_score_of_a_linear_problem_is_its_evidence(freedom, kind, rng):
    """Of paint but for the determinants, which are those of the normal equations."""
    _, _, found, expected = gaussian(rng, freedom, kind)
    assert found == pytest.approx(expected, abs=0.1)


def test_a_light_that_was_added_costs_what_it_says(rng):
    """So faint that it changes no pixel: beyond its price, its unknowns are as far determined as before."""
    problem, start, _, _ = gaussian(rng, 0.5)
    spare = problem.layers.lights.count - SPARE
    with_light = {name: value.copy() for name, value in start.items()}
    with_light["flux"][spare] = -25.0
    scores = []
    for state in (start, with_light):
        scores.append(search.score(problem, Run(state, state), problem.evaluate(state)))
    assert problem.added(with_light) == [spare]
    _, cells = problem.blocks.sky
    cost = search.ADDED_LIGHT_COST + 2 * np.log(len(cells))
    assert scores[1] - scores[0] == pytest.approx(cost, abs=0.05)


@pytest.mark.parametrize("lamps", [1, 3])
def test_a_light_elsewhere_costs_as_many_as_it_could_be(lamps, rng):
    transport = DenseTransport.random(rng, FILM, GRID, even=0.8)
    image = np.full((*GRID, 3), LEVEL, np.float32)
    image[8, [10, 25, 40][:lamps]] = 100
    picture = transport.apply(mi.TensorXf(image)).numpy()
    coverage = np.ones((*FILM, 1), np.float32)
    likelihood = Likelihood.of_paint(coverage, coverage, picture, 0.9 * picture)
    likelihood = replace(likelihood, least_noise=SIGMA["painted"])
    layers = Layers.of(image, cycles=3)
    problem = Problem(layers, transport, image, 0.9 * picture, likelihood, of_paint(0.1))
    start = problem.state(layers.start())
    for moved in range(lamps + 1):
        there = start | {"turn": start["turn"].copy()}
        there["turn"][:moved, 1] = 0.5
        point = problem.evaluate(there)
        rest = problem.loss(point, there, likelihood.largest_noise)
        cost = search.score(problem, Run(there, there), point) - rest
        assert cost == pytest.approx(moved * 2 * np.log(lamps), abs=1e-6)
