"""Where a photograph lies on the film of a rendering: shift, scale and rotation by a few percent.

Light differs between the two, outlines do not. What is compared are the directions of the edges of log
luminance without their sign, weighted by how clear they are: z = m e^(2 i phi), of a gradient of direction
phi and size g, with m = g / (g + g_0). The rendering is that under light from everywhere: without shadows.
"""

from __future__ import annotations

import itertools
from dataclasses import astuple, dataclass, replace

import numpy as np

from envedit.core import resampling

MOST_SHIFT, MOST_SCALE, MOST_ROTATION = 0.06, 0.06, 3.0
"""Largest shift, as a share of the width, scale beside 1, and rotation in degrees that are looked for."""
GRID = 5
"""Scales, and rotations, of the coarse search."""
CLEAR_PERCENTILE = 90
"""Percentile of an image's gradients that is g_0: the clearest tenth of its pixels has m above a half."""
FARTHEST_COST = 0.15
"""Share of the correlation that the largest shift, scale or rotation costs, and by its square smaller ones: a
sphere alone does not show how it is turned."""
LEAST_GAIN = 1.02
"""Correlation over that of the picture as it lies, from which on it is resampled."""
CLEAR_PEAK = 5.0
"""Correlation of the best shift, in standard deviations of all shifts, from which on outlines agree: it was
right from 5.4 on and wrong up to 4.7 (``docs/decisions/defaults.md``)."""
FINEST = 1 / 32
"""Last step of the refinement, pixels at the border of the film."""


@dataclass(frozen=True)
class Placement:
    """Where a point of the rendering lies in the photograph.

    ``right`` and ``down`` are its shift, as shares of the rendering's width, ``scale`` is distances in the
    photograph over those in the rendering, ``degrees`` its rotation, from right to down.
    """

    right: float = 0.0
    down: float = 0.0
    scale: float = 1.0
    degrees: float = 0.0

    @property
    def summary(self) -> str:
        """Say it in words; "" where nothing was moved."""
        shift = float(np.hypot(self.right, self.down))
        parts = [f"shifted by {100 * shift:.2g} %"] if shift else []
        parts += [f"scaled by {self.scale:.4g}"] if self.scale != 1 else []
        parts += [f"turned by {self.degrees:.2g} degrees"] if self.degrees else []
        return ", ".join(parts)

    @property
    def shares(self) -> np.ndarray:
        """Shifts, scale and rotation over the largest that are looked for, (4,)."""
        size = np.log(self.scale) / np.log1p(MOST_SCALE)
        return np.array([self.right / MOST_SHIFT, self.down / MOST_SHIFT, size, self.degrees / MOST_ROTATION])

    def sampled(self, picture: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Sample a picture (H, W, k) of the photograph at the pixels of a film of its aspect, bilinearly.

        Returns values (height, width, k), and which of them, (height, width), the photograph has.
        """
        rows, columns, _ = picture.shape
        y, x = np.mgrid[:height, :width] + 0.5
        x, y = x - width / 2, y - height / 2
        cosine, sine = self.scale * np.cos(np.radians([self.degrees, self.degrees - 90]))
        across = (cosine * x - sine * y + self.right * width) * columns / width + columns / 2 - 0.5
        down = (sine * x + cosine * y + self.down * width) * rows / height + rows / 2 - 0.5
        inside = (across > -0.51) & (across < columns - 0.49) & (down > -0.51) & (down < rows - 0.49)
        return resampling.bilinear(picture, down, across), inside


def find(photo: np.ndarray, rendering: np.ndarray) -> tuple[Placement, bool]:
    """Find where a photograph lies, and whether outlines agree at all; as it is, if no place agrees better.

    ``photo`` (H, W) is its luminance, of the aspect of the ``rendering`` (h, w), the luminance under light
    from everywhere.
    """
    # ---- Edges of both
    height, width = rendering.shape
    known = _edges(_log(rendering))
    logarithm = _log(photo)[..., None]

    def edges(placement):
        values, inside = placement.sampled(logarithm, height, width)
        return _edges(values[..., 0]) * inside

    def agreement(placement):
        found = edges(placement)
        size = np.sqrt(np.square(np.abs(known)).sum() * np.square(np.abs(found)).sum())
        cost = 1 - FARTHEST_COST * np.square(placement.shares).sum()
        return float(cost * (known.conj() * found).real.sum() / max(size, 1e-30))

    # ---- All shifts at once, at scales and rotations on a grid
    best, most, clear = Placement(), -np.inf, False
    reach = int(MOST_SHIFT * width)
    near = np.abs(np.fft.fftfreq(height, 1 / height))[:, None] <= reach
    near = near & (np.abs(np.fft.fftfreq(width, 1 / width)) <= reach)
    scales = np.exp(np.linspace(-1, 1, GRID) * 0.75 * np.log1p(MOST_SCALE))
    rotations = np.linspace(-1, 1, GRID) * 0.75 * MOST_ROTATION
    spectrum = np.fft.fft2(known).conj()
    for scale, degrees in itertools.product(scales, rotations):
        candidate = Placement(0, 0, float(scale), float(degrees))
        correlation = np.fft.ifft2(spectrum * np.fft.fft2(edges(candidate))).real
        row, column = np.unravel_index(np.argmax(np.where(near, correlation, -np.inf)), correlation.shape)
        if correlation[row, column] > most:
            most = correlation[row, column]
            clear = most - correlation.mean() > CLEAR_PEAK * correlation.std()
            down = (row + height // 2) % height - height // 2
            right = (column + width // 2) % width - width // 2
            best = replace(candidate, right=float(right / width), down=float(down / width))

    # ---- Every parameter in turn, by steps that move the film's border by ever less
    units = 1 / width, 1 / width, 2 / width, np.degrees(2 / width)
    step, now = 4.0, agreement(best)
    while step >= FINEST:
        moved = False
        for name, sign in itertools.product(range(4), (1, -1)):
            values = list(astuple(best))
            values[name] += sign * step * units[name]
            candidate = Placement(*values)
            there = agreement(candidate)
            if there > now:
                best, now, moved = candidate, there, True
        step = step if moved else step / 2
    if not clear or now < LEAST_GAIN * agreement(Placement()):
        best = Placement()
    return best, bool(clear)


def _log(luminance):
    """Return log luminance, without what is darker than a 2000th of the mean."""
    values = np.float64(luminance)
    return np.log(np.maximum(values, 5e-4 * max(float(values.mean()), 1e-30)))


def _edges(logarithm):
    """Return z of the module's first lines, (h, w) complex; 0 at the border."""
    smooth = logarithm
    for axis in (0, 1):
        ahead, back = np.roll(smooth, 1, axis), np.roll(smooth, -1, axis)
        smooth = (ahead + 2 * smooth + back) / 4
    across, down = (np.roll(smooth, -1, axis) - np.roll(smooth, 1, axis) for axis in (1, 0))
    size = np.hypot(across, down)
    size[[0, 1, -2, -1]] = 0
    size[:, [0, 1, -2, -1]] = 0
    weight = size / (size + max(float(np.percentile(size, CLEAR_PERCENTILE)), 1e-12))
    return weight * np.exp(2j * np.arctan2(down, across))
