"""The network against plain numpy in double precision, and Dr.Jit's own AD."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.representations.siren import network as siren
from tests.oracles.kernels import own
from tests.oracles.plain import numpy_forward

OMEGA = 30.0


POINTS = [1, 7, 1023, 4997, 16385]  # alone, fewer than a block, no multiple of any block, several blocks


def plain_forward(params, x, omega):
    """The same in Dr.Jit, operation by operation, for its automatic differentiation."""
    h, last = x, len(params) // 2 - 1
    for i in range(last + 1):
        z = dr.matmul(h, params[f"{i}.weight"], Bt=True) + params[f"{i}.bias"]
        h = dr.sin(omega * z) if i < last else 1 / (1 + dr.exp(-z))
    return h


def arrays(params):
    return {name: np.array(value, np.float64) for name, value in params.items()}


def points(rng, count):
    return own(rng.uniform(-1, 1, (count, 2)))


def gradient(network, params, x, seed_grad):
    leaves = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(leaves)
    dr.backward(dr.sum((network(leaves, x, OMEGA) * seed_grad).array))
    return {name: np.array(dr.grad(leaf), np.float64) for name, leaf in leaves.items()}


def ours(params, x, seed_grad):
    return gradient(siren.evaluate, params, x, seed_grad)


def differ(a, b, tolerance=1e-4):
    """List the tensors that differ by more than so much of their length.

    Each by itself, so that a large layer cannot hide a small one.
    """
    assert list(a) == list(b) and all(a[name].shape == b[name].shape for name in a)
    assert all(np.linalg.norm(b[name]) > 0 for name in b)
    return [name for name in b if not np.linalg.norm(a[name] - b[name]) < tolerance * np.linalg.norm(b[name])]


@pytest.mark.parametrize(("hidden", "depth"), [(1, 0), (7, 0), (33, 2), (16, 6)])
@pytest.mark.parametrize("count", POINTS)
def test_forward_is_the_published_network(hidden, depth, count, rng):
    params, x = siren.init(3, hidden, depth), points(rng, count)
    y, _ = siren.forward(params, x, OMEGA)
    assert y.shape == (count, 3) and len(params) == 2 * (depth + 2)
    expected = numpy_forward(arrays(params), x.numpy(), OMEGA)
    # One rounding of a phase, 6e-8, is multiplied by omega |W| in every layer.
    np.testing.assert_allclose(y.numpy(), expected, atol=2e-5)
    np.testing.assert_array_equal(siren.evaluate(params, x, OMEGA).numpy(), y.numpy())


def test_extreme_outputs_saturate_without_overflow():
    params = siren.init(0, 4, 0)
    params["1.weight"] = dr.zeros(mi.TensorXf, (3, 4))
    params["1.bias"] = own([-1e6, 0, 1e6])
    y, tape = siren.forward(params, siren.coordinates(2, 4), OMEGA)
    np.testing.assert_array_equal(y.numpy(), np.repeat([[0.0, 0.5, 1.0]], 8, axis=0))
    grads = siren.backward(params, tape, own(np.ones((8, 3))))
    assert all(np.isfinite(g.numpy()).all() for g in grads.values())


SIZES = [(hidden, depth, 24) for depth in range(8) for hidden in (1, 7, 33)]
SIZES += [(*one, count) for one in ((7, 7), (129, 1)) for count in POINTS]


@pytest.mark.parametrize(("hidden", "depth", "count"), SIZES)
def test_gradient_is_that_of_automatic_differentiation(hidden, depth, count, rng):
    """1 to 8 sine layers."""
    params, x = siren.init(count + depth, hidden, depth), points(rng, count)
    weight = rng.normal(size=(count, 3))
    expected = gradient(plain_forward, params, x, own(weight))
    assert differ(ours(params, x, own(weight)), expected) == []
    # Only the last point, and all but the last: what a remainder could be dropped or counted twice by.
    last = np.zeros_like(weight)
    last[-1] = weight[-1]
    alone = gradient(plain_forward, params, own(x.numpy()[-1:]), own(weight[-1:]))
    assert differ(ours(params, x, own(last)), alone) == []
    if count > 1 < hidden:  # negative control
        assert differ(ours(params, x, own(weight - last)), expected) == list(params)


def test_gradients_come_in_the_order_of_the_parameters():
    # dr.CustomOp.set_grad_in takes a dict by position: in another order it is dropped without a word.
    params, x = siren.init(0, 8, 2), siren.coordinates(2, 4)
    for order in (list(params), sorted(params, reverse=True)):
        shuffled = {name: params[name] for name in order}
        _, tape = siren.forward(shuffled, x, OMEGA)
        assert list(siren.backward(shuffled, tape, dr.ones(mi.TensorXf, (8, 3)))) == order
        through_the_graph = ours(shuffled, x, dr.ones(mi.TensorXf, (8, 3)))
        assert all(g.any() for g in through_the_graph.values())


def test_initial_weights_are_uniform_within_the_published_bounds():
    hidden, omega = 64, 25.0
    params = arrays(siren.init(11, hidden, 3, omega, inputs=4))
    assert [params[f"{i}.weight"].shape for i in range(5)] == [(64, 4), *[(64, 64)] * 3, (3, 64)]
    assert [params[f"{i}.bias"].shape for i in range(5)] == [(64,)] * 4 + [(3,)]
    for i in range(5):
        fan_in = 4 if i == 0 else hidden
        bounds = {"weight": 1 / 4 if i == 0 else np.sqrt(6 / hidden) / omega, "bias": fan_in**-0.5}
        for kind, bound in bounds.items():
            values = params[f"{i}.{kind}"] / bound
            assert np.abs(values).max() <= 1 + 1e-6
            if values.size >= 64:
                assert np.abs(values).max() > 0.9
            if values.size < 1000:
                continue
            # Variance of U(-1, 1) is 1/3, its own standard error sqrt(4/45 / n): 4.5 sigma is 1 in 150 000.
            assert abs(np.var(values) - 1 / 3) < 4.5 * np.sqrt(4 / 45 / values.size)
            assert abs(values.mean()) < 4.5 * np.sqrt(1 / 3 / values.size)
