"""TIFF files: the first picture, decoded by tifffile; codes of 8 or 16 bits, or linear floats."""

from __future__ import annotations

import numpy as np

from envedit.core.errors import InputError, MachineError
from envedit.core.extras import required
from envedit.core.types import Info
from envedit.images.headers import check_declared, damaged

HOW = "run pip install '.[tiff]' in the checkout, or save a PNG of 16 bits"
ORIENTATION, PROFILE = 274, 34675
"""Numbers of tags."""
PREMULTIPLIED, STRAIGHT = 1, 2
"""Kinds of alpha."""


def read(name: str, head: bytes, info: Info, stored: bool) -> np.ndarray:
    """Decode a file; arguments as in :mod:`.headers`. Further channels than alpha are left out."""
    tifffile = required("tifffile", "tiff", f"{name}: TIFF")
    with tifffile.TiffFile(name) as file:
        page = file.pages.first
        check_declared(name, page.imagewidth, page.imagelength)
        kind = tifffile.PHOTOMETRIC(page.photometric).name
        colours = {"RGB": 3, "MINISBLACK": 1}.get(kind)
        if colours is None or page.dtype not in (np.uint8, np.uint16, np.float16, np.float32):
            what = f"{kind} of {page.dtype}"
            raise InputError(f"{name}: holds {what}, expected grey or RGB of 8 or 16 bits, or floats; {HOW}")
        try:
            pixels = page.asarray()
        except (KeyError, ValueError) as error:
            if "imagecodecs" in str(error):
                raise MachineError(f"{name}: {error.args[0]}: {HOW}") from None
            raise damaged(name, error) from None
        info["hdr"] = page.dtype.kind == "f"
        for mark, tag in (("orientation", ORIENTATION), ("profile", PROFILE)):
            if tag in page.tags and not (info["hdr"] and tag == PROFILE):  # floats are linear
                info["marks"][mark] = page.tags[tag].value
        pixels = np.moveaxis(pixels, 0, 2) if page.axes == "SYX" else pixels.reshape(*page.shape[:2], -1)
        has_alpha = tuple(page.extrasamples[:1]) == ((PREMULTIPLIED if info["hdr"] else STRAIGHT),)
    pixels = pixels[..., : colours + has_alpha]
    if not info["hdr"]:
        info["bits"] = 8 * pixels.dtype.itemsize
        return np.ascontiguousarray(pixels)
    light = pixels if stored else np.broadcast_to(pixels[..., :colours], (*pixels.shape[:2], 3))
    return light.astype(np.float32)
