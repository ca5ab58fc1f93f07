"""Normal equations of a Gauss-Newton step, and how they are solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.solve.derivatives import Linearisation

ROWS = 64
"""Rows of a triangular matrix that are solved for together."""


@dataclass(frozen=True)
class Normal:
    """Hessian and gradient of F / 2 by m unknowns, and what they were made of."""

    hessian: np.ndarray  # (m, m)
    gradient: np.ndarray  # (m,)
    precision: np.ndarray  # (m, m), K in the Hessian
    linear: Linearisation  # derivatives of the rendering
    # ---- Of pixels
    robust: np.ndarray  # (h, w, 1), weights
    slope: np.ndarray  # (h, w, 3), of the display curve
    # ---- Sums over blocks of pixels
    # squared, pulled: (blocks, 3), of weight times slope squared, and of weight, slope and residual
    squared: np.ndarray
    pulled: np.ndarray
    # (blocks, k), of weight times slope squared times pictures of lights, per channel
    lights: list[np.ndarray]
    # ---- The mean of what was not painted, q of ``likelihood.py``, as one more residual of each channel
    mean: np.ndarray  # (3,), its value
    mean_by_unknowns: np.ndarray  # (3, m), its derivatives
    mean_by_pixels: np.ndarray  # (h, w, 3), likewise by the radiance of pixels
    mean_by_blocks: np.ndarray  # (blocks, 3), these times the profile, summed over blocks

    @property
    def determined(self) -> float:
        """How many unknowns the picture determines: the trace of H^-1 (H - K)."""
        try:
            shares = np.linalg.solve(self.hessian, self.precision)
        except np.linalg.LinAlgError:
            return float(len(self.hessian))
        return float(len(self.hessian) - np.trace(shares))

    @property
    def decrement(self) -> float:
        """By how much a step lowers F at most, were F quadratic: q' H^-1 q; inf where there is no step."""
        try:
            step = solved(np.linalg.cholesky(self.hessian), self.gradient)
        except np.linalg.LinAlgError:
            return np.inf
        return float(self.gradient @ step)


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
