"""Normal equations of a Gauss-Newton step, and how they are solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ROWS = 64
"""Rows of a triangular matrix that are solved for together."""


@dataclass(frozen=True)
class Blocks:
    """What normal equations are made of, by blocks of pixels.

    Attributes
    ----------
    jacobian : list of ndarray (blocks, n)
        Of the gain, per channel.
    squared, pulled : ndarray (blocks, 3)
        Sums of weight times slope squared, and of weight, slope and residual.
    lights : list of ndarray (blocks, k)
        Sums of weight times slope squared times pictures of lights, per channel; empty without lights.
    """

    jacobian: list[np.ndarray]
    squared: np.ndarray
    pulled: np.ndarray
    lights: list[np.ndarray]


@dataclass(frozen=True)
class MeanOfRest:
    """The mean of what was not painted, q of ``likelihood.py``, as one more residual of each channel.

    Attributes
    ----------
    jacobian : ndarray (3, m)
        Its derivatives by the unknowns.
    residual : ndarray (3,)
        Its value.
    by_pixels : ndarray (h, w, 3)
        Its derivatives by the radiance of pixels.
    by_blocks : ndarray (blocks, 3)
        These times the profile, summed over blocks.
    """

    jacobian: np.ndarray
    residual: np.ndarray
    by_pixels: np.ndarray
    by_blocks: np.ndarray


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
