"""Exact columns of the light transport: one ray from every path vertex towards the very texel.

Recorded samples are spread over the whole map, so that a single bright texel is hit by few of them. A column
holds, for one texel, its contribution to every pixel, from as many rays towards it as there are path
vertices. Which columns a rendering uses is a value, :class:`Columns`; the columns themselves lie in a bounded
store, packed as (r, g, b, unused) and interleaved in slices of 8 pixels, so that both the product and its
adjoint read neighbouring memory. Their number is an argument of the kernels, not a part of them: more columns
compile nothing.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

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


@dataclass(frozen=True, eq=False)
class Columns:
    """Which texels have an exact column: ``texels`` (n,) int64, distinct, first those that matter most.

    ``paths`` (n,) int64 are the camera paths a pixel of each.
    """

    texels: np.ndarray
    paths: np.ndarray

    @classmethod
    def none(cls) -> Columns:
        """Return no columns."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.texels)

    def paths_of(self, texels: np.ndarray) -> np.ndarray:
        """Return the paths of the columns of some texels, (n,); 0 of those without one."""
        known = dict(zip(self.texels.tolist(), self.paths.tolist(), strict=True))
        return np.array([known.get(texel, 0) for texel in texels.tolist()], np.int64)


class Bound(NamedTuple):
    """Columns as the kernels read them."""

    slots: np.ndarray  # their places in the store
    assigned: int  # how often the store had given slots away by then
    # texel_of, slot_of: of each column; count: how many there are
    texel_of: mi.UInt32
    slot_of: mi.UInt32
    count: mi.UInt32
    mask: mi.Float  # (H * W,), 1 of texels without a column, 0 with one: what is left to the coarse tier


class ColumnStore:
    """Columns of T, traced when they are used; those used least lately make room.

    Made for a scene, its camera and film, the texels of ``grid``, paths of ``bounces`` surface points and a
    ``seed``, that of every random choice: a column of a texel with so many paths is always the same. The
    memory of ``capacity`` columns is taken at once, 16 bytes a pixel and column; ``paths_bytes`` of camera
    paths are kept for columns that are traced later.
    """

    def __init__(
        self, scene: Scene, grid: Grid, bounces: int, capacity: int, seed: int, paths_bytes: int = 0
    ):
        self.scene = scene
        self.grid = grid
        self.bounces = bounces
        self.capacity = max(capacity, 1)
        self.seed = seed
        self.pixels = scene.width * scene.height
        self.paths_bytes = paths_bytes
        self._slot_of: dict[tuple[int, int], int] = {}  # of texel and paths
        self._used = np.full(self.capacity, -1, np.int64)  # when each slot was used last; -1: it is free
        self._uses = itertools.count()
        self._assigned = 0
        self._store = dr.zeros(mi.Float, -(-self.pixels // SLICE) * self.capacity * SLICE * 4)
        self._lost = dr.opaque(mi.UInt32, 0)
        self._kept: dict[int, list[path_vertices.Block]] = {}
        dr.make_opaque(self._store)

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

    # ---- tracing -------------------------------------------------------------------------------------------

    def bind(self, columns: Columns, bound: Bound | None = None) -> Bound:
        """Return columns, at most :attr:`capacity`, as the kernels read them; traces those that are missing.

        ``bound`` is what was returned for the same columns before; it is returned where it still holds.
        """
        if bound is None or bound.assigned != self._assigned:
            ascending = np.argsort(columns.texels)  # sums do not depend on the order
            texels = columns.texels[ascending]
            slots = self._slots(texels, columns.paths[ascending])
            mask = np.ones(self.grid.texels, np.float32)
            mask[texels] = 0
            bound = Bound(
                slots=slots,
                assigned=self._assigned,
                texel_of=dr.opaque(mi.UInt32(self._padded(texels))),
                slot_of=dr.opaque(mi.UInt32(self._padded(slots))),
                count=dr.opaque(mi.UInt32, len(texels)),
                mask=dr.opaque(mi.Float(mask)),
            )
        self._used[bound.slots] = next(self._uses)
        return bound

    def warm_up(self, texel: int, counts: tuple[int, ...]) -> None:
        """Trace one column with each number of paths: what is traced later needs no other kernel.

        Of the largest number only one block of pixels, and nothing is kept of it.
        """
        most = max(counts)
        for count in sorted(set(counts), reverse=True):
            (slot,) = self._free_slots(1, taken=np.zeros(0, np.int64))
            self._trace(np.array([texel]), np.array([slot]), count, blocks=1 if count == most else None)

    def _padded(self, numbers):
        """Return numbers, at most :attr:`capacity`, with zeros: arrays of one length compile nothing."""
        padded = np.zeros(self.capacity, np.uint32)
        padded[: len(numbers)] = numbers
        return padded

    def _slots(self, texels, paths):
        """Return the slots of columns; those that are missing are traced."""
        keys = list(zip(texels.tolist(), paths.tolist(), strict=True))
        slots = np.array([self._slot_of.get(key, -1) for key in keys], np.int64)
        missing = np.flatnonzero(slots < 0)
        if len(missing):
            slots[missing] = self._free_slots(len(missing), taken=slots[slots >= 0])
            for i in missing:
                self._slot_of[keys[i]] = int(slots[i])
            for count in np.unique(paths[missing])[::-1]:
                some = missing[paths[missing] == count]
                self._trace(texels[some], slots[some], int(count))
        self._used[slots] = next(self._uses)
        return slots

    def _free_slots(self, count, taken):
        """Return slots whose columns are used least lately, and forget these; none of those ``taken``."""
        since = self._used.copy()
        since[taken] = np.iinfo(np.int64).max
        slots = np.argsort(since, kind="stable")[:count]
        given_up = set(slots.tolist())
        self._slot_of = {key: slot for key, slot in self._slot_of.items() if slot not in given_up}
        self._used[slots] = -1
        self._assigned += 1
        return slots

    def _trace(self, texels, slots, count, blocks=None):
        """Trace columns of distinct texels with so many camera paths a pixel into slots.

        Only so many ``blocks`` of pixels, if given: enough to have all kernels, but no column to be used.
        """
        for block in itertools.islice(self._paths(count), blocks):
            most = max(1, MOST_VALUES // max(block.vertices, 1))
            for start in range(0, len(texels), most):
                some = slice(start, start + most)
                self._add_vertices(block, texels[some], slots[some], count)
            if block.escapes:
                self._add_escapes(block, texels, slots)

    def _paths(self, count):
        """Yield blocks of the paths of a picture, kept from an earlier call where there is memory for it."""
        if count in self._kept:
            yield from self._kept[count]
            return
        traced = []
        room = self.paths_bytes - self.kept_bytes
        own = seeds.columns(self.seed)
        for block in path_vertices.blocks(self.scene.mi, self.grid, self.pixels, count, self.bounces, own):
            traced.append(block)
            room -= block.bytes
            yield block
            if room < 0:
                traced.clear()
        if room >= 0:
            self._kept[count] = traced

    def _add_vertices(self, block, texels, slots, count):
        """Add what a block of paths contributes to columns by way of its vertices."""
        value, lost = path_vertices.column_values(self.scene.mi, self.grid, block, texels, count, self.seed)
        self._lost += lost
        place = self._places(slots, block.pixels, dr.opaque(mi.UInt32, block.first)) * 4
        for c in range(3):  # whatever the slot held before is overwritten
            dr.scatter(self._store, value[c], place + c)
        dr.eval(self._store, self._lost)

    def _places(self, slots, count, first):
        """Return the packets of so many pixels of columns, column by column."""
        first_of = path_vertices.on_device(mi.UInt32, (slots * SLICE).astype(np.uint32))
        lane = dr.arange(mi.UInt32, len(slots) * count)
        pixels = dr.opaque(mi.UInt32, count)
        column = lane // pixels
        pixel = lane - column * pixels + first
        return _first_place(pixel, self.capacity) + dr.gather(mi.UInt32, first_of, column)

    def _add_escapes(self, block, texels, slots):
        """Add paths that left the scene towards some texels.

        Few do; they are summed on the host, in a fixed order.
        """
        slot_of = np.full(self.grid.texels, -1, np.int64)
        slot_of[texels] = slots
        traced = slot_of >= 0
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
        pixel = pixel[0, escape].astype(np.int64)
        slot = slot_of[around[tap, escape]]
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

    def read(self, columns: Columns) -> np.ndarray:
        """Return columns, of any number, as (n, pixels, 3); in memory channel by channel."""
        planes = np.zeros((3, len(columns), self.pixels), np.float32)
        for start in range(0, len(columns), self.capacity):
            some = slice(start, start + self.capacity)
            slots = self._slots(columns.texels[some], columns.paths[some])
            packets = dr.gather(mi.Vector4f, self._store, self._places(slots, self.pixels, 0))
            dr.eval(packets)
            for c in range(3):
                planes[c, some] = packets[c].numpy().reshape(len(slots), self.pixels)
        return planes.transpose(1, 2, 0)

    def product(self, packets: mi.Float, bound: Bound, count: int = 1) -> list[mi.Color3f]:
        """Multiply with maps: sum over columns of column * E[texel], of each map one colour a pixel.

        ``packets`` are ``count`` maps, as :func:`.sparse_matrix.to_packets` interleaves them.
        """
        return _product(
            self._store,
            packets,
            bound.texel_of,
            bound.slot_of,
            bound.count,
            self.pixels,
            self.capacity,
            count,
        )

    def add_adjoint(self, flat: mi.Float, packets: mi.Float, bound: Bound) -> None:
        """Put the adjoint, the sum over pixels of column * I, in the places of the texels that have a column.

        ``flat``, H * W * 3, is the map that is being pulled back to; ``packets`` the picture, 4 floats a
        pixel, (r, g, b, unused), flat.
        """
        part = _adjoint_parts(self._store, packets, bound.slot_of, bound.count, self.pixels, self.capacity)
        dr.eval(part)
        column, total = dr.arange(mi.UInt32, self.capacity), mi.Color3f(0)
        for segment in range(_SEGMENTS):
            total += dr.gather(mi.Color3f, part, column + dr.opaque(mi.UInt32, segment * self.capacity))
        column = dr.arange(mi.UInt32, self.capacity)
        dr.scatter(flat, total, dr.gather(mi.UInt32, bound.texel_of, column), column < bound.count)


# ---- kernels -----------------------------------------------------------------------------------------------


def _first_place(pixel, capacity):
    """Packet of a pixel's entry in slot 0; those of the next slots follow at a distance of SLICE packets."""
    return (pixel // SLICE) * dr.opaque(mi.UInt32, capacity * SLICE) + pixel % SLICE


@dr.syntax
def _product(store, packets, texel_of, slot_of, columns, pixels, capacity, count):
    first = _first_place(dr.arange(mi.UInt32, pixels), capacity)
    column = dr.zeros(mi.UInt32, pixels)
    total = [mi.Color3f(0) for _ in range(count)]
    while column < columns:
        weight = dr.gather(mi.Vector4f, store, first + SLICE * dr.gather(mi.UInt32, slot_of, column))
        total = add_products(total, weight, packets, dr.gather(mi.UInt32, texel_of, column))
        column += 1
    return total


@dr.syntax
def _adjoint_parts(store, packets, slot_of, columns, pixels, capacity):
    """Sum of column * picture over the pixels of each segment; segments occupy every core."""
    # Lanes are columns: their weights for a pixel share cache lines with the next 7 pixels.
    lane = dr.arange(mi.UInt32, capacity * _SEGMENTS)
    size = dr.opaque(mi.UInt32, capacity)
    column, segment = lane % size, lane // size
    slot = dr.gather(mi.UInt32, slot_of, column)
    each = -(-pixels // (_SEGMENTS * SLICE)) * SLICE
    pixel = segment * dr.opaque(mi.UInt32, each)
    stop = dr.minimum(pixel + dr.opaque(mi.UInt32, each), dr.opaque(mi.UInt32, pixels))
    stop = dr.select(column < columns, stop, 0)
    stride = size * SLICE
    total = mi.Color3f(0)
    while pixel < stop:
        weight = dr.gather(mi.Vector4f, store, (pixel // SLICE) * stride + slot * SLICE + pixel % SLICE)
        value = dr.gather(mi.Vector4f, packets, pixel)
        total += mi.Color3f(weight.x * value.x, weight.y * value.y, weight.z * value.z)
        pixel += 1
    return total
