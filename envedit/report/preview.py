"""Pictures of a run as 8-bit display values: renderings and maps, their differences, influence of texels.

Every picture of the preview, the report and the sheet of variants is made here, from linear radiance
``(H, W, 3)``, finite. They have no text: what they show stands in captions, and in a PNG's text
``Description``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.color import linear_to_srgb, luminance
from envedit.core.color import tonemap as apply_tonemap
from envedit.core.resampling import fit
from envedit.core.types import FilePath, Views
from envedit.images.images import png
from envedit.solve.feasibility import Reach
from envedit.targets.photo import Photo
from envedit.transport.influence import per_solid_angle

UNKNOWN = 216
"""Grey level of a picture that is not known, and of texels that were kept."""
BACKGROUND = 250
"""Grey level between the pictures of a sheet."""
GAP = 6
"""Pixels between the pictures of a sheet."""
WIDEST = 1024
"""Pixels along a picture of the report, at most."""
FULL_COLOUR_DIFFERENCE = 0.25
"""Difference of display values that :func:`unreachable` shows in full colour."""


# ---- One picture -------------------------------------------------------------------------------------------


def known(pictures: Mapping[str, np.ndarray | None]) -> dict[str, np.ndarray]:
    """Return those of some pictures that are known."""
    return {name: image for name, image in pictures.items() if image is not None}


def display(
    image: np.ndarray, tonemap: str = "gamma", stops: float = 0.0, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Scale, expose and tonemap linear radiance (H, W, 3) to 8 bits.

    ``size`` is height and width; by default the picture's own, or :data:`WIDEST` pixels across.
    """
    scaled = fit(image, *(size or _shown_size(image)))
    shown = apply_tonemap(scaled.astype(np.float64) * 2.0**stops, tonemap)
    return np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)


def _shown_size(image):
    """Return height and width at which a picture is shown by itself."""
    height, width, _ = image.shape
    factor = min(1.0, WIDEST / width)
    return max(round(height * factor), 1), max(round(width * factor), 1)


SHOWN = 2e-3, 1.0
"""Median luminance between which pictures are shown as they are; display values 0.06 and 1."""
GREY = 0.18
"""Luminance near which the median of others is shown."""


def stops_of(pictures: Iterable[np.ndarray]) -> int:
    """Return the exposure in whole stops at which pictures together are neither white nor black.

    0 where the median luminance of what is not black is in :data:`SHOWN`, or where nothing is.
    """
    values = np.concatenate([np.zeros(0), *(luminance(image).ravel() for image in pictures)])
    bright = values[values > 0]
    median = float(np.median(bright)) if bright.size else GREY
    return 0 if SHOWN[0] <= median <= SHOWN[1] else round(np.log2(GREY / median))


def exposed(stops: float) -> str:
    """Return what is added to a caption of a picture that is shown at an exposure; "" at 0."""
    return f", {stops:+g} stops" if stops else ""


# ---- The preview -------------------------------------------------------------------------------------------


def sheet(
    renders: Mapping[str, np.ndarray | None],
    maps: Mapping[str, np.ndarray | None],
    tonemap: str = "gamma",
    views: Views = (),
) -> bytes:
    """Draw a row of renderings and under each its environment map, each row at the exposure of `stops_of`.

    Pictures ``(H, W, 3)`` are linear radiance, in the order of the columns, usually ``initial``, ``target``,
    ``edited``. A map stands under the rendering of the same name; one that is missing or None (the true map
    is not always known) leaves a grey rectangle. Maps are drawn 2:1, and renderings of several ``views``, of
    which these are the rows, below each other. Returns a PNG file, whose text ``Description`` names the
    columns and the exposures.
    """
    names = list(dict.fromkeys([*renders, *maps]))
    renders = known(renders)
    maps = known(maps)
    stops = stops_of(renders.values())
    map_stops = stops_of(maps.values())

    # ---- Columns of 214 to 768 pixels; small pictures are enlarged by a whole factor
    widest = max((image.shape[1] for image in renders.values()), default=512)
    width = min(widest * max(1, round(320 / widest)), 768)
    parts = views or (slice(None),)
    shapes = [image[rows].shape for image in [*renders.values()][:1] for rows in parts]
    heights = [min(max(round(width * shape[0] / shape[1]), 1), 4 * width) for shape in shapes]
    columns = []
    for name in names:
        tiles = [np.full((height, width, 3), UNKNOWN, np.uint8) for height in heights]
        if name in renders:
            sizes = zip(parts, heights, strict=True)
            tiles = [display(renders[name][rows], tonemap, stops, (height, width)) for rows, height in sizes]
        if name in maps:
            tiles.append(display(maps[name], tonemap, map_stops, (width // 2, width)))
        elif maps:
            tiles.append(np.full((width // 2, width, 3), UNKNOWN, np.uint8))
        columns.append(np.concatenate([_framed(tile, (GAP, 0)) for tile in tiles]))
    text = f"from left to right: {', '.join(names)}; renderings{exposed(stops)} over maps{exposed(map_stops)}"
    return png(_framed(np.hstack(columns), (0, GAP)), {"Description": text})


def _framed(pixels, width):
    """Add a frame on top and left, and at bottom and right, of the given widths."""
    return np.pad(pixels, (width, width, (0, 0)), constant_values=BACKGROUND)


# ---- Differences -------------------------------------------------------------------------------------------

DIVERGING = np.array([[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 130], [178, 24, 43]])
"""Evenly spaced colours of a difference: blue where it is negative, white at 0, red where it is positive."""


def difference_image(
    a: np.ndarray, b: np.ndarray, kind: str = "tonemapped", tonemap: str = "gamma"
) -> tuple[np.ndarray, float]:
    """Draw the difference a - b in luminance: red where a is brighter, blue where it is darker.

    ``a`` and ``b`` (H, W, 3) are linear radiance. ``kind`` is "tonemapped", the difference of the luminance
    under ``tonemap``, for renderings; or "stops", log2 of the ratio of luminances, for maps, whose sun a
    tonemap clips. There both are lifted by a thousandth of b's median, so that a black texel is dark and not
    minus infinity.

    Returns pixels (H, W, 3) uint8, at most :data:`WIDEST` across, and the difference that is drawn in full
    red or blue: the 99.5th percentile, rounded up to 1, 2 or 5 times a power of ten, and at least 0.01
    (tonemapped) or 0.1 (stops), as rounding is no edit.
    """
    size = _shown_size(a)
    a = fit(a, *size).astype(np.float64)
    b = fit(b, *size).astype(np.float64)
    if kind == "stops":
        luminance_a = np.maximum(luminance(a), 0)
        luminance_b = np.maximum(luminance(b), 0)
        lift = max(1e-3 * float(np.median(luminance_b)), 1e-9)
        difference = np.log2((luminance_a + lift) / (luminance_b + lift))
        least = 0.1
    else:
        difference = luminance(apply_tonemap(a, tonemap)) - luminance(apply_tonemap(b, tonemap))
        least = 0.01
    typical = float(np.percentile(np.abs(difference), 99.5))
    scale = _round_up(max(typical, least))
    return colours(DIVERGING, difference / scale / 2 + 0.5), scale


def _round_up(value):
    """Return the smallest of 1, 2, 5 times a power of ten that is not below ``value`` > 0."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * (1 - 1e-9))


def colours(scale: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return positions (...) on a scale of colours (n, 3), cut to [0, 1], as (..., 3) uint8."""
    place = np.clip(position.astype(np.float64), 0, 1) * (len(scale) - 1)
    channels = [np.interp(place, np.arange(len(scale)), scale[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


# ---- Influence ---------------------------------------------------------------------------------------------

# Nine colours of viridis (Smith and van der Walt 2015), evenly spaced: their lightness rises evenly.
RISING = np.array([[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141],
                   [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]])  # fmt: skip
INFLUENCE_RANGE = (1e-3, 1e1)
"""Influence drawn in the first and the last colour, as shares of the mean."""
INFLUENCE_WIDTH = 512
"""Pixels along ``influence.png``, at least."""


def influence_image(influence: np.ndarray, frozen: np.ndarray | None = None) -> np.ndarray:
    """Draw the influence (H, W) of texels per solid angle, as shares of its mean over the sphere, as uint8.

    ``influence`` is T' 1 of :class:`.light_transport.LightTransport`; colours follow its logarithm. Texels
    that were kept, ``frozen`` (H, W), are grey.
    """
    mean = influence.sum(dtype=np.float64) / (4 * np.pi)
    low, high = np.log10(INFLUENCE_RANGE)
    level = np.log10(np.maximum(per_solid_angle(influence) / max(mean, 1e-300), INFLUENCE_RANGE[0]))
    pixels = colours(RISING, (level - low) / (high - low))
    if frozen is not None:
        pixels[frozen] = UNKNOWN
    return pixels


def influence_caption(frozen: np.ndarray | None) -> str:
    """Return what a picture of :func:`influence_image` shows."""
    caption = "influence of each texel on the rendering, per solid angle; 1 is the mean"
    if frozen is not None and frozen.any():
        caption += "; grey texels are not determined by this view and keep their original value"
    return caption


def unreachable(reach: Reach) -> np.ndarray:
    """Show the infeasible rest as display values (h, w, 3) in [0, 1].

    White: feasible. Red: stays darker than painted. Blue: stays brighter. Full colour is a difference of
    :data:`FULL_COLOUR_DIFFERENCE` in display values, whatever the request, so that pictures can be compared.
    Shown is the channel that differs most.
    """
    most = np.abs(reach.residual).argmax(axis=2)
    signed = np.take_along_axis(reach.residual, most[..., None], axis=2)[..., 0] / FULL_COLOUR_DIFFERENCE
    red, blue = np.clip(signed, 0, 1), np.clip(-signed, 0, 1)
    return np.stack([1 - blue, 1 - np.maximum(red, blue), 1 - red], axis=2).astype(np.float32)


def photograph(photo: Photo, rendering: np.ndarray, outliers: np.ndarray) -> list[np.ndarray]:
    """Return a photograph, a rendering (h, w, 3) under its camera, and its outliers (h, w) in red.

    Each is (h, w, 3) display values in [0, 1].
    """
    values = [np.clip(one, 0, 1) for one in (photo.values, photo.camera.shown(rendering))]
    if photo.camera.curve == "linear":
        values = [linear_to_srgb(one) for one in values]
    grey = 0.5 * values[0].mean(axis=2, keepdims=True) + 0.25
    return [*values, np.where(outliers[..., None], (0.9, 0.1, 0.1), grey)]


def influence(path: FilePath, values: np.ndarray, frozen: np.ndarray | None = None) -> None:
    """Draw ``influence.png``: :func:`influence_image`, every texel a square of pixels."""
    pixels = influence_image(values, frozen)
    factor = -(-INFLUENCE_WIDTH // pixels.shape[1])
    low, high = INFLUENCE_RANGE
    scale = f"violet: at most {low:g}, yellow: at least {high:g}, logarithmic between"
    text = {"Description": f"{influence_caption(frozen)}; {scale}"}
    write_atomically(path, png(pixels.repeat(factor, axis=0).repeat(factor, axis=1), text))
