"""Lights on the sphere against plain numpy in float64; derivatives also by the fundamental theorem."""

import dataclasses
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from envedit.core import latlong
from envedit.core.color import LUMINANCE, luminance
from envedit.core.rotations import rotation_vector
from envedit.images import images
from envedit.representations.layers import aureoles, layers, lights
from envedit.representations.layers.lights import DARK, LOBE_DEGREES, SPARE, Lights
from envedit.representations.layers.separation import GLOW_DEGREES, Light, glow_at
from tests.oracles import maps
from tests.oracles.plain import single

H, W = 25, 48
UP = np.array([0.0, 1.0, 0.0])


def turned(v, d):
    """Rotate rows of directions (n, 3) by a rotation vector, with a matrix."""
    angle = np.linalg.norm(v)
    if angle == 0:
        return np.asarray(d, np.float64)
    x, y, z = np.asarray(v, np.float64) / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return d @ (np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k).T


def random_turn(rng):
    """Anywhere on the sphere: up to a whole turn about any axis."""
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis) * rng.uniform(0, 2 * np.pi)


def unit(rng, *shape):
    d = rng.normal(size=(*shape, 3))
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def patch(rng, top, left, rows=3, columns=4, *, shape=(H, W), peak=100.0, glow=None):
    """Make a light of a patch of texels of a map, columns periodic."""
    height, width = shape
    r, c = np.meshgrid(top + np.arange(rows), (left + np.arange(columns)) % width, indexing="ij")
    r, c = r.ravel(), c.ravel()
    radiance = peak * rng.uniform(0.2, 1.0, (len(r), 3))
    flux = radiance.sum(axis=1) * latlong.lookup_solid_angles(*shape)[r]
    centre = (latlong.directions(*shape)[r, c] * flux[:, None]).sum(axis=0)
    return Light(
        direction=centre / np.linalg.norm(centre),
        texels=r * width + c,
        radiance=radiance,
        hidden=np.zeros_like(radiance),
        glow=glow,
    )


def image_of(light, shape=(H, W)):
    image = np.zeros((shape[0] * shape[1], 3))
    image[light.texels] = light.radiance
    return image.reshape(*shape, 3)


def place(made, turn=0.0, flux=0.0, size=0.0):
    """Parameters (turn, log flux, log size) of the own lights; spare ones stay dark."""
    own = made.count - SPARE
    dark = np.full((SPARE, 3), DARK)
    turn = np.concatenate([np.broadcast_to(turn, (own, 3)), np.zeros((SPARE, 3))])
    flux = np.concatenate([np.broadcast_to(flux, (own, 3)), dark])
    size = np.concatenate([np.broadcast_to(size, (own, 1)), np.zeros((SPARE, 1))])
    return single(turn), single(flux), single(size)


def core(made, *at, shape=(H, W), **where):
    return made.core(*(at or place(made, **where)), shape).numpy()


def second_moments(image, centre):
    """Mean squares in degrees to the east and to the north of a direction, (2,), over luminance."""
    east = np.cross(UP, centre) / np.linalg.norm(np.cross(UP, centre))
    d = latlong.directions(*image.shape[:2])
    share = np.float64(image).sum(axis=2) * latlong.lookup_solid_angles(*image.shape[:2])[:, None]
    away = np.degrees([d @ east, d @ np.cross(centre, east)])
    return (np.square(away) * share).sum(axis=(1, 2)) / share.sum()


def plain_core(light, turn, flux=0.0, size=0.0, shape=(H, W)):
    """The core of one light of a map, in float64 and without snapping."""
    height, width = shape
    row, column = np.divmod(light.texels, width)
    points = latlong.directions(*shape)[row, column]
    power = light.radiance * latlong.lookup_solid_angles(*shape)[row][:, None] * np.exp(flux)
    along = (points @ light.direction)[:, None] * light.direction
    points = along + (points - along) * np.exp(size)
    points = turned(turn, points / np.linalg.norm(points, axis=1, keepdims=True))
    y, x = latlong.texel_position(points, height, width)
    sine = np.sin(np.pi * row / (height - 1)) * np.exp(size)
    half = np.clip(sine / np.maximum(np.hypot(points[:, 0], points[:, 2]), 1e-9), 1, 2 * width)

    def tents(k, at, half):
        share = np.maximum(1 - np.abs(k - at[:, None]) / half, 0)
        return share / share.sum(axis=1, keepdims=True)

    down = tents(np.arange(height), y, 1.0)
    across = tents(np.arange(-3 * width, 4 * width), x, half[:, None]).reshape(-1, 7, width).sum(axis=1)
    lit = np.einsum("nr,nc,nk->rck", down, across, power)
    return lit / latlong.lookup_solid_angles(*shape)[:, None, None]


def weights(shape=(H, W)):
    """Smooth on the sphere, another for every channel."""
    d = latlong.directions(*shape)
    return np.stack([np.sin(2 * d[..., k] + 0.7 * k) + d[..., (k + 1) % 3] ** 2 for k in range(3)], axis=-1)


def derivatives(loss, *at):
    """Gradients of a loss of (turn, log flux, log size), and its value."""
    at = [type(p)(p) for p in at]
    dr.enable_grad(at)
    value = loss(*at)
    dr.backward(value)
    return [dr.grad(p).numpy().astype(np.float64) for p in at], np.float64(value.numpy())


def weighted(image, weight):
    return dr.sum((image * single(weight)).array)


# ---- rotations -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0, 1e-9, 1e-4, 0.3, math.pi / 2, math.pi, 5.0, 2 * math.pi])
def test_rotate_is_the_rotation_matrix(angle, rng):
    v, d = unit(rng, 50) * angle, unit(rng, 50)
    got = lights.rotate(mi.Vector3f(v.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32))).numpy().T
    expected = np.concatenate([turned(a, b[None]) for a, b in zip(v, d, strict=True)])
    np.testing.assert_allclose(got, expected, atol=3e-6)
    if angle == 0:
        np.testing.assert_array_equal(got, d.astype(np.float32))


angles = st.tuples(st.floats(-math.pi, math.pi), st.floats(-math.pi / 2, math.pi / 2))


def direction(azimuth, elevation):
    c = math.cos(elevation)
    return np.array([c * math.sin(azimuth), math.sin(elevation), -c * math.cos(azimuth)])


@pytest.mark.slow
@settings(deadline=None, max_examples=300)
@given(angles, angles)
@example((0.0, 0.0), (math.pi, 0.0))
@example((0.4, 0.3), (0.4 - math.pi, -0.3))
@example((0.0, math.pi / 2), (0.0, -math.pi / 2))
@example((0.0, math.pi / 2), (2.0, 0.1))
@example((2.0, 0.1), (0.0, -math.pi / 2))
@example((0.0, 0.5), (0.0, 0.5 + 1e-7))
def test_rotation_vector_takes_one_direction_to_the_other(start, end):
    start, end = direction(*start), direction(*end)
    v = rotation_vector(start, end)
    assert np.linalg.norm(v) < math.pi + 1e-9
    np.testing.assert_allclose(turned(v, start[None])[0], end, atol=3e-6)
    # Upright stays upright: level stays level.
    for d in (start, end):
        if np.hypot(d[0], d[2]) < 1e-3:
            return
    east = [np.array([-d[2], 0, d[0]]) / np.hypot(d[0], d[2]) for d in (start, end)]
    np.testing.assert_allclose(turned(v, east[0][None])[0], east[1], atol=3e-6)


@pytest.mark.parametrize("d", [(0, 1, 0), (0, -1, 0), (1, 0, 0), (0.6, 0, -0.8), (-0.48, 0.6, 0.64)])
def test_rotation_vector_between_equal_directions_is_zero(d):
    np.testing.assert_array_equal(rotation_vector(d, d), 0)
    np.testing.assert_allclose(rotation_vector(d, 3 * np.array(d)), 0, atol=1e-12)


# ---- values ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [1, -1, 24])
@pytest.mark.parametrize("top", [2, 11])
def test_turn_by_whole_texels_is_a_roll(top, columns, rng):
    light = patch(rng, top, 44)
    got = core(Lights([light], (0, H), W), turn=(0, columns * 2 * np.pi / W, 0))
    expected = np.roll(image_of(light), -columns, axis=1)
    assert np.abs(got - expected).max() < 1e-6 * expected.max()
    assert np.abs(got - image_of(light)).max() > 0.1 * expected.max()  # negative control


@pytest.mark.parametrize("shape", [(H, W), (49, 96), (13, 24), (30, 50), (7, 9)])
def test_core_is_the_plain_one(shape, rng):
    height, width = shape
    light = patch(rng, height // 4, width - 2, shape=shape)
    made = Lights([light], (0, height), width)
    for size in np.linspace(-3, 1, 10):
        turn, flux = random_turn(rng), rng.normal(size=3)
        expected = plain_core(light, turn, flux, size, shape)
        got = core(made, turn=turn, flux=flux, size=size, shape=shape)
        # What snaps to a texel's centre is at most 2e-4 of a texel off, in rows and in columns.
        assert np.abs(got - expected).max() < 5e-4 * expected.max()
    assert np.abs(got - plain_core(light, turn, flux, size + 0.3, shape)).max() > 0.01 * expected.max()


def test_cores_of_one_light_are_those_of_all_with_the_others_out(rng):
    """In several images at once, to rounding: as a solver's finite differences take them."""
    made = Lights([patch(rng, 4, 5), patch(rng, 9, 20)], (0, H), W)
    for i in (0, 1, 2):
        ways = [(random_turn(rng) * 0.1, rng.normal(0, 0.3, 3), rng.normal(0, 0.2)) for _ in range(3)]
        found = made.cores_of(i, ways, (H, W))
        assert found.shape == (3, H, W, 3) and found.any(axis=(1, 2, 3)).all()
        for one, (turn, flux, size) in zip(found, ways, strict=True):
            at = [np.zeros((made.count, n)) for n in (3, 3, 1)]
            at[0][i], at[1][:], at[1][i], at[2][i] = turn, DARK, flux, size
            alone = made.core(*(mi.TensorXf(np.float32(v)) for v in at), (H, W)).numpy()
            np.testing.assert_allclose(one, alone, rtol=3e-6, atol=1e-5)


def centred_at(light, elevation, azimuth):
    return rotation_vector(light.direction, direction(azimuth, elevation))


GOALS = [(math.pi / 2, 0.0), (-math.pi / 2, 0.0), (1.5, 2.0), (-1.5, -2.0), (0.0, math.pi), (1.2, -math.pi),
         (0.01, 0.1), (0.9, 0.0)]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("top", [1, 11])
def test_flux_is_kept_anywhere_on_the_sphere(top, rng):
    """Low to high and back, across the seam, over a pole, at a pole."""
    light = patch(rng, top, 46)
    made, expected = Lights([light], (0, H), W), maps.flux(image_of(light))
    np.testing.assert_allclose(made.flux[0], expected, rtol=1e-6)
    turns = [centred_at(light, *goal) for goal in GOALS] + [random_turn(rng) for _ in range(30)]
    for turn in turns:
        got = core(made, turn=turn)
        assert np.isfinite(got).all() and (got >= 0).all()
        np.testing.assert_allclose(maps.flux(got), expected, rtol=1e-5)


@pytest.mark.parametrize("scale", [1e-20, *(10.0**k for k in range(-5, 6)), 1e20, 1e38])
def test_flux_of_any_size_is_shared_out_in_integers_of_40_bits(scale):
    row, column = mi.Float([3.3, 7.8]), mi.Float([9.2, 31.7])
    flux = mi.Color3f(scale * 0.02) + mi.Color3f(mi.Float(0, 0))
    got = lights.shared_out(row, column, mi.Float([1.0, 1.5]), flux, 1.0, (16, 32), (0, 16)).numpy()
    np.testing.assert_allclose(maps.flux(got), 2 * np.float64(np.float32(scale * 0.02)), rtol=1e-6)


def test_rows_that_are_not_wanted_lose_their_flux_and_nothing_else(rng):
    light = patch(rng, 4, 10, rows=6)
    for turn in (np.zeros(3), random_turn(rng), centred_at(light, 0.2, 3.1)):
        whole = core(Lights([light], (0, H), W), turn=turn)
        for first, last in [(0, 7), (2, 9), (3, H), (4, 25)]:
            of_rows = dataclasses.replace(light, texels=light.texels - first * W)
            part = core(Lights([of_rows], (first, H), W), turn=turn, shape=(last - first, W))
            np.testing.assert_allclose(part, whole[first:last], rtol=1e-6, atol=1e-8)


def test_a_spare_light_can_have_a_colour_that_no_light_has(rng):
    light = patch(rng, 4, 10)
    red = dataclasses.replace(light, radiance=light.radiance * [1, 0, 0])
    made = Lights([red], (0, H), W)
    assert (made.flux[0] > 0).tolist() == [True, False, False]
    turn, flux, size = (np.array(p) for p in place(made, flux=DARK))
    flux[1] = np.log(made.flux[1, 0] / made.flux[1])
    got = maps.flux(core(made, single(turn), single(flux), single(size)))
    np.testing.assert_allclose(got, made.flux[0, 0], rtol=1e-4)


def test_spare_lights_are_lobes_with_the_mean_flux(rng):
    shape = (64, 128)
    both = [patch(rng, 4, 10, shape=shape), patch(rng, 15, 40, shape=shape)]
    for own in (both, both[:1], []):
        made = Lights(own, (0, 64), 128)
        fluxes = [maps.flux(image_of(light, shape)) for light in own] or [np.ones(3)]
        turn, flux, size = (np.array(p) for p in place(made, flux=DARK))
        assert made.count == len(own) + SPARE
        for i in range(SPARE):
            flux[:], turn[:] = DARK, 0
            flux[len(own) + i] = 0
            for _ in range(5):
                goal = unit(rng)
                turn[len(own) + i] = rotation_vector(UP, goal)
                got = core(made, single(turn), single(flux), single(size), shape=shape)
                np.testing.assert_allclose(maps.flux(got), np.mean(fluxes, axis=0), rtol=1e-5)
                near = maps.angle(latlong.directions(64, 128), goal) < 4 * LOBE_DEGREES + 2 * 180 / 64
                assert (maps.flux(got, near) > 0.9 * maps.flux(got)).all()


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.03, 1.0, 6.0])  # the first: as narrow as it is round
@pytest.mark.parametrize("width", [256, 1024])
def test_spare_lights_are_round(width, degrees, rng):
    """Second moments: the lobe's own, cut at 2.5 radii, and its points'."""
    shape, texel = (width // 2, width), 360 / width
    made = Lights([], (0, shape[0]), width)
    turn, flux, size = (np.array(p) for p in place(made))
    flux[0], size[0] = 0, made.log_size(degrees)
    degrees = max(degrees, lights.NARROWEST * texel)
    cut = 1 - 3.125 * math.exp(-3.125) / (1 - math.exp(-3.125))
    expected = cut * degrees**2 + texel**2 / 6
    for elevation in (-70, 5, 40, 80):
        azimuth, tilt = rng.uniform(0, 2 * np.pi), np.radians(elevation + rng.uniform(-2, 2))
        goal = np.array([np.cos(tilt) * np.sin(azimuth), np.sin(tilt), -np.cos(tilt) * np.cos(azimuth)])
        turn[0] = rotation_vector(UP, goal)
        got = core(made, single(turn), single(flux), single(size), shape=shape)
        np.testing.assert_allclose(maps.flux(got), made.flux[0], rtol=1e-5)
        moments = second_moments(got, goal)
        np.testing.assert_allclose(moments, moments.mean(), rtol=0.05)
        # Tents are wider where texels are finer than points lie apart.
        apart = max(1.0, degrees / lights.SPACINGS / texel)
        assert 0.95 * expected < moments.mean() < 1.05 * (expected + (apart**2 - 1) * texel**2 / 6)


def test_without_a_glow_in_the_map_spare_lights_have_that_of_a_clear_sun(rng):
    own = [patch(rng, 4, 10)]
    sky = np.full((H, W, 3), 3.0 / np.pi)
    made = Lights(own, (0, H), W, background=sky)
    assert made.flux[1] @ LUMINANCE == pytest.approx(40 * 3, rel=0.01)
    turn, flux, _ = (np.array(p) for p in place(made, flux=DARK))
    flux[1] = np.log(0.25)
    at = np.radians([10.0, 60.0, 130.0])
    d = mi.Vector3f(np.stack([np.sin(at), np.cos(at), 0 * at]).astype(np.float32))
    # The mean of the sky is not its irradiance over pi to the last digit.
    strength = 2 * 0.25 / 1.25 * np.minimum(1.0, aureoles.ground_irradiance(sky, (0, H)) / 3)
    expected = 1 + 26 * np.exp(-np.array([10, 60, np.inf]) / 15)[:, None] * strength
    np.testing.assert_allclose(made.glow_of(1, single(turn), single(flux), d).numpy().T, expected, rtol=1e-4)
    for radiance in (0.0, 1e-300):
        made = Lights(own, (0, H), W, background=np.full((H, W, 3), radiance))
        assert made.glows[1] is None and np.isfinite(made.flux).all()


def test_a_glow_has_no_other_colour_where_the_sky_has(rng):
    """Elsewhere the sky is twice as red and half as blue: its glow is no redder there, nor bluer."""
    light = patch(rng, 4, 10)
    glow = np.exp(-GLOW_DEGREES / 10)[:, None] * np.float64([3.0, 2.0, 1.0])
    light = dataclasses.replace(light, glow=glow)
    toward = latlong.directions(H, W)
    opposite = (toward @ light.direction < 0)[..., None]
    sky = np.where(opposite, [2.0, 1.0, 0.5], [1.0, 1.0, 1.0])
    made = Lights([light], (0, H), W, background=sky)
    away = -light.direction
    d, centre = (mi.Vector3f(*v.tolist()) for v in (away, away))
    got = made.glow_around(0, d, centre).numpy().ravel()
    np.testing.assert_allclose(got, np.array([3.0, 2.0, 1.0]) * [0.5, 1.0, 1.0], rtol=0.02)


@pytest.mark.parametrize("name", ["autumn_field", "rustig_koppie", "syferfontein_18d_clear"])
def test_the_glow_of_a_clear_sun_is_that_of_photographed_ones(name, data):
    image, _ = images.load_envmap(str(data / "puresky" / f"{name}_puresky_1k.hdr"), 256)
    made = layers.Layers.of(image[:64], (0, 128))
    flux = made.lights.flux[0] / luminance(aureoles.ground_irradiance(made.base, (0, 128)))
    strength = aureoles.glow_strength(flux / aureoles.CLEAR_FLUX)
    expected = (aureoles.clear_glow() * strength)[5:31] @ LUMINANCE
    ratio = made.lights.glows[0][5:31] @ LUMINANCE / expected
    assert 0.55 < ratio.min() < 1 < ratio.max() < 1.6


@pytest.mark.parametrize(("there", "strength"), [(5.0, 1 / 5), (0.2, 1)])
def test_a_glow_is_no_brighter_wherever_its_light_is(there, strength, rng):
    """In a brighter half of the sky it adds as much radiance as in the darker one; there it is a factor."""
    table = np.exp(-np.maximum(GLOW_DEGREES - 2, 0) / 8)[:, None] * np.ones(3) * (GLOW_DEGREES < 40)[:, None]
    light = patch(rng, 12, 16, glow=table)
    bright = np.where(latlong.directions(H, W)[..., :1] * np.sign(light.direction[0]) > 0, 1.0, there)
    made = Lights([light], (0, H), W, background=bright * np.ones(3))
    turn, flux, _ = (np.array(p) for p in place(made, flux=DARK))
    flux[0] = 0
    beside = []
    for degrees in (0.0, 180.0):
        turn[0] = [0, np.radians(degrees), 0]
        at = turned(turn[0], light.direction[None])
        d = mi.Vector3f(np.ascontiguousarray(at.T, np.float32))
        beside.append(made.glow_of(0, single(turn), single(flux), d).numpy()[0, 0] - 1)
    assert beside[0] == pytest.approx(1, rel=1e-3)
    assert beside[1] == pytest.approx(strength, rel=0.1)


def test_spare_lights_have_the_glow_of_the_strongest_light_in_proportion_to_flux(rng):
    table = np.exp(-GLOW_DEGREES / 10)[:, None] * [4.0, 3.0, 2.0] * (GLOW_DEGREES < 60)[:, None]
    own = [patch(rng, 4, 10, peak=100.0, glow=table), patch(rng, 8, 30, peak=3.0, glow=table / 7)]
    made = Lights([*own, patch(rng, 15, 40, peak=1000.0)], (0, H), W)
    turn, flux, _ = (np.array(p) for p in place(made, flux=DARK))
    d = mi.Vector3f(unit(rng, 200).T.astype(np.float32))
    np.testing.assert_array_equal(made.glow_of(3, single(turn), single(flux), d).numpy(), 1)
    strength = np.array([0.3, 1.0, 2.0])
    turn[3], flux[3] = random_turn(rng), np.log(strength * made.flux[0] / made.flux[3])
    got = made.glow_of(3, single(turn), single(flux), d).numpy()
    cosine = d.numpy().T @ turned(turn[3], UP[None])[0]
    share = made.flux[3] / made.flux[0]
    factor = strength / share
    expected = 1 + 2 * factor / (1 + factor) * share * glow_at(table, cosine)
    np.testing.assert_allclose(got.T, expected, rtol=1e-3)


# ---- derivatives -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("top", [3, 11])
def test_gradient_is_the_finite_difference(top, rng):
    """Of the plain core, at random places on the whole sphere, but for those at a line through centres."""
    light, h, seen = patch(rng, top, 46), 1e-7, 0
    made = Lights([light], (0, H), W)
    for _ in range(12):
        at = np.concatenate([random_turn(rng), rng.normal(size=3) * 0.5, rng.uniform(-0.5, 0.5, 1)])

        def loss(x):
            return (plain_core(light, x[:3], x[3:6], x[6]) * weights()).sum()

        here = loss(at)
        ahead, behind = (
            np.array([sign * (loss(at + sign * h * e) - here) / h for e in np.eye(7)]) for sign in (1, -1)
        )
        scale = np.abs(ahead).max()
        if np.abs(ahead - behind).max() > 1e-4 * scale:
            continue
        seen += 1
        grads, value = derivatives(
            lambda *p: weighted(made.core(*p, (H, W)), weights()),
            *place(made, turn=at[:3], flux=at[3:6], size=at[6]),
        )
        np.testing.assert_allclose(value, here, rtol=1e-3)
        got = np.concatenate([g[0] for g in grads])
        np.testing.assert_allclose(got, (ahead + behind) / 2, atol=2e-3 * scale)
        assert all(np.abs(g[1:]).max() < 1e-9 * scale for g in grads)  # spare lights are dark
    assert seen >= 8


def over(light, name):
    """Ends of paths for a light: rotation vectors (start, end)."""
    east = np.cross(light.direction, UP)
    east /= np.linalg.norm(east)
    polar = math.acos(light.direction[1])  # angle to the zenith
    return {
        "texel borders": (np.zeros(3), np.array([0.6, 0.8, -0.1])),
        "seam": (np.array([0, -0.4, 0.01]), np.array([0, 0.5, 0.02])),
        "over the pole": (east * (polar - 0.8), east * (polar + 0.3)),
    }[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["texel borders", "seam", "over the pole"])
def test_gradient_along_a_path_adds_up_to_the_change(name, rng):
    """Many copies of a light, one at every step of the path: a linear loss is the sum of theirs."""
    light, count, weight = patch(rng, 3, 46), 1000, weights()
    start, end = over(light, name)
    turns = start + (end - start) * ((np.arange(count) + 0.5) / count)[:, None]
    at = place(made := Lights([light] * count, (0, H), W), turn=turns)
    (turn, _, _), _ = derivatives(lambda *p: weighted(made.core(*p, (H, W)), weight), *at)
    slopes = turn[:count] @ (end - start)
    alone = Lights([light], (0, H), W)
    low, high = ((core(alone, turn=v) * weight).sum() for v in (start, end))
    np.testing.assert_allclose(slopes.mean(), high - low, atol=3 / count * np.abs(slopes).mean())
    assert abs(high - low) > 0.05 * np.abs(slopes).mean()


def test_gradients_of_lights_do_not_mix(rng):
    both = [patch(rng, 4, 10), patch(rng, 15, 40, peak=10.0)]
    made = Lights(both, (0, H), W)
    where = {"turn": np.array([[0.11, 0.03, 0.07], [-0.05, 0.13, 0.02]]), "size": np.array([[0.1], [0.2]])}
    upper = weights() * (np.arange(H) < 12)[:, None, None]
    grads, _ = derivatives(lambda *p: weighted(made.core(*p, (H, W)), upper), *place(made, **where))
    alone = Lights(both[:1], (0, H), W)
    expected, _ = derivatives(
        lambda *p: weighted(alone.core(*p, (H, W)), upper),
        *place(alone, **{name: value[0] for name, value in where.items()}),
    )
    for got, one in zip(grads, expected, strict=True):
        assert one[0].all()
        np.testing.assert_allclose(got[0], one[0], rtol=1e-5)
        assert not got[1].any()


def test_gradient_of_an_unmoved_light_has_the_direction_of_the_change(rng):
    """Where all its texels lie on lines through centres, and every fit begins."""
    light = patch(rng, 11, 20)
    made = Lights([light], (0, H), W)
    weight = weights() * latlong.lookup_solid_angles(H, W)[:, None, None]
    (turn, _, _), _ = derivatives(lambda *p: weighted(made.core(*p, (H, W)), weight), *place(made))
    ends = [[(plain_core(light, v) * weight).sum() for v in 0.02 * sign * np.eye(3)] for sign in (1, -1)]
    slope = (np.array(ends[0]) - ends[1]) / 0.04
    assert turn[0] @ slope > 0.98 * np.linalg.norm(turn[0]) * np.linalg.norm(slope)
    assert np.linalg.norm(turn[0]) > 0.8 * np.linalg.norm(slope)


@pytest.mark.parametrize("goal", [UP, -UP])
def test_gradient_at_a_pole_is_finite(goal, rng):
    light = patch(rng, 8, 20, rows=1, columns=1)
    made = Lights([light], (0, H), W)
    at = place(made, turn=rotation_vector(light.direction, goal))
    grads, value = derivatives(lambda *p: weighted(made.core(*p, (H, W)), weights()), *at)
    assert np.isfinite(value) and all(np.isfinite(g).all() for g in grads)


# ---- glow ------------------------------------------------------------------------------------------------

TABLE = np.stack(
    [a * (np.exp(-GLOW_DEGREES / b) - np.exp(-80 / b)) for a, b in [(3, 15), (2, 20), (1, 40)]], 1
)
TABLE[80:] = 0  # falls there without a step


def device(d):
    return mi.Vector3f(np.ascontiguousarray(d.reshape(-1, 3).T, np.float32))


def plain_glow(own, turns, fluxes, d):
    factor = np.ones((len(d), 3))
    for light, turn, flux in zip(own, turns, fluxes, strict=True):
        if light.glow is not None:
            strength = 2 * np.exp(flux) / (1 + np.exp(flux))
            factor *= 1 + glow_at(light.glow, d @ turned(turn, light.direction[None])[0]) * strength
    return factor


def test_glow_is_the_product_over_the_lights(rng):
    own = [patch(rng, 4, 10, glow=TABLE), patch(rng, 9, 20), patch(rng, 15, 40, glow=0.5 * TABLE[:, ::-1])]
    made, d = Lights(own, (0, H), W), latlong.directions(H, W).reshape(-1, 3)
    assert made.glowing and not Lights(own[1:2], (0, H), W).glowing
    for _ in range(5):
        turn, flux = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
        turns, fluxes, _ = place(made, turn=turn, flux=flux)
        got = made.glow(turns, fluxes, device(d)).numpy().T
        np.testing.assert_allclose(got, plain_glow(own, turn, flux, d), rtol=2e-3)
    before = made.glow_before(device(d)).numpy().T  # without spare lights
    np.testing.assert_allclose(before, plain_glow(own, 0 * turn, 0 * flux, d), rtol=2e-3)
    far = plain_glow(own, turn, flux, d) == 1
    assert far.any()
    np.testing.assert_array_equal(got[far], 1)


@pytest.mark.slow
def test_gradient_of_the_glow_is_the_finite_difference(rng):
    own = [patch(rng, 4, 10, glow=TABLE), patch(rng, 15, 40, glow=0.5 * TABLE)]
    made, d, h = Lights(own, (0, H), W), unit(rng, 200), 1e-6
    weight = rng.normal(size=(200, 3))
    for _ in range(4):
        at = rng.normal(size=12) * 0.7

        def loss(x):
            return (plain_glow(own, x[:6].reshape(2, 3), x[6:].reshape(2, 3), d) * weight).sum()

        expected = np.array([(loss(at + h * e) - loss(at - h * e)) / (2 * h) for e in np.eye(12)])
        turn, flux, _ = place(made, turn=at[:6].reshape(2, 3), flux=at[6:].reshape(2, 3))

        def ours(turn, flux):
            value = made.glow(turn, flux, device(d))
            w = mi.Color3f(np.ascontiguousarray(weight.T, np.float32))
            return dr.sum(value.x * w.x + value.y * w.y + value.z * w.z)

        grads, value = derivatives(ours, turn, flux)
        np.testing.assert_allclose(value, loss(at), rtol=1e-4)
        got = np.concatenate([g[:2].ravel() for g in grads])
        np.testing.assert_allclose(got, expected, atol=2e-3 * np.abs(expected).max())


# ---- what is not finite -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["turn", "flux", "size"])
def test_what_is_not_finite_is_not_dropped(name, rng):
    made = Lights([patch(rng, 4, 10), patch(rng, 15, 40)], (0, H), W)
    where = {"turn": np.zeros((2, 3)), "flux": np.zeros((2, 3)), "size": np.zeros((2, 1))}
    assert np.isfinite(core(made, **where)).all()
    where[name][1, 0] = np.nan
    assert np.isnan(core(made, **where)).any()
