"""How likely a rendering is for a target: independent values, their noise, and what was not painted.

With r_p the root mean square over the channels of a pixel's residual of display values, minus twice the
logarithm of the likelihood is, but for a constant,

    3 / (A sigma^2) sum_p w_p rho_s(r_p)  +  |q|^2 / sigma^2  +  6 n log(sigma)

* A is the number of pixels whose errors go together, n = pixels / A + m the number of independent values of a
  channel. A rendering has :data:`INDEPENDENT`. A stroke is no measurement of each pixel that it covers, but a
  few statements (:data:`STATEMENTS`) of somebody who cannot paint physics.
* rho_s is Huber's loss for a rendering: quadratic up to s = sigma, linear beyond, so that pixels which no light
  can explain (caustics, shadow edges) have limited weight. Of a painted picture every residual counts by its
  square: a large one is the change that is asked for.
* q is m^(1/2) times the mean of r over what was not painted, (3,): the exposure and the colour of the rest as
  a whole. It is a statement of its own, and the pattern of the rest another (the weights w).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

INDEPENDENT = 256
"""Residuals of a rendering that count as independent, per channel: neighbouring pixels err together."""
STATEMENTS = 3.0
"""Independent values, per channel, that all paint together states."""


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of residuals.

    Attributes
    ----------
    weight : ndarray (h, w, 1)
        How much each pixel counts beside the others; 1 on average (:func:`on_average_one`).
    independent : float
        Independent values of a channel among the pixels.
    robust : bool
        Huber's loss in place of squares.
    rest : ndarray (h, w, 1) or None
        Pixels whose mean is a statement of its own, as shares in [0, 1]; None: there is none.
    mean_counts : float
        For how many independent values this mean counts.
    """

    weight: np.ndarray
    independent: float = INDEPENDENT
    robust: bool = True
    rest: np.ndarray | None = None
    mean_counts: float = 0.0

    @classmethod
    def of_paint(cls, weight: np.ndarray, coverage: np.ndarray) -> Likelihood:
        """Return the likelihood of a painted picture.

        Its paint counts for :data:`STATEMENTS`, its rest for as much more as it weighs beside the paint, and
        the mean of the rest for :data:`STATEMENTS` times the share of pixels that are rest: where nearly all
        is painted, nothing is said of an exposure that stays.

        Parameters
        ----------
        weight, coverage : ndarray (h, w, 1)
            How much each pixel counts, and was painted.
        """
        counted = weight > 0
        painted = float((weight * coverage).sum(dtype=np.float64) / weight.sum(dtype=np.float64))
        rest = (1 - coverage) * counted
        share = float(rest.sum(dtype=np.float64) / counted.sum())
        return cls(
            weight=on_average_one(weight, weight.shape[:2]),
            independent=STATEMENTS / painted if painted > 0 else STATEMENTS,
            robust=False,
            rest=rest if share > 0 else None,
            mean_counts=STATEMENTS * share,
        )

    @property
    def area(self) -> float:
        """Pixels whose errors go together, A; at least one."""
        return max(1.0, self.weight.size / self.independent)

    @property
    def values(self) -> float:
        """Independent values of a channel, n."""
        return self.independent + (0.0 if self.rest is None else self.mean_counts)

    @property
    def share(self) -> np.ndarray | float:
        """What each pixel contributes to q, (h, w, 1); 0 where there is no such statement."""
        if self.rest is None:
            return 0.0
        return np.sqrt(self.mean_counts) * self.rest / self.rest.sum(dtype=np.float64)

    def mean(self, residual: np.ndarray) -> np.ndarray:
        """Return q of a residual (h, w, 3): (3,)."""
        return (residual * self.share).sum(axis=(0, 1))

    def misfit(self, residual: np.ndarray, sigma: float) -> float:
        """Return the first two parts of the formula above."""
        size = sizes(residual)
        loss = size**2
        if self.robust:
            loss = np.where(size <= sigma, loss, sigma * (2 * size - sigma))
        mean = np.square(self.mean(residual)).sum()
        return float((3 * (self.weight * loss).sum() / self.area + mean) / sigma**2)

    def weights(self, residual: np.ndarray, sigma: float) -> np.ndarray:
        """Return the weights (h, w, 1) under which a sum of squares has the gradient of the first part."""
        weight = self.weight / (self.area * sigma**2)
        if self.robust:
            weight = weight * np.minimum(1, sigma / np.maximum(sizes(residual), 1e-12))
        return weight

    def noise(self, residual: np.ndarray, least: float) -> float:
        """Return the standard error under which the misfit is what independent values of it have, 3 n.

        The most likely one: for squares exactly, with Huber's loss as an M-estimate of scale (not his
        proposal 2). At least ``least``.
        """
        if self.misfit(residual, least) <= 3 * self.values:
            return least
        if not self.robust:
            return least * float(np.sqrt(self.misfit(residual, least) / (3 * self.values)))
        # With the n smallest r within sigma, a their sum of w r^2, and b, c those of w r and w of the others,
        # (a + 2 b sigma - c sigma^2) / (d sigma^2) is to be 1: of the n whose root lies in its range.
        size = sizes(residual)
        order = np.argsort(size, axis=None)
        r, w = (v.ravel()[order].astype(np.float64) for v in (size, self.weight))
        a = np.cumsum(np.append(0, w * r * r))
        b, c = (np.append(np.cumsum(part[::-1])[::-1], 0) for part in (w * r, w))
        d = self.area * self.values
        sigma = (b + np.sqrt(b * b + (d + c) * a)) / (d + c)
        inside = np.flatnonzero((sigma >= np.append(0, r)) & (sigma <= np.append(r, np.inf)))
        return float(max(least, sigma[inside[0]] if len(inside) else r[-1]))


def on_average_one(weight: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray:
    """Return weights (h, w, 1) whose mean is 1: where few pixels count, they are the whole picture."""
    if weight is None:
        return np.ones((*shape, 1), np.float32)
    mean = float(np.mean(weight, dtype=np.float64))
    return np.float32(weight) if abs(mean - 1) < 1e-6 else np.float32(weight / max(mean, 1e-30))


def sizes(residual: np.ndarray) -> np.ndarray:
    """Return the root mean square over the channels of every pixel, (h, w, 1)."""
    return np.sqrt((residual**2).mean(axis=2, keepdims=True))
