"""``envedit lights``: sky and lights whose sum is the map, bit for bit, and a list that holds their flux."""

import json
import math

import numpy as np
import pytest

from envedit.cli import lights
from envedit.core import latlong, primaries
from envedit.export import light_list
from envedit.images import images
from envedit.maps import map_lights
from envedit.representations.layers import file_lights
from envedit.representations.layers.separation import separate

HEIGHT, WIDTH = 48, 96
AT = 12, 30


def sunny(rng, peak=5000.0):
    envmap = rng.uniform(0.2, 1.0, (HEIGHT, WIDTH, 3)).astype(np.float32)
    envmap[AT] = peak, 0.7 * peak, 0.4 * peak
    return envmap


def written(envmap, tmp_path, name="sky.exr", **how):
    (images.write_hdr if name.endswith("hdr") else images.write_exr)(tmp_path / name, envmap, **how)
    assert lights.main([str(tmp_path / name), "--out", str(tmp_path / "out"), "--json"]) == 0
    sky, info = images.load_envmap(tmp_path / "out" / "sky.exr", convert=False)
    return sky, images.load_envmap(tmp_path / "out" / "lights.exr", convert=False)[0], info


@pytest.mark.parametrize(
    "how", [{"name": "sky.hdr"}, {}, {"half": True}, {"chromaticities": primaries.ACES_AP1}]
)
def test_sky_and_lights_sum_to_the_map_bit_for_bit(how, rng, tmp_path, capsys):
    sky, alone, info = written(sunny(rng), tmp_path, **how)
    stored, _ = images.load_envmap(tmp_path / how.get("name", "sky.exr"), convert=False)
    assert alone[AT].min() > 100 and sky[AT].max() < 2 and np.array_equal(sky + alone, stored)
    assert (info["chromaticities"] is None) == ("chromaticities" not in how)


def test_the_sum_is_exact_for_any_values(rng):
    envmap = np.exp(rng.uniform(-60, 60, (20000, 3))).astype(np.float32)
    envmap[0] = 0, np.finfo(np.float32).max, np.finfo(np.float32).tiny
    core = envmap * rng.uniform(0, 1, envmap.shape)
    sky, alone = light_list.split(envmap, core)
    assert np.array_equal(sky + alone, envmap) and sky.min() >= 0 and alone.min() >= 0
    assert (np.abs(alone - core) <= 2.0**-23 * envmap + 1e-38).all()


def test_the_list_has_direction_flux_and_stops(rng, tmp_path, capsys):
    envmap = sunny(rng)
    written(envmap, tmp_path)
    said = json.loads(capsys.readouterr().out)
    (light,) = said["lights"]
    assert said["ok"] and json.loads((tmp_path / "out/lights.json").read_text())["lights"] == said["lights"]
    toward = latlong.directions(HEIGHT, WIDTH)[AT]
    assert np.degrees(np.arccos(toward @ light["direction"])) < 360 / WIDTH
    omega = latlong.lookup_solid_angles(HEIGHT, WIDTH)[AT[0]]
    np.testing.assert_allclose(light["flux"], envmap[AT] * omega, rtol=1e-2)
    # A sky of mean radiance 0.6 gives pi 0.6.
    assert abs(light["stops"] - math.log2(0.715 * 5000 * omega / (math.pi * 0.6))) < 0.1


def test_irradiance_of_the_sky_is_in_rec709_as_flux_is(rng, tmp_path, capsys):
    envmap = sunny(rng)
    written(envmap, tmp_path, "a.exr")
    plain = json.loads(capsys.readouterr().out)
    acescg = envmap @ np.linalg.inv(primaries.to_rec709(primaries.ACES_AP1)).T
    written(acescg.astype(np.float32), tmp_path, "b.exr", chromaticities=primaries.ACES_AP1)
    wide = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(wide["sky_irradiance"], plain["sky_irradiance"], rtol=1e-3)


def test_bands_of_a_large_map_hold_the_lights_of_the_whole(rng):
    envmap = latlong.resize(sunny(rng), 300, 600)
    apart = file_lights.lights_of(envmap)
    whole = separate(envmap).lights
    assert [len(one.texels) for one in apart] == [len(one.texels) for one in whole]
    for one, other in zip(apart, whole, strict=True):
        assert np.array_equal(one.texels, other.texels)
        np.testing.assert_array_equal(one.radiance, other.radiance)


def test_irradiance_of_an_even_sky_is_pi():
    normals = np.array(list(map_lights.AXES.values()))
    even = np.full((HEIGHT, WIDTH, 3), 2, np.float32)
    np.testing.assert_allclose(map_lights.irradiance(even, normals), 2 * math.pi, rtol=1e-3)


def test_a_black_map_has_no_lights_and_bad_input_is_one_line(tmp_path, capsys):
    sky, alone, _ = written(np.zeros((6, 12, 3), np.float32), tmp_path)
    assert not sky.any() and not alone.any()
    assert json.loads(capsys.readouterr().out)["lights"] == []
    assert lights.main([str(tmp_path / "none.exr"), "--json"]) == 3
    out, err = capsys.readouterr()
    assert "no such file" in json.loads(out)["error"] and len(err.splitlines()) == 1
