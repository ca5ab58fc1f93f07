"""Colour spaces: matrices against published ones, and files that have other primaries than Rec. 709."""

import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest

from envedit import config, inputs
from envedit.core import primaries
from envedit.core.errors import InputError
from envedit.core.primaries import ACES_AP0, ACES_AP1, P3_D65, REC709, REC2020
from envedit.images import images
from tests.oracles import users_scenes
from tests.oracles.builders import exr, planes, stacked
from tests.oracles.devices import on_cpu
from tests.oracles.runs import TINY, call, changed, pixels


@pytest.mark.parametrize("space, expected", [
    # IEC 61966-2-1; ITU-R BT.2020; SMPTE ST 2065-1; Academy S-2014-004.
    (REC709, [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]),
    (REC2020, [[0.6370, 0.1446, 0.1689], [0.2627, 0.6780, 0.0593], [0.0, 0.0281, 1.0610]]),
    (ACES_AP0, [[0.95255, 0, 0.00009], [0.34397, 0.72817, -0.07213], [0, 0, 1.00883]]),
    (ACES_AP1, [[0.66245, 0.13400, 0.15619], [0.27223, 0.67408, 0.05369], [-0.00557, 0.00406, 1.01034]]),
])  # fmt: skip
def test_matrices_to_xyz_are_the_published_ones(space, expected):
    np.testing.assert_allclose(primaries.rgb_to_xyz(space), expected, atol=6e-5)


def test_acescg_to_rec709_is_the_published_matrix():
    """Bradford from D60 to D65, as OpenColorIO's ACES configurations have it."""
    expected = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
    np.testing.assert_allclose(primaries.to_rec709(ACES_AP1), expected, atol=2e-5)
    np.testing.assert_allclose(primaries.to_rec709(REC709), np.eye(3), atol=1e-12)
    for space in (ACES_AP0, ACES_AP1, REC2020, P3_D65):
        np.testing.assert_allclose(primaries.to_rec709(space) @ np.ones(3), 1, atol=1e-9)


@pytest.mark.parametrize("space", [ACES_AP1, REC2020, P3_D65, (0.7, 0.3, 0.2, 0.75, 0.13, 0.05, 0.31, 0.32)])
def test_a_picture_in_another_space_is_converted(space, tmp_path, rng):
    p = planes(rng)
    found, info = images.read(exr(tmp_path / "a.exr", {"chromaticities": space}, **p))
    np.testing.assert_allclose(found, stacked(p) @ primaries.to_rec709(space).T, rtol=1e-4, atol=1e-3)
    assert info["warnings"] == [f"converted from {primaries.name_of(space)} to Rec. 709"]
    assert np.allclose(info["chromaticities"], space)


@pytest.mark.parametrize("key", ["colorInteropID", "oiio:ColorSpace"])
def test_a_space_that_is_given_by_name(key, tmp_path, rng):
    p = planes(rng)
    found, _ = images.read(exr(tmp_path / "a.exr", {key: "ACEScg"}, **p))
    np.testing.assert_allclose(found, stacked(p) @ primaries.to_rec709(ACES_AP1).T, rtol=1e-4, atol=1e-3)
    same, info = images.read(exr(tmp_path / "b.exr", {key: "lin_rec709_scene"}, **p))
    np.testing.assert_array_equal(same, stacked(p))
    assert info["chromaticities"] is None and not info["warnings"]
    with pytest.raises(InputError, match="c.exr: colour space 'ARRI LogC' is not known: save it as linear"):
        images.read(exr(tmp_path / "c.exr", {key: "ARRI LogC"}, **p))


def test_xyz_is_not_adapted(tmp_path):
    """Grey of Rec. 709 has the X, Y, Z of D65 (IEC 61966-2-1): with 1/3, 1/3 as white it stays grey."""
    header = {"chromaticities": (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)}
    xyz = {c: np.full((4, 8), 0.5 * v, np.float32) for c, v in zip("RGB", (0.9505, 1, 1.0890), strict=True)}
    found, info = images.read(exr(tmp_path / "a.exr", header, **xyz))
    np.testing.assert_allclose(found, 0.5, atol=2e-4)
    assert info["warnings"] == ["converted from CIE XYZ to Rec. 709"]


@pytest.mark.parametrize("name", ["unknown", "Raw", "Utility - Raw"])
def test_a_name_that_says_nothing_is_none(name, tmp_path, rng):
    p = planes(rng)
    found, info = images.read(exr(tmp_path / "a.exr", {"oiio:ColorSpace": name}, **p))
    np.testing.assert_array_equal(found, stacked(p))
    assert info["chromaticities"] is None
    assert f"its colour space '{name}' says nothing: read as linear Rec. 709" in info["warnings"][0]
    other = {"colorInteropID": name, "oiio:ColorSpace": "ACEScg"}
    assert images.read(exr(tmp_path / "b.exr", other, **p))[1]["chromaticities"] == ACES_AP1


@pytest.mark.parametrize("header", [
    {}, {"oiio:ColorSpace": "ARRI LogC"}, {"chromaticities": REC2020}, {"chromaticities": (0.3,) * 8},
])  # fmt: skip
def test_a_key_goes_before_what_the_file_says(header, tmp_path, rng):
    """The map is converted from, and written in, the space that [input] colour_space names."""
    p = planes(rng)
    settings = config.Input(envmap=str(exr(tmp_path / "a.exr", header, **p)), colour_space="ACEScg", width=8)
    given = inputs.read_map(settings, None)
    np.testing.assert_array_equal(given.stored, stacked(p))
    expected = np.maximum(stacked(p) @ primaries.to_rec709(ACES_AP1).T, 0)
    np.testing.assert_allclose(given.radiance, expected, rtol=1e-4, atol=1e-3)
    assert given.at_file_size(settings).chromaticities == given.chromaticities == ACES_AP1
    array = inputs.read_map(settings, None, array=stacked(p))
    np.testing.assert_array_equal(array.radiance, given.radiance)
    plain = inputs.read_map(replace(settings, colour_space="Rec. 709"), None)
    assert plain.chromaticities is None and (plain.radiance == stacked(p)).all()


@pytest.mark.parametrize("space", [
    (0.64, 0.33, 0.64, 0.33, 0.15, 0.06, 0.3127, 0.3290),  # two are the same
    (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.9, 0.05),  # a white that no mixture of them is
    (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3, 0.0),
    (float("nan"),) * 8,
    (0.0, 1e17, 0.0, 2e17, 1e17, 0.0, 0.3, 0.3),  # beside which white is nothing: singular
])  # fmt: skip
def test_chromaticities_that_are_no_primaries_are_refused(space, tmp_path, rng):
    with pytest.raises(InputError, match="a.exr: its chromaticities .* are no primaries"):
        images.read(exr(tmp_path / "a.exr", {"chromaticities": space}, **planes(rng)))


@pytest.mark.slow
@on_cpu
def test_acescg_goes_out_if_it_came_in(tmp_path, isolated, capsys, here):
    """An edit of an ACEScg map is written in ACEScg; texels that are not edited keep their bits."""
    parts = users_scenes.PATH, users_scenes.SENSOR, users_scenes.BALL, users_scenes.light(0.7)
    path = users_scenes.write(tmp_path, parts)
    own = pixels(tmp_path / "own.exr")
    images.write_exr(tmp_path / "own.exr", own, chromaticities=ACES_AP1)
    lit, radiance, _ = users_scenes.loaded(path)
    expected = np.maximum(own @ primaries.to_rec709(ACES_AP1).T, 0) * 0.7
    np.testing.assert_allclose(radiance, expected, rtol=1e-5, atol=1e-6)
    keys = {f"{table}__{key}": value for table, keys in TINY.items() for key, value in keys.items()}
    # More than noise is to be explained.
    keys |= {"scene__width": 16, "target__spp": 1024, "target__rotate_degrees": 120.0, "renderer__spp": 256}
    assert call(path, *changed(**keys), "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert any("map in ACEScg: edited in Rec. 709" in line for line in found["metrics"]["choices"])
    assert any("outside Rec. 709" in line for line in found["warnings"])
    for name in ("edited.exr", "edited_sky.exr", "edited_lights.exr", "edited_layers.exr"):
        with OpenEXR.File(found["files"][name], separate_channels=True) as file:
            assert np.allclose(file.header()["chromaticities"], ACES_AP1)
            if name == "edited.exr":
                edited = np.stack([file.channels()[c].pixels for c in "RGB"], axis=2)
    assert edited[4:].tobytes() == own[4:].tobytes() and (edited[:4] != own[:4]).any()
    given = inputs.InputMap("a", edited, 0.7, (16, 8), [], ACES_AP1)
    before = pixels(tmp_path / "scene_out" / "render_edited.exr")
    after = lit.render(given.radiance, 1024, 3)  # what is written is what was judged
    assert before.mean() == pytest.approx(after.mean(), rel=0.05)
