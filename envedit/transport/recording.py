"""Samples of the light transport: which texel contributes how much to which pixel, whatever the map.

Every vertex of a camera path sends one ray towards a texel, and the path's own direction stands for another
where it leaves the scene. The two are combined by the balance heuristic (Veach 1997), whose densities know
the grid but no map.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.types import Progress
from envedit.scene import camera_paths
from envedit.scene.scene import Scene
from envedit.transport.sparse_matrix import merge
from envedit.transport.texel_sampling import Grid

LANES = 1 << 18
"""Paths traced at once: what bounds the memory of a recording."""


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


def other_light(scene: Scene, max_depth: int, seed: int) -> np.ndarray | None:
    """Render all light that does not come from the environment, (h, w, 3); None where there is none.

    ``max_depth``: -1 for paths of any length.
    """
    if len(scene.mi.emitters()) <= 1:
        return None
    return scene.render(np.zeros((4, 8, 3), np.float32), spp=1024, seed=seed, max_depth=max_depth)
