"""The place of a light to a fraction of a texel, by exact columns around a first guess."""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.transport.light_transport import LightTransport

SPACINGS = (2, 1)
"""Distances of the probes of :func:`refine`, texels: first five by five of them, then three by three."""
PROBES = 25
"""Exact columns that are looked at together."""
FAINT = 0.2
"""Pixels are weighted by 1 / (brightness + this share of the mean brightness)."""


def refine(
    transport: LightTransport,
    target: np.ndarray,
    known: np.ndarray,
    weight: np.ndarray | None,
    gains: np.ndarray,
    direction: np.ndarray,
    flux: np.ndarray,
    first: int,
    last: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the place of a light to a fraction of a texel, by exact columns around a first guess.

    Parameters
    ----------
    transport : LightTransport
        T; gets exact columns for the texels that are looked at.
    target : ndarray (pixels, 3)
        The picture, less all that is not this light or the background.
    known : ndarray (pixels, 3)
        The target itself.
    weight : ndarray (pixels, 1) or None
        How much each pixel counts.
    gains : ndarray (n, pixels, 3)
        Pictures that may be mixed in at will: the background under gains of low order, the glow.
    direction : ndarray (3,)
        First guess.
    flux : ndarray (3,)
        Flux of the light.
    first, last : int
        Rows it may be in.

    Returns
    -------
    direction : ndarray (3,)
        Of the best place.
    factor : ndarray (3,)
        Its flux as a factor of ``flux``.
    """
    height, width = transport.grid.height, transport.grid.width
    omega = latlong.lookup_solid_angles(height, width)
    scale = relative(known, target, weight)
    spans, rest = [], []
    for c in range(3):
        q, r = np.linalg.qr((gains[..., c] * scale).T)
        q = q[:, np.abs(np.diag(r)) > 1e-6 * np.abs(r).max()]
        spans.append(q)
        y = target[:, c] * scale
        rest.append(y - q @ (q.T @ y))

    def score(texels):
        columns = transport.probe(texels) * (flux / omega[texels // width][:, None])[:, None, :]
        found, factor = 0.0, []
        for c in range(3):
            a = (columns[..., c] * scale).T
            a = a - spans[c] @ (spans[c].T @ a)
            power, along = (a * a).sum(axis=0), a.T @ rest[c]
            found = found + np.maximum(along, 0) ** 2 / np.maximum(power, 1e-30)
            factor.append(np.maximum(along, 0) / np.maximum(power, 1e-30))
        return found, np.stack(factor, axis=1)

    row, column = (float(x) for x in latlong.texel_position(direction, height, width))
    row, column = round(row), round(column)
    for spacing, reach in zip(SPACINGS, (2, 1), strict=True):
        steps = np.arange(-reach, reach + 1) * spacing
        rows = np.unique(np.clip(row + steps, first, last))
        columns = (column + steps) % width
        between = len(np.unique(columns)) == len(columns)  # on a map of few texels the steps meet
        columns = columns if between else np.unique(columns)
        texels = (rows[:, None] * width + columns).ravel()
        found, factor = score(texels)
        best = int(found.argmax())
        row, column = divmod(int(texels[best]), width)
    # Between the texels around the best, by how much each explains.
    grid = found.reshape(len(rows), len(columns))
    i, j = np.unravel_index(best, grid.shape)
    row, column = row + _vertex(grid[:, j], i), column + (_vertex(grid[i], j) if between else 0.0)
    theta, phi = np.pi * row / (height - 1), 2 * np.pi * (column + 0.5) / width
    return latlong.on_sphere(theta, phi), factor[best]


def _vertex(values, i):
    """Return the vertex of the parabola through three neighbours, from the middle, within half a step."""
    if not 0 < i < len(values) - 1:
        return 0.0
    a, b, c = values[i - 1 : i + 2]
    bend = a - 2 * b + c
    return float(np.clip(0.5 * (a - c) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def relative(known: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Weigh pixels, or blocks of them, so that equal relative errors count alike.

    That is weight / (brightness + floor).

    Parameters
    ----------
    known, target : ndarray (..., 3)
        The picture, whose channels' mean is the brightness, and what is to be explained of it. The floor is
        :data:`FAINT` of the mean brightness; of paint on black, of the paint's own.
    weight : ndarray (..., 1), optional
        How much each pixel counts.

    Returns
    -------
    ndarray (...)
        ``weight`` itself where there is nothing at all.
    """
    bright = known.mean(axis=-1, dtype=np.float64)
    mean = bright.mean() or np.abs(target).mean()
    count = np.ones(bright.shape) if weight is None else weight[..., 0]
    return count / (bright + FAINT * mean) if mean > 0 else count


def products(d: np.ndarray, order: int) -> np.ndarray:
    """Return a basis of the polynomials up to an order on the sphere, at unit vectors d: (n, functions).

    Products of powers of x, y and z, of which z^2 = 1 - x^2 - y^2 is left out.
    """
    x, y, z = d.T
    powers = [(i, j, k) for i in range(order + 1) for j in range(order + 1 - i) for k in range(2)]
    return np.stack([x**i * y**j * z**k for i, j, k in powers if i + j + k <= order], axis=1)
