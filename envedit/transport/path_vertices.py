"""Camera paths that are kept: their vertices, for columns of T that are traced one after the other.

The paths of a picture are the same for every texel. What a column of T needs of them is kept: of each vertex
that a light can reach, its surface interaction, throughput, pixel and path; of each path that leaves the
scene, the texels around its direction. A column then costs one shadow ray and one BSDF evaluation a vertex.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.types import DrArray
from envedit.scene import camera_paths
from envedit.transport.recording import LANES, bsdf_weight, connect
from envedit.transport.sparse_matrix import SLICE
from envedit.transport.texel_sampling import Grid

VERTEX_BYTES, ESCAPE_BYTES = 216, 64
"""Memory of a kept vertex and of a path that leaves the scene."""
_SHADING = mi.BSDFFlags.Smooth


@dataclass
class Block:
    """The paths of some pixels: vertices sorted by pixel, then bounce, then path; and escapes, on the host.

    Attributes
    ----------
    first, pixels : int
        First pixel, and how many.
    vertices, escapes : int
        How many there are.
    si, throughput, bounce, path, pixel : arrays (vertices,)
        As of :class:`.camera_paths.Vertex`; ``pixel`` counts from the picture's first.
    start : UInt32 (pixels + 1,)
        First vertex of each pixel.
    texel, share, escape : ndarrays (n,)
        Texels around the directions of escapes, four or fewer of each: the texel, its share, and the escape
        that it belongs to.
    light, at : ndarrays (escapes, 3), (escapes,)
        What an escape adds for a radiance of 1, and its pixel, from the block's first.
    """

    first: int
    pixels: int
    vertices: int = 0
    escapes: int = 0
    si: mi.SurfaceInteraction3f | None = None
    throughput: mi.Color3f | None = None
    bounce: mi.UInt32 | None = None
    path: mi.UInt32 | None = None
    pixel: mi.UInt32 | None = None
    start: mi.UInt32 | None = None
    texel: np.ndarray | None = None
    share: np.ndarray | None = None
    escape: np.ndarray | None = None
    light: np.ndarray | None = None
    at: np.ndarray | None = None

    @property
    def bytes(self) -> int:
        """Memory that the block holds."""
        return self.vertices * VERTEX_BYTES + self.escapes * ESCAPE_BYTES


def blocks(scene: mi.Scene, grid: Grid, pixels: int, count: int, bounces: int, seed: int) -> Iterator[Block]:
    """Trace the paths of a picture; yields a :class:`Block` for every few pixels.

    Parameters
    ----------
    scene : mi.Scene
        Its sensors are the views.
    grid : Grid
        Texels that escaping rays are recorded by.
    pixels : int
        Pixels of the picture.
    count : int
        Camera paths a pixel.
    bounces : int
        Surface points along a path.
    seed : int
        Seed of every random choice.
    """
    size = max(SLICE, LANES // count // SLICE * SLICE)
    for first in range(0, pixels, size):
        some = np.arange(first, min(first + size, pixels), dtype=np.uint32)
        block, vertices, escapes = Block(first, len(some)), [], []
        for event in camera_paths.trace(scene, some, count, bounces, seed):
            if isinstance(event, camera_paths.Escape):
                escapes.append(_escapes(event, grid, count))
            else:
                vertices.append(_vertices(event, count, first))
        _sort(block, [part for part in vertices if part is not None])
        _join(block, escapes)
        yield block


def _vertices(event, count, first):
    """Take the vertices that a light can reach; None if there are none."""
    # A filter with negative lobes makes negative throughputs; NaN is kept: what uses it counts what it loses.
    lit = event.active & mi.has_flag(event.si.bsdf().flags(), _SHADING) & dr.any(event.throughput != 0)
    keep = np.flatnonzero(lit.numpy()).astype(np.uint32)
    if not len(keep):
        return None
    index = on_device(mi.UInt32, keep)
    si, throughput = (dr.gather(type(v), v, index) for v in (event.si, event.throughput))
    dr.eval(si, throughput)
    n = len(index)
    if len(keep) < n:  # of a single one there are two, see on_device: the other counts for nothing
        keep = np.repeat(keep, n)
        throughput = dr.select(dr.arange(mi.UInt32, n) == 0, throughput, 0)
    numbers = np.full(n, event.bounce, np.uint32), keep % count, first + keep // count
    return si, throughput, numbers


def _sort(block, parts):
    if not parts:
        return
    bounce, path, pixel = (np.concatenate([part[2][i] for part in parts]) for i in range(3))
    sizes = [len(part[2][0]) for part in parts]
    order = np.argsort(pixel, kind="stable").astype(np.uint32)  # by bounce and path they are sorted already
    index = on_device(mi.UInt32, order)
    block.si = dr.gather(mi.SurfaceInteraction3f, _concatenated([part[0] for part in parts], sizes), index)
    block.throughput = dr.gather(mi.Color3f, _concatenated([part[1] for part in parts], sizes), index)
    dr.eval(block.si, block.throughput)
    block.vertices = len(order)
    block.bounce, block.path, block.pixel = (on_device(mi.UInt32, v[order]) for v in (bounce, path, pixel))
    count = np.bincount(pixel[order] - block.first, minlength=block.pixels)
    block.start = on_device(mi.UInt32, np.concatenate([[0], np.cumsum(count)]).astype(np.uint32))


def _escapes(event, grid, count):
    """Take the paths that left the scene: texels around them and their shares (4, n), light, pixel."""
    taps, _, jacobian = grid.locate(event.direction)
    uniform = grid.width * max(grid.height - 1, 1)
    light = event.throughput * (bsdf_weight(event.pdf, uniform / jacobian) / dr.opaque(mi.Float, count))
    # NaN is kept: what uses it counts what it leaves out.
    active = event.active & ~dr.all(light == 0)
    dr.eval(taps, light, active)
    active = active.numpy()
    keep = np.flatnonzero(active)
    texels, shares = (np.stack([tap[k].numpy()[keep] for tap in taps]) for k in (0, 1))
    # By channel: a Color3f is interleaved by a kernel that has its length in it. Literals have one value.
    light = [np.broadcast_to(light[c].numpy(), active.shape)[keep] for c in range(3)]
    return texels, shares, np.stack(light, axis=1), keep // count


def _join(block, parts):
    texels, shares, light, at = zip(*parts, strict=True)
    block.light, block.at = np.concatenate(light), np.concatenate(at).astype(np.uint32)
    block.escapes = len(block.at)
    texel, share = (np.concatenate(both, axis=1).ravel() for both in (texels, shares))
    some = np.flatnonzero(share > 0)
    block.texel, block.share = texel[some], share[some]
    block.escape = (some % max(block.escapes, 1)).astype(np.uint32)


def _concatenated(parts, sizes):
    """Concatenate arrays of so many elements, or structures of them member by member.

    Not by ``dr.concat``, whose kernels have the sizes in them; and a single part too, for its literals would
    make other kernels later.
    """
    starts = np.cumsum([0, *sizes[:-1]])
    places = [
        dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, int(start))
        for size, start in zip(sizes, starts, strict=True)
    ]
    leaves = [list(_leaves(part)) for part in parts]
    joined = [dr.empty(type(leaf), sum(sizes)) for leaf in leaves[0]]
    for place, one in zip(places, leaves, strict=True):
        for target, leaf in zip(joined, one, strict=True):
            dr.scatter(target, leaf, place)
    dr.eval(joined)
    return _of_leaves(parts[0], iter(joined))


def _leaves(value):
    """Yield the flat arrays that a structure consists of; pointers as the numbers that they are."""
    kind = type(value)
    if members := getattr(kind, "DRJIT_STRUCT", None):
        for name in members:
            yield from _leaves(getattr(value, name))
    elif dr.depth_v(kind) > 1:
        for member in value:
            yield from _leaves(member)
    else:
        yield dr.reinterpret_array(mi.UInt32, value) if kind.__name__.endswith("Ptr") else value


def _of_leaves(like, leaves):
    """Put flat arrays together to a structure like another."""
    kind = type(like)
    if members := getattr(kind, "DRJIT_STRUCT", None):
        made = kind()
        for name in members:
            setattr(made, name, _of_leaves(getattr(like, name), leaves))
        return made
    if dr.depth_v(kind) > 1:
        members = [_of_leaves(member, leaves) for member in like]
        return kind(*members) if members else like
    leaf = next(leaves)
    return dr.reinterpret_array(kind, leaf) if kind.__name__.endswith("Ptr") else leaf


def on_device(kind: type[DrArray], values: np.ndarray) -> DrArray:
    """Copy an array to the device, with its first element repeated where there is but one.

    A copy, for numpy's memory is not aligned, and two elements at least, for one would be a scalar: either
    makes another kernel.
    """
    return dr.opaque(kind(np.ascontiguousarray(values if len(values) > 1 else np.repeat(values, 2))))


def contributions(
    scene: mi.Scene, grid: Grid, block: Block, texels: np.ndarray, count: int, seed: int
) -> tuple[mi.Color3f, mi.UInt32]:
    """Return what each of some texels adds to the pixels of a block by way of its vertices.

    Parameters
    ----------
    scene : mi.Scene
        What may block a ray.
    grid : Grid
        The texels' grid.
    block : Block
        Of paths.
    texels : ndarray of int64 (k,)
        Which texels.
    count : int
        Camera paths a pixel.
    seed : int
        Seed of the rays' directions.

    Returns
    -------
    radiance : Color3f (k * pixels,)
        For a radiance of 1 in the texel, texel by texel.
    lost : UInt32
        Contributions that were not finite, and were left out.
    """
    lost = dr.opaque(mi.UInt32, 0)
    if not block.vertices:
        return dr.zeros(mi.Color3f, len(texels) * block.pixels), lost
    areas = np.diff(latlong.row_edges(grid.height)) / grid.width
    keys = (texels + seed * 31) & 0xFFFFFFFF
    each = [
        on_device(mi.UInt32, texels.astype(np.uint32)),
        on_device(mi.UInt32, keys.astype(np.uint32)),
        on_device(mi.Float, areas[texels // grid.width].astype(np.float32)),
    ]
    values = [dr.empty(mi.Float, max(len(texels) * block.vertices, 2)) for _ in range(3)]
    _connect(scene, grid, block, dr.opaque(mi.UInt32, len(texels)), each, count, values, lost)
    dr.eval(values, lost)
    total = _by_pixel(mi.Color3f(*values), block, len(texels))
    dr.eval(total)
    return total, lost


@dr.syntax
def _connect(scene, grid, block, texels, each, count, values, lost):
    """Write what a vertex adds for every texel: value t * vertices + v."""
    v = dr.arange(mi.UInt32, block.vertices)
    si, throughput = (
        dr.gather(mi.SurfaceInteraction3f, block.si, v),
        dr.gather(mi.Color3f, block.throughput, v),
    )
    bounce, path, pixel = (dr.gather(mi.UInt32, a, v) for a in (block.bounce, block.path, block.pixel))
    vertices, per_pixel = dr.opaque(mi.UInt32, block.vertices), dr.opaque(mi.Float, count)
    uniform = dr.opaque(mi.Float, grid.width * max(grid.height - 1, 1))  # over (u, v), one sample a texel
    t = dr.zeros(mi.UInt32, block.vertices)
    while t < texels:
        texel = dr.gather(mi.UInt32, each[0], t)
        row = texel // grid.width
        key = dr.gather(mi.UInt32, each[1], t) + bounce
        u = camera_paths.lattice(path, mi.sample_tea_32(pixel, key)[0])
        direction, jacobian = grid.direction(row, texel - row * grid.width, u)
        vertex = camera_paths.Vertex(1, si, throughput, mi.Bool(True))
        value = connect(scene, vertex, direction, jacobian, uniform / jacobian)
        value = value * (dr.gather(mi.Float, each[2], t) * jacobian / per_pixel)
        finite = dr.all(dr.isfinite(value))
        dr.scatter_add(lost, mi.UInt32(1), mi.UInt32(0), ~finite)
        value = dr.select(finite, value, 0)
        dr.scatter(values[0], value.x, t * vertices + v)
        dr.scatter(values[1], value.y, t * vertices + v)
        dr.scatter(values[2], value.z, t * vertices + v)
        t += 1


@dr.syntax
def _by_pixel(values, block, texels):
    """Sum over the vertices of each pixel, one lane a pixel and texel, in a fixed order."""
    pixels, vertices = (dr.opaque(mi.UInt32, n) for n in (block.pixels, block.vertices))
    lane = dr.arange(mi.UInt32, block.pixels * texels)
    texel = lane // pixels
    pixel = lane - texel * pixels
    i = dr.gather(mi.UInt32, block.start, pixel) + texel * vertices
    stop = dr.gather(mi.UInt32, block.start, pixel + 1) + texel * vertices
    total = mi.Color3f(0)
    while i < stop:
        total += dr.gather(mi.Color3f, values, i)
        i += 1
    return total
