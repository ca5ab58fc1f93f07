"""Whether an edited map still looks like a photograph of a sky, in numbers that PSNR does not see."""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.losses.metrics import LOG_EPS, high_frequency_energy

PERCENTILES, MARGIN = (1, 99), 0.1
"""Range of log chroma that a sky has, and by how much a texel may leave it."""
CELL_ROWS, CELL_COLUMNS = 8, 32
"""Cells of the upper half, 11 degrees wide, by which patches are measured."""
COARSE_DEGREES = 60.0
"""Scale from which on a change is no patch but another exposure, or a gradient over the whole sky."""
CLIPPED = 0.01
"""Share of the sky's brightest texels that are cut in cells: the sun moving is no patch."""
SKIES_PATCHES = 0.52
"""RMS of patches between two photographed skies (``python -m experiments natural.skies run``)."""
MOST_WHITE, MOST_PATCHES = 0.05, 1.7
"""From where on a user is warned of a painted edit: a twentieth of the sky more that is white, and the most
patches that two of those skies have. Towards a rendering another sky can be meant."""


def natural(edited: np.ndarray, original: np.ndarray, true: np.ndarray | None = None) -> dict:
    """Compare an edited map with the original, and with the true map, which makes the target, where known.

    They are whole maps (H, W, 3), linear radiance. Returned are the numbers of ``natural`` in
    ``docs/outputs.md``; None where the denominator is 0.
    """
    known = [original] if true is None else [original, true]
    sharp = max(high_frequency_energy(envmap) for envmap in known)
    step = _step(original)
    return {
        "colours_outside": colours_outside(edited, known),
        "seam": _step(edited) / step if step > 0 else None,
        "high_frequency": high_frequency_energy(edited) / sharp if sharp > 0 else None,
        "white": white(edited) - white(original),
        "patches": patches(edited, original) / SKIES_PATCHES,
    }


def warning(measured: dict) -> str:
    """Return a sentence on what is unnatural in a painted edit's :func:`natural`; "" where nothing is."""
    reasons = []
    if measured["white"] > MOST_WHITE:
        reasons.append(f"{100 * measured['white']:.0f} % more of it is white")
    if measured["patches"] > MOST_PATCHES:
        reasons.append(
            f"its patches are {measured['patches']:.1f} times those between two photographed skies"
        )
    if not reasons:
        return ""
    return f"the sky has changed much: {' and '.join(reasons)}; lower solve.freedom, or paint less"


def white(envmap: np.ndarray) -> float:
    """Return the share of the upper half's solid angle whose radiance is at least 1 in all channels."""
    sky, omega = _upper(envmap)
    bright = (sky >= 1).all(axis=2)
    return float((omega * bright).sum() / omega.sum())


def patches(edited: np.ndarray, original: np.ndarray) -> float:
    """Return the RMS of the log gain of the upper half at scales of 11 to 60 degrees.

    The gain is that of mean luminance in cells, with the brightest :data:`CLIPPED` of each map cut, less its
    Gaussian mean of :data:`COARSE_DEGREES`.
    """
    (before, directions, omega) = cells(original)
    (after, _, _) = cells(edited)
    gain = after - before
    angle = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    kernel = np.exp(-0.5 * (angle / COARSE_DEGREES) ** 2) * omega
    smooth = kernel @ gain / kernel.sum(axis=1)
    return float(np.sqrt(omega @ (gain - smooth) ** 2 / omega.sum()))


def cells(envmap: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log luminance (n,), direction (n, 3) and solid angle (n,) of the upper half's cells."""
    sky, omega = _upper(envmap)
    half, width = omega.shape
    shown = luminance(sky)
    shown = np.minimum(shown, np.quantile(shown, 1 - CLIPPED))
    row = np.arange(half) * min(CELL_ROWS, half) // half
    column = np.arange(width) * min(CELL_COLUMNS, width) // width
    cell = row[:, None] * CELL_COLUMNS + column
    weight = np.bincount(cell.ravel(), omega.ravel())
    light = np.bincount(cell.ravel(), (omega * shown).ravel())
    directions = latlong.directions(len(envmap), width, slice(half)).reshape(-1, 3)
    centre = np.stack([np.bincount(cell.ravel(), omega.ravel() * axis) for axis in directions.T], axis=1)
    used = weight > 0
    centre = centre[used] / np.linalg.norm(centre[used], axis=1, keepdims=True)
    return np.log(light[used] / weight[used] + LOG_EPS), centre, weight[used]


def colours_outside(edited: np.ndarray, known: list[np.ndarray]) -> float:
    """Return the share of the upper half's solid angle in colours that none of the known maps has.

    Those are log chroma, log radiance less its mean over channels, that in any channel is beyond
    :data:`PERCENTILES` of all known maps by more than :data:`MARGIN`.
    """
    sky, omega = _upper(edited)
    both = np.concatenate([_chroma(_upper(envmap)[0]).reshape(-1, 3) for envmap in known])
    low, high = np.percentile(both, PERCENTILES, axis=0)
    chroma = _chroma(sky)
    outside = ((chroma < low - MARGIN) | (chroma > high + MARGIN)).any(axis=2)
    return float((omega * outside).sum() / omega.sum())


def _upper(envmap):
    """Return the upper half of a map, and the solid angle (rows, W) of its texels."""
    height, width, _ = envmap.shape
    half = max(1, height // 2)
    return envmap[:half], np.repeat(latlong.solid_angles(height, width)[:half, None], width, axis=1)


def _chroma(image):
    logs = np.log(np.maximum(np.float64(image), 1e-4))
    return logs - logs.mean(axis=2, keepdims=True)


def _step(image):
    """Mean absolute step of log luminance between the rows on either side of the horizon."""
    below = min(image.shape[0] // 2, image.shape[0] - 1)
    rows = np.log(np.maximum(luminance(image[[max(below - 1, 0), below]]), 0) + LOG_EPS)
    return float(np.abs(rows[1] - rows[0]).mean())
