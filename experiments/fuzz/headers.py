"""What a file's header says: where its numbers stand, and how large an image it declares.

Apart from the readers under test, so that neither inherits the other's mistakes. Nothing here fails on a
damaged file: what cannot be followed is left out.
"""

import itertools
import re
import struct
from collections import Counter
from typing import NamedTuple

_MOST_SITES = 4000
MOST_SIDE, MOST_TEXELS = 32768, 2**27
"""What the readers say that they accept."""


class Site(NamedTuple):
    """A number in a file: ``size`` bytes, "little" or "big" end first; size 0: decimal text."""

    offset: int
    size: int
    order: str = "little"


def _row(at, count, size=1):
    """Return numbers that follow one another."""
    return [Site(at + i * size, size) for i in range(count)]


# ---- OpenEXR -----------------------------------------------------------------------------------------------


def _exr_attributes(data):
    """Yield (name, kind, offset of the value's length, its length, part) of the attributes of every part."""
    at, part = 8, 0
    several = len(data) > 5 and data[5] & 0x10
    while at < len(data):
        end = data.find(b"\0", at, at + 256)
        if end < 0:
            return
        if end == at:  # an empty name ends a header, an empty header ends the list
            at, part = at + 1, part + 1
            if not several or data[at : at + 1] in (b"\0", b""):
                yield b"", b"", at + bool(several), 0, part
                return
            continue
        stop = data.find(b"\0", end + 1, end + 257)
        if stop < 0 or stop + 5 > len(data):
            return
        length = int.from_bytes(data[stop + 1 : stop + 5], "little")
        yield data[at:end], data[end + 1 : stop], stop + 1, length, part
        at = stop + 5 + length


_EXR_NUMBERS = b"box2i", b"int", b"v2i", b"tiledesc", b"float", b"v2f", b"chromaticities"
"""Types of attributes that are numbers of four bytes."""


def _exr_channels(data, at, length):
    """Yield where the names of the channels of a list end."""
    place = at
    while place < at + length and (end := data.find(b"\0", place, place + 256)) > place:
        yield end
        place = end + 17


def _exr_sites(data):
    sites = _row(4, 2)
    for name, kind, at, length, _ in _exr_attributes(data):
        if not name:  # the table of offsets follows, and the chunks that it points to
            table = [Site(i, 8) for i in range(at, min(at + 8 * 24, len(data) - 8), 8)]
            for entry in table:
                (place,) = struct.unpack_from("<Q", data, entry.offset)
                sites += _row(place, 5, 4) if place + 20 <= len(data) else []
            return sites + table
        sites.append(Site(at, 4))
        if kind in _EXR_NUMBERS:
            sites += _row(at + 4, -(-min(length, 64) // 4), 4)
        elif kind == b"chlist":
            sites += [Site(end + i, 4) for end in _exr_channels(data, at + 4, length) for i in (1, 5, 9, 13)]
        elif length <= 4:
            sites += _row(at + 4, length)
    return sites


def _area(width, height):
    """Return the texels of an image; 0 if it is to be refused before memory is asked for."""
    accepted = 0 < min(width, height) <= max(width, height) <= MOST_SIDE and width * height <= MOST_TEXELS
    return width * height if accepted else 0


def _box(data, at):
    if at + 16 > len(data):
        return 0
    left, top, right, bottom = struct.unpack_from("<4i", data, at)
    return _area(right - left + 1, bottom - top + 1)


def _exr_declared(data):
    """Sum, over the parts, what data window, display window and one tile take in float32."""
    channels, areas, display = Counter(), Counter(), {}
    for name, kind, at, length, part in _exr_attributes(data):
        if kind == b"chlist":
            channels[part] += len(list(_exr_channels(data, at + 4, length)))
        elif name == b"dataWindow":
            areas[part] += _box(data, at + 4)
        elif name == b"displayWindow":
            display[part] = 16 * _box(data, at + 4)
    if areas.total() > MOST_TEXELS:
        return 0
    return sum(display.values()) + sum(4 * max(channels[part], 3) * area for part, area in areas.items())


# ---- the others --------------------------------------------------------------------------------------------


def _hdr_sites(data):
    line = re.search(rb"\n\n([^\n]*)\n", data[:4096])
    numbers = _digits(data, 0, line.end()) if line else []
    size = [site for site in numbers if site.offset > line.start()]
    rows = [found.start() for found in re.finditer(rb"\x02\x02", data)][:64]
    return 4 * size + numbers + [site for row in rows for site in _row(row, 6)]


def _hdr_declared(data):
    found = re.search(rb"[-+][XY] +(\d{1,9}) +[-+][XY] +(\d{1,9})", data[:65536])
    return 12 * _area(int(found[1]), int(found[2])) if found else 0


def png_chunks(data: bytes):
    """Yield (offset, length, kind) of the chunks of a PNG; none of anything else."""
    at = 8 if data.startswith(b"\x89PNG") else len(data)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        yield at, length, data[at + 4 : at + 8]
        at += 12 + length


def _png_sites(data):
    sites = [Site(16, 4, "big"), Site(20, 4, "big"), *_row(24, 5)]
    for at, length, _ in png_chunks(data):
        sites += [Site(at, 4, "big"), Site(at + 4, 4, "big"), *_row(at + 8, min(length, 32))]
    return sites


def _png_declared(data):
    return 12 * _area(*struct.unpack_from(">2I", data.ljust(24, b"\0"), 16))


def _jpeg_segments(data):
    """Yield (offset, length, marker) of the segments of a JPEG, up to the first scan's pixels."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        yield at, length, data[at + 1]
        if data[at + 1] == 0xDA:
            return
        at += 2 + length


def _jpeg_sites(data):
    sites = []
    for at, length, marker in _jpeg_segments(data):
        sites += [Site(at + 1, 1), Site(at + 2, 2, "big"), *_row(at + 4, min(length, 24))]
        if 0xC0 <= marker <= 0xCF:
            sites += 4 * [Site(at + 5, 2, "big"), Site(at + 7, 2, "big")]
    return sites


def _jpeg_declared(data):
    frames = [
        struct.unpack_from(">2H", data, at + 5)
        for at, _, marker in _jpeg_segments(data)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and at + 9 <= len(data)
    ]
    return 12 * max((_area(*frame) for frame in frames), default=0)


_ZIP = (
    (b"PK\x03\x04", (2, 2, 2, 2, 2, 4, 4, 4, 2, 2)),
    (b"PK\x01\x02", (2, 2, 2, 2, 2, 2, 4, 4, 4, 2, 2, 2, 2, 2, 4, 4)),
    (b"PK\x05\x06", (2, 2, 2, 2, 4, 4, 2)),
)
"""Sizes of the numbers of a local header, of an entry of the central directory, and of its end."""


def _zip_sites(data):
    """Return the numbers of the archive's headers, and of the npy headers in it."""
    sites = []
    for magic, sizes in _ZIP:
        for found in re.finditer(re.escape(magic), data):
            sites += map(Site, itertools.accumulate(sizes, initial=found.end()), sizes)
    for found in re.finditer(rb"\x93NUMPY", data):
        sites += [*_row(found.end(), 2), Site(found.end() + 2, 2)]
        sites += _digits(data, found.end(), 118)
    return sites


def _safetensors_sites(data):
    length = int.from_bytes(data[:8], "little")
    return 8 * [Site(0, 8)] + _digits(data, 8, min(length, 1 << 20))


def _digits(data, start, length):
    return [Site(start + found.start(), 0) for found in re.finditer(rb"\d+", data[start : start + length])]


_KINDS = (
    (b"\x76\x2f\x31\x01", _exr_sites, _exr_declared),
    (b"#?", _hdr_sites, _hdr_declared),
    (b"\x89PNG", _png_sites, _png_declared),
    (b"\xff\xd8", _jpeg_sites, _jpeg_declared),
    (b"PK", _zip_sites, len),
)


def sites(data: bytes) -> list[Site]:
    """Return where the numbers of a file's header and structure stand."""
    found = _safetensors_sites if data[8:9] == b"{" else lambda data: []
    found = next((sites for magic, sites, _ in _KINDS if data.startswith(magic)), found)
    return [site for site in found(data)[:_MOST_SITES] if site.offset + site.size <= len(data)]


def declared(data: bytes) -> int:
    """Return the bytes of the float32 image that a file declares; of a file that is no image, its own size.

    An image larger than the readers accept counts as 0: it is to be refused before memory is asked for.
    """
    return next((found(data) for magic, _, found in _KINDS if data.startswith(magic)), len(data))
