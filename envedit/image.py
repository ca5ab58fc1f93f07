"""HDR images: read, check, mend, write; tonemaps; and the analytic sun and sky.

An image is a float32 array ``(H, W, 3)`` of linear radiance with Rec.709 primaries. Problems that a user can
mend raise ``InputError`` with the file's name; what is merely odd goes to ``info["warnings"]``, a list of
sentences.
"""

import contextlib
import io
import math
import os
import re
import stat
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import latlong
from .errors import ConfigError, EnveditError, InputError, NumericalError

__all__ = [
    "INVERSE_TONEMAPS",
    "TONEMAPS",
    "Health",
    "health",
    "inverse_tonemap",
    "load_envmap",
    "luminance",
    "read",
    "repair",
    "sunsky",
    "tonemap",
    "write_exr",
    "write_png",
]

MAX_SIDE = 32768
MAX_TEXELS = 2**27
"""16384 x 8192 texels: 1.6 GB as float32. A header that declares more is refused before allocation."""

HALF_MAX = 65504.0
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of red, green, blue and white (D65), as the OpenEXR attribute orders them."""


# ----------------------------------------------------------------------------------------------------------
# Reading


def read(path) -> tuple[np.ndarray, dict]:
    """Read an image file as linear radiance.

    The content decides the format, not the name: OpenEXR (half, float or uint; any channel order; layers; the
    first part with colour; luminance-only files become grey), Radiance HDR, and PNG or JPEG, whose sRGB curve
    is undone. Alpha is left out. Values are as stored: they may be negative or not finite, see
    :func:`health`.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    image : array (H, W, 3) float32
        Linear radiance.
    info : dict
        ``path`` (str), ``format`` ("exr", "hdr", "png" or "jpeg"), ``size`` (width, height), ``hdr`` (False
        for 8- and 16-bit pictures), ``metadata`` (dict of str, int and float) and ``warnings`` (list of str).

    Raises
    ------
    InputError
        If the file is missing, empty, truncated, of another kind, or declares more than 32768 texels on a
        side or 2^27 in all.
    """
    name = os.fsdecode(path)
    head = _head(name)
    info = {"path": name, "format": None, "size": None, "hdr": True, "metadata": {}, "warnings": []}
    for kind, magic, reader in _FORMATS:
        if head.startswith(magic):
            info["format"] = kind
            try:
                image = reader(name, head, info)
            except MemoryError:
                raise InputError(f"{name}: not enough memory to read this image; make it smaller") from None
            except EnveditError:
                raise
            except OSError as e:
                raise InputError(f"{name}: cannot be read ({e.strerror or e})") from None
            except (LookupError, TypeError, ValueError, RuntimeError) as e:
                # Damage reaches header fields as well: names that are no text, windows of another type.
                raise _damaged(name, f"{type(e).__name__}: {e}") from None
            info["size"] = (image.shape[1], image.shape[0])
            return image, info
    raise InputError(f"{name}: not an image envedit can read; use OpenEXR or Radiance HDR (or PNG, JPEG)")


def _head(name):
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


def _check_declared(name, width, height):
    """Refuse a size before memory is asked for."""
    if width < 1 or height < 1:
        raise InputError(f"{name}: the header declares {width} x {height} texels; the file is damaged")
    if max(width, height) > MAX_SIDE or width * height > MAX_TEXELS:
        raise InputError(
            f"{name}: the header declares {width} x {height} texels, more than {MAX_SIDE} on a side or "
            f"{MAX_TEXELS} in all; the file is damaged, or has to be made smaller"
        )


def _damaged(name, reason):
    """Return the error for a file that starts well and cannot be decoded."""
    reason = " ".join(str(reason).split())[:160] or "no reason given"
    return InputError(f"{name}: damaged or truncated ({reason}); export or download it again")


@contextlib.contextmanager
def _caught_output():
    """Keep what C libraries print about a file off the user's terminal; yields a list that receives the text.

    OpenEXR and libjpeg write to file descriptor 2 and to ``sys.stdout``, and carry on.
    """
    said, text = [], io.StringIO()
    with contextlib.ExitStack() as stack:
        try:
            sys.stderr.flush()
            kept = os.dup(2)
        except (OSError, ValueError, AttributeError):  # no stderr to protect
            yield said
            return
        sink = stack.enter_context(tempfile.TemporaryFile())
        stack.enter_context(contextlib.redirect_stdout(text))
        os.dup2(sink.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            sink.seek(0)
            said.append(text.getvalue() + sink.read().decode(errors="replace"))


def _read_exr(name, head, info):
    import OpenEXR

    try:
        with _caught_output():
            parts = OpenEXR.File(name, header_only=True).parts
    except Exception as e:  # the library raises bare RuntimeError for anything
        raise _damaged(name, e) from None
    windows = [_window(p.header["dataWindow"]) for p in parts]
    for _, _, width, height in windows:
        _check_declared(name, width, height)
    if sum(w * h for _, _, w, h in windows) > MAX_TEXELS:  # the library decodes every part
        raise InputError(
            f"{name}: its {len(parts)} parts hold more than {MAX_TEXELS} texels; save only colour"
        )
    index, names = _choose_channels(name, [p.header for p in parts], info)

    # separate_channels: the interleaved form guesses at RGB(A) and leaves layers out.
    try:
        with _caught_output() as said:
            decoded = OpenEXR.File(name, separate_channels=True)
            channels = decoded.parts[index].channels if len(decoded.parts) == len(parts) else None
            planes = None if channels is None else [np.array(channels[c].pixels, np.float32) for c in names]
    except MemoryError:
        raise
    except Exception as e:
        raise _damaged(name, e) from None
    left, top, width, height = windows[index]
    # A part that cannot be decoded is dropped with a printed warning, and the others move up.
    if planes is None or any(p.shape != (height, width) for p in planes):
        raise _damaged(name, said and said[0] or "not all of its parts could be decoded")
    image = np.stack(planes if len(planes) == 3 else planes * 3, axis=-1)
    header = parts[index].header
    _describe(header, info)
    return _to_display(image, (left, top), _window(header["displayWindow"]), name, info)


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
                info["warnings"].append(f"{len(colour)} colour layers: '{colour[0] or 'R, G, B'}' was read")
        else:
            grey = [v["Y"] for v in layers.values() if "Y" in v and not {"RY", "BY", "X", "Z"} & v.keys()]
            if not grey:
                continue
            names = grey[:1]
            info["warnings"].append(f"only luminance ('{names[0]}'): read as grey")
        if any(channels[c].xSampling != 1 or channels[c].ySampling != 1 for c in names):
            raise InputError(f"{name}: subsampled channels are not supported; save R, G, B in full")
        return index, names
    raise InputError(f"{name}: no R, G, B channels (found: {', '.join(seen[:12])}); save it as RGB")


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
    _check_declared(name, width, height)
    info["warnings"].append(
        f"data window {image.shape[1]} x {image.shape[0]} at {corner[0]}, {corner[1]} differs from the "
        f"display window {width} x {height} at {left}, {top}: cropped, or filled with black"
    )
    whole = np.zeros((height, width, 3), np.float32)
    y, x = corner[1] - top, corner[0] - left
    y0, x0 = max(y, 0), max(x, 0)
    y1, x1 = min(y + image.shape[0], height), min(x + image.shape[1], width)
    if y1 > y0 and x1 > x0:
        whole[y0:y1, x0:x1] = image[y0 - y : y1 - y, x0 - x : x1 - x]
    return whole


def _read_radiance(name, head, info):
    end = re.search(rb"\n\r?\n([^\n]*)\n", head)
    size = end and re.fullmatch(rb"([-+][XY]) +(\d{1,9}) +([-+][XY]) +(\d{1,9})\s*", end[1])
    if not size:
        raise _damaged(name, "no Radiance resolution line")
    if (size[1], size[3]) != (b"-Y", b"+X"):
        raise InputError(f"{name}: rows are stored as '{end[1].decode()}'; save them as '-Y H +X W'")
    height, width = int(size[2]), int(size[4])
    _check_declared(name, width, height)
    header = dict(re.findall(r"^(\w+) *= *(.*?)\s*$", head[: end.start()].decode("latin-1"), re.M))
    info["metadata"] = header
    if "xyze" in header.get("FORMAT", ""):
        raise InputError(f"{name}: holds XYZ colours (32-bit_rle_xyze); save it as RGB (32-bit_rle_rgbe)")
    for key in {"EXPOSURE", "COLORCORR"} & header.keys():
        if any(float(v) != 1 for v in re.findall(r"[-+.\deE]*\d[-+.\deE]*", header[key])):
            info["warnings"].append(f"{key}={header[key]} in its header is not undone: values are as stored")
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


def _radiance_runs(name, data, height, width):
    """Decode run-length encoded scanlines: (2, 2, W >> 8, W & 255), then four bands of runs and literals.

    Mitsuba's reader is quicker and overruns its buffer on damaged files, which kills the process.
    """
    rows = bytearray()
    start, at = data[:4], 0
    for y in range(height):
        if data[at : at + 4] != start:
            raise _damaged(name, f"scanline {y} of {height} does not begin")
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
                    raise _damaged(name, f"scanline {y} of {height} breaks off")
            if len(rows) > goal:
                raise _damaged(name, f"scanline {y} of {height} is too long")
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
        raise _damaged(name, f"holds {total[-1] if len(total) else 0} of {height * width} texels")
    stop = int(np.searchsorted(total, height * width)) + 1
    count[stop - 1] -= total[stop - 1] - height * width
    return pixels[np.repeat(source[:stop], count[:stop])].reshape(height, width, 4)


def _read_ldr(name, head, info):
    if info["format"] == "png":
        size = (int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big"))
    else:
        size = _jpeg_size(name)
    _check_declared(name, *size)
    image = _bitmap(name)
    if image.dtype not in (np.uint8, np.uint16):
        raise _damaged(name, f"unexpected samples of type {image.dtype}")
    info["hdr"] = False
    depth = 8 * image.dtype.itemsize
    info["warnings"].append(f"a {depth}-bit {info['format'].upper()} is not HDR: light above 1 is missing")
    image = image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2)
    values = srgb_to_linear(np.arange(2**depth) / (2**depth - 1)).astype(np.float32)
    return values[image]


def _jpeg_size(name):
    """Return (width, height) from the frame header, wherever the markers before it end."""
    with open(name, "rb") as file:
        file.seek(2)
        while True:
            marker = file.read(4)
            if len(marker) < 4 or marker[0] != 0xFF:
                raise _damaged(name, "no JPEG frame header")
            if marker[1] == 0xFF:  # padding before a marker
                file.seek(-3, os.SEEK_CUR)
                continue
            if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC):
                frame = file.read(5)
                return int.from_bytes(frame[3:5], "big"), int.from_bytes(frame[1:3], "big")
            file.seek(max(int.from_bytes(marker[2:], "big") - 2, 0), os.SEEK_CUR)


def _bitmap(name):
    """Decode a PNG or JPEG with Mitsuba; returns (H, W, C) as stored."""
    import mitsuba as mi

    try:
        with _caught_output() as said:
            pixels = np.array(mi.Bitmap(name))
    except Exception as e:
        raise _damaged(name, re.sub(r'^(\[\w+\] )?("[^"]*": )?', "", str(e))) from None
    if re.search("corrupt|premature", said[0] if said else "", re.I):  # libjpeg only prints
        raise _damaged(name, said[0])
    return pixels if pixels.ndim == 3 else pixels[..., None]


_FORMATS = (
    ("exr", b"\x76\x2f\x31\x01", _read_exr),
    ("hdr", b"#?", _read_radiance),
    ("png", b"\x89PNG\r\n\x1a\n", _read_ldr),
    ("jpeg", b"\xff\xd8\xff", _read_ldr),
)


# ----------------------------------------------------------------------------------------------------------
# Writing


def write_exr(path, image, metadata: dict | None = None) -> None:
    """Write an image as a float32 OpenEXR file, whole or not at all.

    Marked as lat-long with Rec.709 primaries. Written under another name in the same folder and then renamed.

    Parameters
    ----------
    path : path-like
        The file; an existing one is replaced.
    image : array (H, W, 3)
        Linear radiance, finite in float32. Never written as half: 65504 is less than many a sun.
    metadata : dict, optional
        Attributes to add (str, int or float; anything else as its text), such as ``{"source": "sky.hdr"}``.

    Raises
    ------
    NumericalError
        If a value is not finite in float32; names the first texel.
    InputError
        If the file cannot be written.
    """
    import OpenEXR

    name = os.fsdecode(path)
    image = _checked(name, image)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": REC709,
        "envmap": OpenEXR.ENVMAP_LATLONG,
        "software": f"envedit {_version()}",
    }
    reserved = {"channels", "dataWindow", "displayWindow", "lineOrder", "name", "view", "tiles", *header}
    reserved.remove("software")
    for key, value in (metadata or {}).items():
        if key in reserved or not 0 < len(str(key)) < 256:
            raise ConfigError(f"{name}: '{key}' cannot be used as the name of a metadata attribute")
        plain = isinstance(value, float) or type(value) is int and abs(value) < 2**31
        header[str(key)] = value if plain else str(value)
    planes = {c: np.ascontiguousarray(image[..., i]) for i, c in enumerate("RGB")}
    _write_whole(name, ".exr", OpenEXR.File(header, planes).write)


def write_png(path, image) -> None:
    """Write a picture in [0, 1] as an 8-bit PNG, whole or not at all.

    Parameters
    ----------
    path : path-like
        The file; an existing one is replaced.
    image : array (H, W, 3) or (H, W)
        Display values, already tonemapped; values outside [0, 1] are cut.

    Raises
    ------
    NumericalError, InputError
        As :func:`write_exr`.
    """
    import mitsuba as mi

    name = os.fsdecode(path)
    image = np.asarray(image)
    image = _checked(name, np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image)
    bitmap = mi.Bitmap(np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8))
    _write_whole(name, ".png", bitmap.write)


def _checked(name, image):
    """Return the image as float32 (H, W, 3), refusing anything a file must not hold."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"{name}: an image to write is (H, W, 3), got shape {image.shape}")
    with np.errstate(over="ignore"):  # caught below, as an infinity
        image = image.astype(np.float32)
    bad = _any(~np.isfinite(image))
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise NumericalError(
            f"{name}: not written: {bad.sum()} texels are not finite, the first at row {row}, "
            f"column {column} ({', '.join(f'{v:g}' for v in image[row, column])})"
        )
    return image


def _write_whole(name, suffix, write):
    """Call ``write(temporary name)`` and rename the result to ``name``."""
    target = Path(name)
    temporary = target.with_name(f".{target.name}.{os.getpid()}{suffix}")
    try:
        with _caught_output():
            write(str(temporary))
        os.replace(temporary, target)
    except (RuntimeError, OSError, ValueError) as e:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if not target.parent.is_dir():
            reason = "its folder does not exist"
        else:  # the libraries' texts name the temporary file; what follows the last stop is the cause
            reason = (getattr(e, "strerror", None) or re.split(r"[:.] ", str(e))[-1]).strip(" .")
        raise InputError(f"{name}: cannot be written ({reason}); check folder and free space") from None


def _version():
    """Return the package's version, or "unknown" when it runs uninstalled."""
    import importlib.metadata

    try:
        return importlib.metadata.version("envedit")
    except importlib.metadata.PackageNotFoundError:
        return getattr(sys.modules.get("envedit"), "__version__", "unknown")


# ----------------------------------------------------------------------------------------------------------
# Health


@dataclass(frozen=True)
class Health:
    """What is in an image: texels of each kind, the first (row, column) of them, and the range of luminance.

    A texel counts if any of its channels does. ``minimum`` and ``maximum`` are over finite channel values;
    ``median`` is of finite luminance; ``dynamic_range`` is the largest over the smallest positive luminance,
    0.0 without any. Everything is finite, an image without finite values has 0.0.
    """

    texels: int
    nan: int
    inf: int
    negative: int
    saturated: int
    first_nan: tuple[int, int] | None
    first_inf: tuple[int, int] | None
    first_negative: tuple[int, int] | None
    first_saturated: tuple[int, int] | None
    minimum: float
    maximum: float
    median: float
    dynamic_range: float

    @property
    def ok(self) -> bool:
        """True when every value is finite and none is negative."""
        return not (self.nan or self.inf or self.negative)

    def summary(self) -> str:
        """Return one line for a log or a report."""
        kinds = (
            (self.nan, "NaN", self.first_nan),
            (self.inf, "infinite", self.first_inf),
            (self.negative, "negative", self.first_negative),
            (self.saturated, "at the largest half (65504)", self.first_saturated),
        )
        found = [f"{n} {what} (first at row {p[0]}, column {p[1]})" for n, what, p in kinds if n]
        stops = math.log2(self.dynamic_range) if self.dynamic_range > 0 else 0.0
        spread = f"{self.minimum:.4g} to {self.maximum:.4g}, median {self.median:.4g}, {stops:.1f} stops"
        return f"{self.texels} texels, {spread}; {', '.join(found) or 'nothing unusual'}"


def health(image) -> Health:
    """Count the NaN, infinite, negative and half-saturated texels of an image; see :class:`Health`."""
    image = np.asarray(image)
    finite = np.isfinite(image)
    masks = {
        "nan": _any(np.isnan(image)),
        "inf": _any(np.isinf(image)),
        "negative": _any(image < 0),
        "saturated": _any(image == HALF_MAX),
    }
    fields = {}
    for kind, mask in masks.items():
        fields[kind] = int(mask.sum())
        first = np.unravel_index(mask.argmax(), mask.shape)
        fields[f"first_{kind}"] = (int(first[0]), int(first[1])) if fields[kind] else None
    clean = bool(finite.all())  # then nothing has to be copied
    values = image if clean else image[finite]
    y = luminance(image if clean else image[~_any(~finite)])
    positive = y[y > 0]
    return Health(
        texels=image.shape[0] * image.shape[1],
        minimum=float(values.min()) if values.size else 0.0,
        maximum=float(values.max()) if values.size else 0.0,
        median=float(np.median(y)) if y.size else 0.0,
        dynamic_range=float(positive.max() / positive.min()) if positive.size else 0.0,
        **fields,
    )


def _any(mask):
    """Return where any channel of (H, W, 3) is set; numpy's own ``any(2)`` takes five times as long."""
    return mask[..., 0] | mask[..., 1] | mask[..., 2]


def repair(image) -> tuple[np.ndarray, int]:
    """Replace every non-finite texel by the mean of its finite neighbours.

    The eight neighbours, columns periodic; holes are filled from their rim inwards. A texel with one bad
    channel is replaced whole, as its other channels are no more to be trusted.

    Parameters
    ----------
    image : array (H, W, 3)
        The map; not changed.

    Returns
    -------
    image : array (H, W, 3) float32
        The same where it was finite.
    count : int
        Texels replaced.

    Raises
    ------
    InputError
        If no texel is finite.
    """
    with np.errstate(over="ignore"):
        image = np.array(image, np.float32)
    height, width = image.shape[:2]
    good = ~_any(~np.isfinite(image))
    count = int(good.size - good.sum())
    if count == 0:
        return image, 0
    if count == good.size:
        raise InputError(f"all {count} texels of the image are NaN or infinite: nothing to repair from")
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    row, column = np.nonzero(~good)
    while len(row):
        total = np.zeros((len(row), 3))
        weight = np.zeros(len(row))
        for i, j in steps:
            r, c = row + i, (column + j) % width
            valid = (r >= 0) & (r < height) & good[np.clip(r, 0, height - 1), c]
            total[valid] += image[r[valid], c[valid]]
            weight += valid
        rim = weight > 0
        row, column = row[rim], column[rim]
        image[row, column] = total[rim] / weight[rim, None]
        good[row, column] = True
        # Only neighbours of what was just filled can be next.
        texel = [np.clip(row + i, 0, height - 1) * width + (column + j) % width for i, j in steps]
        texel = np.unique(np.concatenate(texel))
        row, column = np.divmod(texel[~good.ravel()[texel]], width)
    return image, count


_repair = repair  # load_envmap has an argument of that name


def load_envmap(path, width: int | None = None, repair: bool = False) -> tuple[np.ndarray, dict]:
    """Read a lat-long environment map, check it, and bring it to a working width.

    Parameters
    ----------
    path : path-like
        An image of 2:1.
    width : int, optional
        Working width in texels, even and at least 6; the height is half of it. Without, the file's own size.
    repair : bool
        Replace NaN and infinite texels instead of refusing them.

    Returns
    -------
    image : array (width / 2, width, 3) float32
        Linear radiance, finite and not negative.
    info : dict
        As of :func:`read` (``size`` is the file's), with ``health`` (:class:`Health` of the file's values)
        and ``repaired`` and ``clipped`` (numbers of texels).

    Raises
    ------
    InputError
        If the file cannot be read, is not 2:1, is smaller than 6 x 3, or holds texels that are not finite.
    ConfigError
        If ``width`` is odd or less than 6.
    """
    if width is not None and (width < 6 or width % 2 or width > MAX_SIDE):
        raise ConfigError(f"width of the environment map must be even, from 6 to {MAX_SIDE}, got {width}")
    image, info = read(path)
    name, warnings = info["path"], info["warnings"]
    rows, columns = image.shape[:2]
    if columns != 2 * rows:
        raise InputError(f"{name}: a lat-long map is 2:1, this is {columns} x {rows}; crop or resize it")
    if rows < latlong.MIN_HEIGHT:
        raise InputError(f"{name}: {columns} x {rows} texels are too few for a map; use at least 6 x 3")
    found = info["health"] = health(image)
    info["repaired"], info["clipped"] = 0, found.negative
    if found.nan or found.inf:
        row, column = min(p for p in (found.first_nan, found.first_inf) if p)
        bad = int(_any(~np.isfinite(image)).sum())
        where = f"{bad} texels are NaN or infinite, the first at row {row}, column {column}"
        if not repair:
            raise InputError(f"{name}: {where}; repair the map, or ask for repair")
        try:
            image, info["repaired"] = _repair(image)
        except InputError as e:
            raise InputError(f"{name}: {e}") from None
        warnings.append(f"{where}: replaced from their neighbours")
    if found.negative:
        row, column = found.first_negative
        warnings.append(
            f"{found.negative} texels are negative (down to {found.minimum:.3g}), the first at row {row}, "
            f"column {column}: set to 0"
        )
    image = np.maximum(image, 0)  # also turns -0.0 into 0
    if found.saturated:
        row, column = found.first_saturated
        warnings.append(
            f"{found.saturated} texels sit at 65504, the largest half, the first at row {row}, "
            f"column {column}: the light was cut when the file was saved"
        )
    if not image.any():
        warnings.append("the map is black: it lights nothing")
    if width is not None:
        if width > columns:
            warnings.append(f"enlarged from {columns} to {width} texels across: no detail is added")
        image = latlong.resize(image, width // 2, width)
    return image, info


# ----------------------------------------------------------------------------------------------------------
# Luminance and tonemaps


def luminance(image) -> np.ndarray:
    """Return Rec.709 luminance float64 ``(...)`` of radiance ``(..., 3)``: 0.2126 R + 0.7152 G + 0.0722 B."""
    image = np.asarray(image)
    r, g, b = (np.float64(w) for w in (0.2126, 0.7152, 0.0722))  # float64, so that 3e38 does not overflow
    return r * image[..., 0] + g * image[..., 1] + b * image[..., 2]


def srgb_to_linear(t) -> np.ndarray:
    """Undo the sRGB curve (IEC 61966-2-1) of display values in [0, 1]."""
    t = np.clip(t, 0, 1)
    return np.where(t <= 0.04045, t / 12.92, ((t + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(e) -> np.ndarray:
    """Apply the sRGB curve (IEC 61966-2-1) to linear values, cut to [0, 1]."""
    e = np.clip(e, 0, 1)
    return np.where(e <= 0.0031308, 12.92 * e, 1.055 * e ** (1 / 2.4) - 0.055)


LOG_SCALE = 100.0
"""The "log" tonemap is linear well below 1/100 and logarithmic above; it ends at a radiance of 100."""

TONEMAPS: dict[str, Callable] = {
    "gamma": lambda e: np.clip(e, 0, 1) ** (1 / 2.2),
    "srgb": linear_to_srgb,
    "log": lambda e: np.log1p(LOG_SCALE * np.clip(e, 0, LOG_SCALE)) / math.log1p(LOG_SCALE**2),
    "linear": lambda e: np.clip(e, 0, 1),
}
INVERSE_TONEMAPS: dict[str, Callable] = {
    "gamma": lambda t: np.clip(t, 0, 1) ** 2.2,
    "srgb": srgb_to_linear,
    "log": lambda t: np.expm1(np.clip(t, 0, 1) * math.log1p(LOG_SCALE**2)) / LOG_SCALE,
    "linear": lambda t: np.clip(t, 0, 1),
}


def tonemap(image, name: str = "gamma") -> np.ndarray:
    """Map linear radiance to display values in [0, 1], element by element; NaN stays NaN.

    - ``gamma``: clip(E, 0, 1)^(1/2.2)
    - ``srgb``: the sRGB curve of clip(E, 0, 1)
    - ``log``: log(1 + 100 E) / log(1 + 100^2) of clip(E, 0, 100), so that 1 maps to 0.50
    - ``linear``: clip(E, 0, 1)

    Raises
    ------
    ConfigError
        If there is no such tonemap.
    """
    return _named(TONEMAPS, name)(np.asarray(image))


def inverse_tonemap(image, name: str = "gamma") -> np.ndarray:
    """Map display values back to linear radiance; what :func:`tonemap` has cut does not come back."""
    return _named(INVERSE_TONEMAPS, name)(np.asarray(image))


def _named(table, name):
    if name not in table:
        raise ConfigError(f"unknown tonemap '{name}'; use one of {', '.join(table)}")
    return table[name]


# ----------------------------------------------------------------------------------------------------------
# Analytic sky


def sunsky(
    width: int,
    azimuth: float,
    elevation: float,
    turbidity: float = 3.0,
    *,
    ground_albedo: float = 0.2,
    sun_scale: float = 1.0,
    sky_scale: float = 1.0,
) -> np.ndarray:
    """Bake Mitsuba's ``sunsky`` emitter (Hosek and Wilkie 2012, 2013) into a lat-long map, +Y up.

    Sky texels are averages over stratified directions in the texel. The sun, 0.54 degrees across and
    smaller than most texels, is integrated by itself and its flux laid into the texels it covers, so that a
    rendering under the map receives all of it at any width (from the texels' centres: up to half a texel
    off). Below the horizon the plugin is black; here lies a ground that reflects ``ground_albedo *
    irradiance / pi``, as a black half would be degenerate in log space.

    Parameters
    ----------
    width : int
        Texels across, even, from 6 to 16384; the height is half of it.
    azimuth : float
        Degrees along the columns: the sun stands at column ``azimuth / 360 * width - 1/2``.
    elevation : float
        Degrees above the horizon, 0 to 90: the sun stands at row ``(90 - elevation) / 180 * (width / 2 -
        1)``.
    turbidity : float
        Haze, 1 (clear) to 10.
    ground_albedo : float
        Reflectance of the ground, 0 to 1; it lights the sky as well.
    sun_scale, sky_scale : float
        Factors on the radiance of either, at least 0.

    Returns
    -------
    array (width / 2, width, 3) float32
        Linear radiance in the plugin's units.

    Raises
    ------
    ConfigError
        If a parameter is out of its range.
    """
    if width < 6 or width % 2 or width > MAX_SIDE // 2:
        raise ConfigError(f"sunsky: width must be even, from 6 to {MAX_SIDE // 2}, got {width}")
    for key, value, low, high in (
        ("azimuth", azimuth, -1e6, 1e6),
        ("elevation", elevation, 0, 90),
        ("turbidity", turbidity, 1, 10),
        ("ground_albedo", ground_albedo, 0, 1),
        ("sun_scale", sun_scale, 0, 1e6),
        ("sky_scale", sky_scale, 0, 1e6),
    ):
        if not low <= value <= high:  # a NaN is not in any range either
            raise ConfigError(f"sunsky: {key} must be from {low:g} to {high:g}, got {value}")
    height = width // 2
    # The plugin is black for a sun in the horizon itself, to float32: one hundredth of a degree is above it.
    sun_direction = _on_sphere(math.radians(90 - max(elevation, 0.01)), math.radians(azimuth % 360.0))
    common = {"turbidity": turbidity, "albedo": ground_albedo, "sun_direction": _z_up(sun_direction)}
    sky = _sunsky_emitter(sun_scale=0.0, sky_scale=sky_scale, **common)
    sun = _sunsky_emitter(sun_scale=sun_scale, sky_scale=0.0, **common)

    disc = _disc(sun_direction, math.radians(SUN_APERTURE / 2), width)
    flux = sun(disc) * (2 * math.pi * (1 - math.cos(math.radians(SUN_APERTURE / 2))) / len(disc))
    irradiance = (flux * disc[:, 1:2]).sum(0) + _sky_irradiance(sky)
    image = _average(sky, height, width, ground_albedo * irradiance / math.pi)

    row, column = latlong.texel_position(disc, height, width)
    row, column = np.rint(row).astype(int), np.rint(column).astype(int) % width
    np.add.at(image, (row, column), flux / latlong.lookup_solid_angles(height, width)[row, None])
    return image.astype(np.float32)


SUN_APERTURE = 0.5358
"""Angle across the sun's disc in degrees, the plugin's default."""


def _on_sphere(theta, phi):
    """Return directions (..., 3) at a colatitude and at a map azimuth 2 pi u."""
    sin = np.sin(theta)
    return np.stack(np.broadcast_arrays(sin * np.sin(phi), np.cos(theta), -sin * np.cos(phi)), axis=-1)


def _z_up(d):
    """Turn directions (..., 3) from our frame, +Y up, to the plugin's, +Z up."""
    return np.stack([d[..., 0], -d[..., 2], d[..., 1]], axis=-1)


def _sunsky_emitter(sun_direction, **parameters):
    """Return a function from directions (N, 3), +Y up, to the plugin's radiance (N, 3) float64."""
    import drjit as dr
    import mitsuba as mi

    # A scene around it: the emitter needs one to know its bounds. Its texels are then evaluated like any
    # other.
    plugin = {"type": "sunsky", "sun_direction": sun_direction.tolist(), "sun_aperture": SUN_APERTURE}
    emitter = mi.load_dict({"type": "scene", "emitter": plugin | parameters}).environment()

    def radiance(d):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -mi.Vector3f(*_z_up(d).T.astype(np.float32))
        return np.array(emitter.eval(si), np.float64).T

    return radiance


def _disc(centre, radius, width):
    """Return directions (N, 3) spread evenly over a disc of the sky, as Vogel's spiral.

    Enough of them that the texels inside the disc of a wide map are evenly filled.
    """
    count = 16384 + 512 * int(math.pi * (radius / (2 * math.pi / width)) ** 2)
    i = np.arange(count) + 0.5
    # Even in solid angle: 1 - cos(angle) runs linearly; 2 sin^2(angle / 2) keeps its digits.
    angle = 2 * np.arcsin(np.sqrt(i / count) * math.sin(radius / 2))
    phi = i * (math.pi * (3 - math.sqrt(5)))
    side = np.cross(centre, [1.0, 0, 0] if abs(centre[0]) < 0.7 else [0, 0, 1.0])
    side /= np.linalg.norm(side)
    offset = np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * np.cross(centre, side)
    return np.cos(angle)[:, None] * centre + np.sin(angle)[:, None] * offset


def _sky_irradiance(sky):
    """Return the sky's horizontal irradiance (3,): pi times its mean over cosine-distributed directions."""
    i = (np.arange(256) + 0.5) / 256
    theta, phi = np.meshgrid(np.arcsin(np.sqrt(i)), 2 * np.pi * i, indexing="ij")
    return math.pi * sky(_on_sphere(theta, phi).reshape(-1, 3)).mean(0)


def _average(sky, height, width, ground):
    """Return the sky (H, W, 3) averaged over each texel, with the ground below the horizon, in float64."""
    n = max(2, min(8, 2048 // width))  # strata a side: the narrower the map, the more a texel holds
    edges = np.cos(np.pi * latlong.row_edges(height))
    part = (np.arange(n) + 0.5) / n
    phi = 2 * np.pi * (np.arange(width)[:, None] + part).ravel() / width
    image = np.empty((height, width, 3))
    chunk = max(1, (1 << 21) // (n * n * width))
    for top in range(0, height, chunk):
        rows = slice(top, min(top + chunk, height))
        low, high = edges[rows], edges[rows.start + 1 : rows.stop + 1]
        y = low[:, None] + (high - low)[:, None] * part  # even in y is even in solid angle
        d = _on_sphere(np.arccos(y).reshape(-1, 1), phi)
        value = sky(d.reshape(-1, 3)).reshape(d.shape)
        value = np.where(d[..., 1:2] > 0, value, ground)
        image[rows] = value.reshape(len(low), n, width, n, 3).mean((1, 3))
    return image
