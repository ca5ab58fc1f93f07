"""Samples of the light transport: which texel contributes how much to which pixel, whatever the map.

Every vertex of a camera path sends one ray towards a texel, and the path's own direction stands for another
where it leaves the scene. The two are combined by the balance heuristic (Veach 1997), whose densities know
the grid but no map. A few samples taken beforehand decide how deep the paths go and where rays are worth
their cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import seeds
from envedit.core.errors import InputError
from envedit.core.types import Progress
from envedit.scene import camera_paths
from envedit.scene.scene import Scene
from envedit.transport.sparse_matrix import SLICE, merge
from envedit.transport.texel_sampling import Grid

MAX_BOUNCES = 8
"""Most bounces that an automatic path depth allows."""
DEPTH_TOLERANCE = 0.002
"""Share of the picture under a white sky that an automatic path depth may leave out."""
LANES = 1 << 18
"""Paths traced at once: what bounds the memory of a recording."""
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


class Recorded(NamedTuple):
    """Entries of T from some pixels, merged per (pixel, texel).

    ``pixels``, ``texels`` (n,) are uint32, ``weights`` (n, 3) float32; ``lost`` is the number of
    contributions that were not finite and are not among them.
    """

    pixels: np.ndarray
    texels: np.ndarray
    weights: np.ndarray
    lost: int


def connect(
    scene: mi.Scene,
    vertex: camera_paths.Vertex,
    direction: mi.Vector3f,
    jacobian: mi.Float,
    sampled: mi.Float,
) -> mi.Color3f:
    """Evaluate throughput * BSDF * visibility towards a direction, times its balance-heuristic weight.

    ``direction`` is a unit vector in the world for each lane of the vertex, ``jacobian`` d(solid angle) /
    d(u, v) there, ``sampled`` the solid-angle density of the texel sample. Lanes with a jacobian of 0 (a
    pole) give 0.
    """
    si = vertex.si
    bsdf = vertex.si.bsdf()
    active = vertex.active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (jacobian > 0)
    wo = si.to_local(direction)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    value = mi.Color3f(mi.unpolarized_spectrum(si.to_world_mueller(value, -wo, si.wi)))
    active &= dr.max(value) > 0
    active &= ~scene.ray_test(si.spawn_ray(direction), active)
    weight = sampled / (sampled + pdf)
    return dr.select(active, vertex.throughput * value * weight, 0)


def bsdf_weight(pdf: mi.Float, sampled: mi.Float) -> mi.Float:
    """Weigh a BSDF sample by the balance heuristic; 1 where nothing else could sample it (infinite pdf)."""
    return dr.select(dr.isinf(pdf), 1, pdf / (pdf + sampled))


def contributions(
    scene: mi.Scene, grid: Grid, pixels: np.ndarray, spp: int, bounces: int, seed: int, beyond: bool = False
) -> Iterator[tuple[int | mi.UInt32, mi.UInt32, mi.UInt32, mi.Color3f]]:
    """Yield (bounce, pixel of each lane, texel, RGB weight) of one block of pixels, as batches on the device.

    T[p, j] is the radiance of pixel p per unit of radiance of texel j: a sum over the surface points of a
    path of throughput * integral of f(w) V(w) t_j(w) dw, with t_j the bilinear tent of j, f the BSDF with its
    cosine and V the visibility. Over the square of (u, v), dw = J du dv; a direction drawn from the tent has
    density t_j / A_j there, A_j = integral of t_j du dv (``area``). So one sample of texel j, chosen with
    probability P_j, adds throughput * f V J A_j / P_j, times its balance weight. A path that leaves the scene
    counts for one of the four texels around its direction, drawn by their tents.

    Parameters are as of :func:`.camera_paths.trace`, with ``spp`` camera paths a pixel; with ``beyond`` the
    last batch has an array of bounces.
    """
    lane = dr.arange(mi.UInt32, len(pixels) * spp)
    pixel = dr.gather(mi.UInt32, mi.UInt32(pixels), lane // spp)
    for event in camera_paths.trace(scene, pixels, spp, bounces, seed, beyond):
        bounce = event.bounce if isinstance(event.bounce, int) else bounces + 1
        key = dr.opaque(mi.UInt32, (seed * 1009 + 512 + bounce) & 0xFFFFFFFF)
        scramble = mi.sample_tea_32(pixel, key)[0]
        u = camera_paths.lattice(mi.permute_kensler(lane % spp, spp, scramble), scramble)
        if isinstance(event, camera_paths.Escape):
            texel, row, jacobian = grid.locate_one(event.direction, u)
            weight = bsdf_weight(event.pdf, grid.density_at(row) / jacobian)
            yield event.bounce, pixel, texel, dr.select(event.active, event.throughput * (weight / spp), 0)
        else:
            texel, direction, probability, area, jacobian = grid.choose(u)
            density = grid.density_at(grid.row_of(direction)) / jacobian
            value = connect(scene, event, direction, jacobian, density)
            yield event.bounce, pixel, texel, value * (area * jacobian / (probability * spp))


def record(scene: mi.Scene, grid: Grid, pixels: np.ndarray, spp: int, bounces: int, seed: int) -> Recorded:
    """Trace one block of pixels and keep what is not zero; parameters as in :func:`contributions`.

    A contribution that is not finite (a BSDF that overflows) would make its pixel non-finite under any map:
    it is left out and counted.
    """
    parts = [(np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((0, 3), np.float32))]
    lost = 0
    for _, pixel, texel, value in contributions(scene, grid, pixels, spp, bounces, seed):
        dr.eval(pixel, texel, value)  # once: each read-back below would trace the rays again
        finite = dr.all(dr.isfinite(value))
        lost += int(dr.count(~finite)[0])
        keep = dr.compress(finite & (dr.max(dr.abs(value)) > 0))
        if len(keep):
            colours = np.stack([dr.gather(mi.Float, value[c], keep).numpy() for c in range(3)], axis=1)
            row, column = (dr.gather(mi.UInt32, index, keep).numpy() for index in (pixel, texel))
            parts.append((row, column, colours))
    rows, columns, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Recorded(*merge(rows, columns, weights, grid.texels), lost)


def record_all(
    scene: Scene, grid: Grid, spp: int, bounces: int, seed: int, progress: Progress | None = None
) -> Recorded:
    """Record every pixel of a scene's film, block by block; other parameters are as in :func:`contributions`.

    ``progress`` is called with (done, total) blocks.
    """
    pixels = scene.width * scene.height
    block = max(1, LANES // spp)
    starts = range(0, pixels, block)
    parts = []
    for i, start in enumerate(starts):
        some = np.arange(start, min(start + block, pixels), dtype=np.uint32)
        parts.append(record(scene.mi, grid, some, spp, bounces, seed))
        if progress:
            progress(i + 1, len(starts))
    rows, columns, weights, lost = zip(*parts, strict=True)
    return Recorded(np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), sum(lost))


def pilot(scene: Scene, grid: Grid, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure where light comes from under a white sky, from a few samples of 4,096 to 16,384 pixels, or all.

    Returns the light by row of the map, (H,), of paths of at most :data:`MAX_BOUNCES` bounces; and by bounce,
    (n,), to the end of the longest path: 0 is the sky seen directly, and n > MAX_BOUNCES.
    """
    pixels = np.arange(scene.width * scene.height, dtype=np.uint32)
    stride = max(1, int(np.sqrt(len(pixels) / 4096)))
    some = pixels.reshape(scene.height, scene.width)[::stride, ::stride].ravel()
    by_row, by_bounce = np.zeros(grid.height), np.zeros(MAX_BOUNCES + 1)
    for bounce, _, texel, value in contributions(
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
    capacity = int(min(MOST_COLUMNS, (memory_gb - coarse_gb) * 1e9 / (16 * pixels), texels, counted))
    about = gigabytes(pixels, spp, capacity)
    columns = f"up to {capacity} exact columns, about {about:.2g} of {memory_gb:g} GB"
    return spp, capacity, f"light transport: {spp} paths a pixel, {columns}"


def allowed(memory_gb: float | str) -> float:
    """Return the GB that a setting allows."""
    return AUTO_GB if memory_gb == "auto" else float(memory_gb)


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
    return pixels * (spp * 1.5 * 2 + columns) * 16 / 1e9


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


def other_light(scene: Scene, max_depth: int, seed: int) -> np.ndarray | None:
    """Render all light that does not come from the environment, (h, w, 3); None where there is none.

    ``max_depth``: -1 for paths of any length.
    """
    if len(scene.mi.emitters()) <= 1:
        return None
    return scene.render(np.zeros((4, 8, 3), np.float32), spp=1024, seed=seed, max_depth=max_depth)
