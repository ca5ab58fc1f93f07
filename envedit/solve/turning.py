"""By how much the whole sky has turned about the vertical, if it has.

Every turn by whole texels is tried through the block transport; the best ones are rendered by Mitsuba, all
with the same samples, and refined to a fraction of a texel. T is not used for that: how far it errs depends
on where the sun stands. The misfit is the mean over pixels of the residual of display values, not of its
square: a few bright specks of caustics, which no two renderings share, do not decide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.losses import display_curve
from envedit.solve.likelihood import INDEPENDENT, SIGMA, sizes
from envedit.transport.light_transport import LightTransport

TURNS_RENDERED, TURNS_APART_TEXELS = 3, 4
"""Turns that are rendered, and by how many texels they differ at least."""
EXPLAINED = 0.5
"""Share of the residual that a turn leaves at most where it explains the target."""
BLOCK_ERROR_FACTOR = 2.0
"""Multiples of the block transport's own error up to which a turn may explain the target, too."""
FINEST_TEXELS = 0.02
"""Finest turn in texels."""
WHOLE_TEXEL_DEVIATIONS = 3.0
"""A turn by whole texels is preferred up to so many standard errors of the turn's fraction of a texel: texels
keep their bits then."""


@dataclass(frozen=True)
class Turn:
    """A turn of the sky."""

    degrees: float  # as for :func:`.latlong.rotate`
    # error, still: display residual, as of :func:`apart`, with the turn alone and without
    error: float
    still: float
    # The share of the residual of blocks that the turn leaves, beyond what the block transport errs by
    blocks: float = np.inf
    alike: float = 1.0  # how many turns by whole texels are about as likely: the sum of their likelihoods

    @property
    def left(self) -> float:
        """Share of the residual that the turn leaves: by pixels, or by blocks where noise hides it there."""
        return min(self.error / self.still, self.blocks) if 0 < self.still < np.inf else np.inf


def find(
    transport: LightTransport,
    render: Callable[[np.ndarray, int], np.ndarray],
    envmap: np.ndarray,
    picture: np.ndarray,
    weight: np.ndarray,
    thorough: bool = True,
) -> Turn:
    """Find the turn of a map that explains a picture best.

    ``render(envmap, k)`` renders a map (H, W, 3) to (h, w, 3), linear radiance, with the same samples each
    time, those of the integer k from 0. ``picture`` (h, w, 3) is the target, ``weight`` (h, w, 1) how much
    each pixel counts. ``thorough``: turns are rendered in any case; otherwise only where the block transport
    shows that one explains it (:data:`EXPLAINED`, :data:`BLOCK_ERROR_FACTOR`).
    """
    width = envmap.shape[1]
    rendering = render(envmap, 0)
    known = {0.0: apart(rendering, picture, weight)}

    # ---- Turns by whole texels, through the block transport
    misfit, least = _at_a_glance(transport, envmap, picture, weight, rendering)
    explains = misfit.min() <= max(EXPLAINED**2 * misfit[0], BLOCK_ERROR_FACTOR**2 * least)
    if not (thorough or explains):
        return Turn(degrees=0.0, error=known[0.0], still=known[0.0])
    best: list[int] = []
    for shift in np.argsort(misfit, kind="stable"):
        apart_by = [min(abs(shift - other), width - abs(shift - other)) for other in best]
        if len(best) < TURNS_RENDERED and (not apart_by or min(apart_by) >= TURNS_APART_TEXELS):
            best.append(int(shift))

    # ---- The best of them rendered, and refined
    def error(texels):
        texels = round(texels % width / FINEST_TEXELS) * FINEST_TEXELS % width
        if texels not in known:
            known[texels] = apart(render(latlong.rotate(envmap, 360 * texels / width), 0), picture, weight)
        return known[texels]

    sure = error(best[0]) < EXPLAINED * known[0.0]
    texels: float = best[0] if sure else min(best, key=error)
    for step in (2.0,) if sure else (4.0, 2.0):
        texels = min((texels, texels - step, texels + step), key=error)
    while (nearer := min((texels, texels - 1, texels + 1), key=error)) != texels:
        texels = nearer

    # ---- A fraction of a texel, where noise does not leave it open
    for side in (1, -1):
        maps = [latlong.rotate(envmap, 360 * (texels + k) / width) for k in (0, side)]
        part, deviation = _fraction(render, maps, picture, weight)
        if part > 0:
            break
    part = min(max(part, 0.0), 1.0)
    texels += side * (part if abs(part - round(part)) > WHOLE_TEXEL_DEVIATIONS * deviation else round(part))
    texels = round(texels / FINEST_TEXELS) * FINEST_TEXELS % width
    blocks = np.inf
    if least < misfit[0] < np.inf:
        blocks = float(np.sqrt(max(misfit.min() - least, 0) / (misfit[0] - least)))
    return Turn(
        degrees=360 * texels / width,
        error=error(texels),
        still=error(0.0),
        blocks=blocks,
        alike=_alike(misfit),
    )


def _alike(misfit):
    """Return the sum of likelihoods over that of the best turn, by misfits (W,) of :func:`_at_a_glance`."""
    least = misfit.min()
    return float(np.exp(-1.5 * INDEPENDENT * (misfit - least) / max(least, SIGMA**2)).sum())


def _fraction(render, maps, picture, weight):
    """Return how far a picture is on the way from one map to another, and the standard error of that.

    Between them the map is linear in the fraction f: d(t) = d(a) + f (d(b) - d(a)). Both are rendered twice,
    as in a product of differences with independent noise that noise is no bias.
    """
    (a1, b1), (a2, b2) = ([display_values(render(envmap, k)) for envmap in maps] for k in (0, 1))
    target = display_values(picture)
    lengths = weight * (b1 - a1) * (b2 - a2)
    towards = weight * ((target - a1) * (b2 - a2) + (target - a2) * (b1 - a1)) / 2
    if not lengths.sum() > 0:
        return 0.0, np.inf
    part = float(towards.sum() / lengths.sum())
    left = (towards - part * lengths).sum(axis=2)
    return part, float(np.sqrt(np.square(left).sum()) / lengths.sum())


def apart(rendering: np.ndarray, picture: np.ndarray, weight: np.ndarray) -> float:
    """Return a rendering's display residual, RMS over channels and mean over pixels; inf if it is not finite.

    ``rendering`` and ``picture`` (h, w, 3) are linear radiance; ``weight`` (h, w, 1): how much each pixel
    counts.
    """
    mean = (sizes(residuals(rendering, picture)) * weight).mean() / max(float(weight.mean()), 1e-30)
    return float(mean) if np.isfinite(mean) else np.inf


def residuals(rendering: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Return display values of a rendering less those of a picture, (h, w, 3) float64 both."""
    return display_values(rendering) - display_values(picture)


def display_values(picture: np.ndarray) -> np.ndarray:
    """Return display values of a picture (h, w, 3), linear radiance, as float64."""
    return display_curve.values(picture).astype(np.float64)


def _at_a_glance(transport, envmap, picture, weight, rendering):
    """Return the mean squared display residual of blocks under each turn by whole texels, (W,).

    And that of the map as it is from its own rendering: the error of the block transport.
    """
    overview = transport.overview()
    height, width, _ = envmap.shape
    target, own = (overview.to_blocks(display_curve.values(one)) for one in (picture, rendering))
    share = overview.to_blocks(np.float64(weight))
    lamps = overview.to_blocks(transport.other_light())
    omega = np.repeat(latlong.lookup_solid_angles(height, width), width).reshape(height, width)
    # By rows of texels first: a turn keeps them.
    column = overview.cell_of.reshape(height, width)
    first = column[:, 0]
    across = int(column[0].max()) + 1
    tile = -(-width // across)
    band = np.zeros((first.max() // across + 1, width, 3))
    np.add.at(band, first // across, envmap * omega[..., None])
    result, least = np.zeros(width), 0.0
    starts = np.arange(0, width, tile)
    for c in range(3):
        turned = np.stack([np.add.reduceat(np.roll(band[..., c], -k, 1), starts, 1) for k in range(width)], 2)
        means = turned.reshape(overview.cells, width) / overview.omega[:, None]
        blocks = overview.matrix[c] @ means.astype(np.float32) + lamps[:, c : c + 1]
        shown = display_curve.values(blocks)
        result += (share * np.square(shown - target[:, c : c + 1])).sum(axis=0)
        least += float((share[:, 0] * np.square(shown[:, 0] - own[:, c])).sum())
    values = max(3 * float(share.sum()), 1e-30)
    return np.where(np.isfinite(result), result / values, np.inf), least / values
