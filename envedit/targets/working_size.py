"""The size at which an edit is solved: that of the target, or fewer pixels where these say as much.

A smooth change of the sky shows in all pixels of an object: of a large picture the solver sees the same scene
on a smaller film. A mirror shows detail of the sky in every single pixel, and is worked on as it is. The
result is rendered at full size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from envedit import config
from envedit.core.radiance import BRIGHTEST
from envedit.core.resampling import fit
from envedit.representations.layers.gain import CYCLES
from envedit.scene.scene import Scene
from envedit.targets import initial_rendering, rendered_anew
from envedit.targets.pixel_weights import first_hold, hidden_pixels, pixel_weight
from envedit.targets.target import Target, with_noise

PIXELS, PAINTED_PIXELS = 128 * 128, 64 * 64
"""Pixels that an edit is solved on with "auto", and one towards paint (``docs/decisions/defaults.md``)."""
MUCH = 1.8
"""How many times as many pixels a picture must have to be worked on at a smaller size."""


def most_pixels(settings: config.Config, painted: bool = False) -> int | None:
    """Return the most pixels that an edit is solved on, towards paint or not; None: as many as there are."""
    pixels = settings.renderer.pixels
    if isinstance(pixels, int):
        return pixels
    chosen = settings.representation
    smooth = isinstance(chosen.cycles, str) or chosen.cycles <= CYCLES
    if not smooth or not settings.newton:
        return None
    return PAINTED_PIXELS if painted else PIXELS


def smaller(settings: config.Config, scene: Scene, painted: bool = False) -> Scene:
    """Return the scene on a film of at most so many pixels as :func:`most_pixels`, all views together.

    It is the scene itself where its film is hardly larger, or somebody has built it.
    """
    most, pixels = most_pixels(settings, painted), scene.width * scene.height
    if most is None or pixels <= MUCH * most:
        return scene
    small = scaled(scene, (most / pixels) ** 0.5)
    return small if small is not None and small.width * small.height < pixels else scene


def scaled(scene: Scene, factor: float) -> Scene | None:
    """Return the scene on a film that is ``factor`` times as wide and high; None if it is built already."""
    if scene.resized is None:
        return None
    heights = {rows.stop - rows.start for rows in scene.rows}
    height = max(1, round(factor * heights.pop())) if len(heights) == 1 else 0  # 0: by each view's aspect
    return scene.resized(max(4, round(factor * scene.width)), height)


def worked_on(
    settings: config.Config, scene: Scene, small: Scene, envmap: np.ndarray, target: Target
) -> Target:
    """Return the target of a scene as the picture of the ``small`` scene, the same on a smaller film.

    It is rendered anew, so that the film's filter is the same as in what it is compared with. What was
    painted is averaged over the area of each pixel, and asked for beside the smaller initial rendering, under
    ``envmap`` (H, W, 3), the map that is edited.
    """
    chosen = settings.target
    hidden = hidden_pixels(small)
    if target.coverage is None or target.initial is None:
        if target.photo is not None:
            target = target.developed(target.photo.laid((small.height, small.width)))
            picture, noise, spp = target.picture, rendered_anew.noise(target.picture, small.rows), target.spp
        elif target.envmap is None:  # a picture of the scene
            picture = at_size(target.picture, scene, small)
            if target.clipped is not None:
                target = replace(target, clipped=at_size(target.clipped, scene, small) > 0)
            noise = rendered_anew.noise(picture, small.rows)
            spp = rendered_anew.samples(noise, *with_noise(settings, small, envmap)[:2], small.rows)
        else:
            picture, spp, noise = with_noise(settings, small, target.envmap)
        weight = np.where(hidden[..., None], 0, at_size(target.weight, scene, small)).astype(np.float32)
        return replace(target, picture=picture, noise=noise, spp=spp, weight=weight)
    initial = initial_rendering.initial(small, envmap, settings)
    averaged = replace(target, picture=at_size(target.picture, scene, small))
    painted = averaged.seen_as(initial, at_size(target.initial, scene, small))
    picture = np.minimum(painted.aim, np.float32(BRIGHTEST))
    coverage = np.where(hidden[..., None], 0, at_size(target.coverage, scene, small))
    uncounted = at_size((target.weight == 0).astype(np.float32), scene, small)[..., 0] > 0.5
    weight = pixel_weight(coverage, uncounted | hidden, chosen.paint, first_hold(settings))
    return replace(target, picture=picture, initial=initial, coverage=coverage, weight=weight)


def at_size(image: np.ndarray, of: Scene, to: Scene) -> np.ndarray:
    """Scale a picture (h, w, k) of a scene to the film of the same scene at another size, view by view."""
    parts = zip(of.rows, to.rows, strict=True)
    return np.concatenate([fit(image[part], rows.stop - rows.start, to.width) for part, rows in parts])
