"""Renderings that are the same in every run of a scene and a map, kept on disk like the light transport."""

from __future__ import annotations

import hashlib

import mitsuba as mi
import numpy as np

from envedit.core.array_cache import DiskCache, cache_folder
from envedit.scene.scene import Scene

MOST_BYTES = 500_000_000
"""Size above which renderings that were not used for longest are dropped."""
_RECIPE = 3  # raise when the same inputs give another rendering


def rendered(
    scene: Scene, envmap: np.ndarray, spp: int | str, seed: int, keep: bool = True, exactly: int | None = None
) -> tuple[np.ndarray, int, np.ndarray | None]:
    """Render as :meth:`.Scene.sampled`, or take what an earlier call rendered from disk.

    Parameters and values are those of :meth:`.Scene.sampled`; ``keep``: renderings are kept on disk. The
    judged rendering of a result is not taken from here: it is made with fresh samples every time.
    """
    # ---- What a rendering depends on
    cache = DiskCache(cache_folder("renderings") if keep else None, MOST_BYTES)
    image = np.ascontiguousarray(envmap, np.float32)
    key = {
        "version": [_RECIPE, mi.__version__, mi.variant()],
        "scene": [scene.digest, scene.width, scene.height, np.asarray(scene.to_world).tolist()],
        "map": [image.shape, hashlib.sha256(image.tobytes()).hexdigest()],
        "samples": [spp, seed, exactly],
    }

    # ---- From disk, or rendered and stored
    stored = cache.load(key)
    if stored is not None:
        return stored["picture"], int(stored["spp"]), stored.get("noise")
    picture, taken, noise = scene.sampled(envmap, spp, seed, exactly)
    arrays = {"picture": picture, "spp": np.array(taken, np.int64)}
    cache.store(key, arrays if noise is None else arrays | {"noise": noise})
    return picture, taken, noise
