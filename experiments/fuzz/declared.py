"""How large an image a file declares.

Apart from the readers under test, so that neither inherits the other's mistakes. Nothing here fails on a
damaged file: what cannot be followed is left out.
"""

import re
import struct

MOST_SIDE, MOST_TEXELS = 32768, 2**27
"""What the readers say that they accept."""


def area(width: int, height: int) -> int:
    """Return the texels of an image; 0 if it is to be refused before memory is asked for."""
    accepted = 0 < min(width, height) <= max(width, height) <= MOST_SIDE and width * height <= MOST_TEXELS
    return width * height if accepted else 0


def exr(data: bytes) -> int:
    """Sum what the data windows of all parts, with all channels, and the display windows take."""

    def windows(name):
        places = [found.end() for found in re.finditer(name + rb"\0box2i\0....", data, re.DOTALL)]
        boxes = [struct.unpack_from("<4i", data, at) for at in places if at + 16 <= len(data)]
        return [area(right - left + 1, bottom - top + 1) for left, top, right, bottom in boxes]

    # An entry of the list of channels takes 18 bytes or more.
    lists = re.finditer(rb"\0chlist\0(....)", data, re.DOTALL)
    channels = [int.from_bytes(found[1], "little") for found in lists]
    most = max([3, *(min(length, len(data)) // 18 for length in channels)])
    texels = sum(windows(b"dataWindow"))
    return 0 if texels > MOST_TEXELS else 4 * most * texels + 16 * sum(windows(b"displayWindow"))


def hdr(data: bytes) -> int:
    found = re.search(rb"[-+][XY] +(\d{1,9}) +[-+][XY] +(\d{1,9})", data[:65536])
    return 12 * area(int(found[1]), int(found[2])) if found else 0


def png(data: bytes) -> int:
    return 12 * area(*struct.unpack_from(">2I", data.ljust(24, b"\0"), 16))


def jpeg(data: bytes) -> int:
    frames = re.finditer(rb"\xff[\xc0-\xc3\xc5-\xc7\xc9-\xcb\xcd-\xcf]...(..)(..)", data, re.DOTALL)
    sizes = [[int.from_bytes(side, "big") for side in frame.groups()] for frame in frames]
    return 12 * max((area(*size) for size in sizes), default=0)


KINDS = {b"\x76\x2f\x31\x01": exr, b"#?": hdr, b"\x89PNG": png, b"\xff\xd8": jpeg}


def declared(data: bytes) -> int:
    """Return the bytes of the float32 image that a file declares; of a file that is no image, its own size.

    An image larger than the readers accept counts as 0: it is to be refused before memory is asked for.
    """
    return next((size(data) for magic, size in KINDS.items() if data.startswith(magic)), len(data))
