"""``envedit blend``: one sun on a great circle, skies in log radiance, the maps themselves at either end."""

import json

import numpy as np
import pytest

from envedit.cli import blend
from envedit.core import latlong
from envedit.export import light_list
from envedit.images import images
from envedit.maps import blended
from envedit.representations.layers import file_lights

HEIGHT, WIDTH = 64, 128


def sky(at, peak, level):
    """Return a map in the memory layout of one that was read from a Radiance file."""
    envmap = np.full((HEIGHT, 3, WIDTH), level, np.float32).transpose(0, 2, 1)
    if at:
        envmap[at] = np.float32([1, 0.8, 0.6]) * peak
    return envmap


def lights_of(envmap):
    return light_list.listed(file_lights.lights_of(envmap), envmap.shape[:2], np.eye(3))


@pytest.mark.parametrize("amount", [0.25, 0.5, 0.9])
def test_one_sun_moves_on_a_great_circle_and_its_flux_changes_geometrically(amount):
    first, second = sky((12, 30), 20000, 0.2), sky((25, 70), 3000, 0.8)
    ends = [lights_of(one)[0] for one in (first, second)]
    mixed, listed = blended.blend(first, second, amount)
    (light,) = lights_of(mixed)
    flux = np.array(ends[0]["flux"]) ** (1 - amount) * np.array(ends[1]["flux"]) ** amount
    np.testing.assert_allclose(light["flux"], flux, rtol=5e-3)
    np.testing.assert_allclose(listed[0]["flux"], flux, rtol=1e-6)
    a, b = (np.array(end["direction"]) for end in ends)
    whole = np.arccos(a @ b)
    at = (np.sin((1 - amount) * whole) * a + np.sin(amount * whole) * b) / np.sin(whole)
    assert np.degrees(np.arccos(at @ light["direction"])) < 180 / HEIGHT
    far = latlong.directions(HEIGHT, WIDTH) @ at < 0.9
    np.testing.assert_allclose(mixed[far], 0.2 ** (1 - amount) * 0.8**amount, rtol=1e-3)


@pytest.mark.parametrize("other", [20000, 0])
def test_a_light_that_does_not_move_keeps_its_shape(other):
    """Between a map and itself, and where it fades."""
    first, second = sky((12, 30), 20000, 0.2), sky((12, 30) if other else None, other, 0.2)
    expected = first * 1.0
    expected[12, 30] = (expected[12, 30] - 0.2) * (1 if other else 0.5) + 0.2
    np.testing.assert_allclose(blended.blend(first, second, 0.5)[0], expected, rtol=1e-5)


def test_a_light_without_a_partner_fades_where_it_is():
    first, second = sky((12, 30), 20000, 0.2), sky(None, 0, 0.2)
    (before,) = lights_of(first)
    mixed, _ = blended.blend(first, second, 0.75)
    (after,) = lights_of(mixed)
    np.testing.assert_allclose(after["flux"], 0.25 * np.array(before["flux"]), rtol=5e-3)
    np.testing.assert_allclose(after["direction"], before["direction"], atol=0.02)


def test_a_red_sun_that_moves_leaves_no_stain():
    first, second = sky(None, 0, 0.2), sky(None, 0, 0.2)
    first[12, 30] = second[25, 70] = [6500, 1000, 0]
    mixed, _ = blended.blend(first, second, 0.5)
    np.testing.assert_allclose(mixed[[12, 25], [30, 70]], 0.2, rtol=1e-3)


@pytest.mark.parametrize("level", [0.0, 1e-30, 1e6])
def test_black_and_bright_maps_stay_finite(level):
    mixed, _ = blended.blend(sky((12, 30), 20000, 0.2), sky(None, 0, level), 0.5)
    assert np.isfinite(mixed).all() and mixed.min() >= 0


def run(tmp_path, capsys, *options):
    code = blend.main([str(tmp_path / "a.exr"), str(tmp_path / "b.exr"), "--json", *options])
    return code, json.loads(capsys.readouterr().out)


def test_the_ends_are_the_maps_bit_for_bit_and_sizes_are_those_of_the_first(rng, tmp_path, capsys):
    maps = [rng.uniform(0.1, 9, (8, 16, 3)).astype(np.float32) for _ in "ab"]
    for name, envmap in zip("ab", maps, strict=True):
        images.write_exr(tmp_path / f"{name}.exr", envmap)
    for amount, envmap in enumerate(maps):
        out = str(tmp_path / f"{amount}.exr")
        assert run(tmp_path, capsys, "--amount", str(amount), "--out", out)[0] == 0
        assert np.array_equal(images.read(out)[0], envmap)
    images.write_exr(tmp_path / "b.exr", latlong.resize(maps[1], 12, 24))
    for amount in ("0.5", "1"):
        out = str(tmp_path / f"c{amount}.exr")
        code, said = run(tmp_path, capsys, "--amount", amount, "--out", out)
        assert code == 0 and "b.exr: resampled from 24 to 16 texels across" in said["warnings"][0]
        assert images.read(out)[0].shape == (8, 16, 3)
