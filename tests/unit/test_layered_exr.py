"""Layers of one file: they come back by name, and a program without layers sees the edited map."""

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit.core.errors import InputError, NumericalError
from envedit.images import images
from tests.oracles.builders import grey

SIZE = (8, 16)


@pytest.fixture
def parts(rng):
    initial = rng.random((*SIZE, 3), dtype=np.float32) * 1e5
    edited = rng.random((*SIZE, 3), dtype=np.float32)
    influence = rng.random(SIZE, dtype=np.float32)
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


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_values_that_are_not_finite_are_refused(tmp_path, bad):
    path = tmp_path / "a.exr"
    images.write_layers(path, {"edited": grey(1.0)})
    before = path.read_bytes()
    broken = grey(0.0).astype(np.float64)
    broken[3, 5, 1] = bad
    with pytest.raises(NumericalError, match="layer 'difference': not written: 1 texel is .*row 3, column 5"):
        images.write_layers(path, {"edited": grey(1.0), "difference": broken})
    with pytest.raises(NumericalError, match="layer 'influence'.*row 3, column 5"):
        images.write_layers(path, {"edited": grey(1.0), "influence": broken[..., 1]})
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1
