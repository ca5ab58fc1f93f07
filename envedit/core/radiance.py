"""What is wrong with an image: texels that are not finite or negative; named, mended, refused."""

from __future__ import annotations

import math

import numpy as np

from envedit.core.errors import InputError, counted, texels_are
from envedit.core.types import ArrayLike

HALF_MAX = 65504.0
"""The largest half: where many programs cut the sun."""
BRIGHTEST = 2.0**100
"""Radiance, 1.27e30, up to which logarithms, fluxes and sums of a map stay within single precision."""


def any_channel(mask: np.ndarray) -> np.ndarray:
    """Return where any channel of (H, W, 3) is set; numpy's own ``any(2)`` takes five times as long."""
    return mask[..., 0] | mask[..., 1] | mask[..., 2]


def unmasked(values: ArrayLike, what: str) -> np.ndarray:
    """Return values as an array, of dtype object where they are none, such as rows of different lengths.

    InputError, which begins with ``what``, if something is masked: the mask would not be read.
    """
    if masked := int(np.count_nonzero(np.ma.getmask(values))):
        values_are = counted(masked, "value is", "values are")
        raise InputError(f"{what}: {values_are} masked, and masks are not read: fill them (ma.filled)")
    try:
        return np.asarray(values)
    except (TypeError, ValueError):
        return np.asarray(None)


def require_radiance(image: ArrayLike, what: str, first_row: int = 0, brightest: float = math.inf) -> None:
    """Refuse an image that holds anything but radiance: finite, from 0 to ``brightest``, not masked.

    ``image`` (H, W, 3) is linear radiance, and ``what`` the message calls it. ``first_row`` is the row of its
    map at which the image begins: the message gives rows of the map. InputError with the number of texels of
    the first kind found, the first of them, and what to do.
    """
    image = unmasked(image, what)
    for bad, how, cure in (
        (~np.isfinite(image), "not finite", "repair the map"),
        (image < 0, "negative", "set them to 0"),
        (image > brightest, f"brighter than {brightest:.3g}", "scale the map down"),
    ):
        if bad.any():
            raise InputError(f"{what}: {texels_are(bad, how, first_row)}: {cure}")


def repair(image: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Replace infinite radiance by the brightest, and every other non-finite texel by its neighbours.

    A sun that the program before could not hold has overflowed to +Inf: such channels become the largest
    finite value of the image, or :data:`HALF_MAX` if that is more. A texel with NaN or -Inf in a channel
    becomes the mean of its eight neighbours, columns periodic, as its other channels are no more to be
    trusted; holes are filled from their rim inwards.

    Returns the image (H, W, 3) float32, the same where it was finite; and bool (H, W), which texels were
    infinite, and which were replaced by their neighbours. InputError if no texel is finite.
    """
    # ---- Infinities: the brightest of the image
    with np.errstate(over="ignore"):
        image = np.array(image, np.float32)
    height, width = image.shape[:2]
    finite = np.isfinite(image)
    if not (~any_channel(~finite)).any():
        count = height * width
        raise InputError(f"all {count} texels of the image are NaN or infinite: nothing to repair from")
    replaced = any_channel(np.isnan(image) | np.isneginf(image))
    overflowed = any_channel(np.isposinf(image)) & ~replaced
    image[np.isposinf(image)] = max(HALF_MAX, float(image[finite].max()))

    # ---- The rest from the rim inwards: means of the neighbours that are known
    good = ~replaced
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
        beside = [np.clip(row + i, 0, height - 1) * width + (column + j) % width for i, j in steps]
        texel = np.unique(np.concatenate(beside))
        row, column = np.divmod(texel[~good.ravel()[texel]], width)
    return image, overflowed, replaced
