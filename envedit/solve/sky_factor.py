"""By which factor the whole sky has become brighter or darker, a channel at a time.

It is what an edit of a network starts from: a sigmoid of the map's own range reaches no brighter sky
(:mod:`envedit.representations.siren.siren`).
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from envedit.core.radiance import BRIGHTEST
from envedit.solve import turning
from envedit.solve.likelihood import INDEPENDENT
from envedit.transport.light_transport import LightTransport

STOPS = np.arange(-80, 81) / 8
"""Factors that are tried, as powers of two. Derived: half a step, 4 %, is what an edit's own steps reach."""


def find(
    transport: LightTransport,
    envmap: np.ndarray,
    active: np.ndarray,
    picture: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Return the factor of each channel under which some texels of a map explain a picture best, (3,).

    ``envmap`` (H, W, 3) and ``picture`` (h, w, 3) are linear radiance, ``active`` (H, W) says which texels,
    ``weight`` (h, w, 1) how much each pixel counts. A factor other than 1 could have been any of those tried:
    with m the mean squared display residual of a channel, and N independent values of it
    (:data:`.likelihood.INDEPENDENT`, at most one a pixel), it needs N ln(m_1 / m) > 2 ln(number of factors).
    No texel becomes brighter than :data:`.radiance.BRIGHTEST`.
    """
    # ---- What these texels give the rendering, and all else: a sun by exact columns
    transport = transport.resolved(envmap)
    others = np.where(active[..., None], 0, envmap).astype(np.float32)
    still = transport.apply(mi.TensorXf(others)).numpy()
    lit = transport.apply(mi.TensorXf(envmap)).numpy() - still

    # ---- The misfit under every factor
    brightest = float(envmap[active].max(initial=0))
    most = max(BRIGHTEST / brightest, 1.0) if brightest > 0 else np.inf
    factors = 2.0**STOPS
    factors = factors[factors <= most]
    wanted = turning.display_values(picture)

    def misfit(factor):
        seen = turning.display_values(still + np.float32(factor) * lit)
        return (np.square(seen - wanted) * weight).mean(axis=(0, 1))

    misfits = np.array([misfit(factor) for factor in factors])
    misfits = np.where(np.isfinite(misfits), misfits, np.inf)

    # ---- The best, where it is likelier than none
    best = misfits.argmin(axis=0)
    least = misfits[best, range(3)]
    unchanged = misfits[factors == 1][0]
    independent = min(INDEPENDENT, picture.shape[0] * picture.shape[1])
    cost = 2 * np.log(len(factors)) / independent
    likelier = least * np.exp(cost) < unchanged
    return np.where(likelier, factors[best], 1.0)
