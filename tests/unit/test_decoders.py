"""Reading images of every kind, against hand-made files and files damaged on purpose."""

import os
import struct
import sys
import threading
import time
import zlib

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit.core import primaries
from envedit.core.color import srgb_to_linear
from envedit.core.errors import InputError
from envedit.images import exr as exr_module
from envedit.images import images
from tests.oracles.builders import SCANLINE, exr, planes, png, stacked, turned, with_chunk


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
@pytest.mark.parametrize("alpha", [False, True])
def test_exr_pixel_types(tmp_path, rng, dtype, alpha):
    p = planes(rng, dtype)
    extra = {"A": np.zeros((4, 8), dtype)} if alpha else {}
    found, info = images.read(exr(tmp_path / "a.exr", **extra, **p))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, stacked(p))
    assert (info["format"], info["size"], info["hdr"], info["warnings"]) == ("exr", (8, 4), True, [])


def test_exr_mixed_types_layers_and_parts(tmp_path, rng):
    p = planes(rng)
    mixed = {"R": p["R"].astype(np.float16), "G": p["G"], "B": p["B"].astype(np.uint32)}
    np.testing.assert_array_equal(images.read(exr(tmp_path / "m.exr", **mixed))[0], stacked(mixed))

    other = {f"aov.{c}": np.zeros((4, 8), np.float32) for c in "RGB"}
    layers = {f"View.Combined.{c}": p[c] for c in "RGB"} | other | {"Z": p["R"]}
    found, info = images.read(exr(tmp_path / "l.exr", **layers))
    np.testing.assert_array_equal(found, stacked(p))
    assert info["warnings"] == ["2 colour layers (View.Combined, aov): 'View.Combined' was read"]

    part = OpenEXR.Part(dict(SCANLINE), {"Z": p["R"]}, "depth")
    colour = OpenEXR.Part(dict(SCANLINE), dict(p), "colour")
    OpenEXR.File([part, colour]).write(str(tmp_path / "p.exr"))
    np.testing.assert_array_equal(images.read(tmp_path / "p.exr")[0], stacked(p))


@pytest.mark.parametrize(("parts", "channels", "label"), [
    (("ViewLayer.AO", "ViewLayer.Combined"), ("", ""), "ViewLayer.Combined"),
    (("ViewLayer.Combined_Key", "ViewLayer.Combined"), ("", ""), "ViewLayer.Combined"),
    (("one", "two"), ("diffuse.", "beauty."), "two.beauty"),
    (("View.AO", "View.Combined"), ("View.AO.", "View.Combined."), "View.Combined"),
])  # fmt: skip
def test_the_part_of_the_picture_is_read(parts, channels, label, tmp_path, rng):
    """It is named so, by part or layer; every layer with colour is told."""
    p = planes(rng)
    written = [
        OpenEXR.Part(dict(SCANLINE), {prefix + c: values[c] for c in "RGB"}, part)
        for part, prefix, values in zip(parts, channels, (planes(rng), p), strict=True)
    ]
    OpenEXR.File(written).write(str(tmp_path / "p.exr"))
    found, info = images.read(tmp_path / "p.exr")
    np.testing.assert_array_equal(found, stacked(p))
    assert info["warnings"][0].startswith(f"2 colour layers ({parts[0]}")
    assert info["warnings"][0].endswith(f"{label}): '{label}' was read")


def test_exr_of_many_channels_is_refused_before_it_is_decoded(tmp_path, rng, monkeypatch):
    """The library decodes all of them, whichever are asked for."""
    more = {f"aov{i}": np.zeros((4, 8), np.float32) for i in range(9)}
    path = exr(tmp_path / "many.exr", **planes(rng), **more)
    monkeypatch.setattr(exr_module, "_MOST_VALUES", 12 * 32)
    assert images.read(path)[0].shape == (4, 8, 3)
    monkeypatch.setattr(exr_module, "_MOST_VALUES", 12 * 32 - 1)
    with pytest.raises(InputError, match="its 12 channels hold more than 383 values; save only colour"):
        images.read(path)


def test_exr_luminance_is_grey_and_no_colour_is_refused(tmp_path, rng):
    y = rng.random((4, 8)).astype(np.float32)
    found, info = images.read(exr(tmp_path / "y.exr", Y=y))
    np.testing.assert_array_equal(found, np.repeat(y[..., None], 3, 2))
    assert "luminance" in info["warnings"][0]
    with pytest.raises(InputError, match=r"z.exr: no R, G, B channels \(found: Z\)"):
        images.read(exr(tmp_path / "z.exr", Z=rng.random((4, 8)).astype(np.float32)))


def test_a_data_window_is_placed_in_the_display_window(tmp_path, rng):
    p = planes(rng)
    box = {"dataWindow": ((2, 1), (9, 4)), "displayWindow": ((0, 0), (7, 3))}
    path = exr(tmp_path / "w.exr", box, **p)
    found, info = images.read(path)
    expected = np.zeros((4, 8, 3), np.float32)
    expected[1:, 2:] = stacked(p)[:3, :6]
    np.testing.assert_array_equal(found, expected)
    assert "cropped" in info["warnings"][0]


def rgbe_file(path, body, size="-Y 4 +X 8", header="FORMAT=32-bit_rle_rgbe\n"):
    path.write_bytes(f"#?RADIANCE\n{header}\n{size}\n".encode() + body)
    return path


def run_length(rows):
    body = b""
    for row in rows:
        body += bytes([2, 2, 0, len(row)])
        for c in range(4):
            same = (row[:, c] == row[0, c]).all()
            body += bytes([128 + len(row), row[0, c]]) if same else bytes([len(row)]) + row[:, c].tobytes()
    return body


def test_radiance_encodings(tmp_path, rng):
    q = rng.integers(128, 256, (4, 8, 4)).astype(np.uint8)
    q[0, 0] = 0
    q[1] = q[1, 0]
    q[2, :, 3] = 148
    expected = np.where(q[..., 3:] > 0, q[..., :3] * 2.0 ** (q[..., 3:] - 136.0), 0).astype(np.float32)
    old = q[0].tobytes() + q[1, 0].tobytes() + bytes([1, 1, 1, 7]) + q[2:].tobytes()
    for name, body in (("flat", q.tobytes()), ("new", run_length(q)), ("old", old)):
        found, info = images.read(rgbe_file(tmp_path / f"{name}.hdr", body))
        np.testing.assert_array_equal(found, expected, err_msg=name)
        assert info["format"] == "hdr" and info["hdr"] and not info["warnings"]
    # A run longer than 255: the second marker counts in units of 256.
    long = q[0, 1].tobytes() + bytes([1, 1, 1, 255 - 1, 1, 1, 1, 1]) + bytes([1, 1, 1, 1])
    found, _ = images.read(rgbe_file(tmp_path / "long.hdr", long[:12], size="-Y 1 +X 511"))
    np.testing.assert_array_equal(found, np.broadcast_to(expected[0, 1], (1, 511, 3)))


@pytest.mark.parametrize(("header", "told"), [
    ("EXPOSURE=2\nEXPOSURE=4.0\n", "EXPOSURE=8 in its header is not undone"),
    ("EXPOSURE=2\nEXPOSURE=0.5\n", None),
    ("EXPOSURE=2\nEXPOSURE=x\n", "EXPOSURE=2, x in its header"),
    ("COLORCORR=1 2 1\nCOLORCORR=1 2 0.5\n", "COLORCORR=1 4 0.5 in its header"),
    ("EXPOSURE = 2.5EV \n", "EXPOSURE=2.5EV in its header"),  # odd, and no damage
    ("EXPOSURE=1 1 1\n", None),
    ("GAMMA=2.2\n", "GAMMA=2.2 in its header is not undone"),
    ("GAMMA=1\nPRIMARIES=0 0 0 0 0 0 0 0\n", None),  # what some programs write into every file
    ("PRIMARIES=0.64 0.33 0.30 0.60 0.15 0.06 0.3127 0.3290\n", None),
    ("PRIMARIES=.713 .293 .165 .830 .128 .044 .32168 .33767\n", "converted from ACEScg to Rec. 709"),
])  # fmt: skip
def test_radiance_marks(header, told, tmp_path, rng):
    q = rng.integers(128, 256, (4, 8, 4)).astype(np.uint8).tobytes()
    expected, _ = images.read(rgbe_file(tmp_path / "p.hdr", q))
    found, info = images.read(rgbe_file(tmp_path / "e.hdr", q, header=header))
    assert [told in line for line in info["warnings"]] == [True] if told else not info["warnings"]
    if "PRIMARIES=.713" in header:
        expected = primaries.converted(expected, primaries.to_rec709(primaries.ACES_AP1))
    np.testing.assert_array_equal(found, expected)


def test_flat_pixels_whose_first_looks_like_a_run(tmp_path, rng):
    q = rng.integers(128, 256, (4, 8, 4)).astype(np.uint8)
    expected, _ = images.read(rgbe_file(tmp_path / "a.hdr", q.tobytes()))
    q[0, 0] = 2, 2, 0, 8  # 8 texels follow, by channels
    found, _ = images.read(rgbe_file(tmp_path / "b.hdr", q.tobytes()))
    np.testing.assert_array_equal(found.reshape(-1, 3)[1:], expected.reshape(-1, 3)[1:])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_is_decoded_and_flagged(tmp_path, rng, dtype, channels):
    top = np.iinfo(dtype).max
    q = rng.integers(0, top + 1, (4, 8, channels)).astype(dtype)
    q[0, 0], q[0, 1] = 0, top
    found, info = images.read(png(tmp_path / "a.png", q))
    s = np.repeat(q, 3, 2) / top if channels == 1 else q[..., :3] / top
    expected = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    if channels == 4:  # what is transparent gives no light
        expected *= q[..., 3:] / top
        assert f"{(q[..., 3] < top).sum()} texels are transparent" in info["warnings"][1]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert found.dtype == np.float32 and found.shape == (4, 8, 3)
    assert info["hdr"] is False and "not HDR" in info["warnings"][0]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_maps_are_turned_upright(orientation, tmp_path, rng):
    """As the EXIF standard has it: on which sides the stored first row and first column are seen."""
    upright = rng.integers(0, 256, (4, 8, 3)).astype(np.uint8)
    stored = {
        1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1],
        5: upright.swapaxes(0, 1), 6: np.rot90(upright), 7: np.rot90(upright, 2).swapaxes(0, 1),
        8: np.rot90(upright, -1),
    }[orientation]  # fmt: skip
    path = with_chunk(png(tmp_path / "a.png", stored), b"eXIf", turned(orientation))
    found, info = images.load_envmap(path)
    np.testing.assert_array_equal(found, images.load_envmap(png(tmp_path / "u.png", upright))[0])
    told = f"turned upright, as its EXIF orientation {orientation} says"
    assert (told in info["warnings"]) is (orientation > 1) and info["size"] == (8, 4)


@pytest.mark.parametrize("gamma", [100_000, 55_556, 45_455, 45_000, 0])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_curve_that_a_png_says(gamma, dtype, tmp_path, rng):
    """gAMA is honoured, in maps and pictures, unless it stands for sRGB or another mark goes before it."""
    top = np.iinfo(dtype).max
    q = rng.integers(0, top + 1, (4, 8, 4)).astype(dtype)
    q[..., 3] = top
    bitmap = mi.Bitmap(q)
    bitmap.set_srgb_gamma(False)  # no mark of its own
    bitmap.write(str(tmp_path / "a.png"))
    path = with_chunk(tmp_path / "a.png", b"gAMA", struct.pack(">I", gamma))
    odd = gamma > 50_000
    codes = q[..., :3] / top
    light = codes ** (100_000 / gamma) if odd else srgb_to_linear(codes)
    found, info = images.read(path)
    np.testing.assert_allclose(found, light, atol=3e-5)
    assert ("(gAMA): converted to sRGB" in info["warnings"][0]) is odd
    stored, info = images.read_stored(path)
    values = stored / np.iinfo(stored.dtype).max
    np.testing.assert_allclose(srgb_to_linear(values[..., :3]), light, atol=3e-5)
    assert len(info["warnings"]) == odd and (values[..., 3] == 1).all()
    _, info = images.read(with_chunk(path, b"sRGB", b"\0"))
    assert "gAMA" not in info["warnings"][0]


@pytest.mark.parametrize(("kind", "data", "odd"), [
    (b"iCCP", b"ICC\0\0" + zlib.compress(b"GIMP built-in Linear sRGB"), True),
    (b"iCCP", b"ICC\0\0" + zlib.compress(b"sRGB IEC61966-2.1"), False),
    (b"cICP", b"\x09\x10\0\1", True),  # Rec. 2020, PQ
    (b"cICP", b"\1\r\0\1", False),
])  # fmt: skip
def test_a_profile_that_is_not_srgb_is_told_of_maps(kind, data, odd, tmp_path):
    path = png(tmp_path / "a.png", np.full((4, 8, 3), 188, np.uint8))
    _, info = images.load_envmap(with_chunk(path, kind, data))
    assert ("its colour profile is not sRGB" in info["warnings"][0]) is odd


def test_jpeg(tmp_path):
    found, info = images.read(png(tmp_path / "a.jpg", np.full((16, 32, 3), 188, np.uint8)))
    np.testing.assert_allclose(found, 0.503, atol=0.01)  # sRGB 188 is half the light
    assert info["format"] == "jpeg" and info["size"] == (32, 16)


def damaged_files(folder, rng):
    p = planes(rng, size=(64, 128))
    raw = exr(folder / "whole.exr", **p).read_bytes()
    at = raw.index(b"dataWindow\0box2i\0") + 17 + 4
    lines = run_length(rng.integers(128, 256, (4, 8, 4)).astype(np.uint8))
    hdr = rgbe_file(folder / "whole.hdr", lines).read_bytes()
    q = rng.integers(0, 256, (64, 128, 3)).astype(np.uint8)
    codes, jpg = (png(folder / f"whole.{kind}", q).read_bytes() for kind in ("png", "jpg"))
    sof = jpg.index(b"\xff\xc0") + 5
    dqt = jpg.index(b"\xff\xdb") + 2

    def window(x, y):
        return raw[:at] + struct.pack("<4i", 0, 0, x, y) + raw[at + 16 :]

    files = {
        "empty.exr": (b"", "is empty"),
        "text.exr": (b"<html>not found</html>", "not an image"),
        "text.hdr": (b"P6 8 4", "not an image"),
        "half.exr": (raw[: len(raw) // 2], "damaged or truncated"),
        "head.exr": (raw[:60], "damaged or truncated"),
        "magic.exr": (raw[:4], "damaged or truncated"),
        "noise.exr": (raw[:700] + rng.bytes(len(raw) - 700), "damaged or truncated"),
        "wide.exr": (window(199_999, 99_999), "declares 200000 x 100000 texels"),
        "many.exr": (window(32_000, 31_000), "declares 32001 x 31001 texels"),
        "widest.exr": (window(2**31 - 2, 2**31 - 2), "exr: "),
        "negative.exr": (window(-5, -5), "exr: "),
        "half.hdr": (hdr[: len(hdr) - 9], "damaged or truncated"),
        "head.hdr": (hdr[:30], "damaged or truncated"),
        "long.hdr": (hdr.replace(b"\x02\x02\x00\x08\x08", b"\x02\x02\x00\x08\xff"), "is too long"),
        "flat.hdr": (hdr[: hdr.index(b"+X 8") + 5] + bytes(range(3, 40)), "damaged or truncated"),
        "wide.hdr": (hdr.replace(b"-Y 4 +X 8", b"-Y 100000 +X 200000"), "declares 200000 x 100000 texels"),
        "xyz.hdr": (hdr.replace(b"rle_rgbe", b"rle_xyze"), "holds XYZ colours"),
        "turned.hdr": (hdr.replace(b"-Y 4 +X 8", b"+Y 4 +X 8"), "rows are stored as '+Y 4 +X 8'"),
        "none.hdr": (hdr.replace(b"-Y 4 +X 8", b"-Y 0 +X 0"), "declares 0 x 0 texels"),
        "half.png": (codes[: len(codes) // 2], "damaged or truncated"),
        "magic.png": (codes[:8], "png: "),
        "wide.png": (codes[:16] + struct.pack(">2I", *2 * [2**31 - 1]) + codes[24:], "declares 2147483647 x"),
        "half.jpg": (jpg[: len(jpg) // 2], "damaged or truncated"),
        "magic.jpg": (jpg[:3], "damaged or truncated"),
        "table.jpg": (jpg[:dqt] + struct.pack(">H", 66) + jpg[dqt + 2 :], "damaged"),  # a value is missing
        "wide.jpg": (jpg[:sof] + b"\xff\xff\xff\xff" + jpg[sof + 4 :], "declares 65535 x 65535 texels"),
    }
    for name, (content, words) in files.items():
        (folder / name).write_bytes(content)
        yield name, words
    (folder / "folder.exr").mkdir()
    os.mkfifo(folder / "pipe.exr")
    yield from {"folder.exr": "is a folder", "pipe.exr": "no regular", "gone.exr": "no such file"}.items()


def test_damaged_files_are_refused_quietly(tmp_path, rng, capfd):
    for name, words in damaged_files(tmp_path, rng):
        with pytest.raises(InputError) as e:
            images.read(tmp_path / name)
        message = str(e.value)
        assert message.startswith(str(tmp_path / name)) and words in message, message
        assert "\n" not in message
    assert capfd.readouterr() == ("", "")  # no library has spoken over us


def test_threads_that_read_leave_the_standard_streams_as_they_were(tmp_path, rng):
    path = exr(tmp_path / "a.exr", **planes(rng))
    before = [os.fstat(descriptor) for descriptor in (1, 2)]
    streams = sys.stdout, sys.stderr
    start = threading.Barrier(4)

    def read_some():
        start.wait(20)
        for _ in range(50):
            images.read(path)

    threads = [threading.Thread(target=read_some) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    after = [os.fstat(descriptor) for descriptor in (1, 2)]
    assert [(a.st_dev, a.st_ino) for a in after] == [(b.st_dev, b.st_ino) for b in before]
    assert (sys.stdout, sys.stderr) == streams


def test_no_file_stays_open(tmp_path, rng):
    before = set(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else pytest.skip("no /proc")
    kept = [images.read(exr(tmp_path / "a.exr", **planes(rng)))]
    assert set(os.listdir("/proc/self/fd")) == before and kept


@pytest.mark.parametrize("size", [(9, 2**22 + 8), (2**31 - 1, 8), (2**16, 2**16), (1025, 1024)])
def test_tiles_larger_than_the_image_are_refused(tmp_path, rng, size):
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 8, 4
    path = exr(tmp_path / "t.exr", {"type": OpenEXR.tiledimage, "tiles": tiles}, **planes(rng, size=(16, 32)))
    assert images.read(path)[0].shape == (16, 32, 3)
    raw = bytearray(path.read_bytes())
    struct.pack_into("<2I", raw, raw.index(b"tiles\0tiledesc\0") + 19, *size)
    path.write_bytes(raw)
    words = "tiles of" if max(size) < 2**31 - 1 else "tiles of|damaged"  # the library refuses some itself
    with pytest.raises(InputError, match=words):
        images.read(path)


def test_jpeg_2000_that_ends_early_is_damaged_and_quiet(tmp_path, capfd):
    smooth = np.float32(np.add.outer(np.arange(16), np.arange(32)) / 64)
    method = getattr(OpenEXR, "HTJ2K256_COMPRESSION", None)
    if method is None:
        pytest.skip("this OpenEXR has no JPEG 2000")
    path = exr(tmp_path / "j.exr", {"compression": method}, **{c: smooth.copy() for c in "RGB"})
    np.testing.assert_array_equal(images.read(path)[0][..., 0], smooth)
    raw = path.read_bytes()
    read = 0
    for at in range(len(raw) - 400, len(raw), 7):  # within the stream: all that follows moves
        path.write_bytes(raw[:at] + b"\xff\x7f\0" + raw[at:])
        try:
            found = images.read(path)[0]
            read += not np.array_equal(found[..., 0], smooth)
        except InputError as error:
            assert "damaged" in str(error)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "line", [b"EXPOSURE=a" + b" " * 60_000 + b"b", b"EXPOSURE=" + b"e" * 60_000, b"a" * 60_000 + b" ="]
)
def test_a_long_line_in_a_radiance_header_takes_no_time(tmp_path, line):
    (tmp_path / "l.hdr").write_bytes(b"#?RADIANCE\n" + line + b"\n\n-Y 4 +X 8\n" + bytes(range(128)))
    start = time.process_time()
    _, info = images.read(tmp_path / "l.hdr")
    assert time.process_time() - start < 2  # with a pattern: 10 to 25 s of processor time
    assert all(len(w) < 200 and w.isprintable() for w in info["warnings"])
