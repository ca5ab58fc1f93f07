"""``envedit adjust``: rotations that keep flux, a blur on the sphere, files that keep their format."""

import json

import numpy as np
import pytest

from envedit.cli import adjust
from envedit.core import latlong, primaries
from envedit.core.color import luminance
from envedit.core.rotations import Orientation
from envedit.images import images
from envedit.maps import map_file
from envedit.maps.adjusted import Adjustments, adjusted, blur
from envedit.representations.layers import oriented
from tests.oracles.maps import flux

HEIGHT, WIDTH = 64, 128


def sunny(rng, at=(20, 33), peak=20000.0):
    envmap = rng.uniform(0.2, 0.4, (HEIGHT, WIDTH, 3)).astype(np.float32)
    envmap[at] = peak, 0.8 * peak, 0.6 * peak
    return envmap


def brightest(envmap):
    return latlong.directions(*envmap.shape[:2]).reshape(-1, 3)[luminance(envmap).argmax()]


@pytest.mark.parametrize("at", [(20, 33), (1, 5), (33, 127), (62, 70)])
@pytest.mark.parametrize("angles", [(0, 20, 0), (0, 0, 35), (77.7, -50, 61.3), (0, 180, 0), (0, 0, 90)])
def test_a_sun_of_one_texel_keeps_its_flux_and_goes_where_it_is_rotated(at, angles, rng):
    envmap = sunny(rng, at)
    matrix = Orientation(*angles).matrix
    rotated = oriented.oriented(envmap, Orientation(*angles))
    sky = flux(np.where(envmap > 1, 0.3, envmap))
    assert rotated.min() >= 0
    np.testing.assert_allclose(flux(rotated) - sky, flux(envmap) - sky, rtol=2e-3)
    assert brightest(rotated) @ matrix @ brightest(envmap) > np.cos(1.5 * np.pi / HEIGHT)


def test_what_is_no_light_keeps_its_flux_nearly(rng):
    envmap = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    envmap[24, 50] = 1
    rotated = oriented.resampled(envmap, Orientation(10, 30, 50).matrix, (0, HEIGHT), (0, HEIGHT), 2)
    np.testing.assert_allclose(flux(rotated), flux(envmap), rtol=0.04)


def test_the_middle_is_raised_and_clockwise_is_clockwise():
    middle, right = np.array([0, 0, 1.0]), np.array([-1.0, 0, 0])
    assert (Orientation(horizon=30).matrix @ middle)[1] == pytest.approx(0.5)
    assert (Orientation(tilt=30).matrix @ right)[1] == pytest.approx(-0.5)
    d = latlong.directions(HEIGHT, WIDTH)
    np.testing.assert_allclose(latlong.rotate(d, 90) @ Orientation(turn=90).matrix.T, d, atol=1e-12)


@pytest.mark.parametrize("degrees", [3.0, 20.0, 120.0])
def test_a_blur_keeps_flux_and_a_constant_and_has_the_width_that_is_asked(degrees, rng):
    even = np.full((HEIGHT, WIDTH, 3), 0.7, np.float32)
    np.testing.assert_allclose(blur(even, degrees), even, rtol=1e-6)
    envmap = np.zeros_like(even)
    envmap[20, 33] = 1
    blurred = blur(envmap, degrees)
    np.testing.assert_allclose(flux(blurred), flux(envmap), rtol=1e-5)
    if degrees < 30:  # mean of 1 - cos is s^2 on the plane
        cosine = latlong.directions(HEIGHT, WIDTH) @ latlong.directions(HEIGHT, WIDTH)[20, 33]
        spread = flux((1 - cosine[..., None]) * blurred)[0] / flux(blurred)[0]
        assert np.degrees(np.sqrt(spread)) == pytest.approx(degrees, rel=0.05)


def test_saturation_keeps_luminance_and_zero_is_grey(rng):
    envmap = rng.uniform(0.2, 1, (6, 12, 3)).astype(np.float32)
    grey, _ = adjusted(envmap, Adjustments(saturation=0.0))
    np.testing.assert_allclose(grey, luminance(envmap)[..., None] * np.ones(3), rtol=1e-6)
    vivid, _ = adjusted(envmap, Adjustments(saturation=1.1))
    np.testing.assert_allclose(luminance(vivid), luminance(envmap), rtol=1e-6)


@pytest.mark.parametrize("value", [0.0, 1e-30, 65504.0, 1e6])
def test_an_even_map_stays_even(value):
    envmap = np.full((8, 16, 3), value, np.float32)
    how = Adjustments(turn=10, tilt=20, horizon=30, saturation=0.5, blur=5, soften=2, max_radiance=1e7)
    found, _ = adjusted(envmap, how)
    np.testing.assert_allclose(found, envmap, rtol=1e-5)


@pytest.mark.slow
def test_the_command_keeps_format_and_colour_space_and_writes_a_backplate(rng, capsys, here):
    sky = sunny(rng, peak=500.0)
    images.write_exr("sky.exr", sky, half=True, chromaticities=primaries.ACES_AP1)
    plate = ["--background", "plate.exr", "--background-exposure", "-2"]
    assert adjust.main(["sky.exr", "--exposure", "1", *plate, "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert files == {"map": "sky_adjusted.exr", "background": "plate.exr"}
    before, after, plate = (map_file.read(name) for name in ("sky.exr", "sky_adjusted.exr", "plate.exr"))
    assert after.half and after.chromaticities is not None
    np.testing.assert_allclose(after.stored, 2 * before.stored, rtol=2e-3, atol=1e-3)
    np.testing.assert_allclose(plate.stored, 0.5 * before.stored, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize(("options", "code", "says"), [
    ([], 2, "nothing to adjust: give one of --turn"),
    (["--blur", "1", "--out", "sky.hdr"], 2, "sky.hdr: is read by this command"),
    (["--blur", "1", "--background-blur", "2"], 2, "need --background OUT"),
    (["--blur", "1", "--out", "a.exr", "--background", "a.exr"], 2, "where the map itself goes"),
    (["--exposure", "100", "--out", "a.exr"], 5, "leaves float32"),
])  # fmt: skip
def test_bad_options_are_one_line(options, code, says, rng, tmp_path, capsys, here):
    images.write_hdr("sky.hdr", 1e10 * sunny(rng))
    assert adjust.main(["sky.hdr", *options]) == code
    err = capsys.readouterr().err
    assert says in err and len(err.splitlines()) == 1 and not (tmp_path / "a.exr").exists()


@pytest.mark.parametrize(("program", "width", "said"), [
    ("blender", 128, False), ("blender", 90, True), ("unreal", 90, False), ("usd", 90, False)
])  # fmt: skip
def test_what_is_interpolated_for_a_program_is_said(program, width, said, rng, capsys, here):
    envmap = rng.random((width // 2, width, 3), dtype=np.float32)
    images.write_exr("sky.exr", envmap)
    assert adjust.main(["sky.exr", "--for", program]) == 0
    turned, _ = images.load_envmap("sky_adjusted.exr")
    assert np.isin(turned, envmap).all() != said
    out = capsys.readouterr().out
    line = f"interpolated between columns for {program}: 4 does not divide the width, {width}"
    assert (line in out) == said


def test_a_number_out_of_range_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as stop:
        adjust.main(["sky.hdr", "--horizon", "nan"])
    assert stop.value.code == 2
    assert "--horizon: got nan, expected a number from -90 to 90" in capsys.readouterr().err
