r"""How fine a gain a picture determines: octaves of detail beyond the coarse ones, where they can be seen.

A mirror shows the clouds themselves, a matte thing only that there is light above it. A gain that is finer
than what is identifiable from the picture follows noise; one that is coarser cannot make a mirror's picture.
What is identifiable is measured with T. Let J be the derivative of the picture, as a display shows it and in
units of its noise, by the logarithm of the background's texels. A pattern v of log gain is identifiable if

    F(v) = |J v|^2 = E_z[(v' J' z)^2],  z = +-1 at random in every pixel and channel,

is more than one for a contrast that would matter. The patterns asked about alternate from node to node of an
octave's grid within a small patch, so that what a coarser octave can say does not count. The noise of T would
count too: a matte pixel's few hundred samples look like so many small mirrors. So the square is a product, of
J' z through T and through a second, independent recording of it.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.seeds import SIGNS
from envedit.losses import display_curve
from envedit.representations.layers.gain import Octave, grid_size, splines
from envedit.solve.likelihood import SIGMA
from envedit.transport.light_transport import LightTransport

PROBES = 8
"""Random z; what is averaged over them, three patterns and the nodes of a patch is within 40 %."""
HALF_KNOWN_LOG_GAIN = 0.1
"""Contrast of detail, in log gain, that counts as half known where its F is 1: known is F^2 / (F^2 + 1)."""
MIRRORED_SHARE, LEAST_SHARE = 0.8, 0.02
"""Shares of the sky's solid angle in which detail must be identifiable: of the first octave, as in a mirror,
and of further ones. In glossy scenes less of it is; there finer grids made maps worse (matpreview,
principled: by 1 to 4 dB), with colours that no sky has."""


def octaves(
    transport: LightTransport,
    second: LightTransport,
    background: np.ndarray,
    rows: tuple[int, int],
    picture: np.ndarray,
    weight: np.ndarray,
    coarsest: int,
) -> list[Octave]:
    """Measure the octaves of detail that a picture determines.

    Parameters
    ----------
    transport, second : LightTransport
        T, and an independent recording of it.
    background : ndarray (n, W, 3)
        The active rows without their lights.
    rows : (int, int)
        First active row, rows of the map.
    picture : ndarray (h, w, 3)
        The target, linear radiance.
    weight : ndarray (h, w, 1)
        How much each pixel counts.
    coarsest : int
        Cycles of the coarsest octave asked about; each further one has twice as many, up to one node a texel.

    Returns
    -------
    list of Octave
        Coarse to fine; ends before the first that is identifiable too little (:data:`MIRRORED_SHARE`,
        :data:`LEAST_SHARE`).
    """
    height, width, _ = background.shape
    slope = display_curve.slope(picture) / SIGMA * np.sqrt(weight)
    omega = latlong.solid_angles(rows[1], width)[rows[0] : rows[0] + height]
    identified: list[Octave] = []
    cycles = coarsest
    while 2 * cycles <= width:
        size = grid_size(cycles, height / rows[1])
        down, across = splines(size, (height, width))
        least = LEAST_SHARE if identified else MIRRORED_SHARE
        around = down.T @ omega
        total = np.zeros(size)
        # Drawn anew for each octave: of a large map all of them together would take gigabytes.
        for pair in _pulled_back(transport, second, slope, background, rows[0]):
            on_nodes = [np.einsum("yr,yxc,xk->rkc", down, a, across, optimize=True) for a in pair]
            total += _alternating(*on_nodes)
        # Where nothing is identifiable, a product of two estimates may well be negative.
        information = np.maximum(_smooth(total / PROBES), 0) * HALF_KNOWN_LOG_GAIN**2
        known = information**2 / (information**2 + 1)
        share = float((known.mean(axis=1) * around).sum() / around.sum())
        if share < least:
            break
        identified.append(Octave(size, known, share))
        cycles *= 2
    return identified


def _pulled_back(transport, second, slope, background, first):
    """Yield :data:`PROBES` pairs of J' z, (n, W, 3) each, through T and through a second recording of it."""
    rng = np.random.default_rng(SIGNS)
    for _ in range(PROBES):
        z = mi.TensorXf((rng.choice([-1.0, 1.0], slope.shape) * slope).astype(np.float32))
        rows = slice(first, first + len(background))
        pulled = (recording.adjoint(z).numpy()[rows] for recording in (transport, second))
        yield [one.astype(np.float64) * background for one in pulled]


def _alternating(first, second):
    """Product of two estimates (rows, columns, 3) of patterns that alternate by row, column and both."""
    rows, columns, _ = first.shape
    by_row, by_column = (-1.0) ** np.arange(rows)[:, None], (-1.0) ** np.arange(columns)[None]
    total = np.zeros((rows, columns))
    for sign in (by_row + 0 * by_column, by_column + 0 * by_row, by_row * by_column):
        a, b = (_smooth(sign[..., None] * one) for one in (first, second))
        total += (a * b).mean(axis=2)
    return total / 3


def _smooth(values):
    """Sum over a patch: weights 1/2, 1, 1/2 down and around."""
    wrapped = values + 0.5 * (np.roll(values, 1, 1) + np.roll(values, -1, 1))
    padded = np.concatenate([wrapped[:1], wrapped, wrapped[-1:]])
    return padded[1:-1] + 0.5 * (padded[:-2] + padded[2:])
