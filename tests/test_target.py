"""Targets: rendered under a known map, or painted by hand under a stated tonemap."""

import types

import mitsuba as mi
import numpy as np
import pytest
from helpers import BALL, LIGHT, SENSOR, exr, sky, write_scene

from envedit import config, image, latlong, scene, target
from envedit.errors import InputError
from envedit.tonemap import inverse_tonemap, tonemap

FILM = types.SimpleNamespace(width=6, height=4)
"""All that a painted target asks of a scene."""


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return scene.load(write_scene(tmp_path_factory.mktemp("scene"), SENSOR, BALL, LIGHT))


def rendered(**kwargs):
    return config.Target(kind="envmap", spp=4, **kwargs)


def painted(file, **kwargs):
    return config.Target(kind="image", file=str(file), rotate_degrees=0, **kwargs)


def paint(path, picture):
    """Write a picture (H, W, 3), also one that is not finite, as EXR."""
    return exr(path, **{c: np.ascontiguousarray(picture[..., i], np.float32) for i, c in enumerate("RGB")})


def png(path, values):
    mi.Bitmap(np.ascontiguousarray(values)).write(str(path))
    return path


# ---- rendered under a known map --------------------------------------------------------------------------


def test_turned_target_is_the_rendering_of_the_turned_map(ball, rng):
    envmap = sky(rng)
    made = target.make(rendered(rotate_degrees=40), ball, envmap, seed=5)
    np.testing.assert_array_equal(made.envmap, latlong.rotate(envmap, 40).astype(np.float32))
    expected = ball.render(made.envmap, spp=4, seed=5 + target.SEED)
    np.testing.assert_array_equal(made.picture, expected)
    assert made.picture.shape == (12, 16, 3) and made.picture.dtype == made.envmap.dtype == np.float32
    assert made.weight is None and made.warnings == () and "40 degrees" in made.source


def test_a_turn_by_whole_texels_only_moves_columns(ball, rng):
    envmap = sky(rng)
    made = target.make(rendered(rotate_degrees=360 * 3 / 16), ball, envmap, seed=0)
    assert min(np.abs(made.envmap - np.roll(envmap, shift, axis=1)).max() for shift in (3, -3)) < 1e-6
    back = target.make(rendered(rotate_degrees=-360 * 3 / 16), ball, made.envmap, seed=0)
    np.testing.assert_allclose(back.envmap, envmap, atol=1e-6)


def test_target_shares_no_noise_with_other_renderings(ball, rng):
    envmap = sky(rng)
    made = target.make(rendered(rotate_degrees=0), ball, envmap, seed=0)
    assert not np.array_equal(made.picture, ball.render(envmap, spp=4, seed=0))


def test_another_map_is_read_at_the_working_width(ball, tmp_path, rng):
    other = sky(rng, 16, 32)
    other[0, 0, 0] = -1
    file = paint(tmp_path / "other.exr", other)
    made = target.make(rendered(file=str(file)), ball, sky(rng), seed=1)
    expected, info = image.load_envmap(file, 16)
    np.testing.assert_array_equal(made.envmap, expected)
    np.testing.assert_array_equal(made.picture, ball.render(expected, spp=4, seed=1 + target.SEED))
    assert str(file) in made.source
    assert made.warnings == tuple(info["warnings"]) and "negative" in made.warnings[0]


def test_a_map_that_is_not_finite_is_refused_or_repaired(ball, tmp_path, rng):
    other = sky(rng)
    other[3, 4] = np.nan
    settings = rendered(file=str(paint(tmp_path / "other.exr", other)))
    with pytest.raises(InputError, match=r"other\.exr.*row 3, column 4"):
        target.make(settings, ball, sky(rng), seed=0)
    made = target.make(settings, ball, sky(rng), seed=0, repair=True)
    assert np.isfinite(made.picture).all() and np.isfinite(made.envmap).all()


def test_a_missing_map_is_refused(ball, tmp_path, rng):
    with pytest.raises(InputError, match=r"nowhere\.exr"):
        target.make(rendered(file=str(tmp_path / "nowhere.exr")), ball, sky(rng), seed=0)


def test_black_map_makes_a_black_target(ball):
    made = target.make(rendered(rotate_degrees=60), ball, np.zeros((8, 16, 3), np.float32), seed=0)
    assert not made.picture.any()


# ---- painted ---------------------------------------------------------------------------------------------


def test_painted_exr_is_taken_as_it_is(tmp_path, rng):
    picture = (rng.random((4, 6, 3)) * 10).astype(np.float32)
    file = paint(tmp_path / "painted.exr", picture)
    made = target.make(painted(file, tonemap="log"), FILM, None, 0)
    np.testing.assert_array_equal(made.picture, picture)
    assert made.weight is None and made.envmap is None and made.warnings == ()
    assert str(file) in made.source


@pytest.mark.parametrize("name", ["gamma", "srgb", "log", "linear"])
def test_painted_png_is_undone_by_its_tonemap(tmp_path, name):
    values = np.arange(72, dtype=np.uint8).reshape(4, 6, 3) * 3
    values[0, 0] = 255
    made = target.make(painted(png(tmp_path / "p.png", values), tonemap=name), FILM, None, 0)
    np.testing.assert_allclose(made.picture, inverse_tonemap(values / 255, name), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(tonemap(made.picture, name) * 255, values, atol=0.01)
    assert made.picture.dtype == np.float32
    assert any(f"'{name}'" in line and "p.png" in line for line in made.warnings)


@pytest.mark.parametrize("size", [(6, 4), (5, 6), (8, 12)])
def test_picture_of_another_size_is_refused(tmp_path, size):
    file = paint(tmp_path / "painted.exr", np.ones((*size, 3)))
    with pytest.raises(InputError) as info:
        target.make(painted(file), FILM, None, 0)
    message = str(info.value)
    assert "painted.exr" in message and f"{size[1]}x{size[0]}" in message and "6x4" in message
    assert len(message.splitlines()) <= 2 and info.value.exit_code == 3


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_picture_that_is_not_finite_is_refused(tmp_path, value):
    picture = np.ones((4, 6, 3))
    picture[2, 3, 1] = value
    with pytest.raises(InputError, match=r"painted\.exr.*row 2, column 3"):
        target.make(painted(paint(tmp_path / "painted.exr", picture)), FILM, None, 0)


def test_missing_picture_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.png"):
        target.make(painted(tmp_path / "nowhere.png"), FILM, None, 0)


# ---- masks -----------------------------------------------------------------------------------------------


def masked(tmp_path, mask):
    return painted(paint(tmp_path / "painted.exr", np.ones((4, 6, 3))), mask=str(mask))


def test_mask_is_a_weight_for_each_pixel(tmp_path):
    values = np.zeros((4, 6, 3), np.uint8)
    values[1:, :2] = 255
    values[0, 5] = 128
    weight = target.make(masked(tmp_path, png(tmp_path / "mask.png", values)), FILM, None, 0).weight
    assert weight.shape == (4, 6, 1) and weight.dtype == np.float32
    # As painted, half grey counts half; sRGB's curve is undone in float32.
    np.testing.assert_allclose(weight[..., 0], values[..., 0] / 255, atol=1e-6)


def test_mask_beyond_white_counts_as_white(tmp_path):
    values = np.full((4, 6, 3), 7.0)
    values[0] = -3
    weight = target.make(masked(tmp_path, paint(tmp_path / "mask.exr", values)), FILM, None, 0).weight
    assert not weight[0].any() and (weight[1:] == 1).all()


def test_mask_of_another_size_is_refused(tmp_path):
    file = png(tmp_path / "mask.png", np.full((4, 5, 3), 255, np.uint8))
    with pytest.raises(InputError, match=r"mask\.png: is 5x4 pixels, the target is 6x4"):
        target.make(masked(tmp_path, file), FILM, None, 0)


def test_black_mask_is_refused(tmp_path):
    file = png(tmp_path / "mask.png", np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(InputError, match=r"mask\.png: is black everywhere: paint white"):
        target.make(masked(tmp_path, file), FILM, None, 0)


def test_mask_that_is_not_finite_is_refused(tmp_path):
    values = np.ones((4, 6, 3))
    values[3, 1] = np.nan
    with pytest.raises(InputError, match=r"mask\.exr.*row 3, column 1"):
        target.make(masked(tmp_path, paint(tmp_path / "mask.exr", values)), FILM, None, 0)


def test_mask_counts_for_a_rendered_target_too(ball, tmp_path, rng):
    values = np.zeros((12, 16, 3), np.uint8)
    values[:6] = 255
    settings = rendered(rotate_degrees=30, mask=str(png(tmp_path / "m.png", values)))
    made = target.make(settings, ball, sky(rng), 0)
    assert made.weight is not None
    np.testing.assert_allclose(made.weight[..., 0], values[..., 0] / 255, atol=1e-6)  # sRGB undone in float32
