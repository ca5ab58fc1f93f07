"""Adam and the schedules against trajectories recorded from PyTorch, and against closed forms."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.losses.optimizer import Adam, cosine, cosine_warm_restarts, ramp
from tests.oracles import ROOT

# python experiments/references/make_adam_reference.py tests/data/adam_reference.npz      (PyTorch 2.13.0)
REFERENCE = ROOT / "tests" / "data" / "adam_reference.npz"
NAMES = ("weight", "bias", "texels")


@pytest.fixture(scope="module")
def reference():
    with np.load(REFERENCE) as file:
        return dict(file)


def own(array):
    """Put an array into Dr.Jit's memory, as a gradient is."""
    return dr.opaque(mi.TensorXf(np.asarray(array, np.float32)))


def same(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


# --------------------------------------------------------------------------------------------------------
# Adam
# --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", ["one", "small", "large"])
def test_adam_follows_pytorch(reference, scale):
    adam = Adam({n: own(reference[f"{scale}/start/{n}"]) for n in NAMES}, float(reference["lr"]))
    kept = list(reference["kept"])
    for step in range(kept[-1]):
        assert adam.step({n: own(reference[f"{scale}/grad/{n}"][step]) for n in NAMES})
        if step + 1 in kept:
            for n in NAMES:
                expected = reference[f"{scale}/trace/{n}"][kept.index(step + 1)]
                # Parameters are of order 1, and round at 6e-8 in each of 200 steps.
                np.testing.assert_allclose(np.array(adam.params[n]), expected, rtol=1e-5, atol=1e-7)


def test_adam_in_double_precision_is_the_algorithm(rng):
    p = rng.random((3, 4))
    adam = Adam({"p": mi.TensorXd(p)}, 0.1, betas=(0.8, 0.95), eps=1e-3)
    m = v = 0.0
    for t in range(1, 6):
        g, lr = rng.normal(size=p.shape), 0.1 / t
        m, v = 0.8 * m + 0.2 * g, 0.95 * v + 0.05 * g * g
        p = p - lr * (m / (1 - 0.8**t)) / (np.sqrt(v / (1 - 0.95**t)) + 1e-3)
        adam.step({"p": mi.TensorXd(g)}, lr=lr)
    np.testing.assert_allclose(np.array(adam.params["p"]), p, rtol=1e-13)


def test_adam_finds_a_minimum_through_its_leaves():
    adam = Adam({"x": mi.Float([3.0, -2.0])}, lr=0.1)
    for step in range(300):
        leaves = adam.leaves()
        dr.backward(dr.sum(dr.square(leaves["x"] - mi.Float([1.0, 0.5]))))
        adam.step({"x": dr.grad(leaves["x"])}, lr=cosine(0.1, step, 300))
    assert type(adam.params["x"]) is mi.Float and not dr.grad_enabled(adam.params["x"])
    np.testing.assert_allclose(np.array(adam.params["x"]), [1.0, 0.5], atol=1e-4)


def test_kernels_are_compiled_once():
    shapes = {"a": (32, 8), "b": (32, 8), "c": (8,), "d": (8,)}
    adam = Adam({name: dr.zeros(mi.TensorXf, shape) for name, shape in shapes.items()}, lr=0.01)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for step in range(8):
            grads = {name: own(np.full(shape, step + 1.0)) for name, shape in shapes.items()}
            dr.sync_thread()
            dr.kernel_history_clear()
            adam.step(grads, lr=0.01 / (step + 1))
            kernels = dr.kernel_history((dr.KernelType.JIT,))
            assert len(kernels) == 2  # one for each size of parameter
            if step >= 3:
                assert all(kernel["cache_hit"] for kernel in kernels)


def test_the_given_array_is_left_alone(rng):
    start = rng.random((4, 4)).astype(np.float32)
    kept = start.copy()
    adam = Adam({"p": mi.TensorXf(start)}, lr=0.1)
    adam.step({"p": own(np.ones((4, 4)))})
    start_moved = np.array(adam.params["p"])
    np.testing.assert_array_equal(start, kept)
    start[:] = 7
    np.testing.assert_array_equal(np.array(adam.params["p"]), start_moved)


def test_a_checkpoint_continues_exactly(tmp_path, rng):
    grads = [{"a": rng.normal(size=(3, 2)), "b": rng.normal(size=5)} for _ in range(10)]
    start = {"a": own(rng.random((3, 2))), "b": mi.Float(rng.random(5).astype(np.float32))}

    def run(adam, part):
        for g in part:
            adam.step({"a": own(g["a"]), "b": mi.Float(g["b"].astype(np.float32))})
        return adam.state_dict()

    whole = run(Adam(start, lr=0.01), grads)
    np.savez(tmp_path / "checkpoint.npz", **run(Adam(start, lr=0.01), grads[:4]))
    resumed = Adam({"a": own(np.zeros((3, 2))), "b": dr.zeros(mi.Float, 5)}, lr=0.01)
    with np.load(tmp_path / "checkpoint.npz") as file:
        resumed.load_state_dict(file)
    assert same(run(resumed, grads[4:]), whole)
    assert whole["step"] == 10


def test_a_state_of_other_parameters_is_refused():
    x = own([1.0, 2.0])
    adam = Adam({"x": x}, lr=1)
    with pytest.raises(
        InputError, match="entries and the parameters differ in before/x, m/x, params/x, step"
    ):
        adam.load_state_dict({})
    state = adam.state_dict()
    with pytest.raises(InputError, match=r"m/x has shape \(3,\), expected \(2,\)"):
        adam.load_state_dict(state | {"m/x": np.zeros(3)})
    assert same(adam.state_dict(), state)


# --------------------------------------------------------------------------------------------------------
# Schedules
# --------------------------------------------------------------------------------------------------------


def test_warm_restarts_follow_pytorch(reference):
    rates = [cosine_warm_restarts(5e-5, step, 100) for step in range(350)]
    np.testing.assert_allclose(rates, reference["warm_restarts"], rtol=1e-12)


def test_cosine_follows_pytorch(reference):
    # PyTorch's is a recurrence that gathers rounding; the closed form does not.
    rates = [1e-5 + cosine(2e-3 - 1e-5, step, 60) for step in range(61)]
    np.testing.assert_allclose(rates, reference["cosine"], rtol=1e-9)


def test_ramp_ends_exactly_and_is_geometric():
    values = np.array([ramp(1e-4, 1e-8, step, 400) for step in range(400)])
    assert values[0] == 1e-4 and values[-1] == 1e-8
    np.testing.assert_allclose(values[1:] / values[:-1], 1e-4 ** (1 / 399), rtol=1e-10)
    assert ramp(1e-300, 1e300, 1, 3) == pytest.approx(1, rel=1e-12)  # end / start is not representable
    assert ramp(0, 0, 3, 10) == 0


def test_one_step_runs():
    assert cosine(0.1, 0, 1) == cosine_warm_restarts(0.1, 0, 1) == cosine_warm_restarts(0.1, 5, 1) == 0.1
    assert ramp(2, 3, 0, 1) == 2
