"""Which texels of a map are too bright for samples that are spread evenly over directions.

The relative error of such samples, for a map of radiance E, is the standard deviation of E over its mean,
both by solid angle, over the root of their number.
"""

from __future__ import annotations

import numpy as np


def error(radiance: np.ndarray, omega: np.ndarray, samples: float, rest: np.ndarray) -> float:
    """Predict the error of some ``samples`` when only the texels ``rest``, bool (n,), are left to them.

    ``radiance`` and ``omega`` (n,) are radiance and solid angle of every texel; those not in ``rest`` are
    rendered without error. Relative to the light of all texels; 0 where there is none.
    """
    total = (radiance * omega).sum()
    e = radiance[rest]
    w = omega[rest]
    if not (total > 0 and w.sum() > 0):
        return 0.0
    variance = max((e * e * w).sum() - (e * w).sum() ** 2 / w.sum(), 0) * omega.sum()
    return float(np.sqrt(variance / samples) / total)


def brightest(radiance: np.ndarray, omega: np.ndarray, samples: float, tolerance: float) -> np.ndarray:
    """List the fewest texels without which the :func:`error` is at most ``tolerance``, brightest first."""
    total = (radiance * omega).sum()
    span = omega.sum()
    if not total > 0:
        return np.zeros(0, np.int64)
    order = np.argsort(-radiance, kind="stable")
    # Variance of what is left when the first k are taken out, k = 0 ... n.
    e, w = radiance[order], omega[order]
    square = _total_from(e * e * w)
    linear = _total_from(e * w)
    weight = _total_from(w)
    variance = np.maximum(square - linear**2 / np.maximum(weight, 1e-30), 0) * span
    enough = np.flatnonzero(np.sqrt(variance / samples) / total <= tolerance)
    return order[: enough[0] if len(enough) else len(order)]


def _total_from(x):
    """Sum of x[k:] for k = 0 ... len(x)."""
    return np.concatenate([np.cumsum(x[::-1])[::-1], [0.0]])
