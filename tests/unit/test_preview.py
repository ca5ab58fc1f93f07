"""Previews and difference pictures, looked at in numbers."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance
from envedit.core.resampling import fit
from envedit.images import images
from envedit.report import preview
from envedit.solve.feasibility import Reach
from tests.oracles.builders import grey, read_png


def described(path):
    """Text ``Description`` of a PNG."""
    return images.read_stored(path)[1]["metadata"]["Description"]


def test_shrinking_averages_areas_and_enlarging_repeats_texels(rng):
    image = rng.random((12, 18, 3), np.float32)
    blocks = image.reshape(4, 3, 6, 3, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(fit(image, 4, 6), blocks, rtol=1e-6)
    np.testing.assert_array_equal(fit(image, 24, 54), image.repeat(2, axis=0).repeat(3, axis=1))
    # 5 to 3: the first output covers texel 0 and two thirds of texel 1.
    ramp = np.arange(5, dtype=np.float32).reshape(1, 5, 1)
    np.testing.assert_allclose(fit(ramp, 1, 3)[0, :, 0], [0.4, 2.0, 3.6], rtol=1e-6)


def test_preview_places_tonemapped_renderings_above_their_maps(tmp_path):
    renders = {"initial": grey(0.25, 320, 320), "target": grey(0.5, 320, 320), "edited": grey(7.0, 320, 320)}
    maps = {"initial": grey(1e-30), "target": None, "edited": grey(0.125)}
    write_atomically(tmp_path / "preview.png", preview.sheet(renders, maps))
    png, gap = read_png(tmp_path / "preview.png"), preview.GAP
    assert png.shape == (gap + 320 + gap + 160 + gap, gap + 3 * (320 + gap), 3)
    centres = [gap + 160 + i * (320 + gap) for i in range(3)]
    # round(255 * E^(1/2.2)): 0.25 -> 135.8, 0.5 -> 186.1, 0.125 -> 99.1
    assert [png[gap + 160, x].tolist() for x in centres] == [[136] * 3, [186] * 3, [255] * 3]
    maps_row = [png[gap + 320 + gap + 80, x].tolist() for x in centres]
    assert maps_row == [[0] * 3, [preview.UNKNOWN] * 3, [99] * 3]


@pytest.mark.parametrize("factor", [1e-6, 0.3, 1.0, 800.0, 1e20])
def test_pictures_that_would_be_white_or_black_are_exposed(factor, rng, tmp_path):
    """Most pixels are between 5 % and 95 % of white, whatever the unit; and the caption says how."""
    image = (rng.random((8, 16, 3)).astype(np.float32) + 0.1) * np.float32(factor)
    stops = preview.stops_of([image])
    shown = preview.display(image, "gamma", stops).mean(axis=2)
    assert ((shown > 12) & (shown < 243)).mean() > 0.8 and (stops == 0) == (0.1 < factor < 2)
    assert preview.exposed(stops) == (f", {stops:+d} stops" if stops else "")
    write_atomically(tmp_path / "p.png", preview.sheet({"edited": image}, {"edited": image}))
    drawn = read_png(tmp_path / "p.png")
    assert 12 < np.median(drawn[drawn != preview.BACKGROUND]) < 243
    text = f"edited; renderings{preview.exposed(stops)} over maps{preview.exposed(stops)}"
    assert described(tmp_path / "p.png").endswith(text)
    assert preview.stops_of([np.zeros((4, 8, 3))]) == preview.stops_of([]) == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 4096), (4096, 1), (3, 5), (64, 64), (100, 1500)])
def test_preview_takes_any_size(tmp_path, shape):
    write_atomically(
        tmp_path / "p.png", preview.sheet({"a": np.ones((*shape, 3), np.float32)}, {"a": grey(0.0, 1, 1)})
    )
    height, width, _ = read_png(tmp_path / "p.png").shape
    assert 214 <= width <= 800 and height <= 4 * 800


def test_preview_names_its_columns_whatever_their_text(tmp_path):
    names = ["x" * 500, "zażółć ☀ \n\0 \udcff", "", "edited"]
    write_atomically(tmp_path / "p.png", preview.sheet({name: grey(0.5) for name in names}, {}))
    assert read_png(tmp_path / "p.png").ndim == 3
    assert "x" * 500 in described(tmp_path / "p.png")


def test_difference_is_red_where_brighter_blue_where_darker_white_where_equal():
    b = grey(0.5, 3, 4)
    a = b.copy()
    a[0], a[1] = 1.0, 0.0
    pixels, scale = preview.difference_image(a, b)
    assert scale == 1.0  # 0.5^(1/2.2) = 0.73, rounded up
    assert pixels[2, 0].tolist() == [247, 247, 247]
    assert pixels[0, 0, 0] > pixels[0, 0, 2] and pixels[1, 0, 2] > pixels[1, 0, 0]


def test_stops_read_the_ratio_even_of_a_sun():
    b = grey(1.0, 8, 8)
    b[0, 0] = 65504.0
    a = b * 2
    pixels, scale = preview.difference_image(a, b, "stops")
    assert scale == 1.0
    # log2((2 + 1e-3) / (1 + 1e-3)) = 0.9993 stops: full red to a unit in the last place
    assert np.abs(pixels.astype(int) - [178, 24, 43]).max() <= 1


@pytest.mark.parametrize("kind", ["tonemapped", "stops"])
@pytest.mark.parametrize("value", [0.0, 1e-30, 1.0, 65504.0, 1e6, 3e38])
def test_equal_pictures_have_no_difference(kind, value):
    pixels, scale = preview.difference_image(grey(value), grey(value), kind)
    assert (pixels == 247).all() and 0 < scale <= 0.1


def test_influence_is_drawn_per_solid_angle_and_logarithmically():
    sphere = latlong.solid_angles(16, 32)[:, None] * np.ones((16, 32))
    share = np.ones((16, 32))
    share[2], share[5], share[8], share[11] = 0, 1e-3, 0.1, 100
    mean = share.mean(axis=1) @ sphere[:, 0] * 32 / (4 * np.pi)
    share[14] -= (mean - 1) * 4 * np.pi / (sphere[14, 0] * 32)  # so that the mean is 1
    frozen = np.zeros((16, 32), bool)
    frozen[3, 4] = True
    pixels = preview.influence_image((share * sphere).astype(np.float32), frozen)
    rising = preview.RISING
    # From 1e-3 to 10: 0.1 is in the middle, 1 at three quarters.
    for row, colour in ((2, rising[0]), (5, rising[0]), (8, rising[4]), (0, rising[6]), (11, rising[8])):
        assert np.abs(pixels[row].astype(int) - colour).max() <= 1
    assert pixels[3, 4].tolist() == [preview.UNKNOWN] * 3 and np.abs(pixels[3, 5] - rising[6]).max() <= 1
    assert (np.diff(luminance(rising)) > 0).all()


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
def test_influence_picture_has_texels_and_says_what_they_are(value, tmp_path):
    preview.influence(tmp_path / "influence.png", np.full((8, 16), value, np.float32))
    png = read_png(tmp_path / "influence.png")
    assert png.shape == (256, 512, 3) and (png[:32, :32] == png[0, 0]).all()
    assert "1 is the mean" in described(tmp_path / "influence.png")


@pytest.mark.parametrize("stops, rounded", [(0.01, 0.1), (0.1, 0.1), (0.11, 0.2), (3, 5), (5.1, 10)])
def test_the_scale_of_a_difference_is_round(stops, rounded):
    b = grey(1.0)
    a = (b + 1e-3) * 2**stops - 1e-3  # both are lifted by a thousandth of the median
    assert preview.difference_image(a, b, "stops")[1] == pytest.approx(rounded)


def test_colours_show_sign_and_size():
    residual = np.zeros((1, 4, 3), np.float32)
    residual[0, 1] = [0.1, -0.05, 0]
    residual[0, 2] = -preview.FULL_COLOUR_DIFFERENCE / 2
    residual[0, 3] = 1
    shown = preview.unreachable(Reach(0.5, residual, residual, residual))
    np.testing.assert_allclose(shown[0], [[1, 1, 1], [1, 0.6, 0.6], [0.5, 0.5, 1], [1, 0, 0]], atol=1e-6)
