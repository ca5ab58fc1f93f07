"""Strokes: what an artist paints on a rendering, written down as numbers.

A stroke is a dict with a ``type``, a shape (:mod:`.stroke_shapes`; none is the whole image) and what belongs
to the type; the keys, their defaults and ranges are :data:`.list_schema.STROKES`.

With E linear radiance, c coverage times opacity, t = D(E) display values:

- shadow: E (1 - c) + c (1 - amount) color E. Radiance: a penumbra is the share of a lamp that is hidden, and
  a factor keeps texture and highlights. color tints the light that is left, as the sky does outdoors.
- light: E + c amount color. Radiance, 1 is display white: a light adds to what is there, black or not.
- erase-shadow: t + c (f - t), with f the membrane (Laplace's equation) through the pixels around the stroke.
- temperature: E + c (k g E - E) with a gain g for each channel, see :func:`gains`. Radiance: a coloured light
  does this, so a map can. k keeps the summed luminance of what is covered.
- contrast: t + c (u - t), u = m + amount (t - m), with m the mean of t over what is covered, a channel at a
  time; u ends at black, and above display white nothing is made brighter than it was.
- hold: nothing is changed; what is covered is asked to stay as it is, with the weight of what is painted.
- blur: t + c (b - t), with b = t under a Gaussian of standard deviation ``radius`` that sees all of the
  picture.

D is the named tonemap up to display white and a logarithm above it (:class:`Display`): nothing is cut.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.config.list_schema import StrokeList
from envedit.core.color import inverse_tonemap, luminance, tonemap
from envedit.targets.stroke_shapes import coverage

_MOST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Painted:
    """A painted picture."""

    # (h, w, 3) float32, linear radiance. Where coverage is 0 it is the picture painted on, bit for bit
    picture: np.ndarray
    # (h, w, 1) float32, in [0, 1], how much of a pixel was painted: under strokes, whatever their opacity
    # (but not if that is 0), 1 - prod(1 - c)
    coverage: np.ndarray
    excluded: Any = None  # bool (h, w), pixels without information: clipped, or transparent over nothing
    clipped: np.ndarray | None = None  # bool (h, w, 3), values that say "at least so bright"; None: none
    warnings: tuple[str, ...] = ()  # what the user should know


def paint(
    picture: np.ndarray, strokes: Sequence[dict], tonemap: str = "gamma", numbers: Sequence[int] | None = None
) -> Painted:
    """Paint strokes on a picture (h, w, 3), finite linear radiance, each on the result of those before it.

    Negative values are taken as black where a stroke works on display values. ``strokes`` are as in a
    configuration's ``target.strokes``; erase-shadow, contrast and blur work on a display of this ``tonemap``,
    one of :data:`envedit.core.color.TONEMAPS`. Warnings name strokes by their ``numbers``, by default their
    places in the list. ConfigError if a stroke or the tonemap cannot be understood.
    """
    image = np.asarray(picture, np.float32)
    display = Display(tonemap)
    height, width, _ = image.shape
    result = image.astype(np.float64)
    bare = np.ones((height, width, 1))
    warnings = []
    for i, stroke in zip(numbers or range(len(strokes)), StrokeList()(strokes), strict=True):
        name = f"target.strokes[{i}] ({stroke['type']})"
        if not stroke["opacity"]:
            warnings.append(f"{name}: opacity 0, nothing was painted")
            continue
        covered = coverage(stroke, height, width)
        if not covered.any():
            outside = f"{name}: lies outside the {width}x{height} picture, nothing was painted"
            hint = '; lengths in pixels need units = "pixels"' if stroke["units"] == "fraction" else ""
            warnings.append(outside + hint)
            continue
        if stroke["type"] == "erase-shadow" and covered.all():
            warnings.append(f"{name}: covers the whole picture, no surroundings to paint with are left")
            continue
        on_display = stroke["type"] in ON_DISPLAY
        values = display.show(result) if on_display else result
        change = _at_full_strength(values, covered, stroke) - values
        painted = values + covered * stroke["opacity"] * change
        painted = display.radiance(painted) if on_display else painted
        result = np.where(covered > 0, np.minimum(painted, _MOST), result)
        bare *= 1 - covered
    total = (1 - bare).astype(np.float32)
    picture = np.where(total > 0, result.astype(np.float32), image)
    nothing = np.zeros(picture.shape, bool)
    return Painted(picture, total, nothing[..., 0], nothing, tuple(warnings))


# ---- Display values ----------------------------------------------------------------------------------------


class Display:
    """Display values that go on above display white, where the tonemaps of :mod:`envedit.core.color` cut.

    t = T(E) up to white W, and 1 + s log(E / W) above, with s = dT / dlog E at W: the slope is continuous,
    and every radiance comes back. For gamma it is the curve of the edit's losses, but for their toe.
    """

    def __init__(self, name: str):
        self.name = name
        self.white = float(inverse_tonemap(1.0, name))
        step = 1e-4
        self.slope = (1 - float(tonemap(self.white * math.exp(-step), name))) / step

    def show(self, radiance: np.ndarray) -> np.ndarray:
        """Map linear radiance to display values, in float64; less than black is black."""
        above = np.log(np.maximum(radiance, self.white) / self.white)
        return tonemap(np.minimum(radiance, self.white), self.name) + self.slope * above

    def radiance(self, values: np.ndarray) -> np.ndarray:
        """Map display values back to linear radiance."""
        # Under the logarithm of the largest float64, which no blend of pixels comes near.
        above = np.exp(np.minimum(np.maximum(values - 1, 0) / self.slope, 600))
        return inverse_tonemap(values, self.name) * above


# ---- What: values (h, w, 3) of the covered pixels at full strength -----------------------------------------

ON_DISPLAY = ("erase-shadow", "contrast", "blur")
"""Types of strokes that work on display values, the others on radiance."""


def _at_full_strength(values, covered, stroke):
    """Return what a stroke makes of values (h, w, 3); ``covered`` (h, w, 1) is its coverage."""
    mean = (covered * values).sum(axis=(0, 1)) / covered.sum()
    match stroke["type"]:
        case "shadow":
            return values * ((1 - stroke["amount"]) * np.array(stroke["color"]))
        case "light":
            return values + stroke["amount"] * np.array(stroke["color"])
        case "erase-shadow":
            return membrane(values, covered[..., 0] > 0)
        case "temperature":
            gain = gains(stroke["kelvin"])
            before, after = float(luminance(mean)), float(luminance(gain * mean))
            return values * gain * (before / after if before > 0 and after > 0 else 1.0)
        case "contrast":
            # A highlight stays: beyond white, a factor on display values is a power of radiance.
            changed = mean + stroke["amount"] * (values - mean)
            return np.clip(changed, 0, np.maximum(np.maximum(values, mean), 1))
        case "blur":
            sigma = stroke["radius"] * (values.shape[1] if stroke["units"] == "fraction" else 1)
            return _blurred(_blurred(values, sigma, 0), sigma, 1)
    return values  # hold


def gains(kelvin: float) -> np.ndarray:
    """Return the factors (3,) on linear R, G, B that turn a white of 6500 K into one of ``kelvin``.

    The colour of a black body in linear Rec.709 over that of one at 6500 K, scaled to luminance 1: grey keeps
    its luminance, and 6500 changes nothing. Factors on channels and no chromatic adaptation in another basis,
    because a channel of a rendering is lit by that channel of the map alone.
    """
    gain = _black_body(kelvin) / _black_body(6500.0)
    return gain / float(luminance(gain))


def balance(kelvin: float) -> np.ndarray:
    """Return factors (3,) that make the light of a black body neutral and keep the luminance of grey."""
    gain = 1 / gains(kelvin)
    return gain / float(luminance(gain))


def chromaticity(kelvin: float) -> tuple[float, float]:
    """Return the CIE 1931 chromaticity x, y of a black body of 1667 to 25000 K.

    The cubic splines of Kang et al., "Design of Advanced Color Temperature Control System for HDTV
    Applications", J. Korean Phys. Soc. 41 (2002).
    """
    t = 1e3 / kelvin
    if kelvin <= 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if kelvin <= 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif kelvin <= 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    return x, y


_XYZ_TO_RGB = np.array(  # IEC 61966-2-1
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)


def _black_body(kelvin):
    """Return linear R, G, B at Y = 1; positive from 2000 K on."""
    x, y = chromaticity(kelvin)
    return _XYZ_TO_RGB @ np.array([x / y, 1.0, (1 - x - y) / y])


def _blurred(values, sigma, axis):
    """Blur along an axis; weights that fall outside the picture are left out and the others scaled up."""
    length = values.shape[axis]
    reach = min(math.ceil(4 * sigma), length - 1)
    edges = [math.erf((i - 0.5) / (sigma * math.sqrt(2))) for i in range(-reach, reach + 2)]
    taps = np.diff(edges)  # the Gaussian over each pixel, so that a narrow one keeps its weight
    if not taps.sum() > 0:  # so wide that its differences vanish
        taps = np.ones_like(taps)
    size = length + 2 * reach
    moved = np.moveaxis(values, axis, -1)
    transform = np.fft.rfft(taps, size)

    def convolve(a):
        return np.fft.irfft(np.fft.rfft(a, size) * transform, size)[..., reach : reach + length]

    out = convolve(moved) / convolve(np.ones(length))
    return np.moveaxis(np.maximum(out, 0), -1, axis)


def membrane(values: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Replace ``unknown`` pixels (h, w) of a picture (h, w, C) by the membrane through those around them.

    Each is the mean of its neighbours: the discrete Laplace equation, with no flow across the picture's
    border, by conjugate gradients; to about 1e-6 of the largest value. Some pixel must be known.
    """
    row, column = np.nonzero(unknown)
    height, width = unknown.shape
    index = np.full((height + 2, width + 2), -1)
    index[row + 1, column + 1] = np.arange(len(row))
    padded = np.pad(np.where(unknown[..., None], 0, values), ((1, 1), (1, 1), (0, 0)))  # unknown, outside: 0
    steps = ((0, 1), (2, 1), (1, 0), (1, 2))
    around = [index[row + dr, column + dc] for dr, dc in steps]
    right = np.asarray(sum(padded[row + dr, column + dc] for dr, dc in steps))
    inside = np.pad(np.ones((height, width)), 1)
    degree = np.asarray(sum(inside[row + dr, column + dc] for dr, dc in steps))[:, None]

    def laplacian(x):
        extended = np.concatenate([x, np.zeros((1, x.shape[1]))])  # index -1 is no unknown
        return degree * x - sum(extended[i] for i in around)

    x = np.broadcast_to(values[~unknown].mean(axis=0), right.shape).copy()
    residual = right - laplacian(x)
    direction, size = residual.copy(), (residual**2).sum(axis=0)
    enough = (1e-6 * np.abs(values).max()) ** 2
    for _ in range(4 * (height + width) + 100):
        if (size <= enough).all():
            break
        image = laplacian(direction)
        x_step = size / np.maximum((direction * image).sum(axis=0), 1e-300)
        x += x_step * direction
        residual -= x_step * image
        now = (residual**2).sum(axis=0)
        direction = residual + now / np.maximum(size, 1e-300) * direction
        size = now
    out = values.copy()
    out[row, column] = x
    return out
