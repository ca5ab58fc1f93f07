"""Rows below the horizon: told apart by what they show, unchanged under the same sky, without an edge."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.rotations import rotation_vector
from envedit.images import images
from envedit.losses import naturalness
from envedit.representations.layers import below_horizon, unseen
from envedit.representations.layers.below_horizon import Below, kind_of, sky_rows
from envedit.representations.layers.gain import brightened
from envedit.representations.layers.layers import Layers
from tests.oracles.maps import angle
from tests.oracles.plain import gradient

SHAPE = (32, 64)


def mirror(shape=SHAPE, sun=None):
    """A sky of smooth clouds over its own mirror; ``sun`` is a texel."""
    d = latlong.directions(*shape)
    up = d * [1, 0, 1] + np.abs(d * [0, 1, 0])
    image = np.exp(0.4 * np.sin(2 * up[..., :1]) + 0.3 * np.sin(up[..., 2:]) - 0.4 * up[..., 1:2])
    image = image * [0.5, 0.7, 1.0]
    if sun:
        away = angle(d, d[sun])[..., None]
        image = image + 3 * np.exp(-away / 8) + np.where(away < 4, 2000, 0)
    return image.astype(np.float32)


def ground(rng, shape=SHAPE):
    image = mirror(shape)
    up = sky_rows(shape[0])
    image[up:] *= np.exp(rng.normal(0, 0.3, (shape[0] - up, shape[1], 1))).astype(np.float32)
    return image


def halves(image):
    up = sky_rows(len(image))
    return image[up:], image[:up]


def test_what_lies_below_is_told_by_what_it_shows(rng):
    assert kind_of(mirror()) == "mirror" and kind_of(mirror((64, 128))) == "mirror"
    assert kind_of(ground(rng)) == "keep"
    even = mirror()
    even[sky_rows(len(even)) :] = 0.2  # a floor of one colour mirrors nothing
    assert kind_of(even) == "keep"
    assert kind_of(np.zeros((*SHAPE, 3), np.float32)) == "keep"
    assert kind_of(np.ones((3, 2, 3), np.float32)) == "keep"


@pytest.mark.slow
def test_public_maps_are_told_apart(data):
    for folder, kind in (("puresky", "mirror"), ("hdri", "keep")):
        files = sorted(data.glob(f"{folder}/*.hdr"))
        assert files
        for file in files:
            image, _ = images.load_envmap(str(file))
            for width in (128, 256):
                assert kind_of(latlong.resize(image, width // 2, width)) == kind, (file.name, width)


@pytest.mark.parametrize("kind", ("mirror", "keep"))
@pytest.mark.parametrize("height", [3, 8, 31, 32])
def test_the_same_sky_changes_nothing_to_the_bit(kind, height, rng):
    low, sky = halves(mirror((height, 2 * height)))
    below = Below(low, sky, kind)
    assert not below.log_factor(tensor(sky)).numpy().any()


@pytest.mark.parametrize("factor", [1e-6, 0.25, 4.0, 1e6])
def test_a_mirror_follows_a_factor_and_ground_fades(factor):
    low, sky = halves(mirror())
    found = Below(low, sky, "mirror").log_factor(tensor(factor * sky)).numpy()
    # A share of 1e-6 of the mean keeps a black sky from any logarithm.
    np.testing.assert_allclose(found, np.log(factor), rtol=0.12 if factor < 1e-3 else 1e-3)
    kept = Below(low, sky, "keep")
    found = kept.log_factor(tensor(factor * sky)).numpy() / np.log(factor)
    assert found[0].min() > 0.6 and found[-1].max() < 0.01 and (np.diff(found.mean(axis=(1, 2))) < 0).all()


def test_ground_follows_the_glow_above_it_as_far_as_it_continues_the_sky():
    """Walls go on below the horizon; a field of one colour never had the glow of the sun above it."""
    low, sky = halves(mirror(sun=(12, 20)))
    sunless = halves(mirror())[1]
    factors = {}
    for share in (0.0, 0.1, 0.2, 1.0):
        below = Below(0.2 * low**share, sky, "keep")
        factors[share] = below.log_factor(tensor(sunless)).numpy()
    assert not factors[0.0].any() and factors[1.0].min() < -0.3
    np.testing.assert_allclose(factors[0.1], 0.5 * factors[0.2], rtol=0.02, atol=1e-3)
    assert factors[0.2].min() < 0.3 * factors[1.0].min()
    opposite = Below(0.2 / low, sky, "keep")
    assert not opposite.log_factor(tensor(sunless)).numpy().any()


def test_a_mirror_turns_with_its_sky():
    """The truth is the turned map; as it is, the lower half is three times as far from it and more."""
    image = mirror((64, 128), sun=None)
    low, sky = halves(image)
    below = Below(low, sky, "mirror")
    turned = [latlong.rotate(part, 60) for part in (low, sky)]
    found = low * np.exp(below.log_factor(tensor(turned[1])).numpy())
    error, before = (np.abs(np.log(x / turned[0])).mean() for x in (found, low))
    assert error < before / 3


def test_the_width_is_that_under_which_the_original_mirrors_itself():
    low, sky = halves(mirror((64, 128)))
    sharp = np.ascontiguousarray(sky[::-1])
    assert Below(sharp, sky, "mirror").widest == below_horizon.BLUR_MOST_DEGREES[0]
    for widest in below_horizon.BLUR_MOST_DEGREES[1:3]:
        blur = below_horizon._Blur(sky.shape[:2], 64, below_horizon.CHOICE_COLUMNS)
        blur.widen(widest)
        soft = blur(tensor(sky)).numpy().reshape(*blur.grid, 3)
        made = np.einsum("ri,ijx,cj->rcx", blur.down[::-1], soft, blur.across)
        assert Below(np.float32(made), sky, "mirror").widest == widest
    assert Below(low, sky, "keep").widest in below_horizon.BLUR_MOST_DEGREES


@pytest.mark.parametrize("kind", ("mirror", "keep"))
def test_gradient_is_that_of_finite_differences(kind, rng):
    low, sky = halves(mirror((8, 16)))
    below, weight = Below(low, sky, kind), tensor(rng.normal(0, 1, low.shape))
    at = np.float32(sky * np.exp(rng.normal(0, 0.3, sky.shape)))

    def total(x):
        return dr.sum((below.log_factor(x) * weight).array)

    _, slope = gradient(total, tensor(at))
    for _ in range(6):
        way = rng.normal(0, 1, sky.shape) * at
        ends = [float(total(tensor(at + s * 1e-2 * way))[0]) for s in (1, -1)]
        assert (ends[0] - ends[1]) / 2e-2 == pytest.approx((slope * way).sum(), rel=2e-2, abs=2e-2)


@pytest.mark.parametrize("value", [0.0, 1e-30, 65504.0, 1e6])
def test_extremes_stay_finite(value):
    low, sky = halves(mirror())
    below = Below(low, sky, "mirror")
    assert np.isfinite(below.log_factor(tensor(np.full(sky.shape, value))).numpy()).all()
    black = Below(np.zeros_like(low), np.zeros_like(sky), "mirror")
    assert np.isfinite(black.log_factor(tensor(np.full(sky.shape, value))).numpy()).all()


@pytest.mark.parametrize("kind", ["mirror", "keep"])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_channel_that_is_black_in_the_sky_does_not_burst_below_it(kind, channel):
    """The gain lights it up by the veil, from nothing: no ratio to nothing goes into the ground."""
    image = mirror()
    low, sky = halves(image)
    sky = sky.copy()
    sky[..., channel] = 0
    factor = 1.5
    lit = brightened(mi.Color3f(sky.reshape(-1, 3).T), mi.Color3f(factor)).numpy().T.reshape(sky.shape)
    assert lit[..., channel].min() > 0
    found = np.exp(Below(low, sky, kind).log_factor(tensor(lit)).numpy())
    assert found.max() <= (2 * factor - 1) * 1.001 and found.min() > 0.99


# ---- in layers ---------------------------------------------------------------------------------------------
def moved(sun=(24, 20)):
    image = mirror((64, 128), sun)
    made = Layers.of(image, horizon="mirror")
    params = made.start()
    assert len(made.separation.lights) == 1 and made.below is not None
    turn = np.zeros((made.lights.count, 3))
    there = latlong.directions(64, 128)[sun[0] + 2, 90]
    turn[0] = rotation_vector(made.lights.centres[0], there)
    return image, made, params, params | {"turn": tensor(turn / made.scales["turn"])}


@pytest.mark.slow
def test_layers_give_a_whole_map_back_and_have_no_edge_when_the_sun_moves():
    image, made, params, away = moved()
    assert made.decode(params).numpy()[32:].tobytes() == image[32:].tobytes()
    edited = made.decode(away).numpy()
    assert edited.shape == image.shape and np.isfinite(edited).all()
    assert np.abs(np.log(edited[40:] / image[40:])).max() > 0.1  # below the horizon it does follow
    upper = Layers.of(image[:32], (0, 64))
    upper_params = upper.start()
    alone = image.copy()
    turn = away["turn"].numpy()[: upper.lights.count]
    alone[:32] = upper.decode(upper_params | {"turn": tensor(turn)}).numpy()
    seams = [naturalness.natural(one, image)["seam"] for one in (edited, alone)]
    assert seams[0] < 2 and seams[1] > 2 * seams[0]


@pytest.mark.slow
def test_gradient_of_a_whole_map_is_that_of_finite_differences(rng):
    """By a gain: rows below the horizon follow it through the sky above, which has a gradient of its own."""
    _, made, params, _ = moved()
    weight = rng.normal(size=(64, 128, 3))
    grid = rng.normal(0, 0.3, params["gain.0"].shape)

    def decoded(x):
        return made.decode(params | {"gain.0": x})

    def total(values):
        return (np.float64(decoded(tensor(values)).numpy()) * weight).sum()

    _, found = gradient(lambda x: dr.sum((decoded(x) * tensor(weight)).array), tensor(grid))

    for _ in range(3):
        way = rng.normal(size=grid.shape)
        slope = (total(grid + 4e-3 * way) - total(grid - 4e-3 * way)) / 8e-3
        assert abs(slope - (found * way).sum()) < 1e-2 * np.linalg.norm(found)
    assert np.abs(found).max() > 1


def test_hats_of_rows_that_follow_are_those_of_the_rows_that_they_mirror():
    _, made, params, _ = moved()
    for level in range(3):
        for node, share in made.hats(level):
            node, share = node.reshape(64, 128), share.reshape(64, 128)
            np.testing.assert_array_equal(node[32:], node[:32][::-1])
            np.testing.assert_array_equal(share[32:], share[:32][::-1])


def test_only_a_whole_map_has_rows_that_follow():
    image = mirror()
    for rows, part in (((0, 32), image[:16]), ((4, 32), image[4:])):
        assert Layers.of(part, rows, horizon="mirror").below is None
    assert Layers.of(image, (0, 32), horizon="mirror").below is not None


def test_texels_whose_change_nobody_sees_keep_their_bits():
    original = np.full((2, 2, 3), 0.7, np.float32)
    edited = original.copy()
    edited[0, 0, 1] *= 1 + 0.9 * unseen.UNSEEN
    edited[1, 1, 2] *= 1 + 1.1 * unseen.UNSEEN
    kept = unseen.unseen_kept(original, edited)
    assert kept[0].tobytes() == original[0].tobytes() and kept[1, 1, 2] == edited[1, 1, 2]
    black = np.zeros((1, 1, 3), np.float32)
    assert unseen.unseen_kept(black, np.full_like(black, 1e-30))[0, 0, 0] == np.float32(1e-30)
