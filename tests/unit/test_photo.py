"""Photographs as targets: reading, the camera, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from envedit import config
from envedit.core.color import srgb_to_linear
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from envedit.scene import scene
from envedit.targets import target
from envedit.targets.photo import Camera
from tests.oracles.builders import BALL, LIGHT, SENSOR, sky, write_scene

FACTOR = np.log([1.5, 1.2, 0.8])


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """A scene, a map, and its rendering almost without noise."""
    ball = scene.load(write_scene(tmp_path_factory.mktemp("scene"), SENSOR, BALL, LIGHT))
    envmap = sky(np.random.default_rng(1)) * 0.3 + 0.1
    return ball, envmap, ball.render(envmap, spp=1024)


def made(lit, file, **keys):
    ball, envmap, _ = lit
    named = {"file": file if isinstance(file, tuple) else str(file), "align": False}
    settings = config.Target(kind="photo", spp=256, **named | keys)
    return target.make(config.Config(target=settings), ball, envmap)


def taken(lit, file, camera, factor=1):
    images.write_png(file, camera.shown(np.kron(lit[2], np.ones((factor, factor, 1)))))
    return file


@pytest.mark.parametrize("curve", ["srgb", "agx"])
def test_exposure_and_white_balance_are_found_under_the_right_curve(lit, tmp_path, curve):
    found = made(lit, taken(lit, tmp_path / "photo.png", Camera(curve, FACTOR), 3), curve=curve)
    np.testing.assert_allclose(found.photo.camera.log_factor, FACTOR, atol=0.03)
    assert found.photo.curves == (curve,)
    seen = ~found.photo.clipped & (found.photo.values > 0.1)
    assert seen.mean() > 0.3
    np.testing.assert_allclose(found.picture[seen], lit[2][seen], rtol=0.1)
    displayed = found.photo.displayed(found.picture)
    np.testing.assert_allclose(displayed[seen], srgb_to_linear(found.photo.values)[seen], rtol=1e-3)


def test_a_lens_that_darkens_corners_is_undone(lit, tmp_path):
    height, width = lit[2].shape[:2]
    y, x = np.linspace(-height, height, height)[:, None], np.linspace(-width, width, width)
    through = 2.0 ** (-2.0 * (x**2 + y**2) / (height**2 + width**2))[..., None]
    images.write_exr(tmp_path / "photo.exr", (lit[2] * through).astype(np.float32))
    fitting = made(lit, tmp_path / "photo.exr", vignetting=2.0)
    factor = fitting.picture / np.maximum(lit[2], 1e-6)
    assert np.ptp(factor[lit[2] > 0]) < 1e-3 * np.median(factor)
    shown = fitting.photo.displayed(fitting.picture)
    np.testing.assert_allclose(shown, fitting.photo.values, rtol=1e-4, atol=1e-6)
    plain = made(lit, tmp_path / "photo.exr").picture
    assert plain[0, 0].mean() < 0.5 * fitting.picture[0, 0].mean()


def test_what_is_given_of_the_camera_stays_and_linear_files_have_no_curve(lit, tmp_path):
    file = taken(lit, tmp_path / "photo.png", Camera("srgb", FACTOR))
    found = made(lit, file, exposure=1.0, white_balance=4000.0).photo.camera
    assert found.stops == pytest.approx(1.0, abs=1e-6) and found.kelvin == pytest.approx(4000, rel=0.01)
    assert found.curve == "srgb"
    images.write_exr(tmp_path / "photo.exr", 8 * lit[2], panorama=False)
    photo = made(lit, tmp_path / "photo.exr").photo
    assert photo.curves == ("linear",) and not photo.clipped.any()
    assert photo.camera.stops == pytest.approx(3, abs=0.05)


def test_masked_pixels_do_not_count_and_white_is_a_lower_bound(lit, tmp_path):
    values = Camera("srgb", FACTOR).shown(lit[2])
    values[:4] = 1
    images.write_png(tmp_path / "photo.png", values)
    mask = np.ones(values.shape)
    mask[:, -3:] = 0
    images.write_png(tmp_path / "mask.png", mask)
    found = made(lit, tmp_path / "photo.png", mask=str(tmp_path / "mask.png"))
    assert found.photo.clipped[:4].all() and not found.photo.clipped.all()
    np.testing.assert_array_equal(found.weight[..., 0], mask[..., 0])


def test_what_is_known_of_a_photograph_survives_a_checkpoint(lit, tmp_path):
    photo = made(lit, taken(lit, tmp_path / "photo.png", Camera("aces", FACTOR))).photo
    later = replace(photo.under("aces", lit[2], photo.counts), settled=True, recognised=True)
    again = photo.of_array(later.array)
    assert again.camera.curve == "aces" and again.settled and again.recognised
    np.testing.assert_array_equal(again.picture, later.picture)


@pytest.mark.parametrize(("values", "keys", "error", "says"), [
    (np.full((12, 20, 3), 0.5), {}, InputError, "another aspect; crop"),
    (np.zeros((12, 16, 3)), {}, InputError, "neither black nor clipped"),
    (np.ones((12, 16, 3)), {}, InputError, "take another exposure"),
    (np.full((12, 16, 3), 0.5), {"file": ("a.png", "b.png"), "view": ()}, ConfigError, "one file"),
])  # fmt: skip
def test_photographs_that_tell_nothing_are_refused(lit, tmp_path, values, keys, error, says):
    images.write_png(tmp_path / "photo.png", values)
    with pytest.raises(error, match=says):
        made(lit, keys.pop("file", tmp_path / "photo.png"), **keys)


def test_the_configuration_names_what_is_missing():
    with pytest.raises(ConfigError, match="expected the photograph"):
        config.Target(kind="photo")
    with pytest.raises(ConfigError, match=r"target\.curve"):
        config.Target(kind="photo", file="a.png", curve="velvia")
