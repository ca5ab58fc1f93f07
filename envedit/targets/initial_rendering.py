"""The rendering to paint on: the scene under the map as it is, and its export as a picture."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from envedit import config
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError, InputError
from envedit.core.seeds import Seeds
from envedit.core.types import FilePath
from envedit.images import images
from envedit.scene.renderings import rendered
from envedit.scene.scene import Scene

ENDINGS = (".exr", ".png")
"""What the initial rendering can be exported as; a JPEG would not keep it."""
CLIPPED = 0.001
"""Share of the pixels that may be clipped in an exported PNG before another tonemap is used."""


def initial(lit: Scene, envmap: np.ndarray, settings: config.Config) -> np.ndarray:
    """Render the picture to paint on, (h, w, 3): the scene under the map as it is, at [target] spp."""
    picture, _, _ = rendered(
        lit, envmap, settings.target.spp, Seeds.of(settings.seed).exported, settings.renderer.cache
    )
    return picture


def check_export(file: FilePath) -> None:
    """Refuse a file that :func:`export` should not write.

    Raises
    ------
    ConfigError
        If its ending says neither OpenEXR nor PNG.
    InputError
        If it exists, or its folder does not.
    """
    file = Path(os.fsdecode(file))
    if file.suffix.lower() not in ENDINGS:
        raise ConfigError(f"--export-initial: got {str(file)!r}, expected a name that ends in .exr or .png")
    if os.path.lexists(file):
        raise InputError(f"{file}: exists and is not overwritten: name another file, or move it away")
    if not os.path.isdir(file.parent):
        raise InputError(f"{file}: cannot be written (its folder does not exist)")


def export_tonemap(file: FilePath, picture: np.ndarray, settings: config.Config) -> str:
    """Return the tonemap of an exported picture (h, w, 3): "linear" for OpenEXR, or that of the PNG.

    That is [target] tonemap where it clips less than :data:`CLIPPED` of the pixels, which have no information
    when they come back, and otherwise "reinhard", which clips nothing below a radiance of 10^4.
    """
    if Path(os.fsdecode(file)).suffix.lower() == ".exr":
        return "linear"
    clipped = _clipped(tonemap(picture, settings.target.tonemap))
    return "reinhard" if clipped >= CLIPPED else settings.target.tonemap


def _clipped(shown):
    """Return the share of pixels with a channel that is white in a PNG of 16 bits."""
    return float((shown >= 1 - 0.5 / 65535).any(axis=2).mean())


def export(
    file: FilePath, picture: np.ndarray, settings: config.Config, name: str | None = None
) -> list[str]:
    """Write the picture to paint on: float32 OpenEXR, or 16-bit PNG.

    The file says which tonemap it is under, and what it was rendered from.

    Parameters
    ----------
    file : path-like
        Ends in .exr or .png, and is not there yet.
    picture : ndarray (h, w, 3)
        Linear radiance, of :func:`initial`.
    settings : config.Config
        What it was made from.
    name : str, optional
        Its tonemap; by default that of :func:`export_tonemap`.

    Returns
    -------
    list of str
        Warnings.

    Raises
    ------
    ConfigError, InputError
        As :func:`check_export`, or if the file cannot be written.
    """
    check_export(file)
    linear = Path(os.fsdecode(file)).suffix.lower() == ".exr"
    name = name or export_tonemap(file, picture, settings)
    facts = {
        "envedit.tonemap": name,
        "envedit.scene": Path(settings.scene.file).name,
        "envedit.envmap": Path(settings.input.envmap).name,
        "envedit.seed": settings.seed,
        "envedit.spp": settings.target.spp,
    }
    if linear:
        images.write_exr(file, picture, facts, panorama=False)
        return []
    shown = tonemap(picture, name)
    images.write_png(file, shown, 16, facts)
    share = _clipped(shown)
    if share < CLIPPED:
        return []
    return [
        f"{file}: {100 * share:.3g} % of the pixels are clipped under the '{name}' tonemap, and cannot be "
        "painted on: export an .exr"
    ]
