"""How far a sky changes in an edit: the standard deviations behind K of ``map_problem.py``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

AXES = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Luminance, blue-amber and green-magenta, as unit vectors of log RGB."""


SKIES = (np.sqrt(3) * 0.69, np.sqrt(3) * 0.244, 1.2), (0.37, 0.145, 2.1), (0.078, 0.015, 1.3)


def field_covariance(cosine, whole, gradient, power, degrees=32):
    """whole^2 + sum over degrees l of (2 l + 1) (gradient l^-power)^2 P_l."""
    l = np.arange(1, degrees + 1)
    series = (2 * l + 1) * (gradient * l**-power) ** 2
    return np.polynomial.legendre.legval(cosine, np.concatenate([[whole**2], series]))


@dataclass(frozen=True)
class Prior:
    """How far a sky changes: standard deviations, the same for every scene and map.

    Those of a rendered target, which may be of quite another sky; :data:`PAINTED` are those of a painted one.

    Attributes
    ----------
    luminance : float
        Of the mean log gain on the coarsest grid: 1 is a factor of e.
    chroma : float
        Of its blue-amber difference, along which daylight varies: 0.3 is 30 %.
    tint : float
        Of its green-magenta difference, which skies hardly have.
    flux : float
        Of a light's mean log flux; for the map's own lights around their original flux.
    flux_chroma : float
        Of the blue-amber difference of a light's log flux: from the horizon to high above it, that of the sun
        changes by a factor of e and more. Green-magenta is as of the sky.
    turn : float
        Of a light's direction, radians from where the search has put it.
    size, added_size : float
        Of a light's log size: of the map's own, and of a light that is added, which may be haze or a sun.
    saturation : float
        Of the log saturation of the sky's colours.
    """

    luminance: float = 1.0
    chroma: float = 0.3
    tint: float = 0.1
    flux: float = 1.5
    flux_chroma: float = 1.0
    turn: float = np.radians(10.0)
    size: float = 0.3
    added_size: float = 1.0
    saturation: float = 1.0

    freedom: float | None = None

    def gain_precisions(self, gain, ground: bool = False) -> np.ndarray:
        """Return the inverse covariance of the nodes' log gain along luminance, chroma and tint: (3, n, n).

        ``ground``: the last is the factor of ground, which changes as a coarse node of the sky.
        """
        sizes = gain.sizes
        if self.freedom is None:
            fall = np.concatenate([np.full(rows * columns, 0.5**i) for i, (rows, columns) in enumerate(sizes)])
            fall = np.append(fall, 1.0) if ground else fall
            return np.stack(
                [np.diag((sd * fall) ** -2.0) for sd in (np.sqrt(3) * self.luminance, self.chroma, self.tint)]
            )
        d = gain.directions(len(sizes) - 1)
        cosine = np.clip(d @ d.T, -1, 1)
        count = sum(rows * columns for rows, columns in sizes)
        found = np.zeros((3, count + ground, count + ground))
        first = count - len(d)
        for one, (whole, gradient, power) in zip(found, SKIES, strict=True):
            covariance = field_covariance(cosine, whole, max(self.freedom, 0.01) * gradient, power)
            covariance += 1e-6 * np.eye(len(d)) * whole**2
            one[first:count, first:count] = np.linalg.inv(covariance)
            one[np.arange(first), np.arange(first)] = 1e6
            if ground:
                one[count, count] = 1 / whole**2
        return found

    @property
    def flux_precision(self) -> np.ndarray:
        """Inverse covariance of a light's log flux per channel, (3, 3)."""
        sd = np.array([np.sqrt(3) * self.flux, self.flux_chroma, self.tint])
        return AXES.T @ (sd[:, None] ** -2.0 * AXES)


PAINTED = Prior(freedom=0.25, chroma=Prior.chroma / 3, tint=Prior.tint / 3, flux_chroma=Prior.chroma / 3)
"""Of painted targets: paint that asks for another brightness is no reason for another colour of the sky.

In colour a third of what a rendered target may change, and of a light as much as of the sky.
"""
