"""The scene of a configuration as Mitsuba alone loads it, under a map in a file."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.images import images
from envedit.scene import scene as scenes
from envedit.scene.film import threads


def loaded(chosen: config.Scene, envmap: np.ndarray, file: Path, width: int, height: int):
    """Load a scene under a map (H, W, 3) on a film of a size; returns the scene and its parameters.

    The scene is written to ``file``, NAME.xml, and the map, radiance that reaches the scene, to NAME.exr.
    """
    map_file = file.with_suffix(".exr")
    images.write_exr(map_file, envmap)
    text = scenes.relit(chosen.file, map_file.name, dict(chosen.parameters), None, chosen.up, 1.0)
    file.write_text(text, encoding="utf-8")
    with threads(max(2, dr.thread_count())):  # with one, Mitsuba's loader waits for ever
        scene = mi.load_file(str(file))
    params = mi.traverse(scene)
    film = next(name for name, *_ in params if name.endswith("film.size")).removesuffix("size")
    for key in ("size", "crop_size"):
        params[film + key] = mi.ScalarVector2u(width, height)
    params.update()
    return scene, params
