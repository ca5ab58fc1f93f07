"""Loading maps and writing images and layers: another reader, full disks, values that must not be written."""

import os

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit.core import latlong, primaries
from envedit.core.errors import InputError, NumericalError
from envedit.images import images
from tests.oracles.builders import exr, grey, planes, stacked


@pytest.mark.parametrize(("size", "panorama"), [
    ((8, 16), True), ((8, 17), True), ((8, 15), True), ((8, 18), False), ((9, 9), False), ((9, 16), False),
])  # fmt: skip
@pytest.mark.parametrize("ending", ["exr", "png"])
def test_a_panorama_is_twice_as_wide_as_high_to_a_texel(size, panorama, ending, tmp_path, rng):
    file = tmp_path / f"a.{ending}"
    if ending == "exr":
        exr(file, **planes(rng, size=size))
    else:
        mi.Bitmap(rng.integers(0, 256, (*size, 3)).astype(np.uint8)).write(str(file))
    assert images.is_panorama(file) == panorama


def test_load_envmap(tmp_path, rng):
    p = planes(rng, size=(8, 16))
    p["G"][3, 4] = -2
    p["B"][0, 0] = 65504
    path = exr(tmp_path / "a.exr", **p)
    found, info = images.load_envmap(path)
    np.testing.assert_array_equal(found, np.maximum(stacked(p), 0))
    assert info["clipped"] == 1 and info["repaired"] == 0
    assert info["warnings"][0] == "1 texel is negative (down to -2), the first at row 3, column 4: set to 0"
    assert "65504" in info["warnings"][1] and len(info["warnings"]) == 2
    assert images.load_envmap(path, width=8)[0].shape == (4, 8, 3)
    assert "enlarged from 16 to 64" in images.load_envmap(path, width=64)[1]["warnings"][-1]

    beside = {"A": np.full((8, 16), 0.5, np.float32), "Z": p["R"]}
    path = exr(tmp_path / "alpha.exr", **p, **beside)
    said = images.load_envmap(path)[1]["warnings"][-1]
    assert said == "channels of the map beside its colours are not read: A, Z"
    path = exr(tmp_path / "opaque.exr", **p, A=np.ones((8, 16), np.float32))
    assert len(images.load_envmap(path)[1]["warnings"]) == 2

    p["R"][5, 6], p["R"][5, 2] = np.nan, np.inf
    path = exr(tmp_path / "a.exr", **p)
    with pytest.raises(InputError, match=r"a.exr: 2 texels are NaN .*, the first at row 5, column 2"):
        images.load_envmap(path, width=8)
    found, info = images.load_envmap(path, width=8, repair=True)
    assert np.isfinite(found).all() and (found >= 0).all() and info["repaired"] == 2
    said = " ".join(info["warnings"])
    assert "row 5, column 2: taken for the brightest" in said and "row 5, column 6: replaced from" in said
    np.testing.assert_allclose(images.load_envmap(path, repair=True)[0][5, 2, 0], 65504)


@pytest.mark.parametrize(("header", "size", "says"), [
    ({}, (48, 64), "is 2:1, this is 64 x 48; crop it, or convert it to lat-long"),
    (
        {"dataWindow": ((0, 0), (15, 7)), "displayWindow": ((0, 0), (31, 17))},
        (8, 16),
        "this is 32 x 18, its display window, and its data window 16 x 8",
    ),
])  # fmt: skip
def test_what_is_not_lat_long_is_refused(header, size, says, tmp_path, rng):
    with pytest.raises(InputError, match=says):
        images.load_envmap(exr(tmp_path / "a.exr", header, **planes(rng, size=size)))


def test_load_envmap_refusals(tmp_path):
    def grey(height, width, value=1.0):
        return exr(tmp_path / "g.exr", **{c: np.full((height, width), value, np.float32) for c in "RGB"})

    for height, width in ((1, 1), (1, 2), (2, 4), (2, 5)):
        with pytest.raises(InputError, match=rf"g.exr: {width} x {height} texels are too few"):
            images.load_envmap(grey(height, width))
    with pytest.raises(InputError, match="g.exr: all 32 texels"):
        images.load_envmap(grey(4, 8, np.nan), repair=True)
    found, info = images.load_envmap(grey(4, 8, 0.0), width=16)
    assert not found.any() and "black" in info["warnings"][0]


@pytest.mark.parametrize(("height", "width"), [(103, 205), (103, 207), (33, 65)])
@pytest.mark.parametrize("working", [None, 64])
def test_a_texel_of_rounding_is_resampled(height, width, working, rng):
    """A map of 2:1 that was made smaller has an odd width where its height was rounded; its flux is kept."""
    sky = rng.random((height, width, 3)).astype(np.float32)
    sky[height // 3, width // 2] = 50 * height
    found, info = images.load_envmap(sky, working)
    across = working or 2 * height
    assert found.shape == (across // 2, across, 3) and info["size"] == (2 * height, height)
    assert f"{width} x {height} texels are not 2:1: resampled to {2 * height} x {height}" in info["warnings"]
    flux = [i.sum(1, dtype=np.float64).T @ latlong.solid_angles(*i.shape[:2]) for i in (sky, found)]
    np.testing.assert_allclose(flux[0], flux[1], rtol=0.02)


def test_write_exr_round_trip(tmp_path, rng):
    path = tmp_path / "sky é.exr"
    values = (10 ** rng.uniform(-30, 30, (6, 12, 3))).astype(np.float32)
    values[0, 0] = [0, -1.5, 1.5e5]  # more than a half holds
    images.write_exr(path, values, {"source": "sky.hdr", "width": 12, "seed": 2**40, "gamma": 0.5})
    found, info = images.read(path)
    np.testing.assert_array_equal(found, values)
    header = OpenEXR.File(str(path), header_only=True).header()
    assert header["envmap"] == OpenEXR.ENVMAP_LATLONG and not info["warnings"]
    assert header["software"].startswith("envedit ")
    np.testing.assert_allclose(header["chromaticities"], primaries.REC709, rtol=1e-6)
    expected = {"source": "sky.hdr", "width": 12, "seed": str(2**40), "gamma": 0.5}
    assert {k: info["metadata"][k] for k in expected} == expected
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(path))), values)  # another reader
    images.write_exr(path, values * 0)
    assert not images.read(path)[0].any()
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e39])
@pytest.mark.parametrize(("writer", "what"), [
    (images.write_exr, "o.x"),
    (images.write_png, "o.x"),
    (lambda path, v: images.write_layers(path, {"edited": grey(1.0, 4, 8), "sky": v}), "layer 'sky'"),
    (lambda path, v: images.write_layers(path, {"edited": grey(1.0, 4, 8), "a": v[..., 1]}), "layer 'a'"),
])  # fmt: skip
def test_non_finite_values_reach_no_file(tmp_path, bad, writer, what):
    values = np.zeros((4, 8, 3))
    values[2, 5, 1] = bad
    with pytest.raises(NumericalError, match=rf"{what}: not written: 1 texel .* row 2, column 5"):
        writer(tmp_path / "o.x", values)
    assert not os.listdir(tmp_path)


def test_unwritable(tmp_path):
    values = np.zeros((4, 8, 3))
    for writer in (images.write_exr, images.write_png):
        with pytest.raises(InputError, match=r"gone/a.exr: cannot be written \(its folder does not exist\)"):
            writer(tmp_path / "gone" / "a.exr", values)
        (tmp_path / "taken").mkdir(exist_ok=True)
        with pytest.raises(InputError, match=r"taken: cannot be written \(Is a directory\)"):
            writer(tmp_path / "taken", values)
    assert os.listdir(tmp_path) == ["taken"]


# ---- layers ------------------------------------------------------------------------------------------------


@pytest.fixture
def parts(rng):
    initial = rng.random((8, 16, 3), dtype=np.float32) * 1e5
    edited = rng.random((8, 16, 3), dtype=np.float32)
    influence = rng.random((8, 16), dtype=np.float32)
    return {"initial": initial, "edited": edited, "difference": edited - initial, "influence": influence}


def test_layers_come_back_by_name_and_other_programs_see_the_edited_map(tmp_path, parts):
    path = tmp_path / "layers.exr"
    images.write_layers(path, parts)
    file = OpenEXR.File(str(path), separate_channels=True)
    assert len(file.parts) == 1, "one part: many viewers show only the first"
    channels = file.channels()
    names = [f"{layer}.{c}" for layer in ("initial", "difference") for c in "RGB"]
    assert sorted(channels) == sorted([*"RGB", "influence.Y", *names])
    assert all(c.pixels.dtype == np.float32 for c in channels.values())
    for layer in ("initial", "difference"):
        got = np.stack([channels[f"{layer}.{c}"].pixels for c in "RGB"], axis=-1)
        np.testing.assert_array_equal(got, parts[layer])
    np.testing.assert_array_equal(np.stack([channels[c].pixels for c in "RGB"], -1), parts["edited"])
    np.testing.assert_array_equal(channels["influence.Y"].pixels, parts["influence"])
    header = file.header()
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert header["envmap"] == OpenEXR.ENVMAP_LATLONG and "chromaticities" in header
    assert [p.name for p in tmp_path.iterdir()] == ["layers.exr"]
    np.testing.assert_array_equal(images.read(path)[0], parts["edited"])
    split = dict(mi.Bitmap(str(path)).split())
    assert set(split) == {"<root>", "initial", "difference", "influence"}
    np.testing.assert_array_equal(np.array(split["<root>"]), parts["edited"])
    np.testing.assert_array_equal(np.array(split["initial"]), parts["initial"])
    np.testing.assert_array_equal(np.array(split["influence"]).squeeze(), parts["influence"])


def test_without_an_edited_map_the_first_is_the_default(tmp_path):
    path = tmp_path / "a.exr"
    images.write_layers(path, {"sky": grey(2.0), "sun": grey(3.0)})
    assert (images.read(path)[0] == 2).all()
    images.write_layers(path, {"only": grey(4.0)})  # replaced
    assert sorted(OpenEXR.File(str(path), separate_channels=True).channels()) == ["B", "G", "R"]


def test_threads_are_as_they_were(tmp_path):
    if not hasattr(OpenEXR, "global_thread_count"):
        pytest.skip("this OpenEXR cannot be told how many threads to use")
    before = OpenEXR.global_thread_count()
    OpenEXR.set_global_thread_count(3)
    try:
        images.write_layers(tmp_path / "a.exr", {"edited": grey(1.0)})
        assert OpenEXR.global_thread_count() == 3
        with pytest.raises(InputError):
            images.write_layers(tmp_path / "none" / "a.exr", {"edited": grey(1.0)})
        assert OpenEXR.global_thread_count() == 3
    finally:
        OpenEXR.set_global_thread_count(before)
