"""The network against plain numpy in double precision, Dr.Jit's own AD, and finite differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit import siren

OMEGA = 30.0


def numpy_forward(params, x, omega):
    """Sitzmann et al. 2020, layer by layer, in float64."""
    h, last = np.float64(x), len(params) // 2 - 1
    for i in range(last):
        h = np.sin(omega * (np.float64(params[f"{i}.weight"]) @ h + np.float64(params[f"{i}.bias"])))
    z = np.float64(params[f"{last}.weight"]) @ h + np.float64(params[f"{last}.bias"])
    return 1 / (1 + np.exp(-z))


def launched(work):
    """Do some work and return the hashes of the kernels it launched, compiled for it or found in a cache."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work()
        dr.sync_thread()
        return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}


def arrays(params):
    return {name: np.array(value, np.float64) for name, value in params.items()}


def own(array):
    return dr.opaque(mi.TensorXf(np.asarray(array, np.float32)))


def ours(params, x, seed_grad, omega=OMEGA):
    """Gradient of sum(seed_grad * y) by the hand-written pass, through the AD graph."""
    leaves = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(leaves)
    y = siren.evaluate(leaves, x, omega)
    dr.backward(dr.sum((y * seed_grad).array))
    return {name: np.array(dr.grad(leaf), np.float64) for name, leaf in leaves.items()}


# ---- forward ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("hidden", "depth"), [(7, 0), (33, 2), (16, 6)])
def test_forward_is_the_published_network(hidden, depth):
    params, x = siren.init(3, hidden, depth), siren.coordinates(5, 9)
    y, tape = siren.forward(params, x, OMEGA)
    assert y.shape == (3, 45) and len(tape) == siren.layers(params) == depth + 2
    expected = numpy_forward(arrays(params), x.numpy(), OMEGA)
    # One rounding of a phase, 6e-8, is multiplied by omega |W| in every layer.
    np.testing.assert_allclose(y.numpy(), expected, atol=2e-5)
    np.testing.assert_array_equal(siren.evaluate(params, x, OMEGA).numpy(), y.numpy())


def test_extreme_outputs_saturate_without_overflow():
    params = siren.init(0, 4, 0)
    params["1.weight"] = dr.zeros(mi.TensorXf, (3, 4))
    params["1.bias"] = own([[-1e6], [0], [1e6]])
    y, tape = siren.forward(params, siren.coordinates(2, 4), OMEGA)
    np.testing.assert_array_equal(y.numpy(), np.repeat([[0.0], [0.5], [1.0]], 8, axis=1))
    grads = siren.backward(params, tape, own(np.ones((3, 8))))
    assert all(np.isfinite(g.numpy()).all() for g in grads.values())


# ---- gradient --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", range(8))
@pytest.mark.parametrize("hidden", [7, 33])
def test_gradient_is_that_of_automatic_differentiation(depth, hidden, rng):
    """1 to 8 sine layers; every tensor by itself, so that a large layer cannot hide a small one."""
    params, x = siren.init(depth, hidden, depth), siren.coordinates(4, 6)
    weight = own(rng.normal(size=(3, 24)))
    mine = ours(params, x, weight)
    leaves = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(leaves)
    y, _ = siren.forward(leaves, x, OMEGA)  # differentiated by Dr.Jit, operation by operation
    dr.backward(dr.sum((y * weight).array))
    for name, leaf in leaves.items():
        expected = np.array(dr.grad(leaf), np.float64)
        assert np.linalg.norm(expected) > 0
        assert np.linalg.norm(mine[name] - expected) < 1e-4 * np.linalg.norm(expected), name


@pytest.mark.parametrize(("hidden", "depth"), [(7, 0), (33, 3)])
def test_gradient_is_the_finite_difference_in_double_precision(hidden, depth, rng):
    params, x = siren.init(1, hidden, depth), siren.coordinates(4, 6)
    weight = rng.normal(size=(3, 24))
    mine, start, h = ours(params, x, own(weight)), arrays(params), 1e-5
    for name in params:
        direction = mine[name] / np.linalg.norm(mine[name])  # where the slope is largest: its length

        def loss(step, name=name, direction=direction):
            moved = start | {name: start[name] + step * direction}
            return np.sum(weight * numpy_forward(moved, x.numpy(), OMEGA))

        slope = (8 * (loss(h) - loss(-h)) - (loss(2 * h) - loss(-2 * h))) / (12 * h)
        np.testing.assert_allclose(np.linalg.norm(mine[name]), slope, rtol=1e-4, err_msg=name)


def test_gradient_of_a_loss_that_ignores_the_output_is_zero():
    grads = ours(siren.init(0, 8, 1), siren.coordinates(2, 4), own(np.zeros((3, 8))))
    assert not any(g.any() for g in grads.values())


def test_gradients_come_in_the_order_of_the_parameters():
    # dr.CustomOp.set_grad_in takes a dict by position: in another order it is dropped without a word.
    params, x = siren.init(0, 8, 2), siren.coordinates(2, 4)
    for order in (list(params), sorted(params, reverse=True)):
        shuffled = {name: params[name] for name in order}
        _, tape = siren.forward(shuffled, x, OMEGA)
        assert list(siren.backward(shuffled, tape, dr.ones(mi.TensorXf, (3, 8)))) == order
        through_the_graph = ours(shuffled, x, dr.ones(mi.TensorXf, (3, 8)))
        assert all(g.any() for g in through_the_graph.values())


def test_gradient_flows_on_in_a_larger_graph(rng):
    params, x = siren.init(5, 9, 1), siren.coordinates(3, 4)
    gain = mi.Float(2.0)
    leaves = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(leaves, gain)
    scaled = leaves | {"1.bias": leaves["1.bias"] * gain}
    dr.backward(dr.sum(dr.square(siren.evaluate(scaled, x, OMEGA).array)))
    got = np.sum(np.array(dr.grad(leaves["1.bias"]), np.float64) * np.array(params["1.bias"])) / 2
    assert got != 0
    np.testing.assert_allclose(dr.grad(gain)[0], got, rtol=1e-4)


# ---- initial weights, coordinates ------------------------------------------------------------------------


def test_initial_weights_are_uniform_within_the_published_bounds():
    hidden, omega = 64, 25.0
    params = arrays(siren.init(11, hidden, 3, omega, inputs=4, outputs=5))
    assert [params[f"{i}.weight"].shape for i in range(5)] == [(64, 4), *[(64, 64)] * 3, (5, 64)]
    assert [params[f"{i}.bias"].shape for i in range(5)] == [(64, 1)] * 4 + [(5, 1)]
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


def test_sine_layers_start_with_unit_slopes():
    """Sec. 3.2 of Sitzmann et al.: activations keep the arcsine law's variance of 1/2 through the depth."""
    _, tape = siren.forward(siren.init(2, 128, 5), siren.coordinates(16, 32), OMEGA)
    for h, _ in tape[2:]:
        assert 0.4 < np.var(h.numpy()) < 0.6


def test_seed_decides_the_weights():
    a, b, c = (arrays(siren.init(seed, 8, 1)) for seed in (4, 4, 5))
    assert all(np.array_equal(a[name], b[name]) for name in a)
    assert not any(np.array_equal(a[name], c[name]) for name in a)


def test_weight_names_leave_biases_out():
    assert siren.weight_names(siren.init(0, 8, 1)) == ["0.weight", "1.weight", "2.weight"]


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 4), (5, 9)])
def test_coordinates_are_texel_centres(height, width):
    x = siren.coordinates(height, width).numpy()
    assert x.shape == (2, height * width)
    for texel in range(height * width):
        row, column = divmod(texel, width)
        expected = [(row + 0.5) / height * 2 - 1, (column + 0.5) / width * 2 - 1]
        np.testing.assert_allclose(x[:, texel], expected, atol=1e-7)


def test_coordinates_at_half_the_resolution_average_the_finer_ones():
    fine, coarse = siren.coordinates(8, 16).numpy(), siren.coordinates(4, 8).numpy()
    mean = fine.reshape(2, 4, 2, 8, 2).mean(axis=(2, 4)).reshape(2, -1)
    np.testing.assert_allclose(mean, coarse, atol=1e-7)


# ---- cost ------------------------------------------------------------------------------------------------


def test_no_new_kernel_after_the_third_step():
    x, params = dr.opaque(siren.coordinates(5, 11)), siren.init(0, 13, 2)

    def steps(count):
        nonlocal params
        for _ in range(count):
            y, tape = siren.forward(params, x, OMEGA)
            grads = siren.backward(params, tape, dr.opaque(2 * y))
            rate = dr.opaque(mi.Float, 1e-3)
            params = {name: dr.opaque(params[name] - rate * g) for name, g in grads.items()}

    first = launched(lambda: steps(3))
    assert first and launched(lambda: steps(4)) <= first
