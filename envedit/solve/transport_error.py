"""What the stored transport misses of the solution's rendering, measured by Mitsuba and taken off the target.

T is an estimate: it errs around bright areas that are too large for exact columns, at shadow edges, in
caustics. An edit that compares R(E) = T E + I_0 with the target t makes up for these errors by the map. When
its steps end, at E^, a few more are made towards

    t + R(E^) - I(E^),        R(E^) = T E^ + I_0 through T, I(E^) by Mitsuba,

so that T's error cancels near E^ (output space mapping, Bandler et al. 2004): where these steps end, it is
the path-traced rendering that meets the target.
"""

from __future__ import annotations

import numpy as np

from envedit.core.seeds import Seeds
from envedit.scene.renderings import rendered
from envedit.scene.scene import Scene
from envedit.targets.target import Target

SPP = 256
"""Samples a pixel of I, and of renderings by which start and solution are compared."""
STEPS = 6
"""Most steps towards it. Nine edits, mean: without 43.86 dB (map 27.63), 3 steps 44.07 (27.99), 6 steps 44.09
(28.24), the same where lights may be added."""


def corrected(
    target: Target, scene: Scene, envmap: np.ndarray, rendering: np.ndarray, seed: int, keep: bool = True
) -> Target:
    """Return a target whose aim is the picture as T would show it near a map E^ (H, W, 3).

    Its picture stays. ``rendering`` (h, w, 3) is R(E^), ``seed`` that of the configuration. ``keep``: I is
    kept on disk, and a run that is killed and resumed has the same.
    """
    return target.seen_as(rendering, path_traced(scene, envmap, seed, keep))


def path_traced(scene: Scene, envmap: np.ndarray, seed: int, keep: bool = True) -> np.ndarray:
    """Return I(E) of a map E, (h, w, 3), with :data:`SPP` samples; ``keep`` as of :func:`corrected`."""
    picture, _, _ = rendered(scene, envmap, SPP, Seeds(seed).solution_check, keep)
    return picture
