"""``envedit compare``: identical maps are said to be so, a stop is a stop, lights are matched."""

import json

import numpy as np
import pytest

from envedit.cli import compare
from envedit.core import latlong
from envedit.images import images

HEIGHT, WIDTH = 32, 64


@pytest.fixture
def said(tmp_path, capsys, monkeypatch, here):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # without weights of networks

    def run(first, second):
        images.write_exr("a.exr", first)
        images.write_exr("b.exr", second)
        assert compare.main(["a.exr", "b.exr", "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return run


def sunny(rng):
    envmap = rng.uniform(0.2, 0.8, (HEIGHT, WIDTH, 3)).astype(np.float32)
    envmap[8, 20] = 5000
    return envmap


def test_a_map_and_itself(rng, said, tmp_path):
    found = said(*[sunny(rng)] * 2)
    assert found["identical"] and found["psnr"] == 200 and found["ssim"] == 1 and found["lpips"] is None
    assert {one["stops"] for one in found["irradiance"].values()} == {0.0}
    (light,) = found["lights"]["after"]
    assert light["stops_of_flux"] == 0 and not light["added"]
    assert images.read(tmp_path / "a_b_compared" / "difference.png")[0].shape == (HEIGHT, WIDTH, 3)
    assert json.loads((tmp_path / "a_b_compared" / "compare.json").read_text())["identical"]


@pytest.mark.slow
def test_a_stop_brighter_and_turned(rng, said):
    envmap = sunny(rng)
    found = said(envmap, 2 * latlong.rotate(envmap, 90))
    assert not found["identical"] and found["irradiance"]["+y"]["stops"] == pytest.approx(1, abs=1e-3)
    (light,) = found["lights"]["after"]
    elevation = np.radians(light["elevation"])
    arc = 2 * np.arcsin(np.cos(elevation) * np.sin(np.pi / 4))
    assert light["stops_of_flux"] == pytest.approx(1, abs=0.01)
    assert light["moved_degrees"] == pytest.approx(np.degrees(arc), abs=1)


@pytest.mark.slow
def test_another_size_and_a_black_map(rng, said):
    envmap = sunny(rng)
    found = said(envmap, latlong.resize(envmap, 16, 32))
    assert "resampled from 32 to 64 texels" in found["warnings"][0]
    assert abs(found["irradiance"]["+y"]["stops"]) < 0.1
    black = said(np.zeros_like(envmap), envmap)
    assert black["irradiance"]["+y"]["stops"] is None and black["lights"]["after"][0]["added"]
