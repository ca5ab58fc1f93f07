"""Painted pictures: what was painted is found in every format, and what tells nothing is said."""

import struct
import zlib

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from envedit import config
from envedit.core.color import TONEMAPS, tonemap
from envedit.core.errors import InputError
from envedit.images import images
from envedit.targets import initial_rendering, painted_image
from tests.oracles.builders import exr, floats, png, with_chunk

SIZE = (60, 83)  # no multiple of a JPEG's blocks
RECTANGLE = (slice(13, 37), slice(21, 50))


@pytest.fixture
def initial(rng):
    """Return a rendering: a noisy slope, an edge, black pixels and some far above white."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] / 60
    picture = 0.02 + 0.4 * np.stack([rows, columns * 0.5, 1 - rows], -1)
    picture[30:, 60:] *= 0.1
    picture *= 1 + 0.02 * rng.standard_normal((*SIZE, 1))
    picture[50:56, 5:15] = [20, 15, 10]
    picture[2:5, 70:] = 0
    return picture.astype(np.float32)


def brushed(picture):
    """Paint a rectangle; returns the picture and where it was painted."""
    new, where = picture.copy(), np.zeros(picture.shape[:2], bool)
    new[RECTANGLE] = picture[RECTANGLE] * [0.3, 0.35, 0.5] + [0.002, 0.002, 0.004]
    where[RECTANGLE] = True
    return new, where


def codes(picture, name="gamma", top=255):
    return np.rint(tonemap(picture, name) * top).astype({255: np.uint8, 65535: np.uint16}[top])


def jpeg(path, pixels, quality=95):
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(path), mi.Bitmap.FileFormat.JPEG, quality)
    return path


def told(result):
    return " | ".join(result.warnings)


def refused(words, *arguments, **kwargs):
    """Return the message, of one line, with which a picture is refused."""
    with pytest.raises(InputError) as found:
        painted_image.read(*arguments, **kwargs)
    message = str(found.value)
    assert found.value.exit_code == 3 and "\n" not in message and len(message) < 400
    assert all(part in message for part in words), message
    return message


# ---- what was painted --------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["exr", "half", "hdr", "png16", "png8", "widened"])
@pytest.mark.parametrize("name", TONEMAPS)
def test_exactly_the_rectangle_is_painted(kind, name, initial, tmp_path):
    wanted, where = brushed(initial)
    file, step = tmp_path / "p", 0
    if kind in ("exr", "half"):
        floats(file, wanted, np.float16 if kind == "half" else np.float32)
    elif kind == "hdr":
        mi.Bitmap(wanted).write(str(file), mi.Bitmap.FileFormat.RGBE)
    else:
        top = 65535 if kind == "png16" else 255
        pixels, step = codes(wanted, name, top), 1 / top
        png(file.with_suffix(".png"), pixels.astype(np.uint16) * 257 if kind == "widened" else pixels)
        file = file.with_suffix(".png")
    found = painted_image.read(file, SIZE, name, initial)
    np.testing.assert_array_equal(found.coverage, where[..., None].astype(np.float32))
    assert found.coverage.dtype == found.picture.dtype == np.float32
    assert found.picture[~where].tobytes() == initial[~where].tobytes()
    if step:  # right to half a step of display values, with float32 rounding
        error = tonemap(found.picture[where], name) - tonemap(wanted[where], name)
        assert np.abs(error).max() <= 0.5 * step + 1e-6 and not found.excluded[where].any()
    else:
        room = {"exr": 0, "half": 6e-4, "hdr": 1 / 128}[kind] * wanted[where].max(axis=1, keepdims=True)
        assert (np.abs(found.picture[where] - wanted[where]) <= room).all() and not found.excluded.any()
    assert "%" not in told(found)


@pytest.mark.parametrize("quality", [80, 90, 95, 100])
def test_paint_is_found_in_a_jpeg(quality, initial, tmp_path):
    wanted, where = brushed(initial)
    file = jpeg(tmp_path / "p.jpg", codes(wanted), quality)
    assert abs(images.read_stored(file)[1]["quality"] - quality) <= 1
    found = painted_image.read(file, SIZE, "gamma", initial)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, where)
    assert found.picture[~where].tobytes() == initial[~where].tobytes()
    error = np.abs(tonemap(found.picture[where]) - tonemap(wanted[where]))
    assert error.mean() < 0.02 and "roughly" in told(found)


@pytest.mark.parametrize("quality", [75, 90, 100])
def test_paint_is_found_where_colours_are_subsampled(quality, initial, tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    wanted, where = brushed(initial)
    pillow.fromarray(codes(wanted)).save(tmp_path / "p.jpg", quality=quality, subsampling=2)
    found = painted_image.read(tmp_path / "p.jpg", SIZE, "gamma", initial).coverage[..., 0] > 0
    assert (found != where)[np.s_[15:35, 23:48]].sum() == 0  # two pixels inside
    assert (found & ~where).sum() + (where & ~found).sum() <= 12


@pytest.mark.parametrize(("colour", "low", "high", "quality", "bleeds"), [
    (230, 0.2, 0.3, 75, 0), (230, 0.2, 0.3, 90, 0), ([250, 120, 10], 0, 0.5, 85, 1),
    ([250, 120, 10], 0, 0.5, 95, 1),
])  # fmt: skip
def test_strong_paint_rings_and_bleeds_by_a_pixel(colour, low, high, quality, bleeds, initial, tmp_path):
    initial = initial.clip(low, high)
    wanted, where = codes(initial), np.zeros(SIZE, bool)
    for part in (np.s_[13:21, 21:50], np.s_[27:43, 30:44]):
        wanted[part], where[part] = colour, True
    file = jpeg(tmp_path / "p.jpg", wanted, quality)
    found = painted_image.read(file, SIZE, "gamma", initial).coverage[..., 0] > 0
    near = sliding_window_view(np.pad(where, bleeds), (1 + 2 * bleeds, 1 + 2 * bleeds)).any(axis=(2, 3))
    assert not found[~near].any() and found[where].mean() > (0.98 if bleeds else 0.9999)


@pytest.mark.parametrize("quality", [75, 95])
def test_a_colourful_rendering_without_paint_is_refused(quality, tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    initial = np.full((*SIZE, 3), 0.2, np.float32)
    initial[:, (np.arange(83) // 3) % 2 == 0] = [0.6, 0.1, 0.3]  # stripes that subsampled colours mix
    pillow.fromarray(codes(initial)).save(tmp_path / "p.jpg", quality=quality, subsampling=2)
    refused(["nothing of it is painted"], tmp_path / "p.jpg", SIZE, "gamma", initial)


@pytest.mark.parametrize(("top", "hidden", "shown"), [(255, 1, 2), (65535, 31, 33)])
def test_rounding_is_no_paint(top, hidden, shown, initial, tmp_path):
    initial = initial.clip(0.05, 0.7)
    pixels = codes(initial, "gamma", top)
    pixels[3, 4] += shown
    pixels[9, 9, 1] -= shown
    pixels[20:] += np.asarray(hidden).astype(pixels.dtype)
    cut = (tonemap(initial) * top).astype(pixels.dtype)
    pixels[40:] = cut[40:]  # an editor that does not round
    found = painted_image.read(png(tmp_path / "p.png", pixels), SIZE, "gamma", initial).coverage
    assert set(zip(*np.nonzero(found[..., 0]), strict=True)) == {(3, 4), (9, 9)}


def test_without_the_rendering_all_is_painted(initial, tmp_path):
    found = painted_image.read(png(tmp_path / "p.png", codes(initial)), SIZE, "gamma")
    assert (found.coverage == 1).all() and found.coverage.shape == (*SIZE, 1)
    np.testing.assert_array_equal(found.excluded, (codes(initial) == 255).any(axis=2))


def test_faint_radiance_is_paint_and_a_sun_that_a_half_cannot_hold_is_none(tmp_path):
    initial = np.full((8, 8, 3), 1e-4, np.float32)
    wanted = initial.copy()
    wanted[2, 3] *= 1.01
    wanted[5, 5] = 0
    found = painted_image.read(floats(tmp_path / "p.exr", wanted), (8, 8), "gamma", initial)
    assert set(zip(*np.nonzero(found.coverage[..., 0]), strict=True)) == {(2, 3), (5, 5)}
    initial = np.full((8, 8, 3), 0.5, np.float32)
    initial[1, 1] = 1e6
    wanted = np.minimum(initial, 65504)
    wanted[4, 4] = 2
    found = painted_image.read(floats(tmp_path / "p.exr", wanted, np.float16), (8, 8), "gamma", initial)
    assert found.coverage.sum() == 1 and found.picture[1, 1, 0] == 1e6 and found.picture[4, 4, 0] == 2


# ---- tonemaps ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("kind", "text"), [
    (b"tEXt", b"log"), (b"zTXt", b"\0" + zlib.compress(b"log")), (b"iTXt", b"\0\0de\0\0log"),
    (b"iTXt", b"\1\0\0\0" + zlib.compress(b"log")),
])  # fmt: skip
def test_the_tonemap_that_the_file_names_is_used(kind, text, initial, tmp_path):
    wanted, where = brushed(initial)
    file = png(tmp_path / "p.png", codes(wanted, "log", 65535))
    with_chunk(file, b"tEXt", "Author\0Jürgen".encode("latin-1"))  # as many an editor writes
    with_chunk(file, kind, b"envedit.tonemap\0" + text)
    for declared in ("auto", "log"):
        found = painted_image.read(file, SIZE, declared, initial)
        np.testing.assert_array_equal(found.coverage[..., 0] > 0, where)
        np.testing.assert_allclose(found.picture, wanted, rtol=2e-3)
        assert not told(found)
    says = ["p.png: was exported under 'log', where target.tonemap is 'gamma'", '"log" or "auto"']
    refused(says, file, SIZE, "gamma", initial)


@pytest.mark.parametrize("said", [b"filmic", b"", b"\xff\0\xff"])
def test_a_tonemap_that_is_unknown_is_told(said, initial, tmp_path):
    file = png(tmp_path / "p.png", codes(brushed(initial)[0]))
    found = painted_image.read(with_chunk(file, b"tEXt", b"envedit.tonemap\0" + said), SIZE, "gamma", initial)
    assert found.coverage.sum() == brushed(initial)[1].sum()
    assert ("which is unknown" in told(found)) is (said != b"")
    for damage in (b"\1\0\0\0x", b"\1", b""):
        with_chunk(file, b"iTXt", b"envedit.x\0" + damage)
        with_chunk(file, b"zTXt", b"envedit.y\0" + damage)
    assert painted_image.read(file, SIZE, "gamma", initial).coverage.any()


@pytest.mark.parametrize("name", TONEMAPS)
def test_another_tonemap_is_recognised_by_what_was_not_painted(name, initial, tmp_path):
    """An editor drops the name of the tonemap, and 8 bits of 16."""
    wanted, where = brushed(initial)
    file = png(tmp_path / "p.png", codes(wanted, name))
    for exported in TONEMAPS:
        found = painted_image.read(file, SIZE, "auto", initial, exported={"tonemap": exported})
        np.testing.assert_array_equal(found.coverage[..., 0] > 0, where)
        error = tonemap(found.picture[where], name) - tonemap(wanted[where], name)
        assert np.abs(error).max() <= 0.5 / 255 + 1e-6
        assert (f"is the initial rendering under '{name}', and read so" in told(found)) is (name != exported)


@pytest.mark.parametrize("name", TONEMAPS)
def test_a_declared_tonemap_holds(name, initial, tmp_path):
    """And what another would make of the unpainted pixels is told."""
    file = png(tmp_path / "p.png", codes(brushed(initial)[0]))
    found = painted_image.read(file, SIZE, name, initial)
    error = tonemap(found.picture, name) - codes(brushed(initial)[0]) / 255
    assert np.abs(error)[RECTANGLE].max() <= 1e-6
    assert (f"and read under '{name}', as target.tonemap declares" in told(found)) is (name != "gamma")


def test_clipped_pixels_say_nothing_of_a_tonemap(initial, tmp_path):
    """A bright rendering under Reinhard, made brighter: what is white now would be white under gamma."""
    initial = 30 * initial
    wanted = np.clip(1.25 * tonemap(initial, "reinhard"), 0, 1)
    file = png(tmp_path / "p.png", np.rint(wanted * 255).astype(np.uint8))
    assert (wanted == 1).mean() > 0.5
    found = painted_image.read(file, SIZE, "auto", initial, exported={"tonemap": "reinhard"})
    counted = (found.coverage[..., 0] > 0) & ~found.excluded
    assert counted.any() and (found.picture[counted].sum(axis=1) > initial[counted].sum(axis=1)).all()


def test_a_layer_alone_is_read_under_the_tonemap_of_an_export(initial, tmp_path):
    """An editor has dropped its name, and nothing of the rendering shows."""
    lit = config.Config()
    exported = initial_rendering.origin(lit, SIZE, initial_rendering.png_tonemap(30 * initial, lit))
    assert exported["tonemap"] == "reinhard"
    file = png(tmp_path / "p.png", np.rint(layer(initial) * 255).astype(np.uint8))
    found = painted_image.read(file, SIZE, "auto", 30 * initial, exported=exported)
    paint = tonemap(found.picture[20, 30], "reinhard")
    np.testing.assert_allclose(paint, [0.2, 0.3, 0.4], atol=0.5 / 255)


@pytest.mark.parametrize("declared", TONEMAPS)
def test_black_pixels_say_nothing_of_a_tonemap(declared, initial, tmp_path):
    """Black is black under every one, and may be most of a picture."""
    initial = initial.copy()
    initial[3:] = 0
    painted = np.where(brushed(initial)[1][..., None], np.float32(0.5), initial)
    found = painted_image.read(png(tmp_path / "p.png", codes(painted, declared)), SIZE, declared, initial)
    assert "and read so" not in told(found)
    error = tonemap(found.picture, declared) - tonemap(painted, declared)
    assert np.abs(error).max() <= 0.5 / 255 + 1e-6


def test_another_rendering_is_noticed(initial, rng, tmp_path):
    other = initial * (1 + 0.3 * rng.standard_normal((*SIZE, 1))).astype(np.float32).clip(0.1)
    file = floats(tmp_path / "p.exr", other, header={"envedit.seed": 7, "envedit.tonemap": "linear"})
    found = painted_image.read(file, SIZE, "gamma", initial)
    assert "another rendering (it was made with" in told(found) and "seed 7" in told(found)
    assert found.coverage.mean() > 0.9
    warm = floats(tmp_path / "w.exr", initial * np.float32([1.1, 1, 0.9]))  # all of it, on purpose: allowed
    assert "unless all of it was painted" in told(painted_image.read(warm, SIZE, "gamma", initial))


# ---- clipped -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["gamma", "srgb", "linear"])
@pytest.mark.parametrize("top", [255, 65535])
def test_clipped_pixels_are_excluded(top, name, initial, tmp_path):
    pixels = codes(brushed(initial)[0], name, top)
    pixels[20, 30] = top
    pixels[21, 30, 0] = top  # one channel is enough
    pixels[22, 30] = 0  # black is no limit
    found = painted_image.read(png(tmp_path / "p.png", pixels), SIZE, name, initial)
    expected = (initial >= 1).any(axis=2)
    expected[20:22, 30] = True
    np.testing.assert_array_equal(found.excluded, expected)
    assert (found.coverage[20:23, 30] == 1).all() and not found.picture[22, 30].any()
    assert "2 painted pixels are clipped" in told(found)
    # Where it was clipped before, and nothing was painted, the rendering is known.
    assert found.picture[52, 8, 0] == 20 and found.coverage[52, 8] == 0


def test_white_of_a_jpeg_is_not_quite_white(initial, tmp_path):
    pixels = codes(initial)
    pixels[16:32, 16:32], pixels[32:48, 16:32] = 254, 100
    found = painted_image.read(jpeg(tmp_path / "p.jpg", pixels, 100), SIZE, "gamma", initial)
    assert found.excluded[16:32, 16:32].mean() > 0.9 and not found.excluded[32:48, 16:32].any()


# ---- alpha -------------------------------------------------------------------------------------------------
def layer(initial):
    """Return display values (h, w, 4) of a layer with one stroke, half transparent in its first column."""
    pixels = np.zeros((*SIZE, 4))
    pixels[RECTANGLE] = [0.2, 0.3, 0.4, 1]
    pixels[RECTANGLE[0], RECTANGLE[1].start, 3] = 0.6
    return pixels


@pytest.mark.parametrize("top", [255, 65535])
def test_a_layer_is_laid_over_the_rendering(top, initial, tmp_path):
    pixels = layer(initial)
    file = png(tmp_path / "p.png", np.rint(pixels * top).astype(np.uint16 if top > 255 else np.uint8))
    found = painted_image.read(file, SIZE, "gamma", initial)
    np.testing.assert_allclose(found.coverage[..., 0], pixels[..., 3], atol=1e-6)
    assert found.picture[pixels[..., 3] == 0].tobytes() == initial[pixels[..., 3] == 0].tobytes()
    edge = (RECTANGLE[0], RECTANGLE[1].start)
    mixed = 0.6 * np.array([0.2, 0.3, 0.4]) + 0.4 * tonemap(initial[edge])
    np.testing.assert_allclose(tonemap(found.picture[edge]), mixed, atol=1 / top)
    empty = SIZE[0] * SIZE[1] - 24 * 29
    assert f"{empty} pixels are transparent" in told(found) and "24 half transparent" in told(found)
    assert "laid over the initial rendering" in told(found)


def test_alpha_of_an_exr_is_premultiplied(initial, tmp_path):
    alpha = layer(initial)[..., 3].astype(np.float32)
    paint = np.float32([0.5, 2, 0.25]) * alpha[..., None]
    paint[0, 0] = 9  # colour without alpha
    found = painted_image.read(floats(tmp_path / "p.exr", paint, A=alpha), SIZE, "gamma", initial)
    np.testing.assert_allclose(found.picture[0, 0], initial[0, 0])
    expected = paint + (1 - alpha[..., None]) * initial
    expected[0, 0] = initial[0, 0]
    np.testing.assert_allclose(found.picture, expected, rtol=1e-6)
    np.testing.assert_array_equal(found.coverage[..., 0], alpha)
    alone = painted_image.read(tmp_path / "p.exr", SIZE, "gamma")
    np.testing.assert_allclose(alone.picture[alpha > 0], np.float32([[0.5, 2, 0.25]] * (24 * 29)), rtol=1e-6)
    np.testing.assert_array_equal(alone.excluded, alpha == 0)
    assert not alone.picture[0, 0].any() and "taken as it is" in told(alone)


def test_faint_alpha_is_paint_where_it_adds_more_than_a_half_rounds_by(tmp_path):
    initial = np.full((*SIZE, 3), 0.5, np.float32)
    alpha = np.full(SIZE, 1e-4, np.float32)
    found = painted_image.read(floats(tmp_path / "p.exr", 0.1 * initial, A=alpha), SIZE, "gamma", initial)
    np.testing.assert_allclose(found.coverage, 1e-4, rtol=1e-6)
    np.testing.assert_allclose(found.picture, 1.0999 * initial, rtol=1e-5)
    faint = floats(tmp_path / "p.exr", 2e-4 * initial, A=alpha)
    refused(["nothing of it is painted"], faint, SIZE, "gamma", initial)


def test_a_cropped_exr_is_not_black_paint(initial, tmp_path):
    part = brushed(initial)[0][10:40, 15:60]
    box = {"dataWindow": ((15, 10), (59, 39)), "displayWindow": ((0, 0), (82, 59))}
    found = painted_image.read(floats(tmp_path / "p.exr", part, header=box), SIZE, "gamma", initial)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, brushed(initial)[1])


def test_an_empty_layer_is_refused(initial, tmp_path):
    file = png(tmp_path / "p.png", np.zeros((*SIZE, 4), np.uint8))
    refused(["p.png", "nothing of it is painted"], file, SIZE, "gamma", initial)
    refused(["p.png", "nothing of it is painted"], file, SIZE, "gamma")


def test_layers_of_an_exr_are_named(initial, tmp_path):
    """As Krita saves them: paint on another layer than the first is not seen."""
    layers = {f"Background.{c}": initial[..., i].copy() for i, c in enumerate("RGB")}
    layers |= {f"Paint Layer 1.{c}": layer(initial)[..., i].astype("f4") for i, c in enumerate("RGBA")}
    file = exr(tmp_path / "p.exr", **layers)
    says = "2 colour layers (Background, Paint Layer 1): 'Background' was read"
    refused(["nothing of it is painted", says], file, SIZE, "gamma", initial)
    layers["Background.R"][RECTANGLE] = 0.5
    found = painted_image.read(exr(tmp_path / "q.exr", **layers), SIZE, "gamma", initial)
    assert says in told(found)


# ---- grey, palettes, marks ---------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["png", "png alpha", "jpg", "exr"])
def test_grey(kind, initial, tmp_path):
    grey = np.repeat(initial[..., 1:2], 3, axis=2).clip(0.05, 0.8)
    wanted = grey.copy()
    wanted[RECTANGLE] *= 0.3
    one = codes(wanted)[..., :1]
    if kind == "exr":
        file = exr(tmp_path / "p.exr", Y=wanted[..., 0].copy())
    elif kind == "jpg":
        file = jpeg(tmp_path / "p.jpg", one)
    else:
        opaque = np.full_like(one, 255)
        file = png(tmp_path / "p.png", np.concatenate([one, opaque], 2) if "alpha" in kind else one)
    found = painted_image.read(file, SIZE, "gamma", grey)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, brushed(initial)[1])
    assert told(found).count("read as grey") == 1 and "transparent" not in told(found)
    refused(["is grey", "RGB"], file, SIZE, "gamma", initial)
    assert painted_image.read(file, SIZE, "gamma").coverage.all()


def test_cmyk_and_another_size_are_refused(initial, tmp_path):
    frame = bytes([8]) + struct.pack(">HH", *SIZE) + bytes([4]) + bytes(12)
    data = b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame
    (tmp_path / "p.jpg").write_bytes(data + b"\xff\xda\0\2")
    refused(["p.jpg", "4 channels", "CMYK", "RGB"], tmp_path / "p.jpg", SIZE, "gamma", initial)
    file = png(tmp_path / "p.png", codes(initial)[:40])
    refused(["is 83x40 pixels", "83x60", "aspect", "--export-initial"], file, SIZE, "gamma", initial)
    file = png(tmp_path / "p.png", codes(initial)[:1, :1])
    refused(["is 1x1 pixels", "83x60", "more than 16 times"], file, SIZE, "gamma", initial)


# ---- refused -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("factor", [2, 1.5, 0.5])
@pytest.mark.parametrize("method", ["NEAREST", "BILINEAR", "BICUBIC", "LANCZOS"])
def test_a_resized_picture_is_resampled(method, factor, initial, tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    initial = initial.clip(0.05, 0.8)
    wanted, where = brushed(initial)
    size = round(factor * SIZE[1]), round(factor * SIZE[0])
    image = pillow.fromarray(codes(wanted)).resize(size, getattr(pillow, method))
    image.save(tmp_path / "p.png")
    found = painted_image.read(tmp_path / "p.png", SIZE, "gamma", initial)
    inside = np.zeros(SIZE, bool)
    inside[17:33, 25:46] = True
    around = np.ones(SIZE, bool)
    around[5:45, 13:58] = False  # beside strong paint filters ring
    assert (found.coverage[inside] == 1).all() and not found.coverage[around].any()
    assert found.picture[around].tobytes() == initial[around].tobytes()
    assert np.abs(tonemap(found.picture[inside]) - tonemap(wanted[inside])).mean() < 0.01
    assert f"is {size[0]}x{size[1]} pixels, the rendering is 83x60: resampled" in told(found)
    assert "resampled" not in told(painted_image.read(tmp_path / "p.png", SIZE, "gamma"))  # no paint


def test_a_resized_layer_keeps_its_colour(initial, tmp_path):
    pixels = np.rint(layer(initial) * 255).astype(np.uint8)
    file = png(tmp_path / "p.png", pixels.repeat(2, 0).repeat(2, 1))
    found = painted_image.read(file, SIZE, "gamma", initial)
    np.testing.assert_allclose(found.coverage[..., 0], pixels[..., 3] / 255, atol=1e-6)
    np.testing.assert_allclose(tonemap(found.picture[20, 30]), [0.2, 0.3, 0.4], atol=0.5 / 255)
    linear = floats(tmp_path / "p.exr", np.repeat(np.repeat(brushed(initial)[0], 2, 0), 2, 1))
    found = painted_image.read(linear, SIZE, "gamma", initial)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, brushed(initial)[1])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite(value, initial, tmp_path):
    wanted = initial.copy()
    wanted[7, 11, 2] = value
    refused(["row 7, column 11", "not finite"], floats(tmp_path / "p.exr", wanted), SIZE, "gamma", initial)
    alpha = np.ones(SIZE, np.float32)
    alpha[8, 3] = value
    file = floats(tmp_path / "p.exr", initial, A=alpha)
    refused(["row 8, column 3"], file, SIZE, "gamma", initial)


def test_negative_values_are_set_to_zero(initial, tmp_path):
    wanted = initial.copy()
    wanted[7, 11] = [-0.5, 1, 1]
    found = painted_image.read(floats(tmp_path / "p.exr", wanted), SIZE, "gamma", initial)
    np.testing.assert_array_equal(found.picture[7, 11], [0, 1, 1])
    assert "1 pixel is negative, the first at row 7, column 11" in told(found)


# ---- masks -------------------------------------------------------------------------------------------------
def test_a_mask_overrides_what_is_seen(initial, tmp_path):
    wanted, where = brushed(initial)
    mask = np.zeros((*SIZE, 3), np.uint8)
    mask[10:20, 15:30], mask[20:25, 15:30] = 255, 128
    file = png(tmp_path / "p.png", codes(wanted))
    found = painted_image.read(file, SIZE, "gamma", initial, png(tmp_path / "m.png", mask))
    np.testing.assert_allclose(found.coverage, mask[..., :1] / 255, atol=1e-6)
    kept = ~where | (mask[..., 0] == 0)  # what no stroke touched, and what the mask leaves out
    assert found.picture[kept].tobytes() == initial[kept].tobytes()
    assert np.abs(found.picture - initial)[~kept].min(axis=0).max() > 0
    file = png(tmp_path / "s.png", codes(initial))  # nothing differs, and that is meant
    assert painted_image.read(file, SIZE, "gamma", initial, tmp_path / "m.png").coverage.any()


@pytest.mark.parametrize("top", [255, 65535])
def test_greys_of_a_mask_are_weights(top, tmp_path):
    values = np.linspace(0, top, 24).reshape(4, 6, 1)
    pixels = np.rint(values).astype(np.uint16 if top > 255 else np.uint8)
    weight = painted_image.read_mask(png(tmp_path / "m.png", pixels), (4, 6))
    np.testing.assert_allclose(weight, pixels / top, rtol=1e-6)
    assert weight.shape == (4, 6, 1) and weight.dtype == np.float32
    strokes = np.full((4, 6, 4), 255, np.uint8)
    strokes[..., 3] = np.arange(24).reshape(4, 6)
    weight = painted_image.read_mask(png(tmp_path / "m.png", strokes), (4, 6))
    np.testing.assert_allclose(weight[..., 0] * 255, strokes[..., 3], rtol=1e-6)


def test_black_of_a_jpeg_mask_is_black(tmp_path):
    mask = np.full((*SIZE, 3), 3, np.uint8)
    mask[16:32, 16:48] = 252
    weight = painted_image.read_mask(jpeg(tmp_path / "m.jpg", mask, 100), SIZE)
    np.testing.assert_array_equal(weight[..., 0], mask[..., 0] > 100)


@pytest.mark.parametrize(("values", "says"), [
    (np.zeros((4, 6, 3)), "black everywhere"),
    (np.ones((4, 5, 3)), "is 5x4 pixels, the target is 6x4"),
    (np.full((4, 6, 3), np.nan), "row 0, column 0"),
    (np.full((4, 6, 3), -1.0), "black everywhere"),
])  # fmt: skip
def test_masks_that_cannot_be_used(values, says, tmp_path):
    with pytest.raises(InputError, match=rf"m\.exr.*{says}"):
        painted_image.read_mask(floats(tmp_path / "m.exr", values), (4, 6))


# ---- the rendering to paint on -----------------------------------------------------------------------------
def settings(**target):
    return config.Config(target=config.Target(**target), seed=3)


@pytest.mark.parametrize("ending", [".exr", ".png", ".PNG"])
@pytest.mark.parametrize("name", TONEMAPS)
def test_exported_and_painted_on(ending, name, initial, tmp_path):
    file = tmp_path / f"paint{ending}"
    asked = settings(**{"tonemap": name} if name in ("log", "reinhard") else {})  # the others clip highlights
    told_now = initial_rendering.export(file, initial, asked)
    pixels, info = images.read_stored(file)
    stored = info["metadata"]
    assert [str(stored[f"envedit.{k}"]) for k in ("scene", "envmap", "seed")] == ["sphere", "auto", "3"]
    used = name if name in ("log", "reinhard") else "reinhard"
    assert stored["envedit.tonemap"] == ("linear" if ending == ".exr" else used) and not told_now
    refused(["nothing of it is painted"], file, SIZE, "auto", initial)
    if ending == ".exr":
        np.testing.assert_array_equal(pixels, initial)
        assert "envmap" not in OpenEXR.File(str(file), header_only=True).header()
        pixels[RECTANGLE] *= 0.5
        floats(file, pixels)
    else:
        np.testing.assert_array_equal(pixels, codes(initial, used, 65535))
        assert (pixels < 65535).all()
        pixels[RECTANGLE] //= 2
        png(file, pixels)
    found = painted_image.read(file, SIZE, "auto", initial)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, brushed(initial)[1])


def test_a_declared_tonemap_is_that_of_the_export(initial, tmp_path):
    warnings = initial_rendering.export(tmp_path / "a.png", initial, settings(tonemap="gamma"))
    assert "% of the pixels are clipped under the 'gamma' tonemap" in warnings[0]
    assert images.read_stored(tmp_path / "a.png")[1]["metadata"]["envedit.tonemap"] == "gamma"


def exported(made="gamma", **of_run):
    """Return what exports of a run say of themselves."""
    return initial_rendering.origin(config.Config(**of_run), (*SIZE, 3), made)


@pytest.mark.parametrize("drops", ["nothing", "texts", "texts and name", "texts, name and size"])
@pytest.mark.parametrize(
    ("given", "key"),
    [({"input": {"width": 128}}, "input.width 256"), ({"target": {"spp": 64}}, "target.spp auto"),
     ({"input": {"tilt_degrees": 3.0}}, "input.tilt_degrees 0.0"), ({"seed": 4}, "seed 0")],
)  # fmt: skip
def test_a_picture_of_another_rendering_is_refused(drops, given, key, initial, tmp_path):
    made = config.Config()
    file = tmp_path / "paint_me.png"
    initial_rendering.export(file, initial, made)
    wanted = brushed(initial)[0]
    if drops == "nothing":
        texts = images.read_stored(file)[1]["metadata"].items()
        kept = {key: text for key, text in texts if key.startswith("envedit.")}
        images.write_png(file, tonemap(wanted, "reinhard"), 16, kept)
    else:
        file = file if drops == "texts" else tmp_path / "painted.png"
        pixels = codes(wanted, "reinhard")
        png(file, pixels.repeat(2, 0).repeat(2, 1) if "size" in drops else pixels)
    found = painted_image.read(file, SIZE, "auto", initial, exported=exported("reinhard"))
    assert (found.coverage[..., 0] > 0)[RECTANGLE].all() and "under" not in told(found)
    other = exported("reinhard", **given)
    says = [f"{file}: ", f"exported with {key}, where this run has", "export it again"]
    says += [] if drops == "nothing" else ["paint_me.png.envedit.json"]
    refused(says, file, SIZE, "auto", initial, exported=other)


def test_a_picture_exported_at_another_size_is_refused(initial, tmp_path):
    file = tmp_path / "p.png"
    initial_rendering.export(file, initial.repeat(2, 0).repeat(2, 1), config.Config())
    says = ["exported with scene.width 166, scene.height 120, where this run has 83, 60"]
    refused(says, file, SIZE, "auto", initial, exported=exported())


def test_a_neighbour_of_another_scene_says_nothing(initial, tmp_path):
    initial_rendering.export(tmp_path / "a.png", initial, config.Config(scene={"file": "statue"}, seed=9))
    (tmp_path / "b.png.envedit.json").write_bytes(b"\xff{")
    (tmp_path / "c.png.envedit.json").write_bytes(b"[1]")
    (tmp_path / "d.png.envedit.json").write_bytes(b"[" * 65536)
    file = png(tmp_path / "p.png", codes(brushed(initial)[0]))
    here = exported()
    found = painted_image.read(file, SIZE, "auto", initial, exported=here)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, brushed(initial)[1])
    # Of several of the same scene, one that agrees with this run counts.
    initial_rendering.export(tmp_path / "e.png", initial, config.Config(seed=8), "gamma")
    refused(["e.png.envedit.json", "seed 8"], file, SIZE, "auto", initial, exported=here)
    initial_rendering.export(tmp_path / "f.png", initial, config.Config(), "gamma")
    assert painted_image.read(file, SIZE, "auto", initial, exported=here).coverage.any()


def test_of_exports_under_several_maps_that_of_the_run_s_map_counts(initial, tmp_path):
    for name, curve in (("a_grey", "gamma"), ("noon", "reinhard"), ("z_grey", "gamma")):
        made = config.Config(input={"envmap": f"{name}.exr"})
        initial_rendering.export(tmp_path / f"{name}.png", initial, made, curve)
    file = png(tmp_path / "painted.png", codes(brushed(initial)[0], "reinhard"))
    here = exported("reinhard", input={"envmap": "noon.exr"})
    found = painted_image.read(file, SIZE, "reinhard", initial, exported=here)
    np.testing.assert_array_equal(found.coverage[..., 0] > 0, brushed(initial)[1])


def test_texts_of_a_png_are_as_another_program_reads_them(tmp_path, rng):
    picture = rng.random((5, 7, 3))
    named = {"envedit.tonemap": "gamma", "envedit.envmap": "fjälls 空.hdr"}
    images.write_png(tmp_path / "a.png", picture, 16, named)
    texts = pytest.importorskip("PIL.Image").open(tmp_path / "a.png").text
    assert texts["envedit.tonemap"] == "gamma" and texts["envedit.envmap"] == "fjälls ?.hdr"
    pixels, info = images.read_stored(tmp_path / "a.png")
    assert info["metadata"]["envedit.tonemap"] == "gamma"
    np.testing.assert_array_equal(pixels, np.rint(picture.astype(np.float32) * np.float32(65535)))
