"""What is wrong with an image: texels not finite, negative or cut; counted, named, mended, refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.core.color import luminance
from envedit.core.errors import InputError
from envedit.core.types import ArrayLike

HALF_MAX = 65504.0
"""The largest half: where many programs cut the sun."""
BRIGHTEST = 2.0**100
"""Radiance, 1.27e30, up to which logarithms, fluxes and sums of a map stay within single precision."""


@dataclass(frozen=True)
class Health:
    """What is in an image: texels of each kind, the first (row, column) of them, and the range of luminance.

    A texel counts if any of its channels does, as negative only if all of them are finite. ``minimum`` and
    ``maximum`` are over finite channel values; ``median`` is of finite luminance; ``dynamic_range`` is the
    largest over the smallest positive luminance, 0.0 without any. Everything is finite, an image without
    finite values has 0.0.
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
        unusual = [f"{n} {what} (first at row {p[0]}, column {p[1]})" for n, what, p in kinds if p]
        stops = math.log2(self.dynamic_range) if self.dynamic_range > 0 else 0.0
        spread = f"{self.minimum:.4g} to {self.maximum:.4g}, median {self.median:.4g}, {stops:.1f} stops"
        return f"{self.texels} texels, {spread}; {', '.join(unusual) or 'nothing unusual'}"


def health(image: ArrayLike) -> Health:
    """Count the NaN, infinite, negative and half-saturated texels of an image; see :class:`Health`."""
    image = np.asarray(image)
    finite = np.isfinite(image)
    masks = {
        "nan": any_channel(np.isnan(image)),
        "inf": any_channel(np.isinf(image)),
        "negative": any_channel(image < 0),
        "saturated": any_channel(image == HALF_MAX),
    }
    clean = bool(finite.all())  # then nothing has to be copied
    if not clean:
        masks["negative"] &= ~any_channel(~finite)
    counts: dict[str, Any] = {}
    for kind, mask in masks.items():
        counts[kind] = int(mask.sum())
        first = np.unravel_index(mask.argmax(), mask.shape)
        counts[f"first_{kind}"] = (int(first[0]), int(first[1])) if counts[kind] else None
    values = image if clean else image[finite]
    y = luminance(image if clean else image[~any_channel(~finite)])
    positive = y[y > 0]
    return Health(
        texels=image.shape[0] * image.shape[1],
        minimum=float(values.min()) if values.size else 0.0,
        maximum=float(values.max()) if values.size else 0.0,
        median=float(np.median(y)) if y.size else 0.0,
        dynamic_range=float(positive.max() / positive.min()) if positive.size else 0.0,
        **counts,
    )


def any_channel(mask: np.ndarray) -> np.ndarray:
    """Return where any channel of (H, W, 3) is set; numpy's own ``any(2)`` takes five times as long."""
    return mask[..., 0] | mask[..., 1] | mask[..., 2]


def require_unmasked(values: ArrayLike, what: str) -> None:
    """Refuse a masked array of which something is masked: its mask would not be read.

    Raises
    ------
    InputError
        With the number of values that are masked, and what to do.
    """
    if masked := int(np.count_nonzero(np.ma.getmask(values))):
        raise InputError(f"{what}: {masked} values are masked, and masks are not read: fill them (ma.filled)")


def require_radiance(image: ArrayLike, what: str, first_row: int = 0, brightest: float = math.inf) -> None:
    """Refuse an image that holds anything but radiance: finite, from 0 to ``brightest``, not masked.

    Parameters
    ----------
    image : array (H, W, 3)
        Linear radiance.
    what : str
        What the message calls it.
    first_row : int
        Row of its map at which the image begins; the message gives rows of the map.
    brightest : float
        The largest value that may be.

    Raises
    ------
    InputError
        With the number of texels of the first kind found, the first of them, and what to do.
    """
    require_unmasked(image, what)
    image = np.asarray(image)
    for bad, how, cure in (
        (~np.isfinite(image), "not finite", "repair the map"),
        (image < 0, "negative", "set them to 0"),
        (image > brightest, f"brighter than {brightest:.3g}", "scale the map down"),
    ):
        if bad.any():
            texels = any_channel(bad)
            row, column = np.unravel_index(texels.argmax(), texels.shape)
            where = f"the first at row {first_row + row}, column {column}"
            raise InputError(f"{what}: {texels.sum()} texels are {how}, {where}: {cure}")


def repair(image: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Replace infinite radiance by the brightest, and every other non-finite texel by its neighbours.

    A sun that the program before could not hold has overflowed to +Inf: such channels become the largest
    finite value of the image, or :data:`HALF_MAX` if that is more. A texel with NaN or -Inf in a channel
    becomes the mean of its eight neighbours, columns periodic, as its other channels are no more to be
    trusted; holes are filled from their rim inwards.

    Parameters
    ----------
    image : array (H, W, 3)
        The map; not changed.

    Returns
    -------
    image : array (H, W, 3) float32
        The same where it was finite.
    overflowed : array of bool (H, W)
        Texels that were infinite.
    replaced : array of bool (H, W)
        Texels that were replaced by their neighbours.

    Raises
    ------
    InputError
        If no texel is finite.
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
