"""What a configuration starts from: its map, the rows of it that may change, its scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from envedit import config
from envedit.images import analytic_sky, images
from envedit.scene import scene


def load_map(settings: config.Input) -> tuple[np.ndarray, list[str]]:
    """Load the map of a configuration at working width.

    Returns
    -------
    envmap : ndarray (H, W, 3) float32
        Linear radiance.
    warnings : list of str
        What was repaired, or is odd.

    Raises
    ------
    InputError
        As of :func:`.images.load_envmap`.
    """
    if settings.envmap == "sunsky":
        return analytic_sky.sunsky(
            settings.width, settings.azimuth, settings.elevation, settings.turbidity
        ), []
    envmap, info = images.load_envmap(settings.envmap, settings.width, settings.repair)
    return envmap, list(info["warnings"])


def active_rows(rows, height: int) -> tuple[int, int]:
    """Return the first and last row that may change; "upper": above the horizon (paper, Sec. 5.1)."""
    if rows == "upper":
        return 0, (height + 1) // 2 - 1
    return (0, height - 1) if rows == "all" else (rows[0], rows[1])


def load_scene(settings: config.Scene, base: Path | None = None) -> scene.Scene:
    """Load the scene of a configuration; ``base`` and errors as of :func:`.scene.load`."""
    return scene.load(settings.file, settings.width, settings.height, dict(settings.parameters), base)
