"""Maps turned for other programs, so that they stand there as in a Mitsuba scene (``docs/maps.md``).

A program has axes of its own, which an importer of a y-up scene maps the scene's to, and its own look-up of a
lat-long image. None of these mirrors the image: with u the column of a direction over the width, all find it
at u plus a number of quarters of the width.
"""

from __future__ import annotations

import numpy as np

from envedit.core import latlong

QUARTERS = {"blender": 1, "houdini": 0, "three": 1, "unity": 3, "unreal": 2, "usd": 0}
"""Quarters of the width by which a program looks up a direction farther to the right. Derived from
its axes for a direction (x, y, z) and its look-up:

* usd, houdini (Solaris): (x, y, z), the frame of Mitsuba's emitter.
* blender: (x, -z, y), u = 1/2 - atan2(y, x) / 2 pi (Cycles ``direction_to_equirectangular``).
* three: (x, y, z), u = 1/2 + atan2(z, x) / 2 pi (``equirectUv``).
* unreal: (x, z, y), u = 1/2 + atan2(x, -y) / 2 pi (a long-lat texture that is imported as a cube map).
* unity: (-x, y, z), u = 1/2 - atan2(z, x) / 2 pi (``Skybox/Panoramic``).
"""


def turned_for(program: str, envmap: np.ndarray) -> np.ndarray:
    """Return a map (H, W, 3) as a program, one of :data:`QUARTERS`, expects it.

    It is moved by whole columns, without a change of any value, where the quarters are whole columns, and
    interpolated linearly between columns elsewhere.
    """
    return latlong.rotate(envmap, -90.0 * QUARTERS[program])
