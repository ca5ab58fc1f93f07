"""Maps that the engine is measured with: real ones where they are, an analytic sky, one bright texel."""

import os
from pathlib import Path

import numpy as np

from envedit.images import analytic_sky, images
from experiments import puresky

SUNNY = "kloofendal_48d_partly_cloudy"
MESH = ("bunny_watertight.ply", {"up": "z"})
"""File in the data's ``meshes`` folder, and the parameters of the scene ``mesh`` that set it upright."""


def data() -> Path | None:
    """Return the folder of real data that ENVEDIT_DATA names, or None."""
    root = os.environ.get("ENVEDIT_DATA")
    return Path(root).absolute() if root else None


def mesh() -> dict | None:
    """Return the parameters of the scene ``mesh`` for a real mesh, or None without data."""
    file = data() and data() / "meshes" / MESH[0]
    return {"mesh": str(file), **MESH[1]} if file and file.is_file() else None


def skies(names=None) -> dict[str, Path]:
    """Return the PureSky maps by name, all of them or those asked for; empty without data."""
    there = (folder := data()) and (folder / "puresky").is_dir()
    return puresky.of_script(names) if there else {}


def sunny(width: int, real: bool = True) -> tuple[str, np.ndarray]:
    """Return the name and the texels (width / 2, width, 3) of a clear sky with its sun.

    A real one, unless ``real`` is False or there is none; then the analytic sun at 45 degrees.
    """
    if real and (file := skies().get(SUNNY)):
        return SUNNY, images.load_envmap(file, width)[0]
    return "analytic sun and sky", analytic_sky.sunsky(width, 130, 45)


def one_texel_sun(
    width: int, elevation: float, across: float, sun: float = 1e5, background: float = 0.1
) -> np.ndarray:
    """Return a grey sky (width / 2, width, 3) with all the sun in one texel.

    Parameters
    ----------
    width : int
        Texels across.
    elevation : float
        Degrees above the horizon, to the nearest row.
    across : float
        Place in the map from its left edge, 0 to 1: at 0 behind the object, at 1/2 behind the camera of the
        shipped scenes.
    sun, background : float
        Radiances.
    """
    height = width // 2
    picture = np.full((height, width, 3), background, np.float32)
    # Rows are aligned to the corners: row 0 is the zenith, the last one the nadir.
    picture[round((90 - elevation) / 180 * (height - 1)), int(across * width)] = sun
    return picture
