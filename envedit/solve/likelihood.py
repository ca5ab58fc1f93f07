"""How likely a rendering is for a target: independent values, their noise, and what was not painted.

With r_p the root mean square over the channels of a pixel's residual of display values, minus twice the
logarithm of the likelihood is, but for a constant,

    3 / (A sigma^2) sum_p w_p rho_s(r_p)  +  6 n log(sigma)  +  3 N rho_1(q)

* A is the number of pixels whose errors go together, n = pixels / A the number of independent values of a
  channel. A rendering has :data:`INDEPENDENT`. A stroke is no measurement of each pixel that it covers, but a
  few statements (:data:`STATEMENTS`) of somebody who cannot paint physics.
* sigma is the most likely one, at least that of the target; of paint at most :data:`PAINT_NOISE` times the
  change that was painted, or paint that can be followed in part only would be taken for noise.
* rho_s is Huber's loss: quadratic up to s, linear beyond. Of a rendering s = sigma, so that pixels which no
  light can explain (caustics, shadow edges) have limited weight. Of a painted picture every residual counts
  by its square: a large one is the change that is asked for.
* What was not painted makes two statements. Its pattern (shading, highlights, shadows) has weights w that
  are smaller than those of paint, and may follow it. Its mean, which is its exposure and colour as a whole,
  stays to :data:`VISIBLE`, farther only where paint gains by it: a light that is painted lights the rest as
  well. q is the root mean square over the channels of the mean residual over that, times the root of the
  share of pixels that were not painted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from envedit.core.color import brightest_shown
from envedit.losses import display_curve
from envedit.targets.target import Target

SIGMA = 0.005
"""Standard error of display values that a pixel is known to, where it was not measured. Measured: with twice
of it thirty edits of ``experiments natural`` lose 0.2 dB of the rendering and 0.5 of the map."""
INDEPENDENT = 256
"""Residuals of a rendering that count as independent, per channel: neighbouring pixels err together."""
STATEMENTS = 3.0
"""Independent values, per channel, that all paint together states."""
PAINT_NOISE, FOLLOWED = 0.3, 0.2
"""Largest standard errors of paint, as shares of the change that it asks for, as no map makes all of what is
painted: by which explanations of it are compared, and down to which the likeliest follows it
(``docs/decisions/experiment_painted_likelihood.md`` has what other values do)."""
VISIBLE = 0.02
"""Mean change of display values from which on a change of what was not painted counts as visible."""


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of residuals."""

    # (h, w, 1), how much each pixel counts beside the others; 1 on average (:func:`on_average_one`)
    weight: np.ndarray
    independent: float = INDEPENDENT  # independent values of a channel among the pixels
    least_noise: float = SIGMA  # standard error that display values have at least
    # Largest standard error of paint by which explanations are compared, of display values; None: a rendering
    paint_noise: float | None = None
    # (h, w, 1), how much each pixel is of the rest, in [0, 1], whose mean is to stay; None: there is none
    rest: np.ndarray | None = None
    # Radiance from which on all was shown white, where nobody saw differences (``display_curve.py``)
    white: float = np.inf

    @classmethod
    def of_paint(
        cls, weight: np.ndarray, coverage: np.ndarray, initial: np.ndarray, picture: np.ndarray
    ) -> Likelihood:
        """Return the likelihood of a painted picture; its rest counts for as much as it weighs beside paint.

        ``weight`` and ``coverage`` (h, w, 1) say how much each pixel counts, and was painted; ``initial`` and
        ``picture`` (h, w, 3) are what was painted on, and the painted picture, linear radiance.
        """
        # Weights are a c + b (1 - c): b is that of pixels without paint.
        bare = weight[(coverage <= 0) & (weight > 0)]
        of_rest = float(bare[0]) * (1 - coverage) if bare.size else 0.0
        of_paint = np.maximum(weight - of_rest, 0).astype(np.float64)
        painted = float(of_paint.sum() / weight.sum(dtype=np.float64))
        rest = (1 - coverage) * (weight > 0)
        white = max(1.0, brightest_shown(initial))
        return cls(
            weight=on_average_one(weight),
            independent=STATEMENTS / painted if painted > 0 else STATEMENTS,
            paint_noise=PAINT_NOISE * _painted_change(of_paint, initial, picture, white),
            rest=rest if rest.any() else None,
            white=white,
        )

    @classmethod
    def of_target(cls, target: Target) -> Likelihood:
        """Return that of a target's residuals: of a rendering, or of paint where it has coverage.

        Display values have the standard error of the target, at least :data:`SIGMA`.
        """
        if target.coverage is None:
            likelihood = cls(on_average_one(target.weight))
        else:
            likelihood = cls.of_paint(target.weight, target.coverage, target.initial, target.picture)
        if target.noise is None:
            return likelihood
        return replace(likelihood, least_noise=max(SIGMA, float(np.median(target.noise))))

    @property
    def painted(self) -> bool:
        """Whether residuals are those of paint: they count by their squares, and their noise is bounded."""
        return self.paint_noise is not None

    @property
    def largest_noise(self) -> float:
        """Largest standard error of display values: of paint, what is meant to no more than this."""
        return np.inf if self.paint_noise is None else max(self.least_noise, self.paint_noise)

    @property
    def followed_noise(self) -> float:
        """The same towards which the likeliest explanation is followed."""
        least = self.least_noise
        return np.inf if self.paint_noise is None else max(least, FOLLOWED / PAINT_NOISE * self.paint_noise)

    @property
    def area(self) -> float:
        """Pixels whose errors go together, A; at least one."""
        return max(1.0, self.weight.size / self.independent)

    @property
    def unpainted(self) -> float:
        """Share of the pixels that count that were not painted; 0 of a rendering."""
        if self.rest is None:
            return 0.0
        return float(self.rest.sum(dtype=np.float64)) / np.count_nonzero(self.weight)

    @property
    def share(self) -> np.ndarray:
        """What each pixel contributes to q, (h, w, 1)."""
        if self.rest is None:
            return np.zeros_like(self.weight)
        total = self.rest.sum(dtype=np.float64)
        return (np.sqrt(self.unpainted) / (VISIBLE * total) * self.rest).astype(np.float32)

    def mean(self, residual: np.ndarray) -> np.ndarray:
        """Return what q is the size of, of a residual (h, w, 3): (3,)."""
        return (residual * self.share).sum(axis=(0, 1))

    def linear_mean(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return :attr:`share` and :meth:`mean`, so scaled that |mean|^2 has the last part's gradient."""
        mean = self.mean(residual)
        scale = np.sqrt(STATEMENTS) * max(1.0, float(_size(mean))) ** -0.5
        return scale * self.share, scale * mean

    def misfit(self, residual: np.ndarray, sigma: float) -> float:
        """Return the first and the last part of the formula above."""
        return self._pixels(residual, sigma) + float(of_mean(self.mean(residual)))

    def _pixels(self, residual, sigma):
        size = sizes(residual)
        loss = size**2 if self.painted else huber(size, sigma)
        return float(3 * (self.weight * loss).sum() / (self.area * sigma**2))

    def weights(self, residual: np.ndarray, sigma: float) -> np.ndarray:
        """Return the weights (h, w, 1) under which a sum of squares has the gradient of the first part."""
        weight = self.weight / (self.area * sigma**2)
        if not self.painted:
            weight = weight * np.minimum(1, sigma / np.maximum(sizes(residual), 1e-12))
        return weight

    def noise(self, residual: np.ndarray, largest: float | None = None) -> float:
        """Return the standard error under which the first part is what independent values of it have, 3 n.

        The most likely one: for squares exactly, with Huber's loss as an M-estimate of scale (not his
        proposal 2). At least :attr:`least_noise`, of paint at most ``largest``, by default
        :attr:`largest_noise`.
        """
        least = self.least_noise
        ratio = self._pixels(residual, least) / (3 * self.independent)
        if ratio <= 1:
            return least
        if self.painted:
            return float(min(np.sqrt(ratio) * least, self.largest_noise if largest is None else largest))
        # With the n smallest r within sigma, a their sum of w r^2, and b, c those of w r and w of the others,
        # (a + 2 b sigma - c sigma^2) / (d sigma^2) is to be 1: of the n whose root lies in its range.
        size = sizes(residual)
        order = np.argsort(size, axis=None)
        r, w = (v.ravel()[order].astype(np.float64) for v in (size, self.weight))
        a = np.cumsum(np.append(0, w * r * r))
        b, c = (np.append(np.cumsum(part[::-1])[::-1], 0) for part in (w * r, w))
        d = self.area * self.independent
        sigma = (b + np.sqrt(b * b + (d + c) * a)) / (d + c)
        inside = np.flatnonzero((sigma >= np.append(0, r)) & (sigma <= np.append(r, np.inf)))
        return float(max(least, sigma[inside[0]] if len(inside) else r[-1]))

    def at_best(self, residual: np.ndarray) -> float:
        """Return the formula above at the most likely noise."""
        sigma = self.noise(residual)
        return self.misfit(residual, sigma) + 6 * self.independent * float(np.log(sigma))


def _painted_change(weight, initial, picture, white):
    """Return the root mean square change of display values, where it is visible; at least what is."""
    shown = (display_curve.values(np.float32(one), white) for one in (initial, picture))
    size = sizes(np.subtract(*shown, dtype=np.float64))
    weight = np.where(size > VISIBLE, weight, 0)
    total = weight.sum()
    return float(np.sqrt((weight * size**2).sum() / total)) if total > 0 else VISIBLE


def on_average_one(weight: np.ndarray) -> np.ndarray:
    """Return weights (h, w, 1) whose mean is 1: where few pixels count, they are the whole picture."""
    mean = float(np.mean(weight, dtype=np.float64))
    scale = 1.0 if abs(mean - 1) < 1e-6 else 1 / max(mean, 1e-30)
    return np.asarray(weight * scale, np.float32)


def sizes(residual: np.ndarray) -> np.ndarray:
    """Return the root mean square over the channels of every pixel, (h, w, 1)."""
    return _size(residual)[..., None]


def huber(size: np.ndarray, limit: float) -> np.ndarray:
    """Return Huber's loss of sizes: their squares up to a limit, linear beyond."""
    return np.where(size <= limit, size**2, limit * (2 * size - limit))


def of_mean(mean: np.ndarray) -> np.ndarray:
    """Return the last part of the formula above, of means (..., 3) as of :meth:`Likelihood.mean`."""
    return 3 * STATEMENTS * huber(_size(mean), 1.0)


def _size(values):
    return np.sqrt(np.square(values).mean(axis=-1))
