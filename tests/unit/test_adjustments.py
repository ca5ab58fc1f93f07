"""Adjustments of a map without a target: exposure, white balance, softer and less bright lights."""

import numpy as np
import pytest

from envedit import config
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.core.errors import NumericalError
from envedit.export import adjustments
from envedit.images import images
from envedit.targets.strokes import balance, gains
from tests.oracles import users_scenes
from tests.oracles.maps import flux
from tests.oracles.runs import call, changed, measured, pixels

HEIGHT, WIDTH = 64, 128


def sunny(rng, value=5000.0, at=(12, 3)):
    envmap = (0.5 + 0.05 * rng.random((HEIGHT, WIDTH, 3))).astype(np.float32)
    envmap[at] = [value, 0.8 * value, 0.6 * value]
    return envmap


def adjusted(envmap, scale=1.0, lights=None, **output):
    return adjustments.adjust(envmap, config.Lights(**lights or {}), config.Output(**output), scale)


def test_nothing_asked_changes_no_bit(rng):
    envmap = sunny(rng)
    found, notes = adjusted(envmap)
    assert found is envmap and not notes


@pytest.mark.parametrize("stops", [-3.0, 0.5, 10.0])
def test_a_stop_is_a_factor_of_two(stops, rng):
    envmap = sunny(rng)
    np.testing.assert_allclose(adjusted(envmap, exposure=stops)[0], envmap * 2**stops, rtol=1e-6)


def test_an_exposure_beyond_single_precision_is_refused(rng):
    with pytest.raises(NumericalError, match="lower output.exposure"):
        adjusted(sunny(rng, 1e30), exposure=60.0)


@pytest.mark.parametrize("kelvin", [2500.0, 6500.0, 12000.0])
def test_light_of_that_temperature_becomes_neutral(kelvin):
    envmap = np.float32(0.7) * np.ones((HEIGHT, WIDTH, 3), np.float32) * gains(kelvin).astype(np.float32)
    found, _ = adjusted(envmap, white_balance=kelvin)
    np.testing.assert_allclose(found, found[..., :1] * np.ones(3), rtol=1e-5)
    np.testing.assert_allclose(luminance(balance(kelvin)), 1, rtol=1e-9)
    if kelvin == 6500:
        np.testing.assert_allclose(found, envmap, rtol=1e-6)


@pytest.mark.parametrize("at", [(12, 3), (1, 100), (0, 5), (32, 127), (63, 0)])
@pytest.mark.parametrize("degrees", [1.0, 5.0, 40.0])
def test_a_spread_light_keeps_its_flux_and_its_disc(at, degrees):
    core = np.zeros((HEIGHT, WIDTH, 3))
    core[at] = [900, 500, 1e-3]
    found = adjustments.spread(core, degrees)
    np.testing.assert_allclose(flux(found), flux(core), rtol=1e-9)
    d = latlong.directions(HEIGHT, WIDTH)
    angle = np.degrees(np.arccos(np.clip(d @ d[at], -1, 1)))
    assert (found >= 0).all() and not found[angle > degrees + 1e-3].any()
    if degrees < 2 and at[0] in (12, 32):  # nearer to a pole columns lie closer
        np.testing.assert_allclose(found, core, rtol=1e-9)
    else:
        expected = np.maximum(1 - (1 - np.cos(np.radians(angle))) / (1 - np.cos(np.radians(degrees))), 0)
        share = found[..., 0] / found[..., 0].max()
        np.testing.assert_allclose(share, expected / expected.max(), atol=1e-6)


def test_a_light_spread_on_a_coarser_grid_is_the_same_disc():
    core = np.zeros((256, 512, 3))
    core[40:44, 100:103] = [900, 500, 1e-3]
    degrees = 30.0  # 43 texels: more than SPREAD_TEXELS
    found, fine = adjustments.spread(core, degrees), adjustments._spread(core, degrees)
    np.testing.assert_allclose(flux(found), flux(core), rtol=1e-5)
    np.testing.assert_allclose(found / fine.max((0, 1)), fine / fine.max((0, 1)), atol=0.01)


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_no_texel_of_the_file_is_above_the_bound_and_the_light_is_kept(scale, rng):
    envmap = sunny(rng)
    found, notes = adjusted(envmap, scale, {"max_radiance": 50.0})
    assert found.max() <= 50.0 * scale and found.max() > 40 * scale
    np.testing.assert_allclose(flux(found), flux(envmap), rtol=1e-5)
    assert "light 1 spread over" in " ".join(notes) and "are cut" not in " ".join(notes)
    far = latlong.directions(HEIGHT, WIDTH) @ latlong.directions(HEIGHT, WIDTH)[12, 3] < 0.5
    assert (found[far] == envmap[far]).all()


def test_what_is_no_light_is_cut_with_a_note(rng):
    found, notes = adjusted(sunny(rng), lights={"max_radiance": 0.52})
    assert found.max() <= np.float32(0.52) and "and cut: " in notes[-1]


def test_lights_are_softened_where_there_are_some(rng):
    envmap = sunny(rng)
    found, notes = adjusted(envmap, lights={"soften_degrees": 8.0})
    np.testing.assert_allclose(flux(found), flux(envmap), rtol=1e-5)
    assert notes == ["1 light softened by 8 degrees"] and found[12, 3].max() < 0.1 * envmap[12, 3].max()
    envmap = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    found, notes = adjusted(envmap, lights={"soften_degrees": 8.0})
    np.testing.assert_array_equal(found, envmap)
    assert notes == ["no light was found: lights.soften_degrees changes nothing"]


@pytest.mark.parametrize("value", [0.0, 1e-30])
def test_a_dark_map_stays_dark(value):
    envmap = np.full((8, 16, 3), value, np.float32)
    found, _ = adjusted(envmap, lights={"max_radiance": 5.0, "soften_degrees": 3.0}, exposure=1.0)
    np.testing.assert_allclose(found, 2 * envmap)


@pytest.mark.slow
def test_a_run_without_a_target(tmp_path, isolated, capsys):
    """The map of the scene at the file's size, a stop brighter; nothing is traced."""
    parts = users_scenes.PATH, users_scenes.SENSOR, users_scenes.BALL, users_scenes.light(3)
    users_scenes.write(tmp_path, parts)
    large = np.random.default_rng(2).random((32, 64, 3)).astype(np.float32)
    images.write_exr(tmp_path / "own.exr", large)
    keys = {"target__kind": "none", "output__exposure": 1.0, "output__spp": 64, "input__width": 16}
    out = tmp_path / "out"
    assert call(tmp_path / "scene.xml", *changed(**keys, scene__width=16), "--out", str(out)) == 0
    found = measured(out)
    np.testing.assert_allclose(pixels(out / "edited_full.exr"), 2 * large, rtol=1e-6)
    ratio = pixels(out / "render_edited.exr").mean() / pixels(out / "render_initial.exr").mean()
    assert ratio == pytest.approx(2, rel=0.02) and found["transport"] is None and found["iterations"] == 0
    assert "exposure of the map changed by +1 stops" in found["choices"]
    assert "no target; log RMSE of the rendering against the initial one 0." in capsys.readouterr().out
    assert (out / "report.html").exists() and (out / "edited.xml").exists()


def test_temperature_is_the_inverse_of_white_balance_and_less_is_warmer():
    grey = np.full((4, 8, 3), 0.5, np.float32)
    warm, notes = adjustments.adjust(grey, config.Lights(), config.Output(temperature=3200.0))
    assert warm[0, 0, 0] > 0.5 > warm[0, 0, 2]
    assert notes == ["temperature: light of 3200 K in place of 6500 K"]
    back, _ = adjustments.adjust(warm, config.Lights(), config.Output(white_balance=3200.0))
    ratio = back / grey
    assert np.allclose(ratio, ratio[0, 0, 0], rtol=1e-5)
    assert np.allclose(grey * gains(3200.0), warm, rtol=1e-5), "not as a stroke of that temperature"
