"""HDR images: read, check, write.

An image is a float32 array ``(H, W, 3)`` of linear radiance with Rec.709 primaries. Problems that a user can
mend raise ``InputError`` with the file's name; what is merely odd goes to ``info["warnings"]``, a list of
sentences.
"""

from __future__ import annotations

import os
import zlib

import numpy as np

from envedit.core import latlong, primaries, radiance
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError, InputError, texels_are
from envedit.core.types import ArrayLike, FilePath, Info
from envedit.images import exr, ldr, marks, rgbe, tiff
from envedit.images.headers import damaged, finite, head_of, shown

FORMATS = (
    ("exr", b"\x76\x2f\x31\x01", exr.read),
    ("hdr", b"#?", rgbe.read),
    ("png", b"\x89PNG\r\n\x1a\n", ldr.read),
    ("jpeg", b"\xff\xd8\xff", ldr.read),
    ("tiff", b"II*\0", tiff.read),
    ("tiff", b"MM\0*", tiff.read),
)
"""Kind, first bytes and decoder of every format."""
ARRAY = "array"
"""What a map that came as an array is called, where others have the name of their file."""
DEFAULT = "edited"
"""The layer of a file of several that is plain R, G, B: what a program shows that knows of no layers."""


# ---- Reading -----------------------------------------------------------------------------------------------


def read(path: FilePath) -> tuple[np.ndarray, dict]:
    """Read an image file as linear radiance.

    The content decides the format, not the name: OpenEXR (half, float or uint; any channel order; of layers
    and parts that with the picture; luminance-only files become grey), Radiance HDR, and PNG, JPEG or TIFF,
    whose sRGB curve is undone, but of a TIFF of floats. Marks of the file are honoured (:mod:`.marks`); what
    is transparent in a PNG or TIFF is dark. Values are as stored: they may be negative or not finite.

    Returns the image (H, W, 3) float32, and of the file: ``path`` (str), ``format`` ("exr", "hdr", "png",
    "jpeg" or "tiff"), ``size`` (width, height), ``hdr`` (False for 8- and 16-bit pictures, which have
    ``bits``), ``metadata`` (dict of str, int and float), ``chromaticities`` (of the file's colours; None:
    Rec. 709) and ``warnings`` (list of str). Of OpenEXR also ``half``: whether its values are.

    InputError if the file is missing, empty, truncated, of another kind, or declares more than 32768 texels
    on a side or 2^27 in all; MachineError if it is a TIFF and tifffile is not installed.
    """
    image, info = _decode(path, stored=False)
    return marks.in_rec709(image, info), info


def read_stored(path: FilePath) -> tuple[np.ndarray, dict]:
    """Read an image file as it was painted: with alpha, with its display curve; errors as of :func:`read`.

    Returns pixels (H, W, C), and ``info`` as of :func:`read`. They are float32 linear radiance for OpenEXR
    and Radiance, and uint8 or uint16 codes of display values for PNG, JPEG and TIFF. C is 1 (grey), 2 (grey
    and alpha), 3 (RGB) or 4 (RGB and alpha). Alpha is premultiplied in OpenEXR and straight in PNG, by
    convention. ``metadata`` holds a PNG's texts. A JPEG also has ``quality``, as libjpeg counts it, estimated
    from its first table.
    """
    pixels, info = _decode(path, stored=True)
    return marks.in_rec709(pixels, info), info


def _decode(path, stored, space=marks.AUTO):
    try:
        name = os.fsdecode(path)
    except TypeError:
        raise InputError(f"image: got {type(path).__name__}, expected the path of a file") from None
    head = head_of(name)
    info: Info = {"path": name, "format": None, "size": None, "hdr": True, "metadata": {}, "warnings": []}
    info["marks"] = {}
    for kind, magic, reader in FORMATS:
        if head.startswith(magic):
            info["format"] = kind
            try:
                image = marks.honour(reader(name, head, info, stored), info, space)
                if not stored and not info["hdr"]:
                    image = marks.light(image, info)
            except MemoryError:
                raise InputError(f"{name}: not enough memory to read this image; make it smaller") from None
            except EnveditError:
                raise
            except OSError as e:
                raise InputError(f"{name}: cannot be read ({e.strerror or e})") from None
            except (LookupError, TypeError, ValueError, RuntimeError) as e:
                # Damage reaches header fields as well: names that are no text, windows of another type.
                raise damaged(name, f"{type(e).__name__}: {e}") from None
            info["size"] = (image.shape[1], image.shape[0])
            return image, info
    raise InputError(f"{name}: not an image envedit can read; use OpenEXR or Radiance (or PNG, JPEG, TIFF)")


def is_panorama(path: FilePath) -> bool:
    """Say whether an image is 2:1, to a texel, as a lat-long map is; InputError if it cannot be read."""
    _, info = read_stored(path)
    width, height = info["size"]
    return abs(width - 2 * height) <= 1


def load_envmap(
    path: FilePath | np.ndarray,
    width: int | None = None,
    repair: bool = False,
    convert: bool = True,
    name: str = ARRAY,
    space: str = marks.AUTO,
) -> tuple[np.ndarray, dict]:
    """Read a lat-long environment map, check it, and bring it to a working width.

    ``path`` is an image of 2:1, or its linear radiance (H, 2 H, 3), which errors call ``name``; one that a
    texel's rounding made odd is resampled. ``width`` is the working width in texels, even and at least 6, the
    height half of it; None: the file's own size. ``repair`` mends NaN and infinite texels
    (:func:`.radiance.repair`) instead of refusing them. Colours are converted to Rec. 709, unless ``convert``
    is False: then they are those of the file, ``info["chromaticities"]``. ``space`` is the colour space of
    the values, a name of :data:`.primaries.SPACES`; "auto": as the file says.

    Returns linear radiance (width / 2, width, 3) float32, finite and not negative, and ``info`` as of
    :func:`read` (``size`` is the file's), with ``repaired`` and ``clipped``, numbers of texels. InputError if
    the file cannot be read, is not 2:1 to a texel, is smaller than 6 x 3, or holds texels that are not
    finite.
    """
    # ---- Read
    if isinstance(path, np.ndarray):
        image, info = _of_array(path, name, space)
    else:
        image, info = _decode(path, stored=False, space=space)
    if convert:
        image = marks.in_rec709(image, info)

    # ---- Check and mend
    _check_shape(image, info)
    stored = image
    image = _repaired(image, info, repair)
    image = np.maximum(image, 0)  # also turns -0.0 into 0
    _note_oddities(stored, image, info)

    # ---- Bring to the width asked for
    columns = info["size"][0]
    if width is not None and width > columns:
        info["warnings"].append(f"enlarged from {columns} to {width} texels across: no detail is added")
    across = width or columns
    if image.shape[1] != across:
        image = latlong.resize(image, across // 2, across)
    return image, info


def _check_shape(image, info):
    """Refuse what is no lat-long map; of one that a texel's rounding made odd, correct ``info["size"]``."""
    name = info["path"]
    rows, columns = image.shape[:2]
    if abs(columns - 2 * rows) > 1:
        remedy = "; crop it, or convert it to lat-long"
        if "data_size" in info:
            width, height = info["data_size"]
            remedy = f", its display window, and its data window {width} x {height}; save the two alike, 2:1"
        raise InputError(f"{name}: a lat-long map is 2:1, this is {columns} x {rows}{remedy}")
    if rows < latlong.MIN_HEIGHT:
        raise InputError(f"{name}: {columns} x {rows} texels are too few for a map; use at least 6 x 3")
    if columns != 2 * rows:
        info["warnings"].append(f"{columns} x {rows} texels are not 2:1: resampled to {2 * rows} x {rows}")
        info["size"] = 2 * rows, rows


def _repaired(image, info, repair):
    """Mend texels that are not finite, or refuse them."""
    name = info["path"]
    bad = radiance.any_channel(~np.isfinite(image))
    info["repaired"] = int(bad.sum())
    if not bad.any():
        return image
    if not repair:
        raise InputError(
            f"{name}: {texels_are(bad, 'NaN or infinite')}; repair the map, or set input.repair = true "
            "(of commands on maps: --repair)"
        )
    try:
        image, overflowed, replaced = radiance.repair(image)
    except InputError as e:
        raise InputError(f"{name}: {e}") from None
    if overflowed.any():
        brightest = f"taken for the brightest light, {image[overflowed].max():g}"
        info["warnings"].append(f"{texels_are(overflowed, 'infinite')}: {brightest}")
    if replaced.any():
        info["warnings"].append(f"{texels_are(replaced, 'NaN or -Inf')}: replaced from their neighbours")
    return image


def _note_oddities(stored, image, info):
    """Note what is odd in a map, as it was ``stored`` and as it is: warnings."""
    warnings = info["warnings"]
    finite = np.isfinite(stored)
    negative = radiance.any_channel(stored < 0) & ~radiance.any_channel(~finite)
    info["clipped"] = int(negative.sum())
    if negative.any():
        what = f"negative (down to {stored[finite].min():.3g})"
        warnings.append(f"{texels_are(negative, what)}: set to 0")
    saturated = radiance.any_channel(stored == radiance.HALF_MAX)
    if saturated.any():
        what = texels_are(saturated, "at 65504, the largest half")
        warnings.append(f"{what}: the light was cut when the file was saved")
    if unread := info.get("unread"):
        names = ", ".join(shown(channel, 30) for channel in unread[:6]) + (", ..." if len(unread) > 6 else "")
        warnings.append(f"channels of the map beside its colours are not read: {names}")
    if not image.any():
        warnings.append("the map is black: it lights nothing")


def _of_array(values: np.ndarray, name: str, space: str) -> tuple[np.ndarray, dict]:
    """Take a map from an array as :func:`read` takes one from a file."""
    if values.ndim != 3 or values.shape[2] != 3:
        what = f"shape {values.shape} of {values.dtype}"
        raise InputError(f"{name}: got an array of {what}, expected (H, 2 H, 3) numbers")
    size = values.shape[1], values.shape[0]
    info: Info = {"path": name, "format": None, "size": size, "hdr": True, "metadata": {}, "warnings": []}
    info["marks"] = {}
    return marks.honour(values.astype(np.float32), info, space), info


# ---- Writing -----------------------------------------------------------------------------------------------


def write_exr(
    path: FilePath,
    image: ArrayLike,
    metadata: dict | None = None,
    panorama: bool = True,
    alpha: ArrayLike | None = None,
    half: bool = False,
    chromaticities: primaries.Chromaticities | None = None,
) -> None:
    """Write an image as an OpenEXR file, of float32 unless asked for half, whole or not at all.

    ``image`` (H, W, 3) is linear radiance, finite in float32; as half, at most :data:`.radiance.HALF_MAX`.
    Its colours have ``chromaticities``, and are written as they are; None: Rec. 709. ``metadata`` are
    attributes to add (str, int or float; anything else as its text), such as ``{"source": "sky.hdr"}``. A
    ``panorama`` is marked as lat-long, which some viewers show as a sphere. ``alpha`` (H, W) is the share of
    each pixel that is covered; the image is premultiplied by it.

    NumericalError names the first texel with a value that is not finite in the file; InputError if the file
    cannot be written.
    """
    name = os.fsdecode(path)
    pixels = finite(name, image)
    if half:
        with np.errstate(over="ignore"):  # refused as an infinity
            pixels = finite(name, pixels.astype(np.float16)).astype(np.float16)
    planes = {channel: pixels[..., i] for i, channel in enumerate("RGB")}
    if alpha is not None:
        planes["A"] = np.asarray(alpha, np.float32)
    exr.write(name, planes, chromaticities, panorama, metadata)


def write_layers(
    path: FilePath, layers: dict[str, np.ndarray], chromaticities: primaries.Chromaticities | None = None
) -> None:
    """Write layers as one float32 OpenEXR file, whole or not at all.

    The layer ``edited``, or else the first, becomes the channels ``R``, ``G``, ``B``; any other NAME becomes
    ``NAME.R``, ``NAME.G``, ``NAME.B``, and one of two dimensions ``NAME.Y``. One part, marked as lat-long
    with ``chromaticities``; None: Rec. 709.

    Layers (H, W, 3) or (H, W) are linear radiance, or anything else with a value a texel, all of one size;
    the one that becomes R, G, B has three channels. NumericalError for a value that is not finite in float32
    names the layer and the first texel; InputError if the file cannot be written.
    """
    name = os.fsdecode(path)
    default = DEFAULT if DEFAULT in layers else next(iter(layers))
    planes: dict[str, np.ndarray] = {}
    for layer, values in layers.items():
        values = finite(name, values, layer)
        prefix = "" if layer == default else f"{layer}."
        if values.ndim == 2:
            planes[f"{prefix}Y"] = values
        else:
            planes |= {prefix + channel: values[..., i] for i, channel in enumerate("RGB")}
    exr.write(name, planes, chromaticities)


def write_hdr(
    path: FilePath, image: ArrayLike, chromaticities: primaries.Chromaticities | None = None
) -> None:
    """Write (H, W, 3) linear radiance, finite and not negative, as a Radiance file (:func:`.rgbe.encode`).

    Few programs read ``chromaticities`` from such a file; None: Rec. 709. Errors as of :func:`write_exr`.
    """
    name = os.fsdecode(path)
    write_atomically(name, rgbe.encode(finite(name, image), chromaticities))


def write_png(path: FilePath, image: ArrayLike, bits: int = 8, metadata: dict | None = None) -> None:
    """Write a picture in [0, 1] as a PNG of 8 or 16 bits a channel; errors as of :func:`write_exr`.

    ``image`` is (H, W, 3) or (H, W), display values, already tonemapped; values outside [0, 1] are cut.
    ``metadata`` are texts to add, as ``tEXt`` chunks.
    """
    name = os.fsdecode(path)
    image = finite(name, image)
    image = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image
    codes = np.rint(np.clip(image, 0, 1) * np.float32(2**bits - 1))
    write_atomically(name, png(codes.astype({8: np.uint8, 16: np.uint16}[bits]), metadata))


def png(codes: np.ndarray, metadata: dict | None = None) -> bytes:
    """Encode (H, W, 3) uint8 or uint16, already tonemapped, as PNG; ``metadata`` as of :func:`write_png`.

    In memory: Mitsuba does not report that the last bytes of a file did not fit on the disk.
    """
    import mitsuba as mi

    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(codes)).write(stream, mi.Bitmap.FileFormat.PNG)
    data = stream.raw_buffer()
    # By hand: Mitsuba puts its own texts in quotation marks.
    texts = b"".join(_text_chunk(*item) for item in (metadata or {}).items())
    return data[:_PNG_HEADER] + texts + data[_PNG_HEADER:]


_PNG_HEADER = 8 + 25  # magic and IHDR


def _text_chunk(key, value):
    """Return a PNG chunk ``tEXt``, whose characters are Latin-1; others become question marks."""
    body = b"tEXt" + f"{key}\0{value}".encode("latin-1", "replace")
    return (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
