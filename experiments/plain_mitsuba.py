"""The scene of a configuration as Mitsuba alone loads it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.quiet_libraries import quiet_libraries
from envedit.images import images
from envedit.scene import parser
from envedit.scene import scene as scenes
from envedit.scene.film import threads


def loaded(file: Path, like: scenes.Scene, **parameters: str) -> tuple[mi.Scene, mi.SceneParameters]:
    """Load a scene file on a film of the size of ``like``; returns the scene and its parameters."""
    with threads(max(2, dr.thread_count())), quiet_libraries():  # with one thread, files are waited for
        scene = parser.called(file.name, mi.load_file, str(file), **parameters)
        params = mi.traverse(scene)
        film = like.mi.sensors()[0].film()
        sizes = {"size": film.size(), "crop_size": film.crop_size(), "crop_offset": film.crop_offset()}
        place = next(name for name, *_ in params if name.endswith("film.size")).removesuffix("size")
        for key, value in sizes.items():
            params[f"{place}{key}"] = value
        params.update()
    return scene, params


def relit(chosen: config.Scene, envmap: np.ndarray, file: Path) -> Path:
    """Write a scene under a map (H, W, 3), radiance that reaches the scene, to NAME.xml and NAME.exr."""
    map_file = file.with_suffix(".exr")
    images.write_exr(map_file, envmap)
    text = scenes.relit(replace(chosen, scale=1.0), map_file.name)
    file.write_text(text, encoding="utf-8")
    return file
