"""Exact columns of the light transport: one ray from every path vertex towards the very texel.

Recorded samples are spread over the whole map, so that a single bright texel is hit by few of them. A column
holds, for one texel, its contribution to every pixel, from as many rays towards it as there are path
vertices. Columns lie in a bounded store, packed as (r, g, b, unused) and interleaved in slices of 8 pixels,
so that both the product and its adjoint read neighbouring memory. Their number is an argument of the
kernels, not a part of them: more columns compile nothing.
"""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import seeds
from envedit.scene.scene import Scene
from envedit.transport import path_vertices
from envedit.transport.sparse_matrix import SLICE, add_products, merge
from envedit.transport.texel_sampling import Grid

MOST_VALUES = 1 << 22
"""Contributions of vertices to columns that are computed at once."""
_SEGMENTS = 16


class ExactColumns:
    """Columns of T for some texels of a grid, traced on demand.

    Made for a scene, its camera and film, the texels of ``grid`` and paths of ``bounces`` surface points. The
    memory of ``capacity`` columns, the most there will ever be, is taken at once, 16 bytes a pixel and
    column; ``paths_bytes`` of camera paths are kept for columns that are traced later.

    ``texels`` (n,) int64 have a column, in the order of their slots. Of each texel of the grid, (H * W,),
    ``slot_of`` is the slot of its column, -1 without one, ``paths_of`` the camera paths a pixel that it was
    traced with, 0 without one, and ``mask`` (Float) 1 without a column, 0 with one: what is left to the
    coarse tier.
    """

    def __init__(self, scene: Scene, grid: Grid, bounces: int, capacity: int, paths_bytes: int = 0):
        self.scene = scene
        self.grid = grid
        self.bounces = bounces
        self.capacity = capacity
        self.pixels = scene.width * scene.height
        self.texels = np.zeros(0, np.int64)
        self.slot_of = np.full(grid.texels, -1, np.int64)
        self.paths_of = np.zeros(grid.texels, np.int64)
        self.mask = dr.full(mi.Float, 1, grid.texels)
        self._store = dr.zeros(mi.Float, -(-self.pixels // SLICE) * max(capacity, 1) * SLICE * 4)
        self._texel_of = dr.zeros(mi.UInt32, max(capacity, 1))
        self._count = dr.opaque(mi.UInt32, 0)
        self._lost = dr.opaque(mi.UInt32, 0)
        self.paths_bytes = paths_bytes
        self._kept: dict[tuple[int, int], list[path_vertices.Block]] = {}
        dr.make_opaque(self._store, self._texel_of, self.mask)

    @property
    def bytes(self) -> int:
        """Bytes of the store."""
        return 4 * len(self._store)

    @property
    def kept_bytes(self) -> int:
        """Bytes of the paths that are kept: what was traced before decides, unlike :attr:`bytes`."""
        return sum(b.bytes for kept in self._kept.values() for b in kept)

    @property
    def lost(self) -> int:
        """Contributions that were not finite, and were left out."""
        return int(self._lost[0])

    @property
    def room(self) -> int:
        """Columns that can still be added."""
        return self.capacity - len(self.texels)

    # ---- tracing -------------------------------------------------------------------------------------------

    def trace(
        self,
        texels: np.ndarray,
        count: int,
        seed: int,
        keep: np.ndarray | None = None,
        blocks: int | None = None,
    ) -> None:
        """Trace columns of distinct texels with so many camera paths a pixel, in place of older ones.

        ``seed`` is that of every random choice. No more of the texels are new than there is :attr:`room` and
        columns to give up. Texels in ``keep`` give their columns up last, the first of them last of all. Only
        so many ``blocks`` of pixels are traced, if given: enough to have all kernels, but no column to be
        used.
        """
        self._take_slots(texels[self.slot_of[texels] < 0], texels, keep)
        self.paths_of[texels] = count

        for block in itertools.islice(self._paths(count, seed), blocks):
            most = max(1, MOST_VALUES // max(block.vertices, 1))
            for start in range(0, len(texels), most):
                self._add_vertices(block, texels[start : start + most], count, seed)
            if block.escapes:
                self._add_escapes(block, texels)
        self._publish()

    def _paths(self, count, seed):
        """Yield blocks of the paths of a picture, kept from an earlier call where there is memory for it."""
        if (count, seed) in self._kept:
            yield from self._kept[count, seed]
            return
        self._kept = {key: kept for key, kept in self._kept.items() if key[1] == seed}
        traced = []
        room = self.paths_bytes - self.kept_bytes
        own = seeds.columns(seed)
        for block in path_vertices.blocks(self.scene.mi, self.grid, self.pixels, count, self.bounces, own):
            traced.append(block)
            room -= block.bytes
            yield block
            if room < 0:
                traced.clear()
        if room >= 0:
            self._kept[count, seed] = traced

    def _add_vertices(self, block, texels, count, seed):
        """Add what a block of paths contributes to columns by way of its vertices."""
        value, lost = path_vertices.contributions(self.scene.mi, self.grid, block, texels, count, seed)
        self._lost += lost
        place = self._places(texels, block.pixels, dr.opaque(mi.UInt32, block.first)) * 4
        for c in range(3):  # whatever the column held before is overwritten
            dr.scatter(self._store, value[c], place + c)
        dr.eval(self._store, self._lost)

    def _places(self, texels, count, first):
        """Return the packets of so many pixels of texels' columns, texel by texel."""
        slots = path_vertices.on_device(mi.UInt32, (self.slot_of[texels] * SLICE).astype(np.uint32))
        lane = dr.arange(mi.UInt32, len(texels) * count)
        pixels = dr.opaque(mi.UInt32, count)
        texel = lane // pixels
        pixel = lane - texel * pixels + first
        return _first_place(pixel, self.capacity) + dr.gather(mi.UInt32, slots, texel)

    def _take_slots(self, fresh, texels, keep):
        """Give slots to texels without one: new ones first, then those of columns that are given up."""
        new = min(len(fresh), self.room)
        slots = len(self.texels) + np.arange(new)
        if new < len(fresh):
            kept = np.append(texels, [] if keep is None else keep).astype(np.int64)
            rank = np.full(self.grid.texels, len(kept))
            rank[kept[::-1]] = np.arange(len(kept))[::-1]  # of a texel that is listed twice, the first place
            given_up = np.argsort(-rank[self.texels], kind="stable")[: len(fresh) - new]
            gone = self.texels[given_up]
            self.slot_of[gone] = -1
            self.paths_of[gone] = 0
            slots = np.concatenate([slots, given_up])
        self.texels = np.concatenate([self.texels, np.zeros(new, np.int64)])
        self.texels[slots] = fresh
        self.slot_of[fresh] = slots

    def retrace(self, seed: int) -> None:
        """Trace every column again with other samples, each with as many paths as before."""
        paths_of = self.paths_of[self.texels]
        for count in np.unique(paths_of)[::-1]:
            self.trace(self.texels[paths_of == count], int(count), seed)

    def _publish(self):
        """Bring what the kernels read in line with the list of texels."""
        padded = np.zeros(max(self.capacity, 1), np.uint32)
        padded[: len(self.texels)] = self.texels
        self._texel_of = dr.opaque(mi.UInt32(padded))
        mask = np.ones(self.grid.texels, np.float32)
        mask[self.texels] = 0
        self.mask = dr.opaque(mi.Float(mask))
        self._count = dr.opaque(mi.UInt32, len(self.texels))

    def _add_escapes(self, block, texels):
        """Add paths that left the scene towards some texels.

        Few do; they are summed on the host, in a fixed order.
        """
        traced = np.zeros(self.grid.texels, bool)
        traced[texels] = True
        is_traced = dr.opaque(mi.Bool(traced))
        hit = mi.Bool(False)
        for texel in block.texels:
            hit |= dr.gather(mi.Bool, is_traced, texel)
        index = dr.compress(hit)
        if not len(index):
            return
        around, shares, light, pixel = (
            np.stack([dr.gather(type(v), v, index).numpy() for v in values])
            for values in (block.texels, block.shares, block.light, [block.at])
        )
        tap, escape = np.nonzero(traced[around] & (shares > 0))
        value = light[:, escape].T * shares[tap, escape, None]
        texel = around[tap, escape]
        pixel = pixel[0, escape].astype(np.int64)
        slot = self.slot_of[texel]
        target = (pixel // SLICE * self.capacity + slot) * SLICE + pixel % SLICE
        finite = np.isfinite(value).all(axis=1)
        self._lost += int((~finite).sum())
        target, value = target[finite], value[finite]
        if not len(target):
            return
        _, target, value = merge(np.zeros(len(target), np.uint32), target, value, len(self._store) // 4)
        place = path_vertices.on_device(mi.UInt32, target) * 4
        real = dr.arange(mi.UInt32, len(place)) < dr.opaque(mi.UInt32, len(target))
        mode = dr.ReduceMode.NoConflicts  # merged: each place once; the default's kernel has sizes in it
        for c in range(3):
            channel = path_vertices.on_device(mi.Float, value[:, c])
            dr.scatter_add(self._store, channel, place + c, real, mode)
        dr.eval(self._store)

    # ---- using ---------------------------------------------------------------------------------------------

    def product(self, packets: mi.Float, count: int = 1) -> list[mi.Color3f]:
        """Multiply with maps: sum over columns of column * E[texel], of each map one colour a pixel.

        ``packets`` are ``count`` maps, as :func:`.sparse_matrix.to_packets` interleaves them.
        """
        return _product(self._store, packets, self._texel_of, self._count, self.pixels, self.capacity, count)

    def read(self, texels: np.ndarray) -> np.ndarray:
        """Return the columns of texels that have one, (n, pixels, 3); in memory channel by channel."""
        if not len(texels):
            return np.zeros((0, self.pixels, 3), np.float32)
        columns = dr.gather(mi.Vector4f, self._store, self._places(texels, self.pixels, 0))
        dr.eval(columns)
        planes = np.stack([columns[c].numpy() for c in range(3)])
        return planes.reshape(3, len(texels), self.pixels).transpose(1, 2, 0)

    def add_adjoint(self, flat: mi.Float, packets: mi.Float) -> None:
        """Put the adjoint, the sum over pixels of column * I, in the places of the texels that have a column.

        ``flat``, H * W * 3, is the map that is being pulled back to; ``packets`` the picture, 4 floats a
        pixel, (r, g, b, unused), flat.
        """
        if not self.capacity:
            return
        part = _adjoint_parts(self._store, packets, self._count, self.pixels, self.capacity)
        dr.eval(part)
        slot, total = dr.arange(mi.UInt32, self.capacity), mi.Color3f(0)
        for segment in range(_SEGMENTS):
            total += dr.gather(mi.Color3f, part, slot + dr.opaque(mi.UInt32, segment * self.capacity))
        slot = dr.arange(mi.UInt32, self.capacity)
        dr.scatter(flat, total, dr.gather(mi.UInt32, self._texel_of, slot), slot < self._count)

    def state(self) -> dict:
        """Return which texels have a column, in the order of their slots, and the paths of each."""
        return {"columns": self.texels, "paths": self.paths_of[self.texels]}

    def restore(self, state: dict, seed: int) -> None:
        """Trace the columns of an earlier :meth:`state` again."""
        # The same slots as before: the order of a sum is part of its result.
        self.slot_of[:] = -1
        self.paths_of[:] = 0
        self.texels = state["columns"].astype(np.int64)
        self.slot_of[self.texels] = np.arange(len(self.texels))
        self.paths_of[self.texels] = state["paths"]
        self.retrace(seed)


# ---- kernels -----------------------------------------------------------------------------------------------


def _first_place(pixel, capacity):
    """Packet of a pixel's entry in slot 0; those of the next slots follow at a distance of SLICE packets."""
    return (pixel // SLICE) * dr.opaque(mi.UInt32, capacity * SLICE) + pixel % SLICE


@dr.syntax
def _product(store, packets, texel_of, columns, pixels, capacity, count):
    place = _first_place(dr.arange(mi.UInt32, pixels), capacity)
    slot = dr.zeros(mi.UInt32, pixels)
    total = [mi.Color3f(0) for _ in range(count)]
    while slot < columns:
        weight = dr.gather(mi.Vector4f, store, place)
        total = add_products(total, weight, packets, dr.gather(mi.UInt32, texel_of, slot))
        place += SLICE
        slot += 1
    return total


@dr.syntax
def _adjoint_parts(store, packets, count, pixels, capacity):
    """Sum of column * picture over the pixels of each segment; segments occupy every core."""
    # Neighbouring lanes are neighbouring columns: their weights for a pixel lie 8 packets apart and share
    # cache lines with the next 7 pixels.
    lane = dr.arange(mi.UInt32, capacity * _SEGMENTS)
    size = dr.opaque(mi.UInt32, capacity)
    slot, segment = lane % size, lane // size
    each = -(-pixels // (_SEGMENTS * SLICE)) * SLICE
    pixel = segment * dr.opaque(mi.UInt32, each)
    stop = dr.minimum(pixel + dr.opaque(mi.UInt32, each), dr.opaque(mi.UInt32, pixels))
    stop = dr.select(slot < count, stop, 0)
    stride = size * SLICE
    total = mi.Color3f(0)
    while pixel < stop:
        weight = dr.gather(mi.Vector4f, store, (pixel // SLICE) * stride + slot * SLICE + pixel % SLICE)
        value = dr.gather(mi.Vector4f, packets, pixel)
        total += mi.Color3f(weight.x * value.x, weight.y * value.y, weight.z * value.z)
        pixel += 1
    return total
