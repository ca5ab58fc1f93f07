"""Decoders of OpenEXR, Radiance, PNG and JPEG, behind :func:`envedit.image.read`.

A decoder takes the file's name, its first bytes, the ``info`` of :func:`envedit.image.read`, which it
fills, and whether the pixels are wanted as stored (:func:`envedit.image.read_stored`). Damage is told as
``InputError`` or left to the caller as the library's own exception.
"""

import os
import re
import stat
import zlib

import numpy as np

from .errors import EnveditError, InputError
from .files import quiet_libraries
from .tonemap import srgb_to_linear

MAX_SIDE = 32768
MAX_TEXELS = 2**27
"""16384 x 8192 texels: 1.6 GB as float32. A header that declares more is refused before allocation."""
_MOST_VALUES = 4 * MAX_TEXELS  # over all channels: colour and alpha of the largest
_MOST_TILE = 2**20  # texels: OpenEXR takes memory for a whole tile, however small the image

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of red, green, blue and white (D65), as the OpenEXR attribute orders them."""


def head_of(name):
    """Return the first bytes of a regular file."""
    try:
        mode = os.stat(name).st_mode
        if stat.S_ISDIR(mode):
            raise InputError(f"{name}: is a folder; name an image file")
        if not stat.S_ISREG(mode):  # opening a pipe would wait for ever
            raise InputError(f"{name}: is not a regular file; name an image file")
        with open(name, "rb") as file:
            head = file.read(1 << 16)
    except FileNotFoundError:
        raise InputError(f"{name}: no such file; check the path") from None
    except (OSError, ValueError) as e:
        if isinstance(e, EnveditError):
            raise
        raise InputError(f"{name}: cannot be read ({getattr(e, 'strerror', None) or e})") from None
    if not head:
        raise InputError(f"{name}: the file is empty; export or download it again")
    return head


def check_declared(name, width, height):
    """Refuse a size before memory is asked for."""
    if width < 1 or height < 1:
        raise InputError(f"{name}: the header declares {width} x {height} texels; the file is damaged")
    if max(width, height) > MAX_SIDE or width * height > MAX_TEXELS:
        raise InputError(
            f"{name}: the header declares {width} x {height} texels, more than {MAX_SIDE} on a side or "
            f"{MAX_TEXELS} in all; the file is damaged, or has to be made smaller"
        )


def damaged(name, reason):
    """Return the error for a file that starts well and cannot be decoded."""
    reason = _shown(" ".join(str(reason).split()), 160) or "no reason given"
    return InputError(f"{name}: damaged or truncated ({reason}); export or download it again")


def _shown(text, most=60):
    """Return text of a file for a message: cut to ``most`` characters, without control codes."""
    text = text[:most]
    return text if text.isprintable() else ascii(text)[1:-1][:most]


# ----------------------------------------------------------------------------------------------------------
# OpenEXR


def _read_exr(name, head, info, stored):
    import OpenEXR

    try:
        with quiet_libraries():
            parts = OpenEXR.File(name, header_only=True).parts
    except Exception as e:  # the library raises bare RuntimeError for anything
        raise damaged(name, e) from None
    windows = [_window(p.header["dataWindow"]) for p in parts]
    for _, _, width, height in windows:
        check_declared(name, width, height)
    if sum(w * h for _, _, w, h in windows) > MAX_TEXELS:  # the library decodes every part
        raise InputError(
            f"{name}: its {len(parts)} parts hold more than {MAX_TEXELS} texels; save only colour"
        )
    counts = [len(p.header["channels"]) for p in parts]  # and every channel
    if sum(w * h * n for (_, _, w, h), n in zip(windows, counts, strict=True)) > _MOST_VALUES:
        many = f"its {sum(counts)} channels hold more than {_MOST_VALUES} values"
        raise InputError(f"{name}: {many}; save only colour")
    for part, (_, _, width, height) in zip(parts, windows, strict=True):
        tile = part.header.get("tiles")
        if tile is not None and tile.xSize * tile.ySize > max(width * height, _MOST_TILE):
            raise InputError(
                f"{name}: the header declares tiles of {tile.xSize} x {tile.ySize} texels for an image of "
                f"{width} x {height}; the file is damaged, or has to be saved in scanlines"
            )
    index, names = _choose_channels(name, [p.header for p in parts], info)
    header = parts[index].header
    if stored:
        layer = names[0].rpartition(".")[0]
        beside = [c for c in header["channels"] if c.name.rpartition(".")[0] == layer]
        alpha = [c for c in beside if c.name.rpartition(".")[2].upper() == "A"]
        names += [c.name for c in alpha if c.xSampling == c.ySampling == 1]

    # separate_channels: the interleaved form guesses at RGB(A) and leaves layers out.
    try:
        with quiet_libraries() as said:
            decoded = OpenEXR.File(name, separate_channels=True)
            channels = decoded.parts[index].channels if len(decoded.parts) == len(parts) else None
            planes = None if channels is None else [np.array(channels[c].pixels, np.float32) for c in names]
    except MemoryError:
        raise
    except Exception as e:
        raise damaged(name, e) from None
    left, top, width, height = windows[index]
    # A part that cannot be decoded is dropped with a printed warning, and the others move up.
    # The decoder of JPEG 2000 says that a stream ended early, and fills up with what it likes.
    early = "terminated early" in (said[0] if said else "")
    if planes is None or early or any(p.shape != (height, width) for p in planes):
        raise damaged(name, said and said[0] or "not all of its parts could be decoded")
    display = _window(header["displayWindow"])
    if stored and len(planes) in (1, 3) and windows[index] != display:
        planes.append(np.ones_like(planes[0]))  # what lies outside the data is transparent, not black
    image = np.stack(planes if stored or len(planes) == 3 else planes * 3, axis=-1)
    _describe(header, info)
    return _to_display(image, (left, top), display, name, info)


def _window(box):
    """Return (left, top, width, height) of an inclusive OpenEXR box."""
    (x0, y0), (x1, y1) = ([int(c) for c in corner] for corner in box)
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


def _choose_channels(name, headers, info):
    """Return the first part with colour and its channel names, three or (luminance) one."""
    seen = []
    for index, header in enumerate(headers):
        if "deep" in str(header.get("type", "")).lower():
            seen.append("deep data")
            continue
        channels = {c.name: c for c in header["channels"]}
        seen.extend(channels)
        layers = {}
        for full in channels:
            layer, _, short = full.rpartition(".")
            layers.setdefault(layer, {})[short.upper()] = full
        # Unnamed channels first, then a layer that calls itself the picture, then the order of the file.
        colour = [k for k, v in layers.items() if {"R", "G", "B"} <= v.keys()]
        colour.sort(key=lambda k: (k != "", not re.search("combined|beauty|rgba", k.lower())))
        if colour:
            names = [layers[colour[0]][c] for c in "RGB"]
            if len(colour) > 1:
                chosen = _shown(colour[0]) or "R, G, B"
                info["warnings"].append(f"{len(colour)} colour layers: '{chosen}' was read")
        else:
            grey = [v["Y"] for v in layers.values() if "Y" in v and not {"RY", "BY", "X", "Z"} & v.keys()]
            if not grey:
                continue
            names = grey[:1]
            info["warnings"].append(f"only luminance ('{_shown(names[0])}'): read as grey")
        if any(channels[c].xSampling != 1 or channels[c].ySampling != 1 for c in names):
            raise InputError(f"{name}: subsampled channels are not supported; save R, G, B in full")
        return index, names
    found = ", ".join(_shown(channel, 30) for channel in seen[:12])
    raise InputError(f"{name}: no R, G, B channels (found: {found}); save it as RGB")


def _describe(header, info):
    """Take over the header's plain attributes, and warn of a colour space or projection we would misread."""
    info["metadata"] = {k: v for k, v in header.items() if isinstance(v, str | int | float)}
    primaries = header.get("chromaticities")
    if primaries is not None and not np.allclose(primaries, REC709, atol=2e-3):
        info["warnings"].append("its primaries are not Rec.709: values are used as they are, hues may be off")
    if "CUBE" in str(header.get("envmap", "")):
        info["warnings"].append("it is marked as a cube map: read as if it were lat-long")


def _to_display(image, corner, display, name, info):
    """Place the data window in the display window; what is not stored is black."""
    left, top, width, height = display
    if corner == (left, top) and image.shape[:2] == (height, width):
        return image
    check_declared(name, width, height)
    info["warnings"].append(
        f"data window {image.shape[1]} x {image.shape[0]} at {corner[0]}, {corner[1]} differs from the "
        f"display window {width} x {height} at {left}, {top}: cropped, or filled with black"
    )
    whole = np.zeros((height, width, image.shape[2]), np.float32)
    y, x = corner[1] - top, corner[0] - left
    y0, x0 = max(y, 0), max(x, 0)
    y1, x1 = min(y + image.shape[0], height), min(x + image.shape[1], width)
    if y1 > y0 and x1 > x0:
        whole[y0:y1, x0:x1] = image[y0 - y : y1 - y, x0 - x : x1 - x]
    return whole


# ----------------------------------------------------------------------------------------------------------
# Radiance


def _read_radiance(name, head, info, stored):
    end = re.search(rb"\n\r?\n([^\n]*)\n", head)
    size = end and re.fullmatch(rb"([-+][XY]) +(\d{1,9}) +([-+][XY]) +(\d{1,9})\s*", end[1])
    if not size:
        raise damaged(name, "no Radiance resolution line")
    if (size[1], size[3]) != (b"-Y", b"+X"):
        stored_as = " ".join(end[1].decode().split())
        raise InputError(f"{name}: rows are stored as '{stored_as}'; save them as '-Y H +X W'")
    height, width = int(size[2]), int(size[4])
    check_declared(name, width, height)
    header = info["metadata"] = _radiance_header(head[: end.start()].decode("latin-1"))
    if "xyze" in header.get("FORMAT", ""):
        raise InputError(f"{name}: holds XYZ colours (32-bit_rle_xyze); save it as RGB (32-bit_rle_rgbe)")
    for key in {"EXPOSURE", "COLORCORR"} & header.keys():
        if not _all_ones(header[key]):
            value = _shown(header[key])
            info["warnings"].append(f"{key}={value} in its header is not undone: values are as stored")
    with open(name, "rb") as file:
        file.seek(end.end())
        # No encoding takes more than 1 + 1/127 bytes for one.
        data = file.read(height * (4 + 4 * width + 4 * (width // 64 + 2)))
    if data[:2] == b"\x02\x02" and int.from_bytes(data[2:4], "big") == width:
        rgbe = _radiance_runs(name, data, height, width)
    else:
        rgbe = _radiance_pixels(name, data, height, width)
    # Ward's format: (R, G, B) 2^(E - 136), and E = 0 is black.
    scale = np.ldexp(np.float32(1), rgbe[..., 3].astype(np.int32) - 136)
    scale[rgbe[..., 3] == 0] = 0
    return rgbe[..., :3] * scale[..., None]


def _radiance_header(text):
    """Return the ``KEY=value`` lines of a header. By hand: a pattern takes the square of a line's length."""
    header = {}
    for line in text.split("\n"):
        key, equals, value = line.partition("=")
        if equals and re.fullmatch(r"\w+", key.rstrip(" ")):
            header[key.rstrip(" ")] = value.strip()
    return header


def _all_ones(text):
    try:
        return all(float(number) == 1 for number in text.split())
    except ValueError:
        return False


def _radiance_runs(name, data, height, width):
    """Decode run-length encoded scanlines: (2, 2, W >> 8, W & 255), then four bands of runs and literals.

    Mitsuba's reader is quicker and overruns its buffer on damaged files, which kills the process.
    """
    rows = bytearray()
    start, at = data[:4], 0
    for y in range(height):
        if data[at : at + 4] != start:
            raise damaged(name, f"scanline {y} of {height} does not begin")
        at += 4
        for _ in range(4):
            goal = len(rows) + width
            while len(rows) < goal:
                count = data[at] if at < len(data) else 0
                if count > 128:
                    rows += data[at + 1 : at + 2] * (count - 128)
                    at += 2
                else:
                    rows += data[at + 1 : at + 1 + count]
                    at += 1 + count
                if count == 0 or at > len(data):
                    raise damaged(name, f"scanline {y} of {height} breaks off")
            if len(rows) > goal:
                raise damaged(name, f"scanline {y} of {height} is too long")
    return np.frombuffer(rows, np.uint8).reshape(height, 4, width).transpose(0, 2, 1)


def _radiance_pixels(name, data, height, width):
    """Decode flat pixels with the old run lengths: (1, 1, 1, n) repeats the pixel before it n times."""
    pixels = np.frombuffer(data[: len(data) // 4 * 4], np.uint8).reshape(-1, 4)
    place = np.arange(len(pixels))
    marker = (pixels[:, :3] == 1).all(1)
    source = np.maximum.accumulate(np.where(marker, 0, place))
    # Markers in a row are the digits of one count, the lowest first: n + 256 n' + ...
    digit = np.minimum(place - source - 1, 3)
    count = np.where(marker, pixels[:, 3].astype(np.int64) << 8 * np.maximum(digit, 0), 1)
    total = np.cumsum(count)
    if not len(total) or marker[0] or total[-1] < height * width:
        raise damaged(name, f"holds {total[-1] if len(total) else 0} of {height * width} texels")
    stop = int(np.searchsorted(total, height * width)) + 1
    count[stop - 1] -= total[stop - 1] - height * width
    return pixels[np.repeat(source[:stop], count[:stop])].reshape(height, width, 4)


# ----------------------------------------------------------------------------------------------------------
# PNG and JPEG


def _read_ldr(name, head, info, stored):
    if info["format"] == "png":
        size = (int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"))
    else:
        size = _jpeg_header(name, info if stored else {})
    check_declared(name, *size)
    image = _bitmap(name)
    if image.dtype not in (np.uint8, np.uint16):
        raise damaged(name, f"unexpected samples of type {image.dtype}")
    info["hdr"] = False
    if stored:
        if info["format"] == "png":
            _png_marks(name, info)
        return image
    depth = 8 * image.dtype.itemsize
    info["warnings"].append(f"a {depth}-bit {info['format'].upper()} is not HDR: light above 1 is missing")
    image = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
    values = srgb_to_linear(np.arange(2**depth) / (2**depth - 1)).astype(np.float32)
    return values[image]


def _jpeg_header(name, info):
    """Return (width, height), and note the quality and the marks of a JPEG file."""
    size, mean = None, 0.0
    with open(name, "rb") as file:
        file.seek(2)
        while True:
            marker = file.read(4)
            if len(marker) < 4 or marker[0] != 0xFF:
                break
            if marker[1] == 0xFF:  # padding before a marker
                file.seek(-3, os.SEEK_CUR)
                continue
            if marker[1] == 0xDA:  # the picture begins
                break
            data = file.read(max(int.from_bytes(marker[2:], "big") - 2, 0))
            if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC) and size is None:
                if len(data) < 6:
                    break
                size = int.from_bytes(data[3:5], "big"), int.from_bytes(data[1:3], "big")
                if data[5] not in (1, 3):
                    raise InputError(f"{name}: holds {data[5]} channels (CMYK?); save it as RGB")
            elif marker[1] == 0xDB and not mean and data and not data[0] & 15:
                wide = 2 if data[0] >> 4 else 1
                if len(data) <= 64 * wide:
                    raise damaged(name, "a quantisation table breaks off")
                mean = float(np.frombuffer(data[1 : 1 + 64 * wide], f">u{wide}").mean())
            elif marker[1] == 0xE1 and data[:6] == b"Exif\0\0":
                info["orientation"] = _orientation(data[6:])
            elif marker[1] == 0xE2 and data[:12] == b"ICC_PROFILE\0":
                info["profile"] = info.get("profile", b"") + data[14:]
    if size is None:
        raise damaged(name, "no JPEG frame header")
    scale = mean / _JPEG_MEAN
    quality = round(100 - 50 * scale if scale < 1 else 50 / scale)
    info["quality"] = min(max(quality, 1), 100)
    return size


_JPEG_MEAN = 3688 / 64
"""Mean of the luminance table of the JPEG standard (Annex K), which libjpeg takes for quality 50."""


def _png_marks(name, info):
    """Note texts, orientation and colour profile of a PNG that has been decoded."""
    with open(name, "rb") as file:
        file.seek(8)
        while len(start := file.read(8)) == 8 and start[4:] != b"IEND":
            length, kind = int.from_bytes(start[:4], "big"), start[4:]
            if kind not in (b"eXIf", b"iCCP", b"tEXt", b"iTXt", b"zTXt"):
                file.seek(length + 4, os.SEEK_CUR)
                continue
            data = file.read(length + 4)[:length]
            key, _, rest = data.partition(b"\0")
            if kind == b"eXIf":
                info["orientation"] = _orientation(data)
            elif kind == b"iCCP":
                info["profile"] = _inflated(rest[1:])
            elif kind == b"iTXt":
                text = rest[2:].split(b"\0", 2)[-1]
                text = _inflated(text) if rest[:1] == b"\1" else text
                info["metadata"][key.decode("latin-1")] = text.decode("utf-8", "replace")
            else:  # read here, as Mitsuba fails on letters beyond ASCII
                text = rest if kind == b"tEXt" else _inflated(rest[1:])
                info["metadata"][key.decode("latin-1")] = text.decode("latin-1")


def _inflated(data, most=1 << 22):
    """Decompress a PNG's chunk, of at most 4 MiB; nothing if it is damaged."""
    try:
        return zlib.decompressobj().decompress(data, most)
    except zlib.error:
        return b""


def _orientation(exif):
    """Return tag 274 of the first directory of EXIF data; 1, upright, where it has none."""
    order = {b"II": "little", b"MM": "big"}.get(exif[:2], "big")
    at = int.from_bytes(exif[4:8], order)
    for entry in range(at + 2, at + 2 + 12 * int.from_bytes(exif[at : at + 2], order), 12):
        if int.from_bytes(exif[entry : entry + 2], order) == 274:
            return int.from_bytes(exif[entry + 8 : entry + 10], order)
        if entry > len(exif):
            break
    return 1


def _bitmap(name):
    """Decode a PNG or JPEG with Mitsuba; returns (H, W, C) as stored."""
    import mitsuba as mi

    try:
        with quiet_libraries() as said:
            pixels = np.array(mi.Bitmap(name))
    except Exception as e:
        raise damaged(name, re.sub(r'^(\[\w+\] )?("[^"]*": )?', "", str(e))) from None
    if re.search("corrupt|premature", said[0] if said else "", re.I):  # libjpeg only prints
        raise damaged(name, said[0])
    return pixels if pixels.ndim == 3 else pixels[..., None]


FORMATS = (
    ("exr", b"\x76\x2f\x31\x01", _read_exr),
    ("hdr", b"#?", _read_radiance),
    ("png", b"\x89PNG\r\n\x1a\n", _read_ldr),
    ("jpeg", b"\xff\xd8\xff", _read_ldr),
)
"""Kind, first bytes and decoder of every format."""
