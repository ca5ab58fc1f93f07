"""Adam and the schedules against trajectories recorded from PyTorch, and against closed forms."""

import mitsuba as mi
import numpy as np
import pytest

from envedit.losses.optimizer import Adam, cosine, cosine_warm_restarts, ramp
from tests.oracles import ROOT
from tests.oracles.kernels import own

# By experiments/references/make_adam_reference.py of commit 78ead632, PyTorch 2.13.0.
REFERENCE = ROOT / "tests" / "data" / "adam_reference.npz"
NAMES = ("weight", "bias", "texels")


@pytest.fixture(scope="module")
def reference():
    with np.load(REFERENCE) as file:
        return dict(file)


# ---- Adam -------------------------------------------------------------------------------------------------


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


def test_the_given_array_is_left_alone(rng):
    start = rng.random((4, 4)).astype(np.float32)
    kept = start.copy()
    adam = Adam({"p": mi.TensorXf(start)}, lr=0.1)
    adam.step({"p": own(np.ones((4, 4)))})
    start_moved = np.array(adam.params["p"])
    np.testing.assert_array_equal(start, kept)
    start[:] = 7
    np.testing.assert_array_equal(np.array(adam.params["p"]), start_moved)


# ---- Schedules --------------------------------------------------------------------------------------------


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
