"""Mitsuba's path tracer and Adam on the texels of the map, as its tutorials write it, for a photograph."""

from __future__ import annotations

import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config, inputs
from envedit.core import latlong
from envedit.core.resampling import fit
from envedit.images import images
from experiments.plain_mitsuba import loaded, relit

STEPS, SPP, RATE = 150, 16, 0.05


def edited_by_adam(settings: config.Config, envmap: np.ndarray, photo: Path) -> tuple[np.ndarray, float]:
    """Return the map after Adam, (H, W, 3), and seconds.

    The photograph is undone as sRGB and scaled to the mean of the first rendering; minimised is the mean
    square of the difference, by log radiance.
    """
    # ---- Scene and target
    like = inputs.load_scene(settings.scene)
    scene, params = loaded(relit(settings.scene, envmap, photo.with_name("start.xml")), like)
    target = mi.TensorXf(fit(images.read(str(photo))[0], like.height, like.width))
    target *= dr.mean(mi.render(scene, spp=64).array) / dr.mean(target.array)

    # ---- Steps
    name = next(name for name, *_ in params if name.endswith("bitmap.data") or name.endswith(".data"))
    began = time.perf_counter()
    optimiser = mi.ad.Adam(lr=RATE)
    optimiser["log"] = dr.log(dr.maximum(params[name], 1e-4))
    for step in range(STEPS):
        params[name] = dr.exp(optimiser["log"])
        params.update()
        rendering = mi.render(scene, params, spp=SPP, seed=step)
        dr.backward(dr.mean(dr.square(rendering - target), axis=None))
        optimiser.step()
    seconds = time.perf_counter() - began
    return latlong.from_envmap_data(np.exp(optimiser["log"].numpy())), seconds
