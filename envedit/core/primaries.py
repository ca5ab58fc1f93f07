"""Colour spaces of linear RGB: primaries and white as chromaticities, and conversion to Rec. 709."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from envedit.core.errors import InputError
from envedit.core.rows import bands

Chromaticities = tuple[float, ...]
"""x and y of red, green, blue and white (CIE 1931), as the OpenEXR attribute orders them."""

REC709: Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ACES_AP0: Chromaticities = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
ACES_AP1: Chromaticities = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
REC2020: Chromaticities = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
P3_D65: Chromaticities = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
XYZ: Chromaticities = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
"""CIE XYZ itself: its white is where the axes are scaled alike, not a light that the eye has adapted to."""
SPACES = {
    "Rec. 709": REC709, "ACES2065-1": ACES_AP0, "ACEScg": ACES_AP1, "Rec. 2020": REC2020, "P3-D65": P3_D65,
    "CIE XYZ": XYZ,
}  # fmt: skip
"""Chromaticities by name (ITU-R BT.709 and BT.2020, SMPTE ST 2065-1, Academy S-2014-004, SMPTE EG 432-1)."""
NAMES = {
    "lin_rec709": REC709, "lin_rec709_scene": REC709, "lin_srgb": REC709, "linear": REC709,
    "scene_linear": REC709, "linear rec.709 (srgb)": REC709,
    "utility - linear - srgb": REC709, "utility - linear - rec.709": REC709,
    "acescg": ACES_AP1, "lin_ap1": ACES_AP1, "lin_ap1_scene": ACES_AP1, "aces - acescg": ACES_AP1,
    "aces2065-1": ACES_AP0, "lin_ap0": ACES_AP0, "lin_ap0_scene": ACES_AP0, "aces - aces2065-1": ACES_AP0,
    "lin_rec2020": REC2020, "lin_rec2020_scene": REC2020, "linear rec.2020": REC2020,
    "lin_p3d65": P3_D65, "lin_p3d65_scene": P3_D65, "linear p3-d65": P3_D65,
    "utility - linear - rec.2020": REC2020, "utility - linear - p3-d65": P3_D65,
    "lin_ciexyzd65_scene": XYZ, "cie xyz-d65 - scene-referred": XYZ,
}  # fmt: skip
"""Chromaticities by the names that programs write into a file, in small letters."""
_SAYING_NOTHING = {"unknown", "raw", "data", "none", "unspecified", "default", "non-color", "utility - raw"}
SAME = 2e-3
"""Chromaticities that differ by no more are the same: programs write few digits."""
_FLAT = 2e-6  # twice the area of a triangle of primaries that counts as a line
_BRADFORD = np.array(  # Lam 1985, as of ICC.1:2010, Annex E
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def known(chromaticities: Iterable[float], where: str) -> Chromaticities | None:
    """Check chromaticities of a file; None where they are those of Rec. 709.

    InputError if they are no primaries: not finite, or on a line.
    """
    values = tuple(float(v) for v in chromaticities)
    if len(values) == 8 and np.isfinite(values).all() and abs(values[7]) > 1e-6:
        if np.allclose(values, REC709, atol=SAME):
            return None
        columns = _xyz(values)
        with np.errstate(all="ignore"):
            if abs(np.linalg.det(columns[:, :3])) > _FLAT:
                share = np.linalg.solve(columns[:, :3], columns[:, 3])
                if np.isfinite(share).all() and (share > 0).all():
                    return values
    shown = ", ".join(f"{v:.4g}" for v in values[:8])
    raise InputError(f"{where}: its chromaticities ({shown}) are no primaries: save it as linear Rec. 709")


def says_nothing(name: str) -> bool:
    """Return whether a name stands where a program knew no colour space."""
    return name.strip().lower() in _SAYING_NOTHING


def named(name: str, where: str) -> Chromaticities | None:
    """Return what a colour space is that a file names; None for Rec. 709, InputError for an unknown name."""
    chromaticities = NAMES.get(name.strip().lower())
    if chromaticities is None:
        shown = name[:60] if name.isprintable() else repr(name[:60])
        raise InputError(
            f"{where}: colour space '{shown}' is not known: save it as linear Rec. 709 or ACEScg, "
            "or name that of the map to edit with [input] colour_space"
        )
    return None if chromaticities == REC709 else chromaticities


def name_of(chromaticities: Chromaticities | None) -> str:
    """Name a colour space, or give its chromaticities."""
    if chromaticities is None:
        return "Rec. 709"
    same = [name for name, values in SPACES.items() if np.allclose(values, chromaticities, atol=SAME)]
    return same[0] if same else "primaries " + ", ".join(f"{v:.4g}" for v in chromaticities)


def rgb_to_xyz(chromaticities: Chromaticities) -> np.ndarray:
    """Return the matrix (3, 3) from linear RGB to XYZ in which white has Y = 1 (SMPTE RP 177)."""
    columns = _xyz(chromaticities)
    white = columns[:, 3] / columns[1, 3]
    return columns[:, :3] * np.linalg.solve(columns[:, :3], white)


def to_rec709(chromaticities: Chromaticities) -> np.ndarray:
    """Return the matrix (3, 3) from linear RGB to that of Rec. 709.

    White stays white (Bradford), but for :data:`XYZ`, whose values are those of CIE 1931 as they are.
    """
    if np.allclose(chromaticities, XYZ, atol=SAME):
        return np.linalg.inv(rgb_to_xyz(REC709))
    whites = [_xyz(c)[:, 3] / c[7] for c in (chromaticities, REC709)]
    before, after = (_BRADFORD @ white for white in whites)
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(after / before) @ _BRADFORD
    return np.linalg.inv(rgb_to_xyz(REC709)) @ adapted @ rgb_to_xyz(chromaticities)


def converted(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Multiply the colours of an image (H, W, 3) by a matrix; float32, infinite where it is too large."""
    result = np.empty(image.shape, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for band in bands(len(image)):  # a large map is not copied as float64
            result[band] = image[band].astype(np.float64) @ matrix.T
    return result


def _xyz(chromaticities):
    """Return x, y, z of red, green, blue and white as columns."""
    x, y = np.reshape(chromaticities, (4, 2)).T.astype(np.float64)
    return np.stack([x, y, 1 - x - y])
