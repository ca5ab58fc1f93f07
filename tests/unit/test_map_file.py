"""The file of a map: format, half and colour space are kept, and no input is ever replaced."""

import numpy as np
import pytest

from envedit.core import primaries
from envedit.core.errors import ConfigError, NumericalError
from envedit.images import images
from envedit.maps import map_file


@pytest.fixture
def sky(rng):
    return rng.uniform(0.1, 4, (6, 12, 3)).astype(np.float32)


def test_float_half_and_colour_space_of_an_exr_are_kept(sky, tmp_path):
    for half in (False, True):
        images.write_exr(tmp_path / "a.exr", sky, half=half, chromaticities=primaries.ACES_AP1)
        read = map_file.read(tmp_path / "a.exr")
        assert map_file.write(tmp_path / "b.exr", read.stored, read) == []
        again = map_file.read(tmp_path / "b.exr")
        assert np.array_equal(again.stored, read.stored) and again.half is half
        np.testing.assert_allclose(again.chromaticities, primaries.ACES_AP1, atol=1e-6)


@pytest.mark.parametrize("height", [6, 300])  # within a band of rows that is encoded, and beyond it
def test_a_radiance_file_keeps_its_texels_and_its_primaries(height, rng, tmp_path):
    sky = rng.uniform(0.1, 4, (height, 2 * height, 3)).astype(np.float32)
    images.write_hdr(tmp_path / "a.hdr", sky, primaries.REC2020)
    read = map_file.read(tmp_path / "a.hdr")
    np.testing.assert_allclose(read.chromaticities, primaries.REC2020)
    map_file.write(tmp_path / "b.hdr", read.stored, read)
    assert (tmp_path / "b.hdr").read_bytes() == (tmp_path / "a.hdr").read_bytes()


def test_what_a_file_cannot_hold_is_cut_and_reported_or_reaches_no_file(sky, tmp_path):
    images.write_exr(tmp_path / "a.exr", sky, half=True)
    read = map_file.read(tmp_path / "a.exr")
    brighter = read.stored.copy()
    brighter[2, 3] = 1e6
    (warning,) = map_file.write(tmp_path / "b.exr", brighter, read)
    assert "1 texel is brighter than 65504" in warning
    assert map_file.read(tmp_path / "b.exr").stored.max() == 65504
    sky[1, 1, 1] = np.nan
    for name in ("c.exr", "c.hdr"):
        with pytest.raises(NumericalError, match="1 texel is not finite, the first at row 1, column 1"):
            map_file.write(tmp_path / name, sky)
        assert not (tmp_path / name).exists()


def test_results_have_names_of_their_own(sky, tmp_path, here):
    images.write_hdr("sky.hdr", sky)
    (tmp_path / "link.hdr").symlink_to("sky.hdr")
    named = [map_file.output_path(None, "adjusted", [source]) for source in ("x/sky.hdr", "sky.EXR", "a.png")]
    assert [path.name for path in named] == ["sky_adjusted.hdr", "sky_adjusted.exr", "a_adjusted.exr"]
    images.write_hdr("sky_adjusted.hdr", sky)
    assert map_file.output_path(None, "adjusted", ["sky.hdr"]).name == "sky_adjusted_2.hdr"
    for requested in ("sky.hdr", "link.hdr"):
        with pytest.raises(ConfigError, match=f"{requested}: is read by this command"):
            map_file.output_path(requested, "adjusted", ["sky.hdr"], overwrite=True)
    with pytest.raises(ConfigError, match="exists already: give another name with --out, or --overwrite"):
        map_file.output_path("sky_adjusted.hdr", "adjusted", ["sky.hdr"])
    assert map_file.output_path("sky_adjusted.hdr", "adjusted", ["sky.hdr"], True).name == "sky_adjusted.hdr"
    with pytest.raises(ConfigError, match="ends in '.png', expected .exr or .hdr"):
        map_file.output_path("a.png", "adjusted", ["sky.hdr"])
