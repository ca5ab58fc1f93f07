"""OpenEXR files: which part and channels are a picture, and their pixels as float32."""

from __future__ import annotations

import contextlib
import mmap
import re
from collections.abc import Iterator

import numpy as np

from envedit.core.atomic_files import replacing
from envedit.core.errors import InputError
from envedit.core.machine import cores
from envedit.core.primaries import REC709, Chromaticities
from envedit.core.quiet_libraries import quiet_libraries
from envedit.core.types import Info
from envedit.images.headers import MAX_TEXELS, check_declared, damaged, shown

_SPACE_NAMES = "colorInteropID", "oiio:ColorSpace"  # attributes that name a colour space
_MOST_VALUES = 4 * MAX_TEXELS  # over all channels: colour and alpha of the largest
_MOST_TILE = 2**20  # texels: OpenEXR takes memory for a whole tile, however small the image

_LINES = {
    "NO_COMPRESSION": 1, "RLE_COMPRESSION": 1, "ZIPS_COMPRESSION": 1, "ZIP_COMPRESSION": 16,
    "PIZ_COMPRESSION": 32, "PXR24_COMPRESSION": 16, "B44_COMPRESSION": 32, "B44A_COMPRESSION": 32,
    "DWAA_COMPRESSION": 32, "DWAB_COMPRESSION": 256,
}  # fmt: skip
"""Rows of a chunk of scanlines."""


def declared(name: str) -> list:
    """Return the parts of a file, without pixels, once the sizes that they declare have been checked."""
    import OpenEXR

    with _refusing(name), quiet_libraries():
        parts = OpenEXR.File(name, header_only=True).parts
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
    return parts


def require_whole(name: str) -> None:
    """Refuse a file that cannot be decoded, before a decoder sees it that does not survive that.

    OpenEXR finds the chunks of a file anew where their table is damaged, and Mitsuba's use of it does not.
    """
    parts = declared(name)
    _decoded(name, len(parts))
    if len(parts) == 1:
        _require_chunks(name, parts[0])


def _require_chunks(name, part):
    """Refuse a file of one part whose table of chunks points out of it."""
    _, _, width, height = _window(part.header["dataWindow"])
    tile, lines = part.header.get("tiles"), _LINES.get(part.header["compression"].name)
    if tile is not None and tile.mode.name == "ONE_LEVEL":
        count = -(-width // tile.xSize) * -(-height // tile.ySize)
    elif tile is None and lines:
        count = -(-height // lines)
    else:
        return
    # Only the header and the table are read into memory.
    with open(name, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        begin = 8
        size = len(data)
        while data[begin : begin + 1] not in (b"", b"\0"):  # an attribute: name, type, size, value
            end = data.find(b"\0", data.find(b"\0", begin) + 1) + 1
            if end <= begin:
                raise damaged(name, "its header does not end")
            begin = end + 4 + int.from_bytes(data[end : end + 4], "little")
        table = np.frombuffer(data[begin + 1 : begin + 1 + 8 * count], "<u8")
    if len(table) < count or not ((table > begin) & (table < size)).all():
        raise damaged(name, "its table of chunks points out of the file")


def read(name: str, head: bytes, info: Info, stored: bool) -> np.ndarray:
    """Decode a file; arguments as in :mod:`.headers`."""
    parts = declared(name)
    windows = [_window(p.header["dataWindow"]) for p in parts]
    index, names = _choose_channels(name, [p.header for p in parts], info)
    header = parts[index].header
    layer = names[0].rpartition(".")[0]
    beside = [c for c in header["channels"] if c.name.rpartition(".")[0] == layer]
    if stored:
        alpha = [c for c in beside if c.name.rpartition(".")[2].upper() == "A"]
        names += [c.name for c in alpha if c.xSampling == c.ySampling == 1]

    decoded = _decoded(name, len(parts))[index]
    left, top, width, height = windows[index]
    with _refusing(name):
        info["half"] = all(decoded.channels[c].pixels.dtype == np.float16 for c in names)
        planes = [np.array(decoded.channels[c].pixels, np.float32) for c in names]
    if any(p.shape != (height, width) for p in planes):
        raise damaged(name, "not all of its channels could be decoded")
    info["unread"] = [c.name for c in beside if c.name not in names and not _opaque(decoded.channels[c.name])]
    display = _window(header["displayWindow"])
    if stored and len(planes) in (1, 3) and windows[index] != display:
        planes.append(np.ones_like(planes[0]))  # what lies outside the data is transparent, not black
    image = np.stack(planes if stored or len(planes) == 3 else planes * 3, axis=-1)

    # ---- Plain attributes, and marks
    info["metadata"] = {k: v for k, v in header.items() if isinstance(v, str | int | float)}
    marks = info["marks"]
    if header.get("chromaticities") is not None:
        marks["chromaticities"] = header["chromaticities"]
    marks["spaces"] = [v for k in _SPACE_NAMES if isinstance(v := header.get(k), str) and v]
    marks["cube"] = "CUBE" in str(header.get("envmap", ""))
    return _to_display(image, (left, top), display, name, info)


def write(
    name: str,
    planes: dict[str, np.ndarray],
    chromaticities: Chromaticities | None = None,
    panorama: bool = True,
    metadata: dict | None = None,
) -> None:
    """Write channels (H, W) by name, whole or not at all; other arguments as of :func:`.images.write_exr`.

    Channels are float32, or half.
    """
    import OpenEXR

    import envedit

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": chromaticities or REC709,
        **({"envmap": OpenEXR.ENVMAP_LATLONG} if panorama else {}),
        "software": f"envedit {envedit.__version__}",
    }
    for key, value in (metadata or {}).items():
        plain = isinstance(value, float) or type(value) is int and abs(value) < 2**31
        header[key] = value if plain else str(value)
    planes = {channel: np.ascontiguousarray(values) for channel, values in planes.items()}
    with replacing(name, ".exr") as temporary, quiet_libraries(), on_cores():
        OpenEXR.File(header, planes).write(str(temporary))


@contextlib.contextmanager
def on_cores() -> Iterator[None]:
    """Let the library use a thread a core; left alone it uses one, before 3.5 always."""
    import OpenEXR

    if not hasattr(OpenEXR, "set_global_thread_count"):
        yield
        return
    before = OpenEXR.global_thread_count()
    OpenEXR.set_global_thread_count(cores())
    try:
        yield
    finally:
        OpenEXR.set_global_thread_count(before)


def _decoded(name, count):
    """Decode the parts of a file that declares so many."""
    import OpenEXR

    with _refusing(name), quiet_libraries() as printed, on_cores():
        # separate_channels: the interleaved form guesses at RGB(A) and leaves layers out.
        parts = OpenEXR.File(name, separate_channels=True).parts
    # A part that cannot be decoded is dropped with a printed warning, and the others move up.
    # The decoder of JPEG 2000 says that a stream ended early, and fills up with what it likes.
    if len(parts) != count or "terminated early" in (printed[0] if printed else ""):
        raise damaged(name, printed and printed[0] or "not all of its parts could be decoded")
    return parts


@contextlib.contextmanager
def _refusing(name):
    """Take whatever the library raises, bare RuntimeError for anything, for damage of a file."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as e:
        raise damaged(name, e) from None


def _window(box):
    """Return (left, top, width, height) of an inclusive OpenEXR box."""
    (x0, y0), (x1, y1) = ([int(c) for c in corner] for corner in box)
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


def _choose_channels(name, headers, info):
    """Return the part of the picture and its channel names, three or (luminance) one."""
    channel_names, colour, grey = [], [], []  # of the latter: part, name of the layer, channels
    for index, header in enumerate(headers):
        if "deep" in str(header.get("type", "")).lower():
            channel_names.append("deep data")
            continue
        layers: dict[str, dict[str, str]] = {}
        for channel in header["channels"]:
            channel_names.append(channel.name)
            layer, _, short = channel.name.rpartition(".")
            layers.setdefault(layer, {})[short.upper()] = channel.name
        # Unnamed channels of a part go first; the part's own name is that of all of them.
        for layer, channels in sorted(layers.items(), key=lambda item: item[0] != ""):
            part = str(header.get("name", "")) if len(headers) > 1 else ""
            label = layer if part in layer else ".".join(filter(None, (part, layer)))
            if {"R", "G", "B"} <= channels.keys():
                colour.append((index, label, [channels[c] for c in "RGB"]))
            elif "Y" in channels and not {"RY", "BY", "X", "Z"} & channels.keys():
                grey.append((index, channels["Y"], [channels["Y"]]))
    if not colour + grey:
        listed = ", ".join(shown(channel, 30) for channel in channel_names[:12])
        raise InputError(f"{name}: no R, G, B channels (found: {listed}); save it as RGB")

    # ---- unnamed channels, then a layer or part that calls itself the picture, then the order of the file
    index, label, names = min(colour, key=lambda c: _rank(c[1])) if colour else grey[0]
    if not colour:
        info["warnings"].append(f"only luminance ('{shown(label)}'): read as grey")
    elif len(colour) > 1:
        labels = [shown(c[1], 40) or "R, G, B" for c in colour]
        others = ", ".join(labels[:6]) + (", ..." if len(labels) > 6 else "")
        info["warnings"].append(
            f"{len(colour)} colour layers ({others}): '{shown(label) or 'R, G, B'}' was read"
        )
    if any(c.xSampling != 1 or c.ySampling != 1 for c in headers[index]["channels"] if c.name in names):
        raise InputError(f"{name}: subsampled channels are not supported; save R, G, B in full")
    return index, names


def _opaque(channel):
    """Return whether a channel is alpha, and 1 everywhere."""
    return channel.name.rpartition(".")[2].upper() == "A" and bool((channel.pixels == 1).all())


def _rank(label):
    """Order layers: unnamed channels, names that end in a word for the picture, or hold one, others."""
    if not label:
        return 0
    match = re.search("(combined|beauty|rgba)(.?)", label.lower())
    return 3 if match is None else 2 if match[2] else 1


def _to_display(image, corner, display, name, info):
    """Place the data window in the display window; what is not stored is black."""
    left, top, width, height = display
    if corner == (left, top) and image.shape[:2] == (height, width):
        return image
    check_declared(name, width, height)
    info["data_size"] = image.shape[1], image.shape[0]
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
