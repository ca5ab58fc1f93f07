"""The last layer that is solved for: against formulas, and at its limits."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.representations.siren import fit, output_layer
from envedit.representations.siren import network as siren
from tests.oracles.kernels import own
from tests.oracles.plain import numpy_forward

OMEGA = 30.0


def arrays(params):
    return {name: np.float64(value.numpy()) for name, value in params.items()}


def weights(light, share):
    """Weight of each point and channel: 1 + share E / mean(E); 1 where there is no light at all."""
    light = np.asarray(light, np.float64)
    mean = light.mean(axis=0)
    return 1 + share * np.divide(light, mean, out=np.zeros_like(light), where=mean > 0)


def error(params, x, wanted, light, share):
    y = numpy_forward(arrays(params), x.numpy(), OMEGA)
    return np.sum(weights(light, share) * (y - wanted) ** 2)


def problem(rng, points=200, hidden=8, depth=1, inputs=3):
    """Return a network, points, values within (0, 1), and their light: a few points hold most of it."""
    params, x = siren.init(4, hidden, depth, OMEGA, inputs), own(rng.uniform(-1, 1, (points, inputs)))
    wanted = rng.uniform(0.05, 0.95, (points, 3))
    light = np.exp(8 * wanted).astype(np.float32)
    return params, x, wanted, light


def again(params, times, x, wanted, light, share):
    for _ in range(times):
        params = output_layer.last_layer(params, x, OMEGA, wanted, light, share)
    return params


@pytest.mark.parametrize("share", [0.0, 1.0, 7.5])
def test_points_that_cannot_be_told_apart_get_their_weighted_mean(share):
    """All features alike: the output is one number, sum(w y) / sum(w), channel by channel."""
    params = siren.init(0, 4, 0)
    params["0.weight"] = dr.zeros(mi.TensorXf, (4, 2))
    wanted = np.array([[0.3, 0.4, 0.5], [0.5, 0.5, 0.6], [0.7, 0.3, 0.5]])
    light = np.float32([[1, 0, 5], [2, 0, 1], [30, 0, 0]])
    solved = again(params, 4, siren.coordinates(1, 3), wanted, light, share)
    w = 1 + share * light / [11, 1, 2]  # over the mean; the second channel has no light at all
    expected = np.sum(w * wanted, axis=0) / np.sum(w, axis=0)
    got = siren.forward(solved, siren.coordinates(1, 3), OMEGA)[0].numpy()
    np.testing.assert_allclose(got, np.broadcast_to(expected, (3, 3)), atol=1e-5)


def test_a_last_layer_that_explains_everything_is_found(rng):
    params, x, _, light = problem(rng, points=300, hidden=6)
    truth = params | {"2.weight": own(0.3 * rng.normal(size=(3, 6))), "2.bias": own([0.4, -0.3, 0.1])}
    wanted = numpy_forward(arrays(truth), x.numpy(), OMEGA)
    solved = output_layer.last_layer(params, x, OMEGA, wanted, light, 1.0)
    given = x, wanted, light, 1.0
    # Two steps of Newton: what is left is squared twice, but for the damping.
    assert error(solved, *given) < 1e-3 * error(params, *given)
    solved = again(solved, 4, *given)
    for name in ("2.weight", "2.bias"):
        np.testing.assert_allclose(solved[name].numpy(), truth[name].numpy(), atol=1e-4)


def test_all_but_the_last_layer_stays_and_the_order_of_the_parameters(rng):
    params, x, wanted, light = problem(rng)
    for order in (list(params), sorted(params, reverse=True)):
        given = {name: params[name] for name in order}
        before = {name: value.numpy().copy() for name, value in given.items()}
        solved = output_layer.last_layer(given, x, OMEGA, wanted, light, 1.0)
        assert list(solved) == order and solved is not given
        assert all(isinstance(p, mi.TensorXf) and p.shape == params[name].shape for name, p in solved.items())
        changed = {name for name in order if not np.array_equal(solved[name].numpy(), before[name])}
        assert changed == {"2.weight", "2.bias"}
        for name in order:  # nor is what was given changed
            np.testing.assert_array_equal(given[name].numpy(), before[name])


def unchanged(params, solved):
    before, after = ({name: value.numpy().tobytes() for name, value in p.items()} for p in (params, solved))
    return list(before.items()) == list(after.items())


def test_steps_that_lead_too_far_are_not_taken():
    """From the flat end of the sigmoid Newton's step overshoots to the other end, which is worse."""
    params = siren.init(0, 4, 0)
    params |= {"1.weight": dr.zeros(mi.TensorXf, (3, 4)), "1.bias": own([5, 5, 5])}
    x, light = siren.coordinates(4, 8), np.ones((32, 3), np.float32)
    assert unchanged(params, output_layer.last_layer(params, x, OMEGA, np.full((32, 3), 0.55), light, 1.0))


@pytest.mark.parametrize("where", ["wanted", "2.bias", "2.weight", "0.weight"])
def test_what_is_not_finite_changes_no_channel_that_it_meets(where, rng):
    params, x, wanted, light = problem(rng)
    if where == "wanted":
        wanted[17, 1] = np.nan
    else:
        value = params[where].numpy().copy()
        value[0] = np.nan
        params[where] = own(value)
    solved = output_layer.last_layer(params, x, OMEGA, wanted, light, 1.0)
    met = {"wanted": [1], "0.weight": [0, 1, 2]}.get(where, [0])
    assert len(met) == 3 or not unchanged(params, solved)
    for name in ("2.weight", "2.bias"):
        np.testing.assert_array_equal(solved[name].numpy()[met], params[name].numpy()[met])
        if len(met) < 3:
            assert np.isfinite(np.delete(solved[name].numpy(), met, axis=0)).all()


def extremes(rng):
    sun = np.full((60, 3), 1e-30, np.float32)
    sun[13] = 1e6
    huge = np.exp(rng.normal(size=(60, 3))).astype(np.float32)
    huge[5, 1] = 3e38
    return {
        "one point": np.float32([[0.2, 3.0, 1e-3]]),
        "fewer points than features": np.exp(rng.normal(size=(5, 3))).astype(np.float32),
        "one channel black": np.exp(rng.normal(size=(60, 3))).astype(np.float32) * np.float32([1, 0, 1]),
        "constant": np.full((60, 3), 7.0, np.float32),
        "sun over next to nothing": sun,
        "as bright as float32 goes": huge,
    }


@pytest.mark.parametrize("name", extremes(np.random.default_rng(0)))
@pytest.mark.parametrize("share", [0.01, 1.0])
def test_never_worse_and_always_finite(name, share, rng):
    image = extremes(rng)[name]
    wanted = fit.Normalisation.of(image, 0.05).encode(image)
    for seed in range(4):
        params = siren.init(seed, 8, 1, OMEGA, 3)
        x = own(rng.uniform(-1, 1, (len(image), 3)))
        before = error(params, x, wanted, image, share)
        for _ in range(3):
            params = output_layer.last_layer(params, x, OMEGA, wanted, image, share)
            assert all(np.isfinite(p.numpy()).all() for p in params.values())
            after = error(params, x, wanted, image, share)
            # The solution is rounded to float32 last: 1e-7 of a value, 1e-14 of its square, times the weight.
            assert after <= before + 1e-12 * weights(image, share).sum()
            before = after
