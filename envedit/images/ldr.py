"""PNG and JPEG files: pixels decoded by Mitsuba, and the marks that say how they are meant."""

from __future__ import annotations

import os
import re
import zlib
from typing import Literal

import numpy as np

from envedit.core.errors import InputError
from envedit.core.quiet_libraries import quiet_libraries
from envedit.core.types import Info
from envedit.images.headers import check_declared, damaged


def read(name: str, head: bytes, info: Info, stored: bool) -> np.ndarray:
    """Decode a file; arguments as in :mod:`.headers`."""
    if info["format"] == "png":
        size = (int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"))
    else:
        size = _jpeg_header(name, info)
    check_declared(name, size[0], size[1])
    image = _bitmap(name)
    if image.dtype not in (np.uint8, np.uint16):
        raise damaged(name, f"unexpected samples of type {image.dtype}")
    info["hdr"] = False
    info["bits"] = 8 * image.dtype.itemsize
    if info["format"] == "png":
        _png_marks(name, info)
    return image


def _jpeg_header(name, info):
    """Return (width, height), and note the quality and the marks of a JPEG file."""
    marks = info["marks"]
    size = None
    mean = 0.0
    for marker, data in _jpeg_segments(name):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and size is None:
            if len(data) < 6:
                break
            size = int.from_bytes(data[3:5], "big"), int.from_bytes(data[1:3], "big")
            if data[5] not in (1, 3):
                raise InputError(f"{name}: holds {data[5]} channels (CMYK?); save it as RGB")
        elif marker == 0xDB and not mean and data and not data[0] & 15:
            wide = 2 if data[0] >> 4 else 1
            if len(data) <= 64 * wide:
                raise damaged(name, "a quantisation table breaks off")
            mean = float(np.frombuffer(data[1 : 1 + 64 * wide], f">u{wide}").mean())
        elif marker == 0xE1 and data[:6] == b"Exif\0\0":
            marks["orientation"] = _orientation(data[6:])
        elif marker == 0xE2 and data[:12] == b"ICC_PROFILE\0":
            marks["profile"] = marks.get("profile", b"") + data[14:]
    if size is None:
        raise damaged(name, "no JPEG frame header")
    scale = mean / _JPEG_MEAN
    quality = round(100 - 50 * scale if scale < 1 else 50 / scale)
    info["quality"] = min(max(quality, 1), 100)
    return size


def _jpeg_segments(name):
    """Yield marker, int, and data of each segment of a JPEG file, until the picture begins."""
    with open(name, "rb") as file:
        file.seek(2)
        while len(start := file.read(4)) == 4 and start[0] == 0xFF and start[1] != 0xDA:
            if start[1] == 0xFF:  # padding before a marker
                file.seek(-3, os.SEEK_CUR)
                continue
            yield start[1], file.read(max(int.from_bytes(start[2:], "big") - 2, 0))


_JPEG_MEAN = 3688 / 64
"""Mean of the luminance table of the JPEG standard (Annex K), which libjpeg takes for quality 50."""


def _png_marks(name, info):
    """Note texts, orientation, curve and colour profile of a PNG that has been decoded."""
    marks = info["marks"]
    with open(name, "rb") as file:
        file.seek(8)
        while len(start := file.read(8)) == 8 and start[4:] != b"IEND":
            length = int.from_bytes(start[:4], "big")
            kind = start[4:]
            if kind not in (b"eXIf", b"iCCP", b"sRGB", b"cICP", b"gAMA", b"tEXt", b"iTXt", b"zTXt"):
                file.seek(length + 4, os.SEEK_CUR)
                continue
            data = file.read(length + 4)[:length]
            key, _, rest = data.partition(b"\0")
            if kind == b"eXIf":
                marks["orientation"] = _orientation(data)
            elif kind == b"iCCP":
                marks["profile"] = _inflated(rest[1:])
            elif kind == b"sRGB":
                marks.setdefault("profile", b"sRGB")
            elif kind == b"cICP":  # 1, 13: primaries of Rec. 709, curve of sRGB
                marks["profile"] = b"sRGB" if data[:2] == b"\1\r" else kind
            elif kind == b"gAMA":
                marks["gamma"] = int.from_bytes(data, "big") / 100_000
            elif kind == b"iTXt":
                text = rest[2:].split(b"\0", 2)[-1]
                text = _inflated(text) if rest[:1] == b"\1" else text
                info["metadata"][key.decode("latin-1")] = text.decode("utf-8", "replace")
            else:  # read here, as Mitsuba fails on letters beyond ASCII
                text = rest if kind == b"tEXt" else _inflated(rest[1:])
                info["metadata"][key.decode("latin-1")] = text.decode("latin-1")


def _inflated(data):
    """Decompress a PNG's chunk, of at most 4 MiB; nothing if it is damaged."""
    try:
        return zlib.decompressobj().decompress(data, 1 << 22)
    except zlib.error:
        return b""


def _orientation(exif):
    """Return tag 274 of the first directory of EXIF data; 1, upright, where it has none."""
    order: Literal["little", "big"] = "little" if exif[:2] == b"II" else "big"
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
        with quiet_libraries() as texts:
            pixels = np.array(mi.Bitmap(name))
    except Exception as e:
        raise damaged(name, re.sub(r'^(\[\w+\] )?("[^"]*": )?', "", str(e))) from None
    printed = texts[0] if texts else ""  # all that libjpeg does
    if re.search("corrupt|premature|invalid|inconsistent", printed, re.I):
        raise damaged(name, printed)
    return pixels if pixels.ndim == 3 else pixels[..., None]
