"""A clipped sun is found, estimated and put back; clouds and lamps are left alone."""

import functools
import json

import numpy as np
import pytest

from envedit import config, inputs
from envedit.cli import main
from envedit.core import latlong
from envedit.core.color import linear_to_srgb, luminance
from envedit.images import images
from envedit.images.analytic_sky import sunsky
from envedit.representations.layers import clipped_light, unclip

WIDTH = 512
OMEGA = latlong.lookup_solid_angles(WIDTH // 2, WIDTH)[:, None, None]
DIRECTIONS = latlong.directions(WIDTH // 2, WIDTH)


def direction_of(azimuth, elevation):
    return latlong.on_sphere(np.radians(90 - elevation), np.radians(azimuth))


@functools.cache
def unclipped(azimuth, elevation):
    """A clear sky with a lens' glare, 2^AUREOLE of the flux, as in photographs; and the sun's flux."""
    sky = sunsky(WIDTH, azimuth, elevation, sun_scale=0).astype(np.float64)
    both = sunsky(WIDTH, azimuth, elevation).astype(np.float64)
    flux = ((both - sky) * OMEGA).sum(axis=(0, 1))
    angle = np.degrees(np.arccos(np.clip(DIRECTIONS @ direction_of(azimuth, elevation), -1, 1)))
    table = np.log(clipped_light.RING_DEGREES[: len(unclip.AUREOLE)])
    glare = 2 ** np.interp(np.log(np.maximum(angle, 0.1)), table, unclip.AUREOLE)
    return both + glare[..., None] * flux, flux


def sun(azimuth=180.0, elevation=40.0, clip=None):
    envmap, flux = unclipped(azimuth, elevation)
    return (envmap if clip is None else np.minimum(envmap, clip)).astype(np.float32), flux


def overcast():
    """The CIE's overcast sky, three times as bright at the zenith, over a dark ground."""
    height = DIRECTIONS[..., 1:2]
    return np.where(height > 0, (1 + 2 * height) / 3, 0.1).repeat(3, axis=2).astype(np.float32)


def of_file(tmp_path, envmap, *options, name="sky.exr"):
    images.write_exr(tmp_path / name, envmap)
    return main.main(["unclip", str(tmp_path / name), "--out", str(tmp_path / "out.exr"), "--json", *options])


@pytest.mark.parametrize("azimuth", [180.0, 0.2])
@pytest.mark.parametrize("clip", [5.0, 30.0])
def test_a_clipped_sun_is_found_with_its_flux_across_the_seam_as_well(azimuth, clip):
    image, flux = sun(azimuth, clip=clip)
    light = clipped_light.find(image)
    assert light.kind == "sun"
    assert light.direction @ direction_of(azimuth, 40.0) > np.cos(np.radians(0.5))
    estimate = unclip.estimate(light)
    assert abs(np.log2(luminance(estimate.flux) / luminance(flux))) < estimate.stops
    restored = unclip.restored(image, light, estimate.flux)
    gained = ((restored.astype(np.float64) - image) * OMEGA).sum(axis=(0, 1))
    assert luminance(gained) == pytest.approx(luminance(estimate.flux), rel=0.15)  # and some of the aureole
    near = DIRECTIONS @ light.direction > np.cos(np.radians(8))
    assert np.array_equal(restored[~near], image[~near])


@pytest.mark.parametrize("exposure", [1e-30, 64.0, 1e25])
def test_exposure_does_not_matter(exposure):
    image, _ = sun(clip=20.0)
    light = clipped_light.find(image)
    exposed = clipped_light.find(image * np.float32(exposure))
    assert exposed.kind == light.kind == "sun"
    found, expected = unclip.estimate(exposed).flux, exposure * unclip.estimate(light).flux
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_a_sun_that_is_not_clipped_gets_nothing():
    image, _ = sun()
    light = clipped_light.find(image)
    assert light is None or not unclip.is_clipped(light, unclip.estimate(light).flux)
    assert np.array_equal(unclip.with_sun(image)[0], image)


def test_an_eight_bit_picture_of_a_sun_gets_it_back(tmp_path, capsys):
    image, flux = sun(elevation=55.0)
    exposure = 0.3 / np.median(luminance(image[: WIDTH // 4]))
    images.write_png(tmp_path / "sky.png", linear_to_srgb(exposure * image))
    assert main.main(["unclip", str(tmp_path / "sky.png"), "--out", str(tmp_path / "a.exr"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["added"] and facts["light"]["kind"] == "sun"
    assert abs(np.log2(luminance(facts["flux"]) / luminance(exposure * flux))) < 2 * facts["stops"]


def test_a_map_is_unclipped_at_file_size_when_it_is_read(tmp_path):
    image, _ = sun(clip=30.0)
    images.write_exr(tmp_path / "sky.exr", image)
    read = inputs.read_map(config.Input(envmap=str(tmp_path / "sky.exr"), unclip=True), None, 64)
    np.testing.assert_allclose(read.radiance, latlong.resize(unclip.with_sun(image)[0], 32, 64), rtol=1e-6)
    assert read.unclipped.startswith("sun of flux")


@pytest.mark.slow
def test_cloud_and_lamp_are_named_and_left_alone(tmp_path, capsys):
    room = np.full((WIDTH // 2, WIDTH, 3), 0.01, np.float32)
    room[60:80, 100:130] = 50
    for envmap, kind in ((np.minimum(overcast(), 0.8), "cloud"), (room, "lamp")):
        assert of_file(tmp_path, envmap) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["light"]["kind"] == kind and not facts["added"] and not (tmp_path / "out.exr").exists()


@pytest.mark.parametrize("shape", [(3, 6), (256, 512)])
def test_a_black_map_and_one_bright_texel_are_no_sun(shape, tmp_path, capsys):
    black = np.zeros((*shape, 3), np.float32)
    assert of_file(tmp_path, black) == 0
    assert json.loads(capsys.readouterr().out)["light"] is None
    black[1, 1] = 65504
    assert of_file(tmp_path, black) == 0
    assert not json.loads(capsys.readouterr().out)["added"]


@pytest.mark.slow
def test_the_ratio_to_the_sky_and_the_flux_are_as_asked(tmp_path, capsys):
    image, _ = sun(clip=30.0)
    cosine = np.maximum(DIRECTIONS[..., 1:2], 0)
    assert of_file(tmp_path, image, "--ratio", "3") == 0
    out = images.read(tmp_path / "out.exr")[0].astype(np.float64)
    added = luminance(((out - image) * OMEGA * cosine).sum(axis=(0, 1)))
    sky = luminance((image * OMEGA * cosine).sum(axis=(0, 1)))
    assert added / sky == pytest.approx(3, rel=0.1)
    assert of_file(tmp_path, overcast(), "--flux", "1", "2", "3", "--overwrite") == 0
    out = images.read(tmp_path / "out.exr")[0].astype(np.float64)
    np.testing.assert_allclose(((out - overcast()) * OMEGA).sum(axis=(0, 1)), [1, 2, 3], rtol=0.02)
    capsys.readouterr()


def test_a_light_in_a_black_sky_gets_what_is_asked_for(tmp_path, capsys):
    black = np.zeros((64, 128, 3), np.float32)
    black[20:22, 40:43] = 1
    assert of_file(tmp_path, black, "--flux", "5") == 0
    flux = json.loads(capsys.readouterr().out)["flux"]
    assert luminance(np.array(flux)) == pytest.approx(5) and min(flux) > 1
    out = images.read(tmp_path / "out.exr")[0].astype(np.float64)
    omega = latlong.lookup_solid_angles(64, 128)[:, None, None]
    assert luminance((out * omega).sum(axis=(0, 1))) == pytest.approx(5, rel=0.02)
    assert of_file(tmp_path, black, "--ratio", "3", "--overwrite") == 0
    assert json.loads(capsys.readouterr().out)["ratio"] == pytest.approx(3)


@pytest.mark.parametrize("option", ["--flux", "--ratio"])
def test_in_a_sky_that_is_clipped_all_over_a_sun_has_the_colour_of_the_analytic_one(option, tmp_path, capsys):
    white = np.full((32, 64, 3), 0.5, np.float32)
    assert of_file(tmp_path, white, option, "3") == 0
    added = images.read(tmp_path / "out.exr")[0].astype(np.float64) - white
    flux = (added * latlong.lookup_solid_angles(32, 64)[:, None, None]).sum(axis=(0, 1))
    facts = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(flux, facts["flux"], rtol=0.02)
    sun, _ = unclip.analytic_fluxes(facts["light"]["elevation"])
    np.testing.assert_allclose(flux / luminance(flux), sun / luminance(sun), rtol=0.02)


@pytest.mark.parametrize("flux", [["1", "2"], ["0"]])
def test_a_flux_of_two_numbers_or_of_nothing_is_refused(flux, tmp_path, capsys):
    assert of_file(tmp_path, overcast(), "--flux", *flux) == 2
    assert "expected 1 or 3 numbers above 0" in json.loads(capsys.readouterr().out)["error"]
