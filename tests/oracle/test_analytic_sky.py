"""The baked sun and sky against Mitsuba's plugin."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core import color, latlong
from envedit.images import analytic_sky
from tests.oracles import maps


def plugin_radiance(d, azimuth, elevation, **parameters):
    """Mitsuba's sunsky at directions (N, 3) of our frame, its to_world turning +Z up into +Y up."""
    sun = maps.toward(elevation, azimuth).tolist()
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    plugin = {"type": "sunsky", "sun_direction": sun, "to_world": turn, **parameters}
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -mi.Vector3f(*np.asarray(d, np.float32).T)
    return np.array(mi.load_dict({"type": "scene", "e": plugin}).environment().eval(si), np.float64).T


@pytest.mark.parametrize("width", [16, 1000, 64])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 45), (90, 10), (200, 60), (359.5, 30), (-45, 75)])
def test_sun_stands_where_it_is_told(width, azimuth, elevation):
    found = analytic_sky.sunsky(width, azimuth, elevation)
    assert found.shape == (width // 2, width, 3) and found.dtype == np.float32
    assert np.isfinite(found).all() and (found > 0).all()
    row, column = np.unravel_index(color.luminance(found).argmax(), found.shape[:2])
    assert abs(row - (90 - elevation) / 180 * (width // 2 - 1)) <= 1
    away = (column - azimuth / 360 * width) % width
    assert min(away, width - away) <= 1


@pytest.mark.slow
def test_sky_is_the_plugin_s():
    found = analytic_sky.sunsky(512, 60, 35, turbidity=4, sun_scale=0)
    d = latlong.directions(256, 512)[2:124:7, ::11]
    expected = plugin_radiance(d.reshape(-1, 3), 60, 35, turbidity=4.0, albedo=0.2, sun_scale=0.0).reshape(
        d.shape
    )
    np.testing.assert_allclose(found[2:124:7, ::11], expected, rtol=0.02)


@pytest.mark.parametrize("width", [8, 64, 1500, 256])
@pytest.mark.parametrize("elevation", [90, 88, 45, 5])
def test_the_flux_of_the_sun_is_right(width, elevation):
    found = analytic_sky.sunsky(width, 130, elevation, sky_scale=0, ground_albedo=0)
    flux = found.sum(1, dtype=np.float64).T @ latlong.lookup_solid_angles(width // 2, width)
    # A grid around the sun, finer than the disc.
    x = (np.arange(400) + 0.5) / 400 * 0.012 - 0.006
    to_sun, up = maps.toward(elevation, 130), maps.toward(elevation + 90, 130)
    right = maps.toward(0, 220)
    d = to_sun + x[:, None, None] * right + x[:, None] * up
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    radiance = plugin_radiance((d / length).reshape(-1, 3), 130, elevation, sky_scale=0.0, albedo=0.0)
    expected = (radiance * length.reshape(-1, 1) ** -3).sum(0) * (0.012 / 400) ** 2
    np.testing.assert_allclose(flux, expected, rtol=0.01)


def test_ground_reflects_the_irradiance():
    found = analytic_sky.sunsky(128, 10, 50, ground_albedo=0.3)
    ground = found[33:]
    np.testing.assert_array_equal(ground, np.broadcast_to(ground[0, 0], ground.shape))
    up = (
        np.maximum(latlong.directions(64, 128)[..., 1:2], 0)
        * latlong.lookup_solid_angles(64, 128)[:, None, None]
    )
    np.testing.assert_allclose(ground[0, 0], 0.3 / np.pi * (found * up).sum((0, 1)), rtol=0.01)


@pytest.mark.parametrize(("elevation", "turbidity"), [(0, 1), (0, 5), (0, 10), (90, 1), (0.1, 3), (2, 1)])
def test_sunsky_at_its_limits(elevation, turbidity, capfd):
    """The plugin's own fit is negative beside a low sun, by up to 0.17."""
    found = analytic_sky.sunsky(6, 0, elevation, turbidity)
    assert np.isfinite(found).all() and (found > 0).all()
    assert (analytic_sky.sunsky(32, 30, elevation, turbidity) >= 0).all()
    assert capfd.readouterr() == ("", "")
