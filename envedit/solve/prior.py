"""How far a sky changes in an edit: the standard deviations behind K of ``map_problem.py``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.core.color import AXES
from envedit.representations.layers.gain import GridGain


@dataclass(frozen=True)
class SkyDifference:
    """How much the log radiance of photographed skies differs, along one of :data:`AXES`.

    The difference of two skies is a field with the covariance

        C(angle) = whole^2 + sum over degrees l >= 1 of (2 l + 1) (gradient l^-falloff)^2 P_l(cos angle),

    as ``python -m experiments natural.skies`` measures it: a factor for the whole sky, two gradients, and
    little else.
    """

    whole: float
    gradient: float
    falloff: float

    def covariance(self, cosine: np.ndarray, freedom: float, factor: float) -> np.ndarray:
        """Return freedom^2 C at angles given by cosines; ``whole`` is multiplied by ``factor`` instead."""
        degree = np.arange(1, DEGREES + 1)
        series = (2 * degree + 1) * (freedom * self.gradient * degree**-self.falloff) ** 2
        whole = factor * self.whole
        return np.polynomial.legendre.legval(cosine, np.append(whole**2, series))


DEGREES = 32
"""Highest degree of the fields: beyond the gain's finest grid, which has 12 cycles around the horizon."""
PHOTOGRAPHED = (
    SkyDifference(whole=1.17, gradient=0.399, falloff=1.2),
    SkyDifference(whole=0.356, gradient=0.142, falloff=2.2),
    SkyDifference(whole=0.076, gradient=0.016, falloff=1.6),
)
"""Along luminance, blue-amber and green-magenta; nine maps (``python -m experiments natural.skies run``)."""
LEAST_WHOLE_FREEDOM = 0.25
"""Least freedom of one factor for the whole sky: photographs differ in exposure as their makers chose it."""
LEAST_VARIANCE = 1e-6
"""Variance of nodes of grids that do not take part: they stay at 0. And the share of the variance at a node
that is its own, so that nodes at one place differ; and of a freedom of 0, in units of how skies differ."""


@dataclass(frozen=True)
class Prior:
    """How far a sky changes: standard deviations, the same for every scene and map.

    Those of a rendered target, which may be of quite another sky; of a painted one see :func:`of_paint`.
    """

    luminance: float = 1.0  # of the mean log gain on the coarsest grid: 1 is a factor of e
    chroma: float = 0.3  # of its blue-amber difference, along which daylight varies: 0.3 is 30 %
    tint: float = 0.1  # of its green-magenta difference, which skies hardly have
    flux: float = 1.5  # of a light's mean log flux; for the map's own lights around their original flux
    # Of the blue-amber difference of a light's log flux: from the horizon to high above it, that of the sun
    # changes by a factor of e and more. Green-magenta is as of the sky
    flux_chroma: float = 1.0
    turn: float = np.radians(10.0)  # of a light's direction, radians from where the search has put it
    # size, added_size: of a light's log size: of the map's own, and of a light that is added, which may be
    # haze or a sun
    size: float = 0.3
    added_size: float = 1.0
    saturation: float = 1.0  # of the log saturation of the sky's colours
    # How far the gain may go, in units of how photographed skies differ (:data:`PHOTOGRAPHED`); None: as
    # ``luminance``, ``chroma`` and ``tint`` say, node by node
    freedom: float | None = None
    factor: float = LEAST_WHOLE_FREEDOM  # the same of one factor for the whole sky, where ``freedom`` is set

    def gain_precisions(self, gain: GridGain, ground: bool = False) -> np.ndarray:
        """Return the inverse covariance of the nodes' log gain along luminance, chroma and tint: (3, n, n).

        With :attr:`freedom` the nodes of the finest grid differ as photographed skies do, times freedom, and
        coarser grids, which it contains, stay at 0; without, every node has its own standard deviation.
        ``ground``: the last node is the factor of ground, which changes as a coarse node of the sky.
        """
        coarse = [rows * columns for rows, columns in gain.sizes]
        if self.freedom is None:
            fall = np.concatenate([np.full(count, 0.5**i) for i, count in enumerate(coarse)])
            fall = np.append(fall, 1.0) if ground else fall
            deviations = np.sqrt(3) * self.luminance, self.chroma, self.tint
            return np.stack([np.diag((deviation * fall) ** -2.0) for deviation in deviations])
        directions = gain.directions(len(gain.sizes) - 1)
        cosine = np.clip(directions @ directions.T, -1, 1)
        first, last = sum(coarse[:-1]), sum(coarse)
        precisions = np.zeros((3, last + ground, last + ground))
        for precision, skies in zip(precisions, PHOTOGRAPHED, strict=True):
            covariance = skies.covariance(cosine, max(self.freedom, np.sqrt(LEAST_VARIANCE)), self.factor)
            covariance[np.diag_indices_from(covariance)] *= 1 + LEAST_VARIANCE
            precision[first:last, first:last] = np.linalg.inv(covariance)
            precision[np.arange(first), np.arange(first)] = 1 / LEAST_VARIANCE
            precision[last:, last:] = (self.factor * skies.whole) ** -2.0
        return precisions

    @property
    def flux_precision(self) -> np.ndarray:
        """Inverse covariance of a light's log flux per channel, (3, 3)."""
        sd = np.array([np.sqrt(3) * self.flux, self.flux_chroma, self.tint])
        return AXES.T @ (sd[:, None] ** -2.0 * AXES)


def of_paint(freedom: float, coverage: np.ndarray | None = None) -> Prior:
    """Return the prior of painted targets, of a freedom in units of how photographed skies differ.

    One factor for the whole sky is as free as the picture is painted: ``coverage`` (h, w, 1) is how much each
    pixel was, None: nothing. The colour of a light changes as that factor's.
    """
    painted = 0.0 if coverage is None else float(coverage.mean(dtype=np.float64))
    factor = max(LEAST_WHOLE_FREEDOM, freedom, painted)
    _, chroma, tint = (factor * skies.whole for skies in PHOTOGRAPHED)
    return Prior(tint=tint, flux_chroma=chroma, freedom=freedom, factor=factor)
