"""What a file's header says: where its numbers stand, and how large an image it declares.

Apart from the readers under test, so that neither inherits the other's mistakes. Nothing here fails on a
damaged file: what cannot be followed is left out.
"""

import re
import struct
from typing import NamedTuple

_MOST_SITES = 4000
MOST_SIDE, MOST_TEXELS = 32768, 2**27
"""What the readers say that they accept."""


class Site(NamedTuple):
    """A number in a file: ``size`` bytes, "little" or "big" end first; size 0: decimal text."""

    offset: int
    size: int
    order: str = "little"


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


_EXR_NUMBERS = {
    b"box2i": 4,
    b"int": 4,
    b"v2i": 4,
    b"tiledesc": 4,
    b"float": 4,
    b"v2f": 4,
    b"chromaticities": 4,
}


def _exr_sites(data):
    sites = [Site(4, 1), Site(5, 1)]
    for name, kind, at, length, _ in _exr_attributes(data):
        if not name:  # the table of offsets follows, and the chunks that it points to
            table = [Site(i, 8) for i in range(at, min(at + 8 * 24, len(data) - 8), 8)]
            for entry in table:
                (place,) = struct.unpack_from("<Q", data, entry.offset)
                if place + 20 <= len(data):
                    sites += [Site(place + i, 4) for i in range(0, 20, 4)]
            return sites + table
        sites.append(Site(at, 4))
        value = at + 4
        if step := _EXR_NUMBERS.get(kind):
            sites += [Site(value + i, step) for i in range(0, min(length, 64), step)]
        elif kind == b"chlist":
            while value < at + 4 + length and (end := data.find(b"\0", value, value + 256)) > value:
                sites += [Site(end + i, 4) for i in (1, 5, 9, 13)]
                value = end + 17
        elif length <= 4:
            sites += [Site(value + i, 1) for i in range(length)]
    return sites


def _area(width, height):
    """Return the texels of an image; 0 if it is to be refused before memory is asked for."""
    return (
        width * height
        if 0 < min(width, height) <= max(width, height) <= MOST_SIDE and width * height <= MOST_TEXELS
        else 0
    )


def _box(data, at):
    if at + 16 > len(data):
        return 0
    left, top, right, bottom = struct.unpack_from("<4i", data, at)
    return _area(right - left + 1, bottom - top + 1)


def _exr_declared(data):
    """Sum, over the parts, what data window, display window and one tile take in float32."""
    parts = {}
    for name, kind, at, length, part in _exr_attributes(data):
        found = parts.setdefault(part, {"channels": 0, "areas": 0, "display": 0})
        if kind == b"chlist":
            value = at + 4
            while value < at + 4 + length and (end := data.find(b"\0", value, value + 256)) > value:
                found["channels"] += 1
                value = end + 17
        elif name == b"dataWindow":
            found["areas"] += _box(data, at + 4)
        elif name == b"displayWindow":
            found["display"] = 16 * _box(data, at + 4)
    if sum(p["areas"] for p in parts.values()) > MOST_TEXELS:
        return 0
    return sum(p["display"] + 4 * max(p["channels"], 3) * p["areas"] for p in parts.values())


# ---- the others --------------------------------------------------------------------------------------------


def _hdr_sites(data):
    line = re.search(rb"\n\n([^\n]*)\n", data[:4096])
    numbers = [Site(m.start(1), 0) for m in re.finditer(rb"(\d+)", data[: line.end()])] if line else []
    size = [s for s in numbers if s.offset > line.start()] if line else []
    rows = [m.start() for m in re.finditer(rb"\x02\x02", data)][:64]
    return 4 * size + numbers + [Site(at, 1) for start in rows for at in range(start, start + 6)]


def _hdr_declared(data):
    found = re.search(rb"[-+][XY] +(\d{1,9}) +[-+][XY] +(\d{1,9})", data[:65536])
    return 12 * _area(int(found[1]), int(found[2])) if found else 0


def _png_chunks(data):
    """Yield (offset, length, kind) of the chunks of a PNG."""
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        yield at, length, data[at + 4 : at + 8]
        at += 12 + length


def _png_sites(data):
    sites = [Site(16, 4, "big"), Site(20, 4, "big"), *(Site(at, 1) for at in range(24, 29))]
    for at, length, _ in _png_chunks(data):
        sites += [Site(at, 4, "big"), Site(at + 4, 4, "big")]
        sites += [Site(at + 8 + i, 1) for i in range(min(length, 32))]
    return sites


def _png_declared(data):
    width, height = struct.unpack_from(">2I", data.ljust(24, b"\0"), 16)
    return 12 * _area(width, height)


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
        sites += [Site(at + 1, 1), Site(at + 2, 2, "big")]
        sites += [Site(at + 4 + i, 1) for i in range(min(length, 24))]
        if 0xC0 <= marker <= 0xCF:
            sites += 4 * [Site(at + 5, 2, "big"), Site(at + 7, 2, "big")]
    return sites


def _jpeg_declared(data):
    areas = [0]
    for at, _, marker in _jpeg_segments(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and at + 9 <= len(data):
            height, width = struct.unpack_from(">2H", data, at + 5)
            areas.append(_area(width, height))
    return 12 * max(areas)


def _zip_sites(data):
    """Return the numbers of the local headers, the central directory and its end, and of npy headers."""
    sites = []
    for magic, sizes in (
        (b"PK\x03\x04", (2, 2, 2, 2, 2, 4, 4, 4, 2, 2)),
        (b"PK\x01\x02", (2, 2, 2, 2, 2, 2, 4, 4, 4, 2, 2, 2, 2, 2, 4, 4)),
        (b"PK\x05\x06", (2, 2, 2, 2, 4, 4, 2)),
    ):
        for found in re.finditer(re.escape(magic), data):
            at = found.end()
            for size in sizes:
                sites.append(Site(at, size))
                at += size
    for found in re.finditer(rb"\x93NUMPY", data):
        sites += [Site(found.end(), 1), Site(found.end() + 1, 1), Site(found.end() + 2, 2)]
        digits = re.finditer(rb"\d+", data[found.end() : found.end() + 118])
        sites += [Site(found.end() + digit.start(), 0) for digit in digits]
    return sites


def _safetensors_sites(data):
    length = int.from_bytes(data[:8], "little")
    numbers = re.finditer(rb"\d+", data[8 : 8 + min(length, 1 << 20)])
    return 8 * [Site(0, 8)] + [Site(8 + number.start(), 0) for number in numbers]


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
    for magic, _, found in _KINDS:
        if data.startswith(magic):
            return found(data)
    return len(data)


def png_chunks(data: bytes) -> list[tuple[int, int, bytes]]:
    """Return (offset, length, kind) of the chunks of a PNG; none of anything else."""
    return list(_png_chunks(data)) if data.startswith(b"\x89PNG") else []
