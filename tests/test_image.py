"""Reading, mending and writing images, against hand-made files; the sun and sky against Mitsuba's plugin."""

import os
import resource
import signal
import struct
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit import image, latlong
from envedit.errors import ConfigError, InputError, NumericalError

SCANLINE = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}


def exr(path, header=None, **channels):
    OpenEXR.File(SCANLINE | (header or {}), channels).write(str(path))
    return path


def planes(rng, dtype=np.float32, size=(4, 8)):
    return {c: (rng.random(size) * 100).astype(dtype) for c in "RGB"}


def stacked(p):
    return np.stack([p[c] for c in "RGB"], -1).astype(np.float32)


# -----------------------------------------------------------------------------------------------------------
# Reading


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
@pytest.mark.parametrize("alpha", [False, True])
def test_exr_pixel_types(tmp_path, rng, dtype, alpha):
    p = planes(rng, dtype)
    extra = {"A": np.zeros((4, 8), dtype)} if alpha else {}
    found, info = image.read(exr(tmp_path / "a.exr", **extra, **p))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, stacked(p))
    assert (info["format"], info["size"], info["hdr"], info["warnings"]) == ("exr", (8, 4), True, [])


def test_exr_mixed_types_layers_and_parts(tmp_path, rng):
    p = planes(rng)
    mixed = {"R": p["R"].astype(np.float16), "G": p["G"], "B": p["B"].astype(np.uint32)}
    np.testing.assert_array_equal(image.read(exr(tmp_path / "m.exr", **mixed))[0], stacked(mixed))

    other = {f"aov.{c}": np.zeros((4, 8), np.float32) for c in "RGB"}
    layers = {f"View.Combined.{c}": p[c] for c in "RGB"} | other | {"Z": p["R"]}
    found, info = image.read(exr(tmp_path / "l.exr", **layers))
    np.testing.assert_array_equal(found, stacked(p))
    assert info["warnings"] == ["2 colour layers: 'View.Combined' was read"]

    part = OpenEXR.Part(dict(SCANLINE), {"Z": p["R"]}, "depth")
    colour = OpenEXR.Part(dict(SCANLINE), dict(p), "colour")
    OpenEXR.File([part, colour]).write(str(tmp_path / "p.exr"))
    np.testing.assert_array_equal(image.read(tmp_path / "p.exr")[0], stacked(p))


def test_exr_luminance_is_grey(tmp_path, rng):
    y = rng.random((4, 8)).astype(np.float32)
    found, info = image.read(exr(tmp_path / "y.exr", Y=y))
    np.testing.assert_array_equal(found, np.repeat(y[..., None], 3, 2))
    assert "luminance" in info["warnings"][0]


def test_exr_window_and_primaries(tmp_path, rng):
    p = planes(rng)
    box = {"dataWindow": ((2, 1), (9, 4)), "displayWindow": ((0, 0), (7, 3))}
    header = {"chromaticities": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)}  # ACES AP0
    path = exr(tmp_path / "w.exr", box, **p)
    found, info = image.read(path)
    expected = np.zeros((4, 8, 3), np.float32)
    expected[1:, 2:] = stacked(p)[:3, :6]
    np.testing.assert_array_equal(found, expected)
    assert "cropped" in info["warnings"][0]
    _, info = image.read(exr(tmp_path / "aces.exr", header, **p))
    assert "not Rec.709" in info["warnings"][0]


def test_exr_without_colour(tmp_path, rng):
    with pytest.raises(InputError, match=r"z.exr: no R, G, B channels \(found: Z\)"):
        image.read(exr(tmp_path / "z.exr", Z=rng.random((4, 8)).astype(np.float32)))


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
        found, info = image.read(rgbe_file(tmp_path / f"{name}.hdr", body))
        np.testing.assert_array_equal(found, expected, err_msg=name)
        assert info["format"] == "hdr" and info["hdr"] and not info["warnings"]
    # A run longer than 255: the second marker counts in units of 256.
    long = q[0, 1].tobytes() + bytes([1, 1, 1, 255 - 1, 1, 1, 1, 1]) + bytes([1, 1, 1, 1])
    found, _ = image.read(rgbe_file(tmp_path / "long.hdr", long[:12], size="-Y 1 +X 511"))
    np.testing.assert_array_equal(found, np.broadcast_to(expected[0, 1], (1, 511, 3)))


def test_radiance_header(tmp_path, rng):
    q = rng.integers(128, 256, (4, 8, 4)).astype(np.uint8).tobytes()
    with pytest.raises(InputError, match=r"x.hdr: holds XYZ colours"):
        image.read(rgbe_file(tmp_path / "x.hdr", q, header="FORMAT=32-bit_rle_xyze\n"))
    with pytest.raises(InputError, match=r"x.hdr: rows are stored as '\+Y 4 \+X 8'"):
        image.read(rgbe_file(tmp_path / "x.hdr", q, size="+Y 4 +X 8"))
    _, info = image.read(rgbe_file(tmp_path / "e.hdr", q, header="EXPOSURE=2.5\n"))
    assert "EXPOSURE=2.5" in info["warnings"][0]
    assert not image.read(rgbe_file(tmp_path / "e.hdr", q, header="EXPOSURE=1.000\n"))[1]["warnings"]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_is_decoded_and_flagged(tmp_path, rng, dtype, channels):
    top = np.iinfo(dtype).max
    q = rng.integers(0, top + 1, (4, 8, channels)).astype(dtype)
    q[0, 0], q[0, 1] = 0, top
    mi.Bitmap(q).write(str(tmp_path / "a.png"))
    found, info = image.read(tmp_path / "a.png")
    s = np.repeat(q, 3, 2) / top if channels == 1 else q[..., :3] / top
    expected = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert found.dtype == np.float32 and found.shape == (4, 8, 3)
    assert info["hdr"] is False and "not HDR" in info["warnings"][0]


def test_jpeg(tmp_path):
    mi.Bitmap(np.full((16, 32, 3), 188, np.uint8)).write(str(tmp_path / "a.jpg"))
    found, info = image.read(tmp_path / "a.jpg")
    np.testing.assert_allclose(found, 0.503, atol=0.01)  # sRGB 188 is half the light
    assert info["format"] == "jpeg" and info["size"] == (32, 16)


def damaged_files(folder, rng):
    """Yield (name, words of the message) for files that must be refused."""
    p = planes(rng, size=(64, 128))
    raw = exr(folder / "whole.exr", **p).read_bytes()
    at = raw.index(b"dataWindow\0box2i\0") + 17 + 4
    hdr = rgbe_file(folder / "whole.hdr", run_length(rng.integers(128, 256, (4, 8, 4)).astype(np.uint8)))
    hdr = hdr.read_bytes()
    for kind in ("png", "jpg"):
        mi.Bitmap(rng.integers(0, 256, (64, 128, 3)).astype(np.uint8)).write(str(folder / f"whole.{kind}"))
    png, jpg = ((folder / f"whole.{k}").read_bytes() for k in ("png", "jpg"))
    sof = jpg.index(b"\xff\xc0") + 5

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
        "none.hdr": (hdr.replace(b"-Y 4 +X 8", b"-Y 0 +X 0"), "declares 0 x 0 texels"),
        "half.png": (png[: len(png) // 2], "damaged or truncated"),
        "magic.png": (png[:8], "png: "),
        "wide.png": (png[:16] + struct.pack(">2I", 2**31 - 1, 2**31 - 1) + png[24:], "declares 2147483647 x"),
        "half.jpg": (jpg[: len(jpg) // 2], "damaged or truncated"),
        "magic.jpg": (jpg[:3], "damaged or truncated"),
        "wide.jpg": (jpg[:sof] + b"\xff\xff\xff\xff" + jpg[sof + 4 :], "declares 65535 x 65535 texels"),
    }
    for name, (content, words) in files.items():
        (folder / name).write_bytes(content)
        yield name, words
    (folder / "folder.exr").mkdir()
    os.mkfifo(folder / "pipe.exr")
    yield from (
        ("folder.exr", "is a folder"),
        ("pipe.exr", "not a regular file"),
        ("gone.exr", "no such file"),
    )


def test_damaged_files_are_refused_quietly(tmp_path, rng, capfd):
    for name, words in damaged_files(tmp_path, rng):
        with pytest.raises(InputError) as e:
            image.read(tmp_path / name)
        message = str(e.value)
        assert message.startswith(str(tmp_path / name)) and words in message, message
        assert "\n" not in message
    assert capfd.readouterr() == ("", "")  # no library has spoken over us


def test_reading_survives_random_damage(tmp_path, rng):
    """Flip bytes: each file either reads or is refused, in a process that must end well."""
    exr(tmp_path / "a.exr", **planes(rng, np.float16, (8, 16)))
    rgbe_file(tmp_path / "a.hdr", run_length(rng.integers(128, 256, (4, 8, 4)).astype(np.uint8)))
    script = """
import sys, numpy as np
from pathlib import Path
from envedit import image
from envedit.errors import InputError
rng, folder, refused = np.random.default_rng(1), Path(sys.argv[1]), 0
for name in ("a.exr", "a.hdr"):
    raw = np.frombuffer((folder / name).read_bytes(), np.uint8)
    for _ in range(200):
        bad = raw.copy()
        bad[rng.integers(4, len(raw), 3)] = rng.integers(0, 256, 3)
        (folder / ("b" + name)).write_bytes(bad.tobytes())
        try:
            image.read(folder / ("b" + name))
        except InputError:
            refused += 1
print(refused)
"""
    done = subprocess.run([sys.executable, "-c", script, tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 20


def test_no_file_stays_open(tmp_path, rng):
    before = set(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else pytest.skip("no /proc")
    kept = [image.read(exr(tmp_path / "a.exr", **planes(rng)))]
    assert set(os.listdir("/proc/self/fd")) == before and kept


def test_real_maps(data):
    for name in ("puresky/kloofendal_48d_partly_cloudy_puresky_1k.hdr", "hdri/venice_sunset_1k.hdr"):
        found, info = image.read(data / name)
        assert found.shape == (512, 1024, 3) and not info["warnings"]
        # Independent decoder: the run lengths of the first scanline, by hand.
        raw = (data / name).read_bytes()
        at = raw.index(b"+X 1024\n") + 8 + 4
        bands = []
        for _ in range(4):
            band = []
            while len(band) < 1024:
                n = raw[at]
                band += [raw[at + 1]] * (n - 128) if n > 128 else raw[at + 1 : at + 1 + n]
                at += 2 if n > 128 else 1 + n
            bands.append(band)
        q = np.array(bands, np.float64).T
        np.testing.assert_array_equal(found[0], (q[:, :3] * 2 ** (q[:, 3:] - 136)).astype(np.float32))
        small, info = image.load_envmap(data / name, width=128)
        assert small.shape == (64, 128, 3) and info["size"] == (1024, 512) and info["health"].ok
        energy = [i.sum(1, dtype=np.float64).T @ latlong.solid_angles(*i.shape[:2]) for i in (found, small)]
        np.testing.assert_allclose(*energy, rtol=1e-6)


# -----------------------------------------------------------------------------------------------------------
# Writing


def test_write_exr_round_trip(tmp_path, rng):
    path = tmp_path / "sky é.exr"
    values = (10 ** rng.uniform(-30, 30, (6, 12, 3))).astype(np.float32)
    values[0, 0] = [0, -1.5, 1.5e5]  # more than a half holds
    image.write_exr(path, values, {"source": "sky.hdr", "width": 12, "seed": 2**40, "gamma": 0.5})
    found, info = image.read(path)
    np.testing.assert_array_equal(found, values)
    header = OpenEXR.File(str(path), header_only=True).header()
    assert header["envmap"] == OpenEXR.ENVMAP_LATLONG and not info["warnings"]
    assert header["software"].startswith("envedit ")
    np.testing.assert_allclose(header["chromaticities"], image.REC709, rtol=1e-6)
    expected = {"source": "sky.hdr", "width": 12, "seed": str(2**40), "gamma": 0.5}
    assert {k: info["metadata"][k] for k in expected} == expected
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(path))), values)  # another reader
    image.write_exr(path, values * 0)
    assert not image.read(path)[0].any()
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e39])
@pytest.mark.parametrize("writer", [image.write_exr, image.write_png])
def test_non_finite_values_reach_no_file(tmp_path, bad, writer):
    values = np.zeros((4, 8, 3))
    values[2, 5, 1] = bad
    with pytest.raises(
        NumericalError, match=r"o.x: not written: 1 texels .* row 2, column 5 \(0, (nan|inf), 0\)"
    ):
        writer(tmp_path / "o.x", values)
    assert not os.listdir(tmp_path)


def test_unwritable(tmp_path):
    values = np.zeros((4, 8, 3))
    for writer in (image.write_exr, image.write_png):
        with pytest.raises(InputError, match=r"gone/a.exr: cannot be written \(its folder does not exist\)"):
            writer(tmp_path / "gone" / "a.exr", values)
        (tmp_path / "taken").mkdir(exist_ok=True)
        with pytest.raises(InputError, match=r"taken: cannot be written \(Is a directory\)"):
            writer(tmp_path / "taken", values)
        with pytest.raises(ValueError, match=r"\(H, W, 3\), got shape \(4, 8, 4\)"):
            writer(tmp_path / "a", np.zeros((4, 8, 4)))
    with pytest.raises(ConfigError, match="'dataWindow' cannot be used"):
        image.write_exr(tmp_path / "a.exr", values, {"dataWindow": "x"})
    assert os.listdir(tmp_path) == ["taken"]


@pytest.mark.parametrize("writer", [image.write_exr, image.write_png])
def test_a_full_disk_keeps_the_old_file(tmp_path, rng, writer):
    path = tmp_path / "a.exr"
    path.write_bytes(b"old")
    limit, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limit[1]))
    try:
        with pytest.raises(InputError, match=r"a.exr: cannot be written \(File too large\)"):
            writer(path, rng.random((64, 128, 3)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.exr"]


def test_write_png(tmp_path):
    ramp = np.linspace(-0.1, 1.1, 32).reshape(4, 8)
    image.write_png(tmp_path / "a.png", ramp)
    found = np.array(mi.Bitmap(str(tmp_path / "a.png")))
    assert found.shape == (4, 8, 3) and found.dtype == np.uint8
    np.testing.assert_array_equal(found[..., 1], np.rint(np.clip(ramp, 0, 1) * 255))


# -----------------------------------------------------------------------------------------------------------
# Health, repair, load


def test_health():
    values = np.ones((4, 8, 3), np.float32)
    values[1, 2, 0] = values[3, 0, 1] = np.nan
    values[2, 3] = np.inf
    values[0, 7, 2] = -0.5
    values[3, 7] = 65504
    h = image.health(values)
    assert (h.texels, h.nan, h.inf, h.negative, h.saturated) == (32, 2, 1, 1, 1)
    first = (h.first_nan, h.first_inf, h.first_negative, h.first_saturated)
    assert first == ((1, 2), (2, 3), (0, 7), (3, 7))
    assert (h.minimum, h.maximum, h.median) == (-0.5, 65504, pytest.approx(1))
    assert h.dynamic_range == pytest.approx(65504 / (1 - 1.5 * 0.0722)) and not h.ok
    assert "2 NaN (first at row 1, column 2)" in h.summary() and "\n" not in h.summary()


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e6, 3e38, np.nan, -np.inf])
def test_health_is_finite(value):
    h = image.health(np.full((1, 1, 3), value, np.float32))
    assert np.isfinite([h.minimum, h.maximum, h.median, h.dynamic_range]).all()
    assert h.ok == np.isfinite(value) and h.summary()


def test_repair(rng):
    values = rng.random((6, 8, 3)).astype(np.float32)
    broken = values.copy()
    broken[2, 0, 1] = np.nan  # on the seam: its neighbours are in columns 7, 0 and 1
    mended, count = image.repair(broken)
    around = np.delete(np.concatenate([values[1:4, 7:], values[1:4, :2]], 1).reshape(9, 3), 4, axis=0)
    assert count == 1 and np.isnan(broken[2, 0, 1])
    np.testing.assert_allclose(mended[2, 0], around.mean(0), rtol=1e-6)
    keep = np.ones((6, 8), bool)
    keep[2, 0] = False
    np.testing.assert_array_equal(mended[keep], values[keep])

    broken[:] = np.inf
    broken[5, 3] = [1, 2, 3]
    mended, count = image.repair(broken)
    assert count == 47
    np.testing.assert_allclose(mended, np.broadcast_to([1, 2, 3], (6, 8, 3)), rtol=1e-6)
    assert image.repair(values)[1] == 0
    with pytest.raises(InputError, match="all 48 texels of the image are NaN or infinite"):
        image.repair(np.full((6, 8, 3), np.nan))


def test_load_envmap(tmp_path, rng):
    p = planes(rng, size=(8, 16))
    p["G"][3, 4] = -2
    p["B"][0, 0] = 65504
    path = exr(tmp_path / "a.exr", **p)
    found, info = image.load_envmap(path)
    np.testing.assert_array_equal(found, np.maximum(stacked(p), 0))
    assert info["clipped"] == 1 and info["repaired"] == 0
    assert info["warnings"][0] == "1 texels are negative (down to -2), the first at row 3, column 4: set to 0"
    assert "65504" in info["warnings"][1] and len(info["warnings"]) == 2
    assert image.load_envmap(path, width=8)[0].shape == (4, 8, 3)
    assert "enlarged from 16 to 64" in image.load_envmap(path, width=64)[1]["warnings"][-1]

    p["R"][5, 6], p["R"][5, 2] = np.nan, np.inf
    path = exr(tmp_path / "a.exr", **p)
    with pytest.raises(
        InputError, match=r"a.exr: 2 texels are NaN or infinite, the first at row 5, column 2"
    ):
        image.load_envmap(path, width=8)
    found, info = image.load_envmap(path, width=8, repair=True)
    assert np.isfinite(found).all() and (found >= 0).all() and info["repaired"] == 2
    assert any("replaced from their neighbours" in w for w in info["warnings"])


def test_load_envmap_refusals(tmp_path):
    def grey(height, width, value=1.0):
        return exr(tmp_path / "g.exr", **{c: np.full((height, width), value, np.float32) for c in "RGB"})

    for height, width in ((8, 8), (1, 1), (5, 11)):
        with pytest.raises(InputError, match=rf"g.exr: a lat-long map is 2:1, this is {width} x {height}"):
            image.load_envmap(grey(height, width))
    for height, width in ((1, 2), (2, 4)):
        with pytest.raises(InputError, match=rf"g.exr: {width} x {height} texels are too few"):
            image.load_envmap(grey(height, width))
    for width in (0, 1, 5, 7, -8, 10**6):
        with pytest.raises(ConfigError, match=f"got {width}$"):
            image.load_envmap(grey(4, 8), width=width)
    with pytest.raises(InputError, match="g.exr: all 32 texels"):
        image.load_envmap(grey(4, 8, np.nan), repair=True)
    found, info = image.load_envmap(grey(4, 8, 0.0), width=16)
    assert not found.any() and "black" in info["warnings"][0]


# -----------------------------------------------------------------------------------------------------------
# Luminance and tonemaps


def test_luminance():
    np.testing.assert_allclose(image.luminance(np.eye(3)), [0.2126, 0.7152, 0.0722])
    assert image.luminance(np.full((2, 2, 3), 3e38, np.float32)).max() == pytest.approx(3e38)


@pytest.mark.parametrize("name", list(image.TONEMAPS))
def test_tonemaps(name):
    top = 100.0 if name == "log" else 1.0
    e = np.concatenate([[0, 1e-30, 1e-6], np.linspace(0, top, 1001)])
    t = image.tonemap(e, name)
    assert (
        t.min() == 0 and t.max() == pytest.approx(1) and (np.diff(image.tonemap(np.sort(e), name)) >= 0).all()
    )
    np.testing.assert_allclose(image.inverse_tonemap(t, name), e, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(image.tonemap([-1, 65504, np.inf], name), [0, 1, 1])
    assert np.isnan(image.tonemap(np.nan, name))
    assert image.tonemap(np.ones(3, np.float32), name).dtype == np.float32
    assert image.inverse_tonemap(np.ones(3, np.float32), name).dtype == np.float32


def test_tonemap_values():
    assert image.tonemap(0.5) == pytest.approx(0.5 ** (1 / 2.2))
    assert image.tonemap(0.5, "srgb") == pytest.approx(0.7353569831, rel=1e-9)
    assert image.tonemap(1.0, "log") == pytest.approx(np.log(101) / np.log(10001))
    with pytest.raises(ConfigError, match="unknown tonemap 'filmic'; use one of gamma, srgb, log, linear"):
        image.tonemap(0.5, "filmic")


# -----------------------------------------------------------------------------------------------------------
# Sun and sky


def plugin_radiance(d, azimuth, elevation, **parameters):
    """Mitsuba's sunsky at directions (N, 3) of our frame, its to_world turning +Z up into +Y up."""
    a, e = np.radians(azimuth), np.radians(elevation)
    sun = [np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)]
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    plugin = {"type": "sunsky", "sun_direction": sun, "to_world": turn, **parameters}
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -mi.Vector3f(*np.asarray(d, np.float32).T)
    return np.array(mi.load_dict({"type": "scene", "e": plugin}).environment().eval(si), np.float64).T


@pytest.mark.parametrize("width", [16, 64, 1000])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 45), (90, 10), (200, 60), (359.5, 30), (-45, 75)])
def test_sun_stands_where_it_is_told(width, azimuth, elevation):
    found = image.sunsky(width, azimuth, elevation)
    assert found.shape == (width // 2, width, 3) and found.dtype == np.float32
    assert np.isfinite(found).all() and (found > 0).all()
    row, column = np.unravel_index(image.luminance(found).argmax(), found.shape[:2])
    assert abs(row - (90 - elevation) / 180 * (width // 2 - 1)) <= 1
    away = (column - azimuth / 360 * width) % width
    assert min(away, width - away) <= 1


def test_sky_is_the_plugin_s():
    found = image.sunsky(512, 60, 35, turbidity=4, sun_scale=0)
    d = latlong.directions(256, 512)[2:124:7, ::11]
    expected = plugin_radiance(d.reshape(-1, 3), 60, 35, turbidity=4.0, albedo=0.2, sun_scale=0.0).reshape(
        d.shape
    )
    np.testing.assert_allclose(found[2:124:7, ::11], expected, rtol=0.02)


@pytest.mark.parametrize("width", [8, 64, 256, 1500])
@pytest.mark.parametrize("elevation", [90, 88, 45, 5])
def test_the_flux_of_the_sun_is_right(width, elevation):
    found = image.sunsky(width, 130, elevation, sky_scale=0, ground_albedo=0)
    flux = found.sum(1, dtype=np.float64).T @ latlong.lookup_solid_angles(width // 2, width)
    # A grid around the sun, finer than the disc.
    x = (np.arange(400) + 0.5) / 400 * 0.012 - 0.006
    a, e = np.radians(130), np.radians(elevation)
    to_sun = np.array([np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)])
    right, up = (
        np.array([np.cos(a), 0, np.sin(a)]),
        np.array([-np.sin(e) * np.sin(a), np.cos(e), np.sin(e) * np.cos(a)]),
    )
    d = to_sun + x[:, None, None] * right + x[:, None] * up
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    radiance = plugin_radiance((d / length).reshape(-1, 3), 130, elevation, sky_scale=0.0, albedo=0.0)
    expected = (radiance * length.reshape(-1, 1) ** -3).sum(0) * (0.012 / 400) ** 2
    np.testing.assert_allclose(flux, expected, rtol=0.01)


def test_mitsuba_finds_the_same_irradiance():
    """A floor under the baked map and under the plugin, both integrated by Mitsuba's emitter sampling."""
    # The sun in a texel's centre, row 9 of 32: elsewhere it is turned by up to half a row.
    azimuth, elevation = 360 * 13.5 / 64, 90 - 180 * 9 / 31
    found = image.sunsky(64, azimuth, elevation, turbidity=3)
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    a, e = np.radians(azimuth), np.radians(elevation)
    sun = [np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)]
    irradiance = []
    for emitter in (
        {"type": "envmap", "bitmap": mi.Bitmap(found)},
        {"type": "sunsky", "sun_direction": sun, "to_world": turn, "turbidity": 3.0, "albedo": 0.2},
    ):
        env = mi.load_dict({"type": "scene", "e": emitter}).environment()
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(3, 400_000)
        ds, weight = env.sample_direction(dr.zeros(mi.SurfaceInteraction3f), sampler.next_2d())
        value = np.array(weight * dr.maximum(ds.d.y, 0), np.float64).T
        irradiance.append((value.mean(0), value.std(0) / np.sqrt(len(value))))
    (baked, sigma), (expected, sigma_) = irradiance
    # 4 sigma of the sampling, and 1 % for the blur of 5.6 degrees (1 - h^2 / 12 on the cosine, horizon row).
    assert (np.abs(baked - expected) < 0.01 * expected + 4 * np.hypot(sigma, sigma_)).all(), irradiance


def test_ground_reflects_the_irradiance():
    found = image.sunsky(128, 10, 50, ground_albedo=0.3)
    ground = found[33:]
    np.testing.assert_array_equal(ground, np.broadcast_to(ground[0, 0], ground.shape))
    up = (
        np.maximum(latlong.directions(64, 128)[..., 1:2], 0)
        * latlong.lookup_solid_angles(64, 128)[:, None, None]
    )
    np.testing.assert_allclose(ground[0, 0], 0.3 / np.pi * (found * up).sum((0, 1)), rtol=0.01)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ((7, 0, 45), "width must be even, from 6 to 16384, got 7"),
        ((64, 0, -1), "elevation must be from 0 to 90, got -1"),
        ((64, 0, 45, 0.5), "turbidity must be from 1 to 10, got 0.5"),
        ((64, float("nan"), 45), "azimuth must be .* got nan"),
    ],
)
def test_sunsky_refusals(parameters, message):
    with pytest.raises(ConfigError, match=message):
        image.sunsky(*parameters)


@pytest.mark.parametrize(("elevation", "turbidity"), [(0, 1), (0, 10), (90, 1), (0.1, 3)])
def test_sunsky_at_its_limits(elevation, turbidity, capfd):
    found = image.sunsky(6, 0, elevation, turbidity)
    assert np.isfinite(found).all() and (found > 0).all()
    assert capfd.readouterr() == ("", "")
