"""What the rendering should look like.

A target is a picture in linear radiance, an optional weight per pixel, and, where the question was made from
a known answer, the map that answers it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import config, image, latlong
from .errors import InputError
from .scene import Scene
from .tonemap import inverse_tonemap, linear_to_srgb

SEED = 7_000_003
"""Apart from the seeds of all other renderings, so that no noise is shared between question and answer."""


@dataclass(frozen=True)
class Target:
    """The picture wanted.

    Attributes
    ----------
    picture : ndarray (h, w, 3)
        Linear radiance.
    weight : ndarray (h, w, 1) or None
        How much each pixel counts; None: all the same.
    envmap : ndarray (H, W, 3) or None
        The map that makes the picture, where it is known.
    source : str
        One line for the report.
    warnings : tuple of str
        What the user should know about the picture.
    """

    picture: np.ndarray
    weight: np.ndarray | None
    envmap: np.ndarray | None
    source: str
    warnings: tuple[str, ...] = ()


def make(
    settings: config.Target, scene: Scene, envmap: np.ndarray, seed: int, repair: bool = False
) -> Target:
    """Make the target of a configuration.

    Parameters
    ----------
    settings : config.Target
        What is wanted.
    scene : Scene
        The scene that it is a picture of.
    envmap : ndarray (H, W, 3)
        The map that will be edited; turned by ``rotate_degrees`` where the target names no file.
    seed : int
        Base seed of the rendering.
    repair : bool
        Repair non-finite texels of the target's map.

    Raises
    ------
    InputError
        If a file cannot be read or does not fit the film.
    """
    if settings.kind == "image":
        return _painted(settings, scene)
    height, width, _ = envmap.shape
    if settings.file:
        true, info = image.load_envmap(settings.file, width, repair)
        source, warnings = f"rendered under {settings.file}", tuple(info["warnings"])
    else:
        true, warnings = latlong.rotate(envmap, settings.rotate_degrees), ()
        source = f"rendered under the map turned by {settings.rotate_degrees:g} degrees"
    true = np.ascontiguousarray(true, np.float32)
    picture = scene.render(true, spp=settings.spp, seed=seed + SEED)
    return Target(
        picture, _weight(settings, picture), true, f"{source}, {settings.spp} samples a pixel", warnings
    )


def _painted(settings, scene):
    picture, info = image.read(settings.file)
    if picture.shape[:2] != (scene.height, scene.width):
        height, width = picture.shape[:2]
        raise InputError(
            f"{settings.file}: is {width}x{height} pixels, the rendering is {scene.width}x{scene.height}: "
            "export it at that size, or set [scene] width and height to the picture's"
        )
    warnings = list(info["warnings"])
    if not info["hdr"]:
        # image.read decodes sRGB; the picture was made under the declared tonemap instead.
        picture = inverse_tonemap(linear_to_srgb(picture), settings.tonemap)
        warnings.append(f"{settings.file}: read as a picture under the '{settings.tonemap}' tonemap")
    if not np.isfinite(picture).all():
        row, column = np.argwhere(~np.isfinite(picture).all(axis=2))[0]
        raise InputError(
            f"{settings.file}: pixel at row {row}, column {column} is not finite: "
            "repair it in the program it came from"
        )
    picture = np.ascontiguousarray(picture, np.float32)
    source = f"painted: {settings.file}"
    return Target(picture, _weight(settings, picture), None, source, tuple(warnings))


def _weight(settings, picture):
    """Read the mask as a weight for each pixel (h, w, 1); None without one."""
    if not settings.mask:
        return None
    mask, info = image.read(settings.mask)
    if mask.shape[:2] != picture.shape[:2]:
        raise InputError(
            f"{settings.mask}: is {mask.shape[1]}x{mask.shape[0]} pixels, the target is "
            f"{picture.shape[1]}x{picture.shape[0]}: the mask must have the target's size"
        )
    if not np.isfinite(mask).all():
        row, column = np.argwhere(~np.isfinite(mask).all(axis=2))[0]
        raise InputError(
            f"{settings.mask}: pixel at row {row}, column {column} is not finite: "
            "paint the mask in black and white"
        )
    if not info["hdr"]:
        mask = linear_to_srgb(mask)  # 50 % grey is meant as a half, not as what sRGB makes of it
    weight = np.clip(mask.mean(axis=2, keepdims=True), 0, 1).astype(np.float32)
    if not weight.any():
        raise InputError(f"{settings.mask}: is black everywhere: paint white where the target counts")
    return weight
