"""How T is sampled: chosen from a few paths under a white sky, before anything of it is traced."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.core import latlong
from envedit.core.array_cache import DiskCache, holds
from envedit.scene.scene import Scene
from envedit.transport.recording import (
    DEPTH_TOLERANCE,
    MAX_BOUNCES,
    choose_bounces,
    choose_samples,
    enough_bounces,
    gigabytes,
    left_out,
    pilot,
    row_mass,
)
from envedit.transport.texel_sampling import Grid

COLUMN_TOLERANCE = 0.03
"""Relative error of the coarse tier above which columns are added."""
COLUMN_PATHS = (8, 48, 320)
"""Paths a pixel of a column, by its texel's share of the picture's light (``COLUMN_SHARES``)."""
FEW_PATHS, FEW_TOLERANCE = (8, 16, 48), 0.08
"""Likewise and :data:`COLUMN_TOLERANCE` for maps of few parameters, which cannot follow a column's noise."""


@dataclass(frozen=True, eq=False)
class SamplingPlan:
    """How T is sampled; made by :func:`choose`.

    Other attributes are those of :class:`.LightTransport`.
    """

    spp: int
    bounces: int
    capacity: int
    mass: np.ndarray  # (H,), share of the samples by row of the map, up to a factor
    lamps: int  # path depth of the light of other lamps; 0: there are none; -1: any
    depth_error: float
    paths: tuple[int, int, int]
    tolerance: float
    paths_bytes: int  # memory for camera paths that are kept for further columns
    choices: tuple[str, ...]  # what was chosen automatically, with the measurement that decided
    warnings: tuple[str, ...]

    def key(self) -> dict[str, Any]:
        """Return what a recording depends on, for its place on disk."""
        rows = hashlib.sha256(self.mass.tobytes()).hexdigest()
        return {"samples": self.spp, "bounces": self.bounces, "lamps": self.lamps, "rows": rows}


def white_sky(
    cache: DiskCache, key: dict[str, Any], scene: Scene, shape: tuple[int, int], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Measure the light by row of a map (H, W) and by bounce, or take it from disk; see :func:`pilot`."""
    height, width = shape
    known = {"by_row": ("f8", (height,)), "by_bounce": ("f8", (None,))}
    light = cache.load(
        key,
        lambda arrays: (
            holds(arrays, known) and len(arrays["by_bounce"]) > MAX_BOUNCES and arrays["by_bounce"].sum() > 0
        ),
    )
    if light is None:
        sphere = latlong.solid_angles(height, width)
        by_row, by_bounce = pilot(scene, Grid(height, width, scene.to_world, sphere), seed)
        light = {"by_row": by_row, "by_bounce": by_bounce}
        cache.store(key, light)
    return light["by_row"], light["by_bounce"]


def choose(
    scene: Scene,
    shape: tuple[int, int],
    light: tuple[np.ndarray, np.ndarray],
    spp: int | str,
    max_depth: int | str,
    memory_gb: float,
    few: bool = False,
) -> SamplingPlan:
    """Choose how T of a scene is sampled, for maps of ``shape`` (H, W).

    ``light`` is of :func:`white_sky`; other parameters are those of :meth:`.LightTransport.build`. InputError
    as of :func:`.recording.choose_bounces` and :func:`.recording.choose_samples`.
    """
    # ---- Path depth and samples
    by_row, by_bounce = light[0], light[1].copy()
    if scene.max_depth > 0:
        by_bounce[scene.max_depth :] = 0
    bounces, choices = choose_bounces(scene, max_depth, by_bounce)
    samples, capacity, choice = choose_samples(scene, spp, shape[0] * shape[1], memory_gb)
    depth_error = left_out(by_bounce, bounces)
    warnings = []
    if depth_error > DEPTH_TOLERANCE:
        warnings.append(
            f"light transport: paths of more than {bounces + 1} segments are left out, which add "
            f"{100 * depth_error:.2g} % of the picture under a white sky: set [renderer] max_depth = "
            f"{enough_bounces(by_bounce) + 1}"
        )

    # ---- What memory is left holds the camera paths of exact columns
    left = memory_gb - gigabytes(scene.width * scene.height, samples, capacity)
    # The light of other lamps is constant: it need not be cut where no path depth is asked for.
    most = scene.max_depth if max_depth == "auto" else bounces + 1
    return SamplingPlan(
        spp=samples,
        bounces=bounces,
        capacity=capacity,
        mass=row_mass(latlong.solid_angles(*shape), by_row),
        lamps=most if len(scene.mi.emitters()) > 1 else 0,
        depth_error=depth_error,
        paths=FEW_PATHS if few else COLUMN_PATHS,
        tolerance=FEW_TOLERANCE if few else COLUMN_TOLERANCE,
        paths_bytes=int(1e9 * max(left, 0)),
        choices=(*choices, choice),
        warnings=tuple(warnings),
    )
