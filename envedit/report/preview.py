"""Pictures of a run as 8-bit display values: renderings and maps, their differences, influence of texels.

Every picture of the preview, the report and the sheet of variants is made here, from linear radiance
``(H, W, 3)``. They have no text: what they show stands in captions, and in a PNG's text ``Description``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance
from envedit.core.color import tonemap as apply_tonemap
from envedit.core.errors import InputError
from envedit.core.resampling import fit
from envedit.core.types import ArrayLike, FilePath, Views
from envedit.images.images import png
from envedit.transport.influence import per_solid_angle

NOT_FINITE = (255, 0, 255)
"""Colour of a NaN or Inf, a magenta that no photograph has: it is shown, never painted over."""
PLACEHOLDER = (216, 216, 216)
"""Colour of a picture that is not known, and of texels that were kept."""
BACKGROUND = (250, 250, 250)
GAP = 6
"""Pixels between the pictures of a sheet."""
WIDEST = 1024
"""Pixels along a picture of the report, at most."""


# ----------------------------------------------------------------------------------------------------------
# One picture


def checked(image: ArrayLike, name: str) -> np.ndarray:
    """Return a picture as an array, refusing what is not ``(H, W, 3)``."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InputError(f"report: picture {name!r} has shape {image.shape}, expected (H, W, 3)")
    return image


def known(pictures: Mapping[str, ArrayLike | None]) -> dict[str, np.ndarray]:
    """Return those of some pictures that are known, as arrays; errors as of :func:`checked`."""
    return {name: checked(image, name) for name, image in pictures.items() if image is not None}


def display(
    image: np.ndarray, tonemap: str = "gamma", stops: float = 0.0, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Scale, expose and tonemap linear radiance (H, W, 3) to 8 bits; what holds a NaN or Inf is magenta.

    ``size`` is height and width; by default the picture's own, or :data:`WIDEST` pixels across.
    """
    scaled, bad = _fit_finite(image, size or _shown_size(image))
    shown = apply_tonemap(scaled.astype(np.float64) * 2.0**stops, tonemap)
    pixels = np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)
    pixels[bad] = NOT_FINITE
    return pixels


def _shown_size(image):
    """Return height and width at which a picture is shown by itself."""
    height, width, _ = image.shape
    factor = min(1.0, WIDEST / width)
    return max(round(height * factor), 1), max(round(width * factor), 1)


def _fit_finite(image, size):
    """Scale what is finite, and return the mask of pixels that hold a NaN or Inf as well."""
    finite = np.isfinite(image).all(axis=2, keepdims=True)
    if finite.all():
        return fit(image, *size), np.zeros(size, bool)
    return fit(np.where(finite, image, 0), *size), fit(np.asarray(~finite), *size)[..., 0] > 0


SHOWN = 2e-3, 1.0
"""Median luminance between which pictures are shown as they are; display values 0.06 and 1."""
GREY = 0.18
"""Luminance near which the median of others is shown."""


def stops_of(pictures: Iterable[ArrayLike]) -> int:
    """Return the exposure in whole stops at which pictures together are neither white nor black.

    0 where the median luminance of what is not black is in :data:`SHOWN`, or where nothing is.
    """
    values = [luminance(np.where(np.isfinite(image), image, 0)).ravel() for image in pictures]
    bright = np.concatenate([np.zeros(0), *(one[one > 0] for one in values)])
    median = float(np.median(bright)) if bright.size else GREY
    return 0 if SHOWN[0] <= median <= SHOWN[1] else round(np.log2(GREY / median))


def exposed(stops: float) -> str:
    """Return what is added to a caption of a picture that is shown at an exposure; "" at 0."""
    return f", {stops:+g} stops" if stops else ""


# ----------------------------------------------------------------------------------------------------------
# The preview


def preview(
    path: FilePath,
    renders: Mapping[str, np.ndarray | None],
    maps: Mapping[str, np.ndarray | None],
    tonemap: str = "gamma",
    views: Views = (),
) -> None:
    """Write ``preview.png``: what :func:`sheet` draws; errors as there, or that it cannot be written."""
    write_atomically(path, sheet(renders, maps, tonemap, views))


def sheet(
    renders: Mapping[str, np.ndarray | None],
    maps: Mapping[str, np.ndarray | None],
    tonemap: str = "gamma",
    views: Views = (),
) -> bytes:
    """Draw a row of renderings and under each its environment map, each row at the exposure of `stops_of`.

    Parameters
    ----------
    renders, maps : dict of str to array or None
        Linear radiance, ``(H, W, 3)``, in the order of the columns, usually ``initial``, ``target``,
        ``edited``. A map stands under the rendering of the same name; one that is missing or None (the true
        map is not always known) leaves a grey rectangle. Maps are drawn 2:1.
    tonemap : str
        A name of `envedit.core.color.TONEMAPS`.
    views : sequence of slice
        Rows of each view, where renderings are of several: they are drawn below each other.

    Returns
    -------
    bytes
        A PNG file, whose text ``Description`` names the columns and the exposures.

    Raises
    ------
    InputError
        If a picture is not ``(H, W, 3)``, or there is none.
    ConfigError
        If there is no such tonemap.
    """
    names = list(dict.fromkeys([*renders, *maps]))
    renders = known(renders)
    maps = known(maps)
    if not renders and not maps:
        raise InputError("report: no picture to preview")
    stops = stops_of(renders.values())
    map_stops = stops_of(maps.values())

    # ---- Columns of 214 to 768 pixels; small pictures are enlarged by a whole factor
    widest = max((image.shape[1] for image in renders.values()), default=512)
    width = min(widest * max(1, round(320 / widest)), 768)
    columns = {}
    for name, image in renders.items():
        parts = [image[rows] for rows in views or (slice(None),)]
        columns[name] = [display(part, tonemap, stops, (_height(part, width), width)) for part in parts]
    heights = [sum(len(part) + GAP for part in parts) for parts in columns.values()]
    map_top = GAP + max(heights, default=0)

    # ---- The sheet
    canvas = np.full((map_top + width // 2 + GAP, GAP + len(names) * (width + GAP), 3), BACKGROUND, np.uint8)
    for i, name in enumerate(names):
        column = canvas[:, GAP + i * (width + GAP) :][:, :width]
        column[GAP : map_top - GAP] = BACKGROUND if name in columns else PLACEHOLDER
        top = GAP
        for part in columns.get(name, []):
            column[top : top + len(part)] = part
            top += len(part) + GAP
        below = column[map_top : map_top + width // 2]
        below[:] = PLACEHOLDER
        if name in maps:
            below[:] = display(maps[name], tonemap, map_stops, below.shape[:2])
    text = f"from left to right: {', '.join(names)}; renderings{exposed(stops)} over maps{exposed(map_stops)}"
    return png(canvas, {"Description": text})


def _height(image, width):
    """Height at which a rendering is drawn, of at most four times its width."""
    return min(max(round(width * image.shape[0] / image.shape[1]), 1), 4 * width)


# ----------------------------------------------------------------------------------------------------------
# Differences

DIVERGING = np.array([[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 130], [178, 24, 43]])
"""Evenly spaced colours of a difference: blue where it is negative, white at 0, red where it is positive."""


def difference_image(
    a: ArrayLike, b: ArrayLike, kind: str = "tonemapped", tonemap: str = "gamma", scale: float | None = None
) -> tuple[np.ndarray, float]:
    """Draw the difference a - b in luminance: red where a is brighter, blue where it is darker.

    Parameters
    ----------
    a, b : array
        Linear radiance, ``(H, W, 3)``.
    kind : str
        ``"tonemapped"``: difference of the luminance of the tonemapped pictures, for renderings.
        ``"stops"``: log2 of the ratio of luminances, for maps, whose sun the tonemap clips; both are
        lifted by a thousandth of b's median so that a black texel is dark and not minus infinity.
    tonemap : str
        A name of `envedit.core.color.TONEMAPS`, for ``"tonemapped"``.
    scale : float, optional
        Difference drawn in full red or blue. By default the 99.5th percentile, rounded up to 1, 2 or 5
        times a power of ten, and at least 0.01 (tonemapped) or 0.1 (stops): rounding is no edit.

    Returns
    -------
    pixels : array
        ``(H, W, 3)`` uint8, at most :data:`WIDEST` across; magenta where a or b is not finite.
    scale : float
        The scale used, to be printed beside the picture.

    Raises
    ------
    InputError
        If the shapes differ.
    """
    a, b = checked(a, "a"), checked(b, "b")
    if a.shape != b.shape:
        raise InputError(f"report: cannot subtract a picture of shape {b.shape} from one of {a.shape}")
    size = _shown_size(a)
    (a, bad_a), (b, bad_b) = (_fit_finite(image, size) for image in (a, b))
    a, b, finite = a.astype(np.float64), b.astype(np.float64), ~(bad_a | bad_b)

    # ---- The difference, and what is drawn in full colour
    if kind == "stops":
        luminance_a = np.maximum(luminance(a), 0)
        luminance_b = np.maximum(luminance(b), 0)
        lift = max(1e-3 * float(np.median(luminance_b[finite])) if finite.any() else 0.0, 1e-9)
        difference = np.log2((luminance_a + lift) / (luminance_b + lift))
        least = 0.1
    elif kind == "tonemapped":
        difference = luminance(apply_tonemap(a, tonemap)) - luminance(apply_tonemap(b, tonemap))
        least = 0.01
    else:
        raise ValueError(f"difference_image: kind {kind!r} is neither 'tonemapped' nor 'stops'")
    if scale is None:
        typical = float(np.percentile(np.abs(difference[finite]), 99.5)) if finite.any() else 0.0
        scale = _round_up(max(typical, least))

    pixels = _colours(DIVERGING, difference / scale / 2 + 0.5)
    pixels[~finite] = NOT_FINITE
    return pixels, float(scale)


def _round_up(value):
    """Return the smallest of 1, 2, 5 times a power of ten that is not below ``value`` > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * (1 - 1e-9))


def _colours(scale, position):
    """Return positions (...) on a scale of colours, cut to [0, 1], as (..., 3) uint8."""
    place = np.clip(position, 0, 1) * (len(scale) - 1)
    channels = [np.interp(place, np.arange(len(scale)), scale[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


# ----------------------------------------------------------------------------------------------------------
# Influence

# Nine colours of viridis (Smith and van der Walt 2015), evenly spaced: their lightness rises evenly.
RISING = np.array([[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141],
                   [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]])  # fmt: skip
INFLUENCE_RANGE = (1e-3, 1e1)
"""Influence drawn in the first and the last colour, as shares of the mean."""
INFLUENCE_WIDTH = 512
"""Pixels along ``influence.png``, at least."""


def influence_image(influence: np.ndarray, frozen: np.ndarray | None = None) -> np.ndarray:
    """Draw the influence of texels per solid angle, as shares of its mean over the sphere, logarithmically.

    Parameters
    ----------
    influence : ndarray (H, W)
        T' 1 of :class:`.light_transport.LightTransport`.
    frozen : ndarray of bool (H, W), optional
        Texels that were kept, drawn in grey.

    Returns
    -------
    array (H, W, 3) uint8
    """
    mean = influence.sum(dtype=np.float64) / (4 * np.pi)
    low, high = np.log10(INFLUENCE_RANGE)
    level = np.log10(np.maximum(per_solid_angle(influence) / max(mean, 1e-300), INFLUENCE_RANGE[0]))
    pixels = share_image((level - low) / (high - low))
    if frozen is not None:
        pixels[frozen] = PLACEHOLDER
    return pixels


def influence_caption(frozen: np.ndarray | None) -> str:
    """Return what a picture of :func:`influence_image` shows."""
    caption = "influence of each texel on the rendering, per solid angle; 1 is the mean"
    if frozen is not None and frozen.any():
        caption += "; grey texels are not determined by this view and keep their original value"
    return caption


def share_image(share: np.ndarray) -> np.ndarray:
    """Draw shares from 0 to 1, (H, W), in colours from violet to yellow: (H, W, 3) uint8."""
    return _colours(RISING, np.asarray(share, np.float64))


def influence(path: FilePath, values: np.ndarray, frozen: np.ndarray | None = None) -> None:
    """Draw ``influence.png``: :func:`influence_image`, every texel a square of pixels.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    pixels = influence_image(values, frozen)
    factor = -(-INFLUENCE_WIDTH // pixels.shape[1])
    low, high = INFLUENCE_RANGE
    scale = f"violet: at most {low:g}, yellow: at least {high:g}, logarithmic between"
    text = {"Description": f"{influence_caption(frozen)}; {scale}"}
    write_atomically(path, png(pixels.repeat(factor, axis=0).repeat(factor, axis=1), text))
