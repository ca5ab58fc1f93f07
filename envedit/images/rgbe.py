"""Radiance files (RGBE). Decoded here, as ``mi.Bitmap`` corrupts the heap on damaged ones."""

from __future__ import annotations

import re

import numpy as np

from envedit.core.errors import InputError
from envedit.core.rows import bands
from envedit.core.types import Info
from envedit.images.headers import check_declared, damaged


def read(name: str, head: bytes, info: Info, stored: bool) -> np.ndarray:
    """Decode a file; arguments as in :mod:`.headers`."""
    end = re.search(rb"\n\r?\n([^\n]*)\n", head)
    size = end and re.fullmatch(rb"([-+][XY]) +(\d{1,9}) +([-+][XY]) +(\d{1,9})\s*", end[1])
    if not end or not size:
        raise damaged(name, "no Radiance resolution line")
    if (size[1], size[3]) != (b"-Y", b"+X"):
        stored_as = " ".join(end[1].decode().split())
        raise InputError(f"{name}: rows are stored as '{stored_as}'; save them as '-Y H +X W'")
    height, width = int(size[2]), int(size[4])
    check_declared(name, width, height)
    header = info["metadata"] = _radiance_header(head[: end.start()].decode("latin-1"))
    if "xyze" in header.get("FORMAT", ""):
        raise InputError(f"{name}: holds XYZ colours (32-bit_rle_xyze); save it as RGB (32-bit_rle_rgbe)")
    for key in {"EXPOSURE", "COLORCORR", "GAMMA"} & header.keys():
        if header[key] and set(_numbers(header[key])) != {1}:
            info["marks"][key] = header[key]
    chromaticities = _numbers(header.get("PRIMARIES", ""))
    if len(chromaticities) == 8 and any(chromaticities):  # zeros: none are known
        info["marks"]["chromaticities"] = chromaticities
    with open(name, "rb") as file:
        file.seek(end.end())
        # No encoding takes more than 1 + 1/127 bytes for one.
        data = file.read(height * (4 + 4 * width + 4 * (width // 64 + 2)))
    rgbe = None
    if data[:2] == b"\x02\x02" and int.from_bytes(data[2:4], "big") == width:
        try:
            rgbe = _radiance_runs(name, data, height, width)
        except InputError:
            if len(data) != 4 * height * width:  # of flat pixels, the first may look like a run's begin
                raise
    if rgbe is None:
        rgbe = _radiance_pixels(name, data, height, width)
    # Ward's format: (R, G, B) 2^(E - 136), and E = 0 is black.
    scale = np.ldexp(np.float32(1), rgbe[..., 3].astype(np.int32) - 136)
    scale[rgbe[..., 3] == 0] = 0
    return rgbe[..., :3] * scale[..., None]


def _radiance_header(text):
    """Return the ``KEY=value`` lines of a header. By hand: a pattern takes the square of a line's length."""
    header: dict[str, str] = {}
    for line in text.split("\n"):
        key, equals, value = line.partition("=")
        key, value = key.rstrip(" "), value.strip()
        if equals and re.fullmatch(r"\w+", key):
            if key in ("EXPOSURE", "COLORCORR") and key in header:
                value = _product(header[key], value)
            header[key] = value
    return header


def _product(first, second):
    """Multiply the numbers of two lines of a key, as programs add a line for each of their changes."""
    factors = _numbers(first), _numbers(second)
    if not factors[0] or len(factors[0]) != len(factors[1]):
        return f"{first}, {second}"[:60]
    return " ".join(f"{a * b:g}" for a, b in zip(factors[0], factors[1], strict=True))


def _numbers(text):
    """Return the numbers of a line; none if a word of it is no number."""
    try:
        return [float(number) for number in text.split()]
    except ValueError:
        return []


def _radiance_runs(name, data, height, width):
    """Decode run-length encoded scanlines: (2, 2, W >> 8, W & 255), then four bands of runs and literals.

    Mitsuba's reader is quicker and overruns its buffer on damaged files, which kills the process.
    """
    rows = bytearray()
    start = data[:4]
    at = 0
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


# ---- Writing -----------------------------------------------------------------------------------------------


def encode(image: np.ndarray, chromaticities: tuple[float, ...] | None = None) -> bytes:
    """Encode (H, W, 3) linear radiance, finite, as a Radiance file; negative values are 0.

    A texel's channels share the exponent of the largest and have 8 bits each, rounded to the nearest: an
    error of at most 1/256 of the largest channel. What is below 2^-128 is 0. Chromaticities, if there are
    any, become the line ``PRIMARIES``.
    """
    height, width, _ = image.shape
    space = "" if chromaticities is None else f"PRIMARIES={' '.join(f'{v:g}' for v in chromaticities)}\n"
    head = f"#?RADIANCE\n{space}FORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    start = bytes((2, 2, width >> 8 & 255, width & 255))
    rows = [head]
    for band in bands(height):
        texels = _texels(image[band])
        if not 8 <= width < 32768:  # too short or long for scanlines by channel
            rows.append(texels.tobytes())
            continue
        for row in texels:
            rows.append(start)
            for channel in row.T:
                plain = channel.tobytes()  # in runs of up to 128 that do not repeat
                parts = (plain[i : i + 128] for i in range(0, width, 128))
                rows += [bytes((len(part),)) + part for part in parts]
    return b"".join(rows)


def _texels(image):
    """Return mantissas and exponent (rows, W, 4) uint8 of radiance (rows, W, 3)."""
    values = np.clip(image.astype(np.float64), 0, _LARGEST)
    exponent = np.frexp(values.max(axis=2))[1]
    exponent += np.rint(np.ldexp(values.max(axis=2), 8 - exponent)) > 255
    codes = np.rint(np.ldexp(values, (8 - exponent)[..., None]))
    shown = (values.max(axis=2) > 0) & (exponent > -128)
    texels = np.zeros((*image.shape[:2], 4), np.uint8)
    texels[..., :3] = np.where(shown[..., None], codes, 0)
    texels[..., 3] = np.where(shown, exponent + 128, 0)
    return texels


_LARGEST = 2.0**127 * (255 / 256)
