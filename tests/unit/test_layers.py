"""A map told apart and composed again: nothing changes but what is asked for, at any resolution."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.color import LUMINANCE
from envedit.core.rotations import rotation_vector
from envedit.representations.layers import layers
from envedit.representations.layers.gain import VEIL
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK, SPARE
from tests.oracles.builders import grey
from tests.oracles.maps import angle, flux
from tests.oracles.plain import double, single

SHAPE, SUN = (64, 128), (20, 126)
SMALL = (24, 48)  # quick to tell apart


def sky(shape=SHAPE, sun=SUN, glow=True, peak=5000.0, level=1.0):
    """A blue sky brighter upwards, with a sun of a few texels across the seam and its aureole."""
    d = latlong.directions(*shape)
    image = 0.5 + 0.3 * d[..., 1:2] * np.array([0.6, 0.8, 1.0]) + 0.05 * np.sin(5 * d[..., :1])
    if sun:
        away = angle(d, d[sun])[..., None]
        image = image * (1 + 3 * np.exp(-away / 12)) if glow else image
        image = image + peak * np.array([1, 0.9, 0.7]) * np.clip(4 - away, 0, 1)
    return (image * level).astype(np.float32)


def lamp(shape=SHAPE, sun=SUN):
    image = sky(shape, sun, glow=False)
    return np.where(image > 100, image, 0).astype(np.float32)


def encoded(image, rows=None, **kwargs):
    made = Layers.of(image, rows, **kwargs)
    return made, made.start()


@pytest.fixture(scope="module")
def shared():
    return encoded(sky())


@pytest.fixture
def sunny(shared):
    """The layers of :func:`sky`, all texels free, and their parameters."""
    made, params = shared
    return made, dict(params)


def core_of(made):
    return (made.separation.core > 0).any(axis=2)


def far_from(inside):
    near = inside.copy()
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            near |= np.roll(inside, (row, column), axis=(0, 1))
    return ~near


def moved(params, light=0, **changes):
    """Set parameters of one light, in radians and logarithms."""
    params = dict(params)
    for name, value in changes.items():
        array = params[name].numpy().copy()
        array[light] = np.asarray(value) / layers.SCALES[name]
        params[name] = single(array)
    return params


def sent(made, params, end, light=0):
    return moved(params, light, turn=rotation_vector(made.lights.centres[light], end))


def random_gain(params, rng, size=1.0):
    gains = [name for name in params if name.startswith("gain")]
    return params | {name: single(rng.normal(size=params[name].shape) * size) for name in gains}


# ---- identity --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("glow", "shape", "level"), [
    (True, SHAPE, 1.0), (False, SHAPE, 1.0), (True, (33, 66), 1e4), (True, (24, 48), 1e-3),
    (False, (24, 48), 1e4), (True, (16, 32), 1.0), (False, (17, 30), 1.0),
])  # fmt: skip
def test_decoding_gives_the_map_back(glow, shape, level):
    sun = (shape[0] // 3, shape[1] - 1)
    image = sky(shape, sun, glow, level=level)
    made, params = encoded(image)
    assert len(made.separation.lights) == 1 and core_of(made)[sun]
    got, inside = made.decode(params).numpy(), core_of(made)
    np.testing.assert_array_equal(got[far_from(inside)], image[far_from(inside)])
    assert np.abs(got - image).max() <= 1e-6 * image.max()


def test_map_without_lights_keeps_every_bit(rng):
    for image in (sky(sun=None), grey(0.7), grey(65504.0), rng.random((9, 18, 3), dtype=np.float32) + 0.5):
        made, params = encoded(image)
        assert made.separation.lights == [] and made.lights.count == SPARE
        assert made.decode(params).numpy().tobytes() == image.tobytes()


def test_map_is_its_parts(sunny):
    made, params = sunny
    parts = made.separation
    np.testing.assert_allclose(parts.background * parts.glow + parts.core, sky(), rtol=1e-6)
    dark = made.decode(moved(params, flux=DARK)).numpy()  # core and glow both gone
    gone = 1 - 1 / (parts.glow @ LUMINANCE)[..., None]
    behind = parts.background * np.exp(gone * made.behind.log_change(parts.background))
    np.testing.assert_allclose(dark, behind, rtol=2e-3, atol=2e-3)
    assert np.abs(made.decode(params).numpy() - parts.background).max() > 1000


# ---- rows ------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(("first", "last"), [(0, 40), (10, 40), (12, 64)])
def test_rows_of_a_map(first, last, sunny):
    image = sky()[first:last]
    made, params = encoded(image, (first, SHAPE[0]))
    assert len(made.separation.lights) == 1
    got, outside = made.decode(params).numpy(), ~core_of(made)
    np.testing.assert_array_equal(got[outside], image[outside])
    assert np.abs(got - image).max() <= 1e-6 * image.max()
    whole, full = sunny
    end = latlong.directions(*SHAPE)[30, 60]
    there, expected = made.decode(sent(made, params, end)), whole.decode(sent(whole, full, end))
    np.testing.assert_allclose(there.numpy()[30 - first].max(), expected.numpy()[30].max(), rtol=0.05)
    # Out of the rows: the core is gone, and all stays finite.
    if first:
        gone = made.decode(sent(made, params, [0, 1, 0])).numpy()
        assert np.isfinite(gone).all() and gone.max() < 0.01 * image.max()


# ---- gain ------------------------------------------------------------------------------------------------
def test_log_gain_is_that_of_the_map(rng):
    made, params = encoded(grey(1.0, 24, 48))
    params = random_gain(params, rng, 0.3)
    params["gain.0"] = params["gain.0"] - 0.3
    log = made.log_gain(params)
    got = made.decode(params).numpy()
    down = (log < 0).all(axis=2)
    assert log.shape == got.shape and log.dtype == np.float32 and down.mean() > 0.02
    np.testing.assert_allclose(np.log(got)[down], log[down], rtol=1e-4, atol=1e-6)


def test_gain_of_a_channel_leaves_the_others(rng):
    image = sky(SMALL, None)
    made, params = encoded(image)
    nodes = np.zeros(params["gain.1"].shape, np.float32)
    nodes[..., 1] = rng.normal(size=nodes.shape[:2]) * 0.5
    got = made.decode(params | {"gain.1": single(nodes)}).numpy()
    np.testing.assert_array_equal(got[..., [0, 2]], image[..., [0, 2]])
    assert (got[..., 1] != image[..., 1]).mean() > 0.9


@pytest.mark.parametrize("factor", [1.5, 4.0, 0.5])
def test_black_channel_is_brightened_by_the_veil(factor):
    image = grey(1.0) * np.float32([0, 0.6, 0.2])
    made, params = encoded(image)
    even = dr.full(mi.TensorXf, np.log(factor) / made.scales["gain.0"], params["gain.0"].shape)
    got = made.decode(params | {"gain.0": even}).numpy()
    if factor < 1:
        np.testing.assert_allclose(got, image * factor, rtol=1e-5, atol=1e-9)
    else:
        part = image * (1 - VEIL) + (image @ LUMINANCE)[..., None] * VEIL
        np.testing.assert_allclose(got, image + (factor - 1) * part, rtol=1e-4)
        assert got[..., 0].min() > 0


# ---- texels that are kept --------------------------------------------------------------------------------
def test_kept_texels_keep_their_bits_under_any_gain_and_lights_move_into_them(rng, sunny):
    free = rng.random(SHAPE) < 0.4
    made, params = sunny
    before = made.decode(params).numpy()
    changed = random_gain(params, rng)
    got = made.keeping(free).decode(changed).numpy()
    np.testing.assert_array_equal(got[~free], before[~free])
    np.testing.assert_array_equal(got[free], made.decode(changed).numpy()[free])
    assert (got[free] != before[free]).mean() > 0.9
    assert (made.decode(changed).numpy()[~free] != before[~free]).mean() > 0.9  # negative control
    made, params = sunny
    there = sent(made, params, latlong.directions(*SHAPE)[40, 60])
    made = made.keeping(np.zeros(SHAPE, bool))
    assert made.decode(there).numpy()[40, 60].max() > 1000


# ---- moving lights ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("end", [(40, 60), (25, 0), (10, 120), (50, 3)])
def test_moving_a_light_without_a_glow_leaves_the_background(end):
    image = 0.5 + lamp()
    made, params = encoded(image, aureoles=False)
    assert not made.lights.glowing
    p = sent(made, params, latlong.directions(*SHAPE)[end])
    real = [p[name] * layers.SCALES[name] for name in ("turn", "flux", "size")]
    core, got = made.lights.core(*real, SHAPE).numpy(), made.decode(p).numpy()
    away = (core == 0).all(axis=2) & ~core_of(made)
    assert away.mean() > 0.9 and core[end].max() > 100
    np.testing.assert_array_equal(got[away], image[away])
    # What the light has left is the sky around it.
    left = core_of(made) & (core == 0).all(axis=2)
    np.testing.assert_allclose(got[left], 0.5, rtol=0.01)
    np.testing.assert_allclose(flux(got), flux(image), rtol=1e-4)


def test_moving_a_light_with_a_glow_leaves_what_is_far_from_it(sunny):
    image = sky()
    made, params = sunny
    (light,) = made.separation.lights
    assert light.glow is not None
    reach = np.flatnonzero((light.glow > 0).any(axis=1)).max() + 1.5
    d = latlong.directions(*SHAPE)
    end = d[26, 110]
    got = made.decode(sent(made, params, end)).numpy()
    near = np.maximum(d @ light.direction, d @ end) > np.cos(np.radians(reach))
    assert (~near).mean() > 0.1
    np.testing.assert_array_equal(got[~near], image[~near])
    changed = np.abs(got / image - 1).max(axis=2) > 0.01
    assert changed.sum() > 2 * core_of(made).sum() and not changed[~near].any()
    # The sky is brightest around the light's new place, and darker than it was around the old.
    old = np.unravel_index(np.argmax(d @ light.direction - 10 * core_of(made)), SHAPE)
    assert got[old].max() < image[old].max() and got[26, 104].max() > 1.2 * image[26, 104].max()


# ---- derivatives -----------------------------------------------------------------------------------------
def gradients(made, params, weight):
    params = {name: mi.TensorXf(value) for name, value in params.items()}
    dr.enable_grad(params)
    decoded = made.decode(params)
    dr.backward(dr.sum((decoded * single(weight)).array))
    return {name: dr.grad(value).numpy() for name, value in params.items()}


@pytest.mark.slow
def test_gradient_by_gain_and_flux_is_the_finite_difference(rng, sunny):
    """With nodes of either sign, so that both branches of the veil are seen."""
    made, params = sunny
    weight = rng.random((*SHAPE, 3)) / sky()
    params = random_gain(moved(sent(made, params, [0.5, 0.4, 0.7]), light=1, flux=-4.0), rng, 0.3)
    grads = gradients(made, params, weight)

    def loss(p):
        return dr.sum((double(made.decode(p).numpy()) * double(weight)).array)[0]

    for name in ("gain.0", "gain.1", "gain.2", "flux"):
        along = rng.normal(size=params[name].shape)
        if name == "flux":
            along[-1] = 0
        up, down = (loss(params | {name: params[name] + single(h * along)}) for h in (3e-3, -3e-3))
        slope = (grads[name].astype(np.float64) * along).sum()
        least = 1e-3 * np.abs(grads[name]).max()
        np.testing.assert_allclose(slope, (up - down) / 6e-3, rtol=0.01, atol=least)


@pytest.mark.slow
def test_kept_texels_pull_at_no_gain(rng, sunny):
    made, params = sunny
    weight, free = rng.normal(size=(*SHAPE, 3)), np.zeros(SHAPE, bool)
    grads = gradients(made.keeping(free), params, weight)
    assert not any(grads[name].any() for name in grads if name.startswith("gain")) and grads["turn"].any()
    free[30, 30] = True
    assert gradients(made.keeping(free), params, weight)["gain.2"].any()


# ---- stress ----------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("shape", [(3, 6), (4, 6), (5, 6), (6, 6)])
def test_smallest_maps(shape, rng):
    image = rng.random((*shape, 3), dtype=np.float32)
    image[min(2, shape[0] - 2), 2] += 1000
    made, params = encoded(image)
    np.testing.assert_allclose(made.decode(params).numpy(), image, atol=1e-6 * image.max())
    for p in (random_gain(params, rng), moved(params, flux=1.0, turn=[1.0, 0.5, 2.0], size=0.5)):
        assert np.isfinite(made.decode(p).numpy()).all()


@pytest.mark.slow
@pytest.mark.parametrize("value", [1e-28, 1e-12, 65504.0, 1e6])
def test_any_exposure_is_finite(value, rng):
    for image in (sky(SMALL, (8, 47), level=value), grey(value)):
        made, params = encoded(image)
        far = random_gain(sent(made, params, [0.5, 0.4, 0.7]), rng, 3)
        for p in (params, far):
            got = made.decode(p).numpy()
            assert np.isfinite(got).all() and (got >= 0).all()
        assert all(np.isfinite(g).all() for g in gradients(made, far, np.ones(image.shape)).values())


@pytest.mark.parametrize("horizon", ["keep", "mirror"])
def test_the_slope_of_a_glow_is_that_of_the_sky_by_its_flux(horizon):
    """Where it has grown, where it is gone, and in the mirror below the horizon."""
    image = sky() * np.float32(1 + 0.3 * np.sin(9 * latlong.directions(*SHAPE)[..., :1]))
    made = Layers.of(image, horizon=horizon)
    params = sent(made, made.start(), made.lights.centres[0] * [-1, 1, -1])
    real = params["flux"].numpy()

    def at(change):
        flux = real.copy()
        flux[0] += change / layers.SCALES["flux"]
        return np.float64(made.parts(params | {"flux": single(flux)})[0].numpy())

    turn = params["turn"].numpy() * layers.SCALES["turn"]
    log_glow = made.log_glow_of(0, turn, real * layers.SCALES["flux"])
    slope = made.glow_slope(params, at(0).astype(np.float32)) * -np.expm1(-log_glow)
    slope *= 0.5  # d log f / d log s of f = 2 s / (1 + s) at 1
    expected = (at(0.05) - at(-0.05)) / 0.1
    up = made.shape[0]
    # A difference of 0.05 is off where the glow is as before, in the kink between growing and going.
    assert np.abs(slope - expected)[:up].max() < 0.03 * expected[:up].max()
    if horizon == "mirror":  # what follows is blurred, which the slope is not
        near = slice(up, up + 2)
        assert np.abs(slope - expected)[near].max() < 0.2 * expected[:up].max()
