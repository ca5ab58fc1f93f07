"""The texel grid against Mitsuba's own emitter, closed forms and brute force."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.errors import InputError
from tests.oracles.plain import lookup


def mitsuba_eval(image, d):
    scene = mi.load_dict({"type": "scene", "e": {"type": "envmap", "bitmap": mi.Bitmap(image)}})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -mi.Vector3f(*np.asarray(d, np.float32).T)
    return np.array(scene.environment().eval(si)).T


def random_directions(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def energy(image):
    return (image.astype(np.float64).sum(1) * latlong.solid_angles(*image.shape[:2])[:, None]).sum(0)


@pytest.mark.parametrize("size", [(3, 6), (3, 2), (7, 13), (16, 32)])
def test_lookup_is_mitsuba_s(rng, size):
    image = rng.random((*size, 3)).astype(np.float32)
    seam = random_directions(rng, 200) * [1e-3, 1, 1]
    special = [[0, 1, 1e-7], [0, -1, 1e-7], [1, 0, 0], [0, 0, 1]]
    d = np.concatenate([random_directions(rng, 2000), seam, special])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    # float32 directions: the row position carries an error of about 1e-3 (H - 1) near the poles.
    # CUDA's textures interpolate with weights of eight bits.
    coarse = 2 / 256 if mi.variant().startswith("cuda") else 0
    found = mitsuba_eval(image, d)
    np.testing.assert_allclose(lookup(image, d), found, atol=2e-4 * size[0] + coarse)


def test_directions_are_texel_centres(rng):
    image = rng.random((9, 18, 3)).astype(np.float32)
    d = latlong.directions(9, 18)
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1, atol=1e-15)
    np.testing.assert_allclose(lookup(image, d)[1:-1], image[1:-1], rtol=1e-12)
    seen = mitsuba_eval(image, d[1:-1].reshape(-1, 3)).reshape(7, 18, 3)
    np.testing.assert_allclose(seen, image[1:-1], atol=1e-5)
    np.testing.assert_array_equal(d[0], np.broadcast_to([0.0, 1.0, 0.0], (18, 3)))
    np.testing.assert_array_equal(d[-1] * [1, -1, 1], np.broadcast_to([0.0, 1.0, 0.0], (18, 3)))


def test_position_inverts_directions_and_closes_the_seam():
    row, column = latlong.texel_position(latlong.directions(12, 24) * 3.5, 12, 24)
    np.testing.assert_allclose(row, np.broadcast_to(np.arange(12.0)[:, None], row.shape), atol=1e-12)
    np.testing.assert_allclose(column[1:-1], np.broadcast_to(np.arange(24.0), column[1:-1].shape), atol=1e-12)
    _, column = latlong.texel_position([[1e-30, 0, -1], [-1e-30, 0, -1], [-1e-3, 0, -1]], 12, 24)
    assert column[0] == column[1] == -0.5  # the seam is one place, whichever side it is reached from
    assert 23.4 < column[2] < 23.5


@pytest.mark.parametrize("height", [1, 2, 3, 64, 4096])
@pytest.mark.parametrize("measure", [latlong.solid_angles, latlong.lookup_solid_angles])
def test_solid_angles_cover_the_sphere(height, measure):
    omega = measure(height, 2 * height)
    assert omega.shape == (height,) and (omega > 0).all()
    assert omega.sum() * 2 * height == pytest.approx(4 * np.pi, rel=1e-12)
    np.testing.assert_allclose(omega, omega[::-1], rtol=1e-9)
    np.testing.assert_allclose(latlong.row_edges(3), [0, 0.25, 0.75, 1])


@pytest.mark.slow
def test_lookup_solid_angles_integrate_the_interpolation():
    v, u = (np.arange(2000) + 0.5) / 2000, (np.arange(400) + 0.5) / 400
    theta, phi = np.meshgrid(np.pi * v, 2 * np.pi * u, indexing="ij")
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    weight = np.sin(theta)[..., None] * (np.pi / 2000) * (2 * np.pi / 400)
    rows = np.eye(5)[:, None, :] * np.ones((5, 10, 1))  # channel r lights row r
    integral = (lookup(rows, d) * weight).sum((0, 1)) / 10
    np.testing.assert_allclose(integral, latlong.lookup_solid_angles(5, 10), rtol=1e-5)


@pytest.mark.parametrize("size", [(16, 32), (10, 20), (7, 31), (1, 1), (24, 50), (31, 5), (2, 64)])
def test_shrinking_keeps_the_energy(rng, size):
    image = rng.lognormal(sigma=3, size=(32, 64, 3)).astype(np.float32)
    image[5, 0] = 1e6
    small = latlong.resize(image, *size)
    assert small.shape == (*size, 3) and small.dtype == np.float32
    np.testing.assert_allclose(energy(small), energy(image), rtol=1e-6)
    assert image.min() <= small.min() and small.max() <= image.max()


@pytest.mark.slow
def test_shrinking_is_an_area_average(rng):
    # Brute force: average the nearest source texel over dense directions inside one new texel.
    image = rng.random((9, 18, 3))
    small = latlong.resize(image, 4, 5)
    low, high = np.cos(np.pi * latlong.row_edges(4)[1:3])
    y = low + (high - low) * (np.arange(2000) + 0.5) / 2000
    phi = 2 * np.pi * (2 + (np.arange(2000) + 0.5) / 2000) / 5
    r = np.sqrt(1 - y**2)[:, None]
    d = np.stack([r * np.sin(phi), np.broadcast_to(y[:, None], (2000, 2000)), -r * np.cos(phi)], -1)
    row, column = latlong.texel_position(d, 9, 18)
    expected = image[np.rint(row).astype(int), np.floor(column + 0.5).astype(int) % 18].mean((0, 1))
    np.testing.assert_allclose(small[1, 2], expected, atol=1e-3)


def test_a_dim_texel_survives_beside_a_bright_one():
    image = np.full((64, 128, 3), 1e-30, np.float32)
    image[20, 20] = 65504
    small = latlong.resize(image, 16, 32)
    assert small[0, 0, 0] == pytest.approx(1e-30, rel=1e-6) and (small > 0).all()


def test_growing_samples_the_interpolated_map(rng):
    image = rng.random((8, 16, 3)).astype(np.float32)
    large = latlong.resize(image, 24, 41)
    inner = latlong.directions(24, 41)[1:-1]
    np.testing.assert_allclose(large[1:-1], lookup(image, inner), rtol=1e-5)
    np.testing.assert_allclose(energy(latlong.resize(image, 128, 256)), energy(image), rtol=2e-2)
    for row, tolerance in ((0, 1e-2), (1, 2e-3), (40, 2e-3), (127, 1e-2)):
        lit = np.zeros((128, 256, 1), np.float32)
        lit[row, 255] = 1
        flux = latlong.resize(lit, 256, 512).sum((1, 2)) @ latlong.lookup_solid_angles(256, 512)
        assert flux == pytest.approx(latlong.lookup_solid_angles(128, 256)[row], rel=tolerance)
    assert np.array_equal(latlong.resize(np.full((1, 4, 3), 2.0), 5, 4), np.full((5, 4, 3), 2.0))


def test_rotate(rng):
    image = rng.random((8, 16, 3)).astype(np.float32)
    np.testing.assert_array_equal(latlong.rotate(image, 90), np.roll(image, -4, axis=1))
    np.testing.assert_array_equal(latlong.rotate(image, -22.5), np.roll(image, 1, axis=1))
    np.testing.assert_array_equal(latlong.rotate(image, 360 * 7), image)
    assert np.argmax(latlong.rotate(np.eye(1, 16, 5)[..., None], 45)) == 3  # to the left
    part = latlong.rotate(image, 30)
    assert part.dtype == np.float32
    # Turning the map by a and looking at azimuth phi is looking at the unturned map at phi + a.
    d = latlong.directions(8, 16)[1:-1]
    a = np.radians(30)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    np.testing.assert_allclose(part[1:-1], lookup(image, d @ turn.T), rtol=1e-5)


def test_envmap_data_is_mitsuba_s(rng):
    image = rng.random((4, 8, 3)).astype(np.float32)
    data = latlong.to_envmap_data(image)
    params = mi.traverse(mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)}))
    np.testing.assert_array_equal(data, params["data"].numpy())
    np.testing.assert_array_equal(latlong.from_envmap_data(params["data"]), image)
    np.testing.assert_array_equal(image.ravel()[latlong.halo_index(4, 8)], data.ravel())


def test_a_map_that_mitsuba_would_enlarge_is_refused():
    with pytest.raises(InputError, match="4 x 2 texels is too small for Mitsuba"):
        latlong.to_envmap_data(np.zeros((2, 4, 3)))
