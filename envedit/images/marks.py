"""What a file says of its pixels: honoured or reported, the same for maps and painted pictures.

Decoders put what they find into ``info["marks"]``:

- ``orientation``: EXIF, 1 to 8 (PNG, JPEG)
- ``profile``: an ICC profile, or its name (PNG, JPEG)
- ``gamma``: codes are light to this power (PNG, ``gAMA``)
- ``chromaticities``: 8 numbers as OpenEXR orders them (OpenEXR; ``PRIMARIES`` of Radiance)
- ``spaces``: names of a colour space, the first counts most (OpenEXR)
- ``cube``: the file is marked as a cube map (OpenEXR)
- ``EXPOSURE``, ``COLORCORR``, ``GAMMA``: text (Radiance)
"""

from __future__ import annotations

import numpy as np

from envedit.core import primaries
from envedit.core.color import linear_to_srgb, srgb_to_linear
from envedit.core.errors import counted
from envedit.core.types import Info
from envedit.images.headers import shown

AUTO = "auto"
"""The colour space that the file says."""
_SRGB_GAMMA = 1 / 2.2
_GAMMA_TOLERANCE = 0.02  # programs write 0.45455 for sRGB, rounded to 0.45 by some


def honour(pixels: np.ndarray, info: Info, space: str = AUTO) -> np.ndarray:
    """Return the pixels (H, W, C) of a file upright, codes under the sRGB curve; note the rest in ``info``.

    Pixels are float32, or uint8 or uint16 codes. Of the decoder's ``info`` ``marks`` is taken out,
    ``chromaticities`` set and ``warnings`` extended. ``space`` is a name of :data:`.primaries.SPACES` that
    goes before what the file says, or "auto". InputError if the file's colour space is not known.
    """
    marks = info.pop("marks")
    warnings = info["warnings"]

    # ---- where the pixels belong
    if marks.get("cube"):
        warnings.append("it is marked as a cube map: read as if it were lat-long")
    orientation = marks.get("orientation", 1)
    if 2 <= orientation <= 8:
        pixels = _upright(pixels, orientation)
        warnings.append(f"turned upright, as its EXIF orientation {orientation} says")

    # ---- the curve of codes
    profile = marks.get("profile", b"sRGB").replace(b"\0", b"")  # its name may be UTF-16
    gamma = marks.get("gamma", 0)
    if b"sRGB" not in profile or b"inear" in profile:
        warnings.append(
            "its colour profile is not sRGB, but values are used as if it were: light and hues may be off; "
            "convert it to sRGB, or save it as linear OpenEXR"
        )
    elif "profile" not in marks and gamma > 0 and abs(gamma - _SRGB_GAMMA) > _GAMMA_TOLERANCE:
        pixels = _recoded(pixels, gamma)
        warnings.append(f"its codes are light to the power {gamma:g} (gAMA): converted to sRGB")
    for key in ("EXPOSURE", "COLORCORR", "GAMMA"):
        if key in marks:
            value = shown(marks[key])
            warnings.append(f"{key}={value} in its header is not undone: values are as stored")

    info["chromaticities"] = _chromaticities(marks, info, space)
    return pixels


def light(codes: np.ndarray, info: Info) -> np.ndarray:
    """Return the linear radiance (H, W, 3) float32 of sRGB codes (H, W, C); what is transparent is dark."""
    top = np.iinfo(codes.dtype).max
    warnings = info["warnings"]
    warnings.append(f"{info['format'].upper()} of {info['bits']} bits is not HDR: light above 1 is missing")
    colours = 3 if codes.shape[2] >= 3 else 1
    values = srgb_to_linear(np.arange(top + 1) / top).astype(np.float32)
    radiance = values[np.broadcast_to(codes[..., :colours], (*codes.shape[:2], 3))]
    if codes.shape[2] > colours and (codes[..., -1] < top).any():
        alpha = codes[..., -1:]
        texels_are = counted((alpha < top).sum(), "texel is", "texels are")
        warnings.append(f"{texels_are} transparent: light is multiplied by opacity")
        radiance *= (alpha / top).astype(np.float32)
    return radiance


def in_rec709(pixels: np.ndarray, info: Info) -> np.ndarray:
    """Convert the colours of (H, W, C) to Rec. 709, where the file has others."""
    if info["chromaticities"] is None or pixels.shape[2] < 3:
        return pixels
    info["warnings"].append(f"converted from {primaries.name_of(info['chromaticities'])} to Rec. 709")
    matrix = primaries.to_rec709(info["chromaticities"])
    return np.concatenate([primaries.converted(pixels[..., :3], matrix), pixels[..., 3:]], axis=2)


def _upright(pixels, orientation):
    """Undo an EXIF orientation: from 5 on rows are columns, then either axis may run backwards."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _recoded(codes, gamma):
    """Return codes of light to a power as 16-bit sRGB codes; alpha has no curve."""
    top = np.iinfo(codes.dtype).max
    values = linear_to_srgb((np.arange(top + 1) / top) ** (1 / gamma))
    recoded = np.rint(65535 * values).astype(np.uint16)[codes]
    if codes.shape[2] in (2, 4):
        recoded[..., -1] = codes[..., -1] * np.uint16(65535 // top)
    return recoded


def _chromaticities(marks, info, space):
    """Return the chromaticities of a file's colours; None for Rec. 709."""
    if space != AUTO:
        return primaries.known(primaries.SPACES[space], space)
    if "chromaticities" in marks:
        return primaries.known(marks["chromaticities"], info["path"])
    spaces = marks.get("spaces", [])
    for name in spaces:
        if not primaries.says_nothing(name):
            return primaries.named(name, info["path"])
    if spaces:
        info["warnings"].append(
            f"its colour space '{shown(spaces[0])}' says nothing: read as linear Rec. 709; "
            "of the map to edit, [input] colour_space can say what it is"
        )
    return None
