"""How strongly pixels without paint are held, where ``target.hold`` is "auto".

Paint and the rest, of the pixels that count, have the same weight at first. The rest gains weight until it is
not visibly changed: a rough surface shows a small highlight only under a sky so bright that the whole picture
pales.
"""

from __future__ import annotations

import numpy as np

from envedit import config
from envedit.core.color import tonemap
from envedit.solve.likelihood import VISIBLE

RAISE, LARGEST_HOLD = 2.0, 256.0
"""Factor by which the weight is raised at once, and the largest weight."""


def change(rendering: np.ndarray, aim: np.ndarray, coverage: np.ndarray, counts: np.ndarray) -> float:
    """Return the mean |change| of display values where nothing was painted; 0 if all was.

    ``rendering`` and ``aim`` (h, w, 3) are linear radiance, under the edited map and as asked for;
    ``coverage`` and ``counts`` (h, w, 1) say how much each pixel was painted, and which count.
    """
    rest = ((coverage <= 0) & (counts > 0))[..., 0]
    if not rest.any():
        return 0.0
    return float(np.abs(tonemap(rendering[rest]) - tonemap(aim[rest])).mean())


def said(weight: float, changed: float) -> str:
    """Say with which weight an edit ended; ``changed`` is the :func:`change` of what was not painted."""
    used = f"target.hold = {weight:.3g} was used"
    if weight < LARGEST_HOLD or changed <= VISIBLE:
        return f"{used}: with less, pixels without paint would change visibly"
    return (
        f"{used}, the largest: pixels without paint still change by {changed:.2g} of a display value on "
        f"average (visible from {VISIBLE:g} on); paint less, or set target.hold"
    )


def further(chosen: config.Target, weight: float, changed: float) -> float | None:
    """Return the weight with which an edit goes on; None where it need not, or where the weight was given.

    ``chosen`` is table ``[target]``, ``weight`` that of what was not painted, and ``changed`` the
    :func:`change` that it has led to.
    """
    if chosen.hold != "auto" or chosen.rest == "follow" or not chosen.paint:
        return None
    if changed <= VISIBLE or weight >= LARGEST_HOLD:
        return None
    return min(LARGEST_HOLD, RAISE * weight)
