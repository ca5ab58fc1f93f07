"""How T is sampled: chosen from a few paths under a white sky, before anything of it is traced.

They show how deep paths must go, and from which rows of the map light comes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from envedit.core import latlong, seeds
from envedit.core.array_cache import DiskCache
from envedit.core.errors import InputError
from envedit.scene.scene import Scene
from envedit.transport import recording
from envedit.transport.sparse_matrix import SLICE
from envedit.transport.texel_sampling import Grid

MAX_BOUNCES = 8
"""Most bounces that an automatic path depth allows."""
DEPTH_TOLERANCE = 0.002
"""Share of the picture under a white sky that an automatic path depth may leave out."""
PATHS = 1 << 22
"""Paths of a recording, all pixels together: more pixels need fewer each, as neighbours see the same map."""
FEWEST_SPP, MOST_SPP = 16, 256
"""Paths a pixel between which "auto" chooses."""
AUTO_GB = 2.0
COARSE_SHARE = 0.7
"""GB of memory that "auto" allows; share of it that samples of "auto" may fill: the rest is for columns."""
PILOT_SPP = 16
"""Paths a pixel of the pilot, whose sums over rows and bounces are of the whole picture."""
MOST_COLUMNS = 256
"""Exact columns at most: an edit with so many ends where one with 768 does, in two thirds of the time."""
COLUMNS_STORED = 2
"""Columns in memory for each that a rendering may use: a step is tried beside where it begins."""
COLUMN_TOLERANCE = 0.03
"""Relative error of the coarse tier above which columns are added."""
COLUMN_PATHS = (8, 48, 320)
"""Paths a pixel of a column, by its texel's share of the picture's light (``COLUMN_SHARES``)."""
FEW_PATHS, FEW_TOLERANCE = (16, 32, 64), 0.08
"""Likewise and :data:`COLUMN_TOLERANCE` for maps of few parameters, which cannot follow a column's noise
(docs/decisions/store_of_the_transport.md)."""


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


def pilot(scene: Scene, grid: Grid, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure where light comes from under a white sky, from a few samples of 4,096 to 16,384 pixels, or all.

    Returns the light by row of the map, (H,), of paths of at most :data:`MAX_BOUNCES` bounces; and by bounce,
    (n,), to the end of the longest path: 0 is the sky seen directly, and n > MAX_BOUNCES.
    """
    pixels = np.arange(scene.width * scene.height, dtype=np.uint32)
    stride = max(1, int(np.sqrt(len(pixels) / 4096)))
    some = pixels.reshape(scene.height, scene.width)[::stride, ::stride].ravel()
    by_row, by_bounce = np.zeros(grid.height), np.zeros(MAX_BOUNCES + 1)
    for bounce, _, texel, value in recording.contributions(
        scene.mi, grid, some, PILOT_SPP, MAX_BOUNCES, seeds.pilot(seed), True
    ):
        # Summed on the host: atomics would give other bits, and so other samples, on every run.
        amount = np.nan_to_num(dr.mean(value).numpy().astype(np.float64), nan=0, posinf=0, neginf=0)
        if isinstance(bounce, int):
            by_row += np.bincount(texel.numpy() // grid.width, amount, minlength=grid.height)
            by_bounce[bounce] += amount.sum()
        else:
            further = np.bincount(bounce.numpy(), amount, minlength=len(by_bounce))
            by_bounce = np.pad(by_bounce, (0, len(further) - len(by_bounce))) + further
    return by_row, by_bounce


def white_sky(
    cache: DiskCache, key: dict[str, Any], scene: Scene, shape: tuple[int, int], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Measure the light by row of a map (H, W) and by bounce, or take it from disk; see :func:`pilot`."""
    height, width = shape
    light = cache.load(key)
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
    as of :func:`choose_bounces` and :func:`choose_samples`.
    """
    # ---- Path depth and samples
    by_row, by_bounce = light[0], light[1].copy()
    if scene.integrator.max_depth > 0:
        by_bounce[scene.integrator.max_depth :] = 0
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
    most = scene.integrator.max_depth if max_depth == "auto" else bounces + 1
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


def left_out(by_bounce: np.ndarray, bounces: int) -> float:
    """Share of the picture under a white sky that comes from beyond ``bounces``, of the light by bounce."""
    return max(1 - float(by_bounce[: bounces + 1].sum() / by_bounce.sum()), 0.0)


def enough_bounces(by_bounce: np.ndarray) -> int:
    """Return the fewest bounces that leave out at most :data:`DEPTH_TOLERANCE`, of the light by bounce."""
    return next(n for n in range(len(by_bounce)) if left_out(by_bounce, n) <= DEPTH_TOLERANCE)


def choose_bounces(scene: Scene, max_depth: int | str, by_bounce: np.ndarray) -> tuple[int, list[str]]:
    """Choose the surface points along a path from the light by bounce (n,) that :func:`pilot` found.

    ``max_depth`` is Mitsuba's path depth, taken as it is if it is a number, or "auto". Returned are the
    bounces, path depth - 1, and what to report about an automatic choice. InputError, which names the scene,
    if no light arrives within that depth.
    """
    automatic = max_depth == "auto"
    most = MAX_BOUNCES + 1 if automatic else max_depth
    if not by_bounce[:most].sum() > 0:
        within = "" if automatic and not by_bounce.any() else f" within path depth {most}"
        raise InputError(
            f"{scene.path or 'scene dict'}: no pixel receives light from the environment{within}: "
            "check the camera and that the scene is open"
        )
    if not automatic:
        return int(max_depth) - 1, []
    bounces = min(enough_bounces(by_bounce), MAX_BOUNCES)
    left = left_out(by_bounce, bounces)
    added = f"further bounces add {100 * left:.2g} % of the picture under a white sky"
    return bounces, [f"path depth {bounces + 1}: {added}"]


def choose_samples(scene: Scene, spp: int | str, texels: int, memory_gb: float) -> tuple[int, int, str]:
    """Choose how many samples and exact columns fit into the memory allowed, GB, for the film of a scene.

    ``spp``, paths a pixel, is taken as it is if it is a number; "auto" is :data:`PATHS` over the pixels, or
    :func:`most_samples` if those are fewer. More columns than the map has ``texels`` are of no use. Returned
    are paths a pixel, most exact columns, and what to report to the user. InputError if the samples alone do
    not fit.
    """
    pixels = scene.width * scene.height
    spp = min(_automatic_spp(pixels), most_samples(pixels, memory_gb)) if spp == "auto" else int(spp)
    coarse_gb = gigabytes(pixels, spp)
    if coarse_gb > memory_gb:
        raise InputError(
            f"light transport needs {coarse_gb:.2g} GB for {scene.width}x{scene.height} pixels at {spp} "
            f"samples, memory_gb allows {memory_gb:g}: raise [renderer] memory_gb, or lower [renderer] spp "
            "or [scene] width"
        )
    counted = (2**32 - 1) // (4 * (pixels + SLICE))  # an index into their store has 32 bits
    stored = min((memory_gb - coarse_gb) * 1e9 / (16 * pixels), counted)
    capacity = int(min(MOST_COLUMNS, stored / COLUMNS_STORED, texels))
    about = gigabytes(pixels, spp, capacity)
    columns = f"up to {capacity} exact columns, about {about:.2g} of {memory_gb:g} GB"
    return spp, capacity, f"light transport: {spp} paths a pixel, {columns}"


def allowed(memory_gb: float | str) -> float:
    """Return the GB that a setting allows."""
    return AUTO_GB if isinstance(memory_gb, str) else memory_gb


def most_samples(pixels: int, memory_gb: float) -> int:
    """Return the most samples a pixel, a power of two, whose T leaves memory to columns.

    From :data:`FEWEST_SPP`, which may be too many, to :data:`MOST_SPP`.
    """
    spp = MOST_SPP
    while gigabytes(pixels, spp) > COARSE_SHARE * memory_gb and spp > FEWEST_SPP:
        spp //= 2
    return spp


def gigabytes(pixels: int, spp: int, columns: int = 0) -> float:
    """Estimate the GB of T, its transpose and columns: 16 bytes an entry, and a path leaves about 1.5."""
    return pixels * (spp * 1.5 * 2 + COLUMNS_STORED * columns) * 16 / 1e9


def _automatic_spp(pixels):
    """Return the power of two next below PATHS over the pixels, within bounds."""
    return int(np.clip(1 << (PATHS // pixels or 1).bit_length() - 1, FEWEST_SPP, MOST_SPP))


def row_mass(sphere: np.ndarray, by_row: np.ndarray) -> np.ndarray:
    """Share samples out among the rows of a map, (H,): solid angle * sqrt(light per solid angle).

    ``sphere`` (H,) is the solid angle of a texel of each row, steradians, ``by_row`` (H,) light by row, from
    :func:`pilot`. There is a floor: rows that hardly matter to this view get few samples, but never none.
    """
    floor = 0.05 * by_row.max()
    mass = sphere * np.clip(by_row / np.maximum(sphere, 1e-12), floor / sphere.max(), None) ** 0.5
    return np.maximum(mass, 1e-6 * mass.sum())
