"""TIFF files: read as the PNG or OpenEXR of the same pixels is."""

import sys

import numpy as np
import pytest

from envedit.core.errors import InputError, MachineError
from envedit.images import images

tifffile = pytest.importorskip("tifffile", reason="the extra envedit[tiff] is not installed")
CODES = np.random.default_rng(0).integers(0, 2**16, (5, 7, 4)).astype(np.uint16)


@pytest.mark.parametrize(
    "keys", [{"byteorder": ">"}, {"planarconfig": "separate"}, {"compression": "deflate"}]
)
def test_codes_are_those_of_a_png(tmp_path, keys):
    codes = CODES[..., :3]
    planes = np.moveaxis(codes, 2, 0) if "planarconfig" in keys else codes
    try:
        tifffile.imwrite(tmp_path / "a.tif", planes, photometric="rgb", **keys)
    except KeyError:
        pytest.skip("imagecodecs, which compresses, is not installed")
    images.write_png(tmp_path / "a.png", codes / 65535, bits=16)
    for read in (images.read, images.read_stored):
        (found, info), (expected, _) = read(tmp_path / "a.tif"), read(tmp_path / "a.png")
        np.testing.assert_array_equal(found, expected)
        assert (info["hdr"], info["bits"]) == (False, 16)


def test_alpha_stays_orientation_is_undone_and_floats_are_linear(tmp_path):
    tags = [(274, "H", 1, 3, True)]
    keys = {"photometric": "rgb", "extrasamples": ["unassalpha"], "extratags": tags}
    tifffile.imwrite(tmp_path / "a.tif", CODES, **keys)
    np.testing.assert_array_equal(images.read_stored(tmp_path / "a.tif")[0], CODES[::-1, ::-1])
    light = np.float32(CODES[..., 0]) / 1000
    tifffile.imwrite(tmp_path / "a.tif", light, photometric="minisblack")
    found, info = images.read(tmp_path / "a.tif")
    np.testing.assert_array_equal(found, np.stack([light] * 3, axis=2))
    assert info["hdr"]


def test_what_cannot_be_read_is_said(tmp_path, monkeypatch):
    tifffile.imwrite(tmp_path / "cmyk.tif", CODES, photometric="separated")
    with pytest.raises(InputError, match="SEPARATED of uint16, expected grey or RGB"):
        images.read(tmp_path / "cmyk.tif")
    (tmp_path / "cut.tif").write_bytes((tmp_path / "cmyk.tif").read_bytes()[:40])
    with pytest.raises(InputError, match=r"cut\.tif"):
        images.read(tmp_path / "cut.tif")
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(MachineError, match=r"needs tifffile.*\[tiff\]"):
        images.read(tmp_path / "cmyk.tif")
