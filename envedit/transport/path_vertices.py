"""Camera paths that are kept: their vertices, for columns of T that are traced one after the other.

The paths of a picture are the same for every texel. What a column of T needs of them is kept: of each vertex
that a light can reach, its ray and intersection, throughput, pixel and path; of each path that leaves the
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

VERTEX_BYTES, ESCAPE_BYTES = 80, 48
"""Memory of a kept vertex and of a path that leaves the scene."""
_SHADING = mi.BSDFFlags.Smooth


@dataclass
class Block:
    """The paths of some pixels: vertices sorted by pixel, then bounce, then path; and escapes."""

    # first, pixels: first pixel, and how many
    first: int
    pixels: int
    # vertices, escapes: how many there are
    vertices: int = 0
    escapes: int = 0
    # (vertices,), origin, direction and time of rays; distance, coordinates, primitive, shape and instance
    # that they meet: what surface interactions are computed from again
    hits: tuple | None = None
    # throughput, bounce, path, pixel: (vertices,), as of :class:`.camera_paths.Vertex`; ``pixel`` counts from
    # the picture's first
    throughput: mi.Color3f | None = None
    bounce: mi.UInt32 | None = None
    path: mi.UInt32 | None = None
    pixel: mi.UInt32 | None = None
    start: mi.UInt32 | None = None  # (pixels + 1,), first vertex of each pixel
    # texels, shares: (escapes,), the four texels around the direction of an escape, and their shares
    texels: mi.Vector4u | None = None
    shares: mi.Vector4f | None = None
    light: mi.Color3f | None = None  # (escapes,), what an escape adds for a radiance of 1
    at: mi.UInt32 | None = None  # (escapes,), its pixel, from the picture's first

    @property
    def bytes(self) -> int:
        """Memory that the block holds."""
        return self.vertices * VERTEX_BYTES + self.escapes * ESCAPE_BYTES


def blocks(scene: mi.Scene, grid: Grid, pixels: int, count: int, bounces: int, seed: int) -> Iterator[Block]:
    """Trace the paths of a picture; yields a :class:`Block` for every few pixels.

    ``pixels`` are those of the picture, ``count`` the camera paths of each; escaping rays are recorded by the
    texels of ``grid``. Other parameters are as of :func:`.camera_paths.trace`.
    """
    size = max(SLICE, LANES // count // SLICE * SLICE)
    for first in range(0, pixels, size):
        some = np.arange(first, min(first + size, pixels), dtype=np.uint32)
        block = Block(first, len(some))
        vertices = []
        escapes = []
        for event in camera_paths.trace(scene, some, count, bounces, seed):
            if isinstance(event, camera_paths.Escape):
                escapes.append(_escapes(event, grid, count, first))
            else:
                vertices.append(_vertices(event, count, first))
        _sort(block, [part for part in vertices if part is not None])
        _join(block, [part for part in escapes if part is not None])
        yield block


def _where(mask):
    """Return the lanes of a mask, and how many there are; of a single one there are two, see on_device."""
    index = dr.compress(mask)
    count = len(index)
    return (on_device(mi.UInt32, index.numpy()) if count == 1 else index), count


def _of_first(value, count):
    """Return a value of lanes; 0 of those beyond a count."""
    return dr.select(dr.arange(mi.UInt32, dr.width(value)) < dr.opaque(mi.UInt32, count), value, 0)


def _vertices(event, count, first):
    """Take the vertices that a light can reach; None if there are none."""
    # A filter with negative lobes makes negative throughputs; NaN is kept: what uses it counts what it loses.
    smooth = mi.has_flag(event.si.bsdf().flags(), _SHADING)
    index, some = _where(event.active & smooth & dr.any(event.throughput != 0))
    if not some:
        return None
    ray, hit = event.hit
    at = hit.t, hit.prim_uv, hit.prim_index, hit.shape_index, hit.shape, hit.instance
    kept = tuple(dr.gather(type(v), v, index) for v in (ray.o, ray.d, ray.time, *at))
    throughput = _of_first(dr.gather(mi.Color3f, event.throughput, index), some)
    pixel = index // dr.opaque(mi.UInt32, count)
    path = index - pixel * dr.opaque(mi.UInt32, count)
    bounce = dr.opaque(mi.UInt32, event.bounce)
    vertices = *kept, throughput, bounce + 0 * index, path, pixel + dr.opaque(mi.UInt32, first)
    dr.make_opaque(vertices)  # literals would make other kernels
    return vertices


def _sort(block, parts):
    """Put vertices in the order of their pixels, then bounces, then paths."""
    if not parts:
        return
    # By pixel and path each part is sorted: a vertex comes after those of earlier pixels and bounces.
    pixels = [part[-1] - dr.opaque(mi.UInt32, block.first) for part in parts]
    counts = np.stack([_counted(pixel, block.pixels) for pixel in pixels])
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    offsets = start[:-1] + np.cumsum(counts, axis=0) - np.cumsum(counts, axis=1)
    places = [
        dr.arange(mi.UInt32, len(pixel)) + dr.gather(mi.UInt32, on_device(mi.UInt32, offset), pixel)
        for pixel, offset in zip(pixels, offsets.astype(np.uint32), strict=True)
    ]
    *hits, block.throughput, block.bounce, block.path, block.pixel = _joined(parts, places)
    block.hits = tuple(hits)
    block.vertices = int(start[-1])
    block.start = on_device(mi.UInt32, start.astype(np.uint32))


def _counted(pixel, count):
    """Count how often each of so many numbers occurs, on the host."""
    counts = dr.zeros(mi.UInt32, max(count, 2))
    # Not in copies for every thread, the default: such a kernel has sizes and threads in it.
    dr.scatter_add(counts, mi.UInt32(1), pixel, mode=dr.ReduceMode.Local)
    return counts.numpy()[:count].astype(np.int64)


def _escapes(event, grid, count, first):
    """Take the paths that left the scene: what a :class:`Block` keeps of them; None if there are none."""
    # NaN is kept: what uses it counts what it leaves out.
    index, some = _where(event.active & dr.any(event.throughput != 0))
    if not some:
        return None
    direction, throughput = dr.gather(mi.Vector3f, event.direction, index), event.throughput
    taps, _, jacobian = grid.locate(direction)
    uniform = grid.width * max(grid.height - 1, 1)
    weight = bsdf_weight(dr.gather(mi.Float, event.pdf, index), uniform / jacobian)
    light = dr.gather(mi.Color3f, throughput, index) * (weight / dr.opaque(mi.Float, count))
    texels, shares = zip(*taps, strict=True)
    pixel = dr.opaque(mi.UInt32, first) + index // dr.opaque(mi.UInt32, count)
    escapes = mi.Vector4u(*texels), mi.Vector4f(*shares), _of_first(light, some), pixel
    dr.eval(escapes)
    return escapes


def _join(block, parts):
    if not parts:
        return
    sizes = [len(part[-1]) for part in parts]
    places = [
        dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, start)
        for size, start in zip(sizes, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True)
    ]
    block.escapes = sum(sizes)
    block.texels, block.shares, block.light, block.at = _joined(parts, places)


def _joined(parts, places):
    """Join tuples of arrays member by member; ``places`` says where the elements of each come to lie.

    Not by ``dr.concat``, whose kernels have the sizes in them; and a single part too, for its literals would
    make other kernels later.
    """
    total = sum(len(place) for place in places)
    joined = tuple(dr.empty(type(member), total) for member in parts[0])
    for part, place in zip(parts, places, strict=True):
        dr.scatter(joined, part, place)
    dr.eval(joined)
    return joined


def on_device(kind: type[DrArray], values: np.ndarray) -> DrArray:
    """Copy an array to the device, with its first element repeated where there is but one.

    A copy, for numpy's memory is not aligned, and two elements at least, for one would be a scalar: either
    makes another kernel.
    """
    return dr.opaque(kind(np.ascontiguousarray(values if len(values) > 1 else np.repeat(values, 2))))


def column_values(
    scene: mi.Scene, grid: Grid, block: Block, texels: np.ndarray, count: int, seed: int
) -> tuple[mi.Color3f, mi.UInt32]:
    """Return what each of some ``texels`` (k,) adds to the pixels of a block by way of its vertices.

    With ``count`` camera paths a pixel; ``seed`` is of the rays' directions. Returned are the radiance of
    each pixel, (k * pixels,), for a radiance of 1 in the texel, texel by texel; and how many contributions
    were not finite, and were left out.
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


def _interaction(hits, lane):
    """Return the surface interactions of kept vertices, as :mod:`.camera_paths` had them."""
    o, d, time, t, uv, prim, index, shape, instance = (dr.gather(type(v), v, lane) for v in hits)
    hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(lane))
    hit.valid = mi.Bool(True)
    hit.t = t
    hit.prim_uv = uv
    hit.prim_index = prim
    hit.shape_index = index
    hit.shape = shape
    hit.instance = instance
    ray = mi.Ray3f(o, d, time, [])
    return hit.compute_surface_interaction(ray, mi.RayFlags.All, mi.Bool(True))


@dr.syntax
def _connect(scene, grid, block, texels, each, count, values, lost):
    """Write what a vertex adds for every texel: value t * vertices + v."""
    v = dr.arange(mi.UInt32, block.vertices)
    si = _interaction(block.hits, v)
    throughput = dr.gather(mi.Color3f, block.throughput, v)
    bounce, path, pixel = (dr.gather(mi.UInt32, a, v) for a in (block.bounce, block.path, block.pixel))
    vertices = dr.opaque(mi.UInt32, block.vertices)
    per_pixel = dr.opaque(mi.Float, count)
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
        dr.scatter_add(lost, mi.UInt32(1), mi.UInt32(0), ~finite, mode=dr.ReduceMode.Local)
        value = dr.select(finite, value, 0)
        for c in range(3):
            dr.scatter(values[c], value[c], t * vertices + v)
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
