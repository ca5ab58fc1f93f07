"""Looks: what is measured of an edit is what it did, and a map in its light has that light."""

import json

import numpy as np
import pytest

from envedit.cli import main as cli
from envedit.core import latlong
from envedit.core.color import LUMINANCE
from envedit.core.errors import ConfigError
from envedit.images import images
from envedit.maps import look_transfer, looks
from envedit.maps.looks import Look, RoleLight
from envedit.representations.layers.placed_lights import direction

EVENING = Look(
    gain=np.array([-3.5, 0.6, 0.2, -0.3, 0, 0, 0, 0, 0]),
    saturation=1.3,
    white_balance=(0.3, 0.0, -0.4),
    lights={"key": RoleLight(220.0, 24.0, 2.5, 0.0, (1.6, 0.89, 0.2))},
)


def sky(sun, exposure=1.0, width=64):
    """Return a sky that is brighter at the horizon, of blue and grey patches, with a sun or without."""
    d = latlong.directions(width // 2, width)
    patches = np.sin(9 * d[..., 0]) * np.sin(7 * d[..., 2] + 1)
    envmap = (0.5 + 0.4 * (1 - np.abs(d[..., 1])))[..., None] * (1 + 0.3 * patches[..., None] * [-1, 0.1, 1])
    if sun:
        apart = np.degrees(np.arccos(np.clip(d @ direction(100, 40), -1, 1)))
        envmap += (900 * (apart < 3) + 3 * np.exp(-apart / 12))[..., None] * [1.1, 1.0, 0.8]
    return (exposure * envmap).astype(np.float32)


def key_of(envmap, toward, degrees=15.0):
    """Measure, without layers, a key light's flux over the sky's irradiance, in stops, and its direction.

    Its light is what is above 20 times the mean of the sky within some degrees of where it should be.
    """
    height, width, _ = envmap.shape
    d = latlong.directions(height, width)
    omega = latlong.lookup_solid_angles(height, width)[:, None]
    light = envmap @ LUMINANCE
    near = d @ toward > np.cos(np.radians(degrees))
    core = near & (light > 20 * np.median(light))
    flux = (light * omega)[core].sum()
    rest = (np.where(core, 0, light) * omega * np.maximum(d[..., 1], 0)).sum()
    centre = (d * (light * omega * core)[..., None]).sum(axis=(0, 1))
    return np.log2(flux / rest), centre / np.linalg.norm(centre)


@pytest.mark.parametrize("sun", [True, False])
def test_a_map_has_the_key_light_that_the_look_says(sun):
    toward = EVENING.toward("key")
    stops, centre = key_of(look_transfer.apply(sky(sun, exposure=30), EVENING), toward)
    assert stops == pytest.approx(2.5, abs=0.1)
    assert np.degrees(np.arccos(centre @ toward)) < 1


@pytest.mark.slow
def test_the_look_of_an_edit_is_what_it_did():
    before = sky(True)
    look = look_transfer.of_edit(before, look_transfer.apply(before, EVENING))
    key, expected = look.lights["key"], EVENING.lights["key"]
    assert (key.azimuth, key.elevation) == pytest.approx((220, 24), abs=1)
    assert key.flux == pytest.approx(expected.flux, abs=0.1) and key.radius == 0
    np.testing.assert_allclose(key.tint, expected.tint, atol=0.1)
    upper = latlong.directions(32, 64)[:14].reshape(-1, 3)
    np.testing.assert_allclose(looks.harmonics(upper) @ (look.gain - EVENING.gain), 0, atol=0.2)
    np.testing.assert_allclose(look.white_balance, EVENING.white_balance, atol=0.1)
    assert look.saturation == pytest.approx(1.3, abs=0.15)


@pytest.mark.slow
def test_no_edit_is_a_look_that_changes_nothing():
    before = sky(True)
    look = look_transfer.of_edit(before, before)
    assert not look.gain.any() and look.saturation == 1 and look.turn == 0
    np.testing.assert_allclose(look_transfer.apply(before, look), before, rtol=1e-3)
    assert look_transfer.apply(before, EVENING, amount=0) is before


@pytest.mark.slow
def test_a_turned_sky_is_turned_until_its_key_light_stands_there():
    before = sky(True)
    look = look_transfer.of_edit(before, latlong.rotate(before, 45), 45)
    assert look.turn == 45 and look.lights["key"].azimuth == pytest.approx(55, abs=2)
    other = latlong.rotate(before, 90)
    made = look_transfer.apply(other, look)
    expected = latlong.rotate(before, 45)
    assert np.median(np.abs(made / expected - 1)) < 0.02


@pytest.mark.slow
def test_between_two_looks_the_light_goes_along_a_great_circle():
    noon = Look(lights={"key": RoleLight(100.0, 60.0, 3.0, 0.0, (1.0, 1.0, 1.0))})
    stops = {}
    for amount in (0.0, 0.5, 1.0):
        made = look_transfer.apply(sky(True), EVENING, amount, noon)
        middle = (1 - amount) * noon.toward("key") + amount * EVENING.toward("key")
        middle = EVENING.toward("key") if amount == 1 else middle / np.linalg.norm(middle)
        stops[amount], centre = key_of(made, middle)
        assert np.degrees(np.arccos(min(centre @ middle, 1))) < 1.5
    assert stops[0.0] == pytest.approx(3, abs=0.1) and stops[1.0] == pytest.approx(2.5, abs=0.1)


def test_half_a_look_has_one_sun():
    strong = Look(lights={"key": RoleLight(220.0, 24.0, 6.0, 0.0, (1.0, 1.0, 1.0))})
    made = look_transfer.apply(sky(True), strong, 0.5)
    middle = direction(100, 40) + strong.toward("key")
    middle /= np.linalg.norm(middle)
    bright = made @ LUMINANCE > 0.2 * (made @ LUMINANCE).max()
    assert (latlong.directions(32, 64)[bright] @ middle).min() > np.cos(np.radians(12))


def test_a_look_without_lights_puts_out_the_sun():
    made = look_transfer.apply(sky(True), Look())
    assert made.max() < 5 and made.mean() > 0.4


@pytest.mark.parametrize("level", [0.0, 1e-30, 1e6])
def test_extreme_maps_stay_finite(level):
    made = look_transfer.apply(np.full((16, 32, 3), level, np.float32), EVENING)
    assert np.isfinite(made).all() and (made.max() > 0) == (level > 0)


def test_a_file_holds_the_look_and_a_bad_one_names_its_key(tmp_path):
    path = tmp_path / "look.toml"
    looks.write(path, EVENING)
    again = looks.read(path)
    assert again.lights == EVENING.lights and again.white_balance == EVENING.white_balance
    np.testing.assert_array_equal(again.gain, EVENING.gain)
    text = path.read_text()
    for old, new, message in (
        ("saturation = 1.3", "saturation = nan", r"look.toml: saturation: got nan, expected a finite number"),
        ("flux = 2.5", "flux = true", r"look.toml: key.flux: got true, expected a number of at least -16"),
        ("tint = [1.6, 0.89, 0.2]", "tint = [1, 2]", r"key.tint: got \[1, 2\], expected a list of 3 numbers"),
        ("tint = [1.6, 0.89, 0.2]", "tint = [0, 0, 0]", "key.tint: got black"),
        ("[key]", "[rim]", r"rim: needs a key light beside it: add the table \[key\]"),
        ("turn", "torn", "look.toml: torn: unknown key"),
        ("radius = 0.0", "", "look.toml: key.radius: missing"),
        ("[key]", "[key", "look.toml: not TOML"),
        ("[key]", f"a = {'9' * 5000}", "look.toml: not TOML"),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(ConfigError, match=message):
            looks.read(path)


@pytest.mark.slow
def test_the_command_writes_maps_of_the_files_own_size_and_format(tmp_path, here, capsys):
    looks.write("evening.toml", EVENING)
    images.write_exr("a.exr", sky(True), half=True)
    images.write_hdr("b.hdr", sky(False))
    assert cli.main(["apply", "evening.toml", "a.exr", "b.hdr", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [entry["file"] for entry in facts["files"]] == ["evening_applied/a.exr", "evening_applied/b.hdr"]
    assert images.read("evening_applied/a.exr")[0].shape == (32, 64, 3)
    assert cli.main(["apply", "evening.toml", "a.exr"]) == 2
    assert "evening_applied/a.exr: exists already: give another folder" in capsys.readouterr().err
    assert cli.main(["apply", "evening.toml", "a.exr", "--out", "b.hdr"]) == 3  # a file, where a folder goes
    assert cli.main(["apply", "evening.toml", "a.exr", "--frames", "2", "--out", "frames"]) == 0
    looks.write("noon.toml", EVENING)
    between = ["noon.toml", "evening.toml", "b.hdr", "--amount", "0", "--out", "between"]
    capsys.readouterr()
    assert cli.main(["apply", *between]) == 0
    assert "b.hdr in the light of noon.toml to evening.toml, amount 0" in capsys.readouterr().out
    frames = [images.read(f"frames/a_{i:04d}.exr")[0] for i in (1, 2)]
    assert np.array_equal(frames[0], images.read("a.exr")[0]) and not np.allclose(*frames)
    for wrong, message in (
        (["evening.toml"], "got 1 look (.toml) and 0 maps"),
        (["evening.toml", "evening.toml", "a.exr"], "got two looks: say where between them"),
        (["none.toml", "a.exr", "--out", "other"], "none.toml: No such file"),
        (["evening.toml", "none.exr", "--out", "other"], "none.exr: no such file"),
    ):
        assert cli.main(["apply", *wrong]) in (2, 3)
        assert message in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
