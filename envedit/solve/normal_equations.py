"""Normal equations of a Gauss-Newton step, and how they are solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ROWS = 64
"""Rows of a triangular matrix that are solved for together."""


@dataclass(frozen=True)
class Blocks:
    """What normal equations are made of, by blocks of pixels."""

    jacobian: list[np.ndarray]  # (blocks, n), of the gain, per channel
    # squared, pulled: (blocks, 3), sums of weight times slope squared, and of weight, slope and residual
    squared: np.ndarray
    pulled: np.ndarray
    # (blocks, k), sums of weight times slope squared times pictures of lights, per channel; may be empty
    lights: list[np.ndarray]


@dataclass(frozen=True)
class MeanOfRest:
    """The mean of what was not painted, q of ``likelihood.py``, as one more residual of each channel."""

    jacobian: np.ndarray  # (3, m), its derivatives by the unknowns
    residual: np.ndarray  # (3,), its value
    by_pixels: np.ndarray  # (h, w, 3), its derivatives by the radiance of pixels
    by_blocks: np.ndarray  # (blocks, 3), these times the profile, summed over blocks


@dataclass(frozen=True)
class Normal:
    """Hessian (m, m) and gradient (m,) of F / 2.

    ``precision`` is K in the Hessian, ``unknowns`` names those after the gain's, ``blocks`` is what the
    Hessian was made of; so are weights ``robust`` (h, w, 1), ``slope`` of the display curve, ``residual`` and
    ``profile`` of the blocks (h, w, 3), and ``pictures`` (k, h, w, 3) of the unknowns that are named.
    """

    hessian: np.ndarray
    gradient: np.ndarray
    precision: np.ndarray
    unknowns: list
    blocks: Blocks
    robust: np.ndarray
    slope: np.ndarray
    residual: np.ndarray
    profile: np.ndarray
    pictures: np.ndarray
    mean_of_rest: MeanOfRest

    @property
    def determined(self) -> float:
        """How many unknowns the picture determines: the trace of H^-1 (H - K)."""
        try:
            shares = np.linalg.solve(self.hessian, self.precision)
        except np.linalg.LinAlgError:
            return float(len(self.hessian))
        return float(len(self.hessian) - np.trace(shares))


def forward(lower: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Solve L x = values, (n,) or (n, k), by substitution, :data:`ROWS` at a time; L is lower triangular."""
    x = np.array(values, np.float64)
    for k in range(0, len(x), ROWS):
        part = slice(k, k + ROWS)
        x[part] = np.linalg.solve(lower[part, part], x[part] - lower[part, :k] @ x[:k])
    return x


def solved(lower: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Solve L L' x = values, (n,) or (n, k), as :func:`forward` does."""
    x = forward(lower, values)
    for k in reversed(range(0, len(x), ROWS)):
        part, rest = slice(k, k + ROWS), slice(k + ROWS, None)
        x[part] = np.linalg.solve(lower[part, part].T, x[part] - lower[rest, part].T @ x[rest])
    return x
