"""Pictures of a run: linear radiance ``(H, W, 3)`` scaled, tonemapped and labelled; differences in colour.

For display only; nothing here feeds back into an edit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance
from envedit.core.color import tonemap as apply_tonemap
from envedit.core.errors import InputError
from envedit.core.resampling import fit
from envedit.core.types import ArrayLike, FilePath, Views
from envedit.images.images import png
from envedit.report.curves import round_up
from envedit.transport.influence import per_solid_angle

NOT_FINITE = (255, 0, 255)  # NaN and Inf are shown, never painted over: no photograph has this magenta
PLACEHOLDER = (216, 216, 216)
GAP, BACKGROUND, INK = 6, (250, 250, 250), (40, 40, 40)

# 5x7 display font: five columns a glyph, least significant bit on top.
_COLUMNS = (
    "7E1111117E 7F49494936 3E41414122 7F4141221C 7F49494941 7F09090901 3E4149497A 7F0808087F 00417F4100 "
    "2040413F01 7F08142241 7F40404040 7F020C027F 7F0408107F 3E4141413E 7F09090906 3E4151215E 7F09192946 "
    "4649494931 01017F0101 3F4040403F 1F2040201F 3F4038403F 6314081463 0708700807 6151494543 3E5149453E "
    "00427F4000 4261514946 2141454B31 1814127F10 2745454539 3C4A494930 0171090503 3649494936 064949291E "
    "0000000000 0060600000 0050300000 0036360000 0808080808 08083E0808 1414141414 2010080402 2313086462 "
    "001C224100 0041221C00 4040404040 0201510906"
)
_FONT = {
    glyph: bytes.fromhex(columns)
    for glyph, columns in zip(
        "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 .,:-+=/%()_?",
        _COLUMNS.split(),
        strict=True,
    )
}


# ----------------------------------------------------------------------------------------------------------
# Scaling, display and labels


def checked(image: ArrayLike, name: str) -> np.ndarray:
    """Return a picture as an array, refusing what is not ``(H, W, 3)``."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InputError(f"report: picture {name!r} has shape {image.shape}, expected (H, W, 3)")
    return image


def fit_finite(image: ArrayLike, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Scale what is finite, and return the (height, width) mask of pixels that hold a NaN or Inf as well."""
    finite = np.isfinite(image).all(axis=2, keepdims=True)
    if finite.all():
        return fit(image, height, width), np.zeros((height, width), bool)
    return fit(np.where(finite, image, 0), height, width), fit(np.asarray(~finite), height, width)[..., 0] > 0


SHOWN = 2e-3, 1.0
"""Median luminance between which pictures are shown as they are; display values 0.06 and 1."""
GREY = 0.18
"""Luminance near which the median of others is shown."""


def stops_of(pictures: Iterable[ArrayLike]) -> int:
    """Return the exposure in whole stops at which pictures together are neither white nor black.

    0 where the median luminance of what is not black is in :data:`SHOWN`, or where nothing is.
    """
    found = [luminance(np.where(np.isfinite(image), image, 0)).ravel() for image in pictures]
    bright = np.concatenate([np.zeros(0), *(one[one > 0] for one in found)])
    median = float(np.median(bright)) if bright.size else GREY
    return 0 if SHOWN[0] <= median <= SHOWN[1] else round(np.log2(GREY / median))


def exposed(stops: float) -> str:
    """Return what is added to a caption of a picture that is shown at an exposure; "" at 0."""
    return f", {stops:+g} stops" if stops else ""


def display(
    image: ArrayLike, height: int, width: int, tonemap: str = "gamma", exposure: float = 0.0
) -> np.ndarray:
    """Scale, expose and tonemap linear radiance to 8 bits; whatever holds a NaN or Inf is magenta."""
    scaled, bad = fit_finite(image, height, width)
    shown = apply_tonemap(scaled.astype(np.float64) * 2.0**exposure, tonemap)
    pixels = np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)
    pixels[bad] = NOT_FINITE
    return pixels


def _text(label, width, scale):
    """(7 scale, width) mask of a one-line label, cut with two dots where it is too long for the width."""
    room = max(width // (6 * scale), 1)
    label = label if len(label) <= room else label[: max(room - 2, 0)] + ".."[: min(room, 2)]
    columns = b"".join(_FONT.get(glyph, _FONT["?"]) + b"\0" for glyph in label.upper())
    bits = np.unpackbits(np.frombuffer(columns, np.uint8)[None], axis=0, bitorder="little")[:7].astype(bool)
    mask = np.zeros((7 * scale, width), bool)
    bits = np.kron(bits, np.ones((scale, scale), bool))[:, :width]
    mask[:, : bits.shape[1]] = bits
    return mask


# ----------------------------------------------------------------------------------------------------------
# The preview


def preview(
    path: FilePath,
    renders: Mapping[str, np.ndarray | None],
    maps: Mapping[str, np.ndarray | None],
    tonemap: str = "gamma",
    labels: bool = True,
    exposure: float | None = None,
    views: Views = (),
) -> None:
    """Write ``preview.png``: what :func:`drawn` draws; errors as there, or that it cannot be written."""
    write_atomically(path, png(drawn(renders, maps, tonemap, labels, exposure, views)))


def drawn(
    renders: Mapping[str, np.ndarray | None],
    maps: Mapping[str, np.ndarray | None],
    tonemap: str = "gamma",
    labels: bool = True,
    exposure: float | None = None,
    views: Views = (),
) -> np.ndarray:
    """Draw a row of renderings and under each its environment map.

    Parameters
    ----------
    renders, maps : dict of str to array or None
        Linear radiance, ``(H, W, 3)``, in the order of the columns, usually ``initial``, ``target``,
        ``edited``. A map stands under the rendering of the same name; one that is missing or None (the true
        map is not always known) leaves a grey rectangle. Maps are drawn 2:1.
    tonemap : str
        A name of `envedit.core.color.TONEMAPS`.
    labels : bool
        Write the names above the columns.
    exposure : float, optional
        Exposure of the maps in stops, before the tonemap, with renderings as they are; None: that of
        :func:`stops_of` for the renderings and for the maps, named in the labels.
    views : sequence of slice
        Rows of each view, where renderings are of several: they are drawn below each other.

    Returns
    -------
    array (h, w, 3) uint8

    Raises
    ------
    InputError
        If a picture is not ``(H, W, 3)``, or there is none.
    ConfigError
        If there is no such tonemap.
    """
    scale = 2  # of the labels: pixels a dot
    names = list(dict.fromkeys([*renders, *maps]))
    shown = {name: checked(image, name) for name, image in renders.items() if image is not None}
    drawn = {name: checked(image, name) for name, image in maps.items() if image is not None}
    if not shown and not drawn:
        raise InputError("report: no picture to preview")
    at = 0 if exposure is not None else stops_of(shown.values())
    exposure = stops_of(drawn.values()) if exposure is None else exposure
    # Columns of 214 to 768 pixels whatever the run's size; small pictures are enlarged by a whole factor.
    widest = max((image.shape[1] for image in shown.values()), default=512)
    width = min(widest * max(1, round(320 / widest)), 768)
    pictures = {name: [image[rows] for rows in views or (slice(None),)] for name, image in shown.items()}
    heights = {name: [_height(image, width) for image in images] for name, images in pictures.items()}
    top = 7 * scale + GAP if labels else 0
    render_height = max((sum(each) + GAP * (len(each) - 1) for each in heights.values()), default=0)
    map_top = GAP + top + render_height + GAP
    canvas = np.empty((map_top + width // 2 + GAP, GAP + len(names) * (width + GAP), 3), np.uint8)
    canvas[:] = BACKGROUND
    for i, name in enumerate(names):
        column = slice(GAP + i * (width + GAP), (i + 1) * (width + GAP))
        if labels:
            label = f"{name}{exposed(at)}" + (f" (map{exposed(exposure)})" if exposure else "")
            canvas[GAP : GAP + 7 * scale, column][_text(label, width, scale)] = INK
        if name in shown:
            first = GAP + top
            for image, height in zip(pictures[name], heights[name], strict=True):
                canvas[first : first + height, column] = display(image, height, width, tonemap, at)
                first += height + GAP
        else:
            canvas[GAP + top : map_top - GAP, column] = PLACEHOLDER
        rows = slice(map_top, map_top + width // 2)
        canvas[rows, column] = PLACEHOLDER
        if name in drawn:
            canvas[rows, column] = display(drawn[name], width // 2, width, tonemap, exposure)
    return canvas


def _height(image, width):
    """Height at which a rendering is drawn, of at most four times its width."""
    return min(max(round(width * image.shape[0] / image.shape[1]), 1), 4 * width)


# ----------------------------------------------------------------------------------------------------------
# Differences

# Blue, white, red: where a is darker than b, equal, brighter.
_DIVERGING = np.array([[33, 102, 172], [146, 197, 222], [247, 247, 247], [244, 165, 130], [178, 24, 43]])


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
        ``(H, W, 3)`` uint8; magenta where a or b is not finite.
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
    finite = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2)
    a, b = (np.where(finite[..., None], image, 0).astype(np.float64) for image in (a, b))
    if kind == "stops":
        la, lb = np.maximum(luminance(a), 0), np.maximum(luminance(b), 0)
        lift = max(1e-3 * float(np.median(lb[finite])) if finite.any() else 0.0, 1e-9)
        difference, least = np.log2((la + lift) / (lb + lift)), 0.1
    elif kind == "tonemapped":
        difference, least = luminance(apply_tonemap(a, tonemap)) - luminance(apply_tonemap(b, tonemap)), 0.01
    else:
        raise ValueError(f"difference_image: kind {kind!r} is neither 'tonemapped' nor 'stops'")
    if scale is None:
        typical = float(np.percentile(np.abs(difference[finite]), 99.5)) if finite.any() else 0.0
        scale = round_up(max(typical, least))
    position = np.clip(difference / scale, -1, 1) * 2 + 2
    pixels = np.stack([np.interp(position, np.arange(5), _DIVERGING[:, c]) for c in range(3)], axis=-1)
    pixels = np.rint(pixels).astype(np.uint8)
    pixels[~finite] = NOT_FINITE
    return pixels, float(scale)


# ----------------------------------------------------------------------------------------------------------
# Influence

# Nine colours of viridis (Smith and van der Walt 2015), evenly spaced: their lightness rises evenly.
RISING = np.array([[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141],
                   [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]])  # fmt: skip
INFLUENCE_RANGE = (1e-3, 1e1)
"""Influence drawn in the first and the last colour, as shares of the mean."""


def _rising(share):
    """Colour shares (...) of the scale, cut to [0, 1], as (..., 3) uint8."""
    place = np.clip(share, 0, 1) * (len(RISING) - 1)
    colours = [np.interp(place, np.arange(len(RISING)), RISING[:, c]) for c in range(3)]
    return np.rint(np.stack(colours, axis=-1)).astype(np.uint8)


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
    pixels = _rising((level - low) / (high - low))
    if frozen is not None:
        pixels[frozen] = PLACEHOLDER
    return pixels


def share_image(share: np.ndarray) -> np.ndarray:
    """Draw shares from 0 to 1, (H, W), in the colours of :func:`influence_image`: (H, W, 3) uint8."""
    return _rising(np.asarray(share, np.float64))


def influence(path: FilePath, values: np.ndarray, frozen: np.ndarray | None = None) -> None:
    """Draw ``influence.png``: :func:`influence_image` at 512 pixels or more, over its scale.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    pixels = influence_image(values, frozen)
    factor = -(-512 // pixels.shape[1])
    pixels = pixels.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width, _ = pixels.shape
    scale = 2  # of the labels: pixels a dot
    top = GAP + 7 * scale + GAP
    foot = slice(top + height + GAP, top + height + GAP + 7 * scale)
    canvas = np.empty((foot.stop + GAP, width + 2 * GAP, 3), np.uint8)
    canvas[:] = BACKGROUND
    inside = canvas[:, GAP : GAP + width]
    title = "influence, 1 = mean" + (" (grey: kept)" if frozen is not None and frozen.any() else "")
    inside[GAP : top - GAP][_text(title, width, scale)] = INK
    inside[top : top + height] = pixels
    room = 6 * 6 * scale  # for a label of five glyphs at either end of the bar
    low, high = (f"{share:g}" for share in INFLUENCE_RANGE)
    inside[foot, :room][_text(low, room, scale)] = INK
    inside[foot, -6 * scale * len(high) :][_text(high, 6 * scale * len(high), scale)] = INK
    inside[foot, room:-room] = _rising(np.linspace(0, 1, width - 2 * room))
    write_atomically(path, png(canvas))
