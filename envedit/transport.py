"""Light transport T: a rendering is linear in the environment map, I = T E + I_0.

T is traced once for a scene, its camera and a texel grid, without looking at any map; then rendering is a matrix product and its
adjoint is exact. Nothing changes from step to step, so no Monte Carlo noise bends the objective (see docs/architecture.md).

Two tiers, both unbiased:

* the **coarse** tier is a sparse matrix of recorded samples, spread evenly over directions; it renders the smooth part of a
  map with little error, but a single bright texel is hit by few samples;
* the **exact** tier holds whole columns of T, one shadow ray per path vertex towards that very texel. :meth:`LightTransport.resolve` adds them
  for the texels that are bright in a given map.

T E = T_coarse (E outside the columns) + T_exact (E inside them). What it costs follows the light, not the grid.

Mitsuba interpolates the map bilinearly: "texel j" is the tent function around its centre. Directions are drawn from that tent, and combined
with BSDF samples by the balance heuristic (Veach 1997), whose densities know the grid but no map.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from . import latlong, paths
from .errors import ConfigError, InputError
from .sparse import SLICE, ColourMatrix, merge

DEPTH_TOLERANCE = 0.002
MAX_BOUNCES = 8
COLUMN_TOLERANCE = 0.03
COLUMN_PATHS = (8, 48)
SHARE_OF_A_LIGHT = 0.01
RESOLVE_EVERY = 10
_LANES = 1 << 18


class Grid:
    """The texels of an ``(height, width)`` map as sampling targets, in the world frame of one emitter.

    ``mass`` (H,) is the probability of each row; within a row all texels are equally likely.
    """

    def __init__(self, height: int, width: int, to_world: np.ndarray, mass: np.ndarray):
        self.height, self.width = height, width
        self.to_world = mi.Matrix3f(np.asarray(to_world, dtype=np.float32))
        mass = np.asarray(mass, np.float64) / np.sum(mass)
        area = np.diff(latlong.row_edges(height)) / width  # of a texel in the (u, v) square
        self.mass, self.area = mi.Float(mass.astype(np.float32)), mi.Float(area.astype(np.float32))
        self.cdf = mi.Float(np.concatenate([[0], np.cumsum(mass)]).astype(np.float32))
        self.density = mi.Float((mass / width / area).astype(np.float32))
        dr.make_opaque(self.mass, self.area, self.cdf, self.density)

    def choose(self, u: mi.Point2f):
        """Choose a texel and a direction in its tent; returns texel, direction, texel's probability, (u, v)-area, jacobian."""
        row = dr.binary_search(0, self.height, lambda i: dr.gather(mi.Float, self.cdf, i + 1) <= u.x)
        row = dr.minimum(row, self.height - 1)
        low, mass = dr.gather(mi.Float, self.cdf, row), dr.gather(mi.Float, self.mass, row)
        x = u.y * self.width
        column = dr.minimum(mi.UInt32(x), self.width - 1)
        rest = mi.Point2f(x - column, dr.clip((u.x - low) / mass, 0, 1))
        direction, jacobian = self.direction(row, column, rest)
        area = dr.gather(mi.Float, self.area, row)
        return row * self.width + column, direction, mass / self.width, area, jacobian

    def direction(self, row, column, u):
        """Return a world direction drawn from the tent of a texel, and d(solid angle) / d(u, v) = 2 pi^2 sin(theta) there."""
        tent_x, tent_y = _tent(u.x), _tent(u.y)
        # The tents of the poles' rows are one-sided.
        tent_y = dr.select(row == 0, dr.abs(tent_y), dr.select(row == self.height - 1, -dr.abs(tent_y), tent_y))
        phi = dr.two_pi * (mi.Float(column) + 0.5 + tent_x) / self.width
        theta = dr.pi * (mi.Float(row) + tent_y) / max(self.height - 1, 1)
        sin_theta, cos_theta = dr.sincos(theta)
        sin_phi, cos_phi = dr.sincos(phi)
        local = mi.Vector3f(sin_theta * sin_phi, cos_theta, -sin_theta * cos_phi)
        return self.to_world @ local, 2 * dr.pi * dr.pi * dr.maximum(sin_theta, 0)

    def locate(self, direction):
        """Return the four texels around a world direction with their bilinear weights, row position and jacobian."""
        d = self.to_world.T @ direction
        x = dr.atan2(d.x, -d.z) * dr.inv_two_pi * self.width - 0.5
        y = dr.safe_acos(d.y) * dr.inv_pi * (self.height - 1)
        column = dr.floor(x)
        row = dr.clip(dr.floor(y), 0, max(self.height - 2, 0))
        fx, fy = x - column, y - row
        column = mi.Int32(column)
        left = mi.UInt32(dr.select(column < 0, column + self.width, column)) % self.width
        right = (left + 1) % self.width
        top = mi.UInt32(row) * self.width
        bottom = dr.minimum(mi.UInt32(row) + 1, self.height - 1) * self.width
        taps = [(top + left, (1 - fx) * (1 - fy)), (top + right, fx * (1 - fy)),
                (bottom + left, (1 - fx) * fy), (bottom + right, fx * fy)]
        jacobian = 2 * dr.pi * dr.pi * dr.safe_sqrt(1 - d.y * d.y)
        return taps, y, jacobian

    def locate_one(self, direction, u):
        """Return one of the four texels around a direction, drawn by its bilinear weight, row position and jacobian."""
        taps, row, jacobian = self.locate(direction)
        (top_left, w00), (top_right, w10), (bottom_left, w01), (bottom_right, _) = taps
        top = w00 + w10
        right = u.x < dr.select(top > 0, w10 / top, 0)
        is_top = u.y < top
        # The horizontal share is the same in both rows.
        right = dr.select(top > 0, right, u.x > w01)
        return dr.select(is_top, dr.select(right, top_right, top_left),
                         dr.select(right, bottom_right, bottom_left)), row, jacobian

    def density_at(self, position):
        """Density of sampled directions over (u, v) at a fractional row, interpolated between rows."""
        row = dr.minimum(mi.UInt32(position), max(self.height - 2, 0))
        below = dr.minimum(row + 1, self.height - 1)
        return dr.lerp(dr.gather(mi.Float, self.density, row), dr.gather(mi.Float, self.density, below),
                       dr.clip(position - row, 0, 1))


def _tent(u):
    return dr.select(u < 0.5, dr.sqrt(2 * u) - 1, 1 - dr.safe_sqrt(2 - 2 * u))


class LightTransport:
    """T for one scene, camera and texel grid; built by :meth:`build`.

    Attributes
    ----------
    influence : ndarray (H, W)
        T' 1: how much a unit of radiance in each texel adds to the picture, summed over pixels and averaged over channels.
    choices : list of str
        What was chosen automatically, with the measurement that decided.
    columns : ndarray of int64
        Texels that have an exact column.
    """

    def __init__(self, scene, grid, spp, bounces, seed, capacity, refresh, choices, progress):
        texels, pixels = grid.height * grid.width, scene.height * scene.width
        self.scene, self.grid, self.shape = scene, grid, (scene.height, scene.width)
        self.spp, self.bounces, self.capacity, self.refresh, self.choices = spp, bounces, capacity, refresh, choices
        self.epoch, self._base_seed = 0, seed
        offset = _other_light(scene, bounces + 1, seed)
        self._record(progress)
        self.columns = np.zeros(0, np.int64)
        self._slot_of = np.full(texels, -1, np.int64)
        self._paths_of = np.zeros(texels, np.int64)
        self._exact = dr.zeros(mi.Float, -(-pixels // SLICE) * max(capacity, 1) * SLICE * 4)
        self._texel_of = dr.zeros(mi.UInt32, max(capacity, 1))
        self._coarse_mask = dr.full(mi.Float, 1, texels)
        self._offset = mi.Float(0) if offset is None else mi.Float(offset.ravel())
        self._count = dr.opaque(mi.UInt32, 0)
        dr.make_opaque(self._exact, self._texel_of, self._coarse_mask, self._offset)

    # ------------------------------------------------------------------ building

    @property
    def seed(self) -> int:
        """Seed of the present recording."""
        return self._base_seed + 1_000_003 * self.epoch

    def _record(self, progress=None):
        """Trace the coarse tier with the seed of the present epoch."""
        texels, pixels = self.grid.height * self.grid.width, self.shape[0] * self.shape[1]
        block = max(1, _LANES // self.spp)
        starts = range(0, pixels, block)
        parts = []
        for i, start in enumerate(starts):
            some = np.arange(start, min(start + block, pixels), dtype=np.uint32)
            parts.append(_record(self.scene.mi, self.grid, some, self.spp, self.bounces, self.seed))
            if progress:
                progress(i + 1, len(starts))
        rows, columns, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
        self.forward = ColourMatrix(rows, columns, weights, (pixels, texels))
        self.reverse = ColourMatrix(columns, rows, weights, (texels, pixels))
        influence = np.bincount(columns, weights.astype(np.float64).mean(axis=1), minlength=texels)
        self.influence = influence.reshape(self.grid.height, self.grid.width).astype(np.float32)

    def _retrace(self, epoch):
        """Record everything again with other samples: a new, independent estimate of the same T."""
        self.epoch = epoch
        self._record()
        self._retrace_columns()

    def _retrace_columns(self):
        paths_of = self._paths_of[self.columns]
        for count in np.unique(paths_of)[::-1]:
            self._trace_columns(self.columns[paths_of == count], int(count))

    @classmethod
    def build(cls, scene, height: int, width: int, *, spp="auto", max_depth="auto", seed: int = 0, memory_gb=2.0,
              refresh: int = 0, progress=None):
        """Trace T.

        Parameters
        ----------
        scene : envedit.scene.Scene
            Scene, camera and film.
        height, width : int
            Texel grid of the maps that T will be applied to.
        spp : int or "auto"
            Texel samples a pixel of the coarse tier.
        max_depth : int or "auto"
            Mitsuba's path depth (1: sky seen directly, 2: direct light). "auto" stops where the next bounce adds less than
            :data:`DEPTH_TOLERANCE` of the picture under a white sky.
        seed : int
            Seed of the recording.
        memory_gb : float
            Bound on the memory of T.
        refresh : int
            Steps after which :meth:`render` records T afresh; 0: never.
        progress : callable, optional
            Called with (done, total) pixel blocks.

        Raises
        ------
        InputError
            No pixel receives light from the environment, or T does not fit into ``memory_gb``.
        """
        memory_gb = 2.0 if memory_gb == "auto" else float(memory_gb)
        for name, value in (("spp", spp), ("max_depth", max_depth)):
            if value != "auto" and not value >= 1:
                raise ConfigError(f"renderer.{name}: came {value}, wanted a whole number of at least 1, or auto")
        choices = []
        pixels = np.arange(scene.width * scene.height, dtype=np.uint32)
        sphere = latlong.solid_angles(height, width)

        pilot_grid = Grid(height, width, scene.to_world, sphere)
        stride = max(1, int(np.sqrt(len(pixels) / 4096)))
        some = pixels.reshape(scene.height, scene.width)[::stride, ::stride].ravel()
        rows_light, bounce_light = _pilot(scene, pilot_grid, some, seed)
        total = bounce_light.sum()
        within = "" if max_depth == "auto" else f" within path depth {max_depth}"
        if not (total if max_depth == "auto" else bounce_light[:max_depth].sum()) > 0:
            raise InputError(f"{scene.path or 'scene dict'}: no pixel receives light from the environment{within}: "
                             "check the camera and that the scene is open")
        if max_depth == "auto":
            left = 1 - np.cumsum(bounce_light) / total
            bounces = int(np.argmax(left <= DEPTH_TOLERANCE)) if (left <= DEPTH_TOLERANCE).any() else MAX_BOUNCES
            choices.append(f"path depth {bounces + 1}: further bounces add {100 * left[bounces]:.2g} % of the picture under a white sky")
        else:
            bounces = int(max_depth) - 1
        # Rows that hardly matter to this view get few samples, but never none.
        floor = 0.05 * rows_light.max()
        mass = sphere * np.clip(rows_light / np.maximum(sphere, 1e-12), floor / sphere.max(), None) ** 0.5
        grid = Grid(height, width, scene.to_world, np.maximum(mass, 1e-6 * mass.sum()))

        # Two packed copies (T and its transpose) of 16 bytes an entry; a path leaves about 1.5 entries.
        wanted, spp = spp, 256 if spp == "auto" else int(spp)
        coarse_gb = _coarse_gb(len(pixels), spp)
        while wanted == "auto" and coarse_gb > 0.7 * memory_gb and spp > 16:
            spp //= 2
            coarse_gb = _coarse_gb(len(pixels), spp)
        if coarse_gb > memory_gb:
            raise InputError(
                f"light transport needs {coarse_gb:.2g} GB for {scene.width}x{scene.height} pixels at {spp} samples, memory_gb allows "
                f"{memory_gb:g}: raise [renderer] memory_gb, or lower [renderer] spp or [scene] width")
        capacity = int(min(768, (memory_gb - coarse_gb) * 1e9 / (16 * len(pixels)), height * width))
        choices.append(f"light transport: {spp} paths a pixel, up to {capacity} exact columns, "
                       f"about {coarse_gb + capacity * 16e-9 * len(pixels):.2g} of {memory_gb:g} GB")

        return cls(scene, grid, spp, bounces, seed, capacity, refresh, choices, progress)

    @property
    def memory_bytes(self) -> int:
        """Bytes held by both tiers."""
        return self.forward.bytes + self.reverse.bytes + 4 * len(self._exact)

    # ------------------------------------------------------------------ using

    def apply(self, envmap: mi.TensorXf) -> mi.TensorXf:
        """Render: (H, W, 3) linear radiance to (h, w, 3), differentiable, T E + I_0."""
        self._check(envmap, (self.grid.height, self.grid.width, 3), "map")
        return dr.custom(_Apply, self, envmap)

    def adjoint(self, image: mi.TensorXf) -> mi.TensorXf:
        """Pull a picture (h, w, 3) back to the map: T' I, (H, W, 3)."""
        self._check(image, (*self.shape, 3), "picture")
        return self._adjoint(image)

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render a map: the interface that all renderers share.

        T does not depend on the step; but now and then it is checked whether the map has grown bright where T is coarse.
        """
        if self.refresh and step // self.refresh != self.epoch:
            self._retrace(step // self.refresh)
        if step % RESOLVE_EVERY == 0:
            self.resolve(dr.detach(envmap).numpy())
        return self.apply(envmap)

    def state(self) -> dict:
        """Return what a checkpoint must hold: which columns are exact, in their order, and how many paths each was traced with."""
        return {"columns": self.columns, "paths": self._paths_of[self.columns], "epoch": np.int64(self.epoch)}

    def restore(self, state: dict) -> None:
        """Trace the columns of an earlier :meth:`state`."""
        if int(state["epoch"]) != self.epoch:
            self.epoch = int(state["epoch"])
            self._record()
        # The same slots as before: the order of a sum is part of its result.
        self.columns = state["columns"].astype(np.int64)
        self._slot_of[self.columns] = np.arange(len(self.columns))
        self._paths_of[self.columns] = state["paths"]
        self._retrace_columns()

    def _check(self, tensor, shape, what):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"light transport: the {what} must have shape {shape}, got {tuple(tensor.shape)}")

    def _apply(self, envmap, offset=True):
        texels = self.grid.height * self.grid.width
        packets = _to_packets(envmap.array, texels)
        coarse = self.forward.apply(_scale_packets(packets, self._coarse_mask, texels))
        exact = _exact_product(self._exact, packets, self._texel_of, self._count, self.shape[0] * self.shape[1], self.capacity)
        flat = dr.ravel(coarse + exact)
        return mi.TensorXf(flat + self._offset if offset else flat, (*self.shape, 3))

    def _adjoint(self, image):
        pixels = self.shape[0] * self.shape[1]
        packets = _to_packets(image.array, pixels)
        coarse = self.reverse.apply(packets) * self._coarse_mask
        flat = dr.ravel(coarse)
        if self.capacity:
            sums = _exact_adjoint(self._exact, packets, self._count, pixels, self.capacity)
            slot = dr.arange(mi.UInt32, self.capacity)
            dr.scatter(flat, sums, dr.gather(mi.UInt32, self._texel_of, slot), slot < self._count)
        return mi.TensorXf(flat, (self.grid.height, self.grid.width, 3))

    # ------------------------------------------------------------------ exact columns

    def resolve(self, envmap, tolerance: float = COLUMN_TOLERANCE, limit: int | None = None) -> int:
        """Trace exact columns for the texels that the coarse tier would render with too much error.

        The coarse tier's relative error for a map is predicted as the standard deviation of E over its mean, over sqrt(samples a
        pixel); the brightest texels are taken out until the rest stays under ``tolerance``.

        Parameters
        ----------
        envmap : array_like (H, W, 3)
            Map that is about to be rendered.
        tolerance : float
            Relative error allowed for the coarse part.
        limit : int, optional
            Trace at most so many new columns.

        Returns
        -------
        int
            Number of columns added. Texels stay exact for good; when the capacity is reached no more are added.
        """
        envmap = np.asarray(envmap)
        wanted = self.bright_texels(envmap, tolerance)
        light = self._light(envmap)
        is_light = light[wanted] > SHARE_OF_A_LIGHT * light.sum()
        traced = 0
        for count, texels in ((COLUMN_PATHS[1], wanted[is_light]), (COLUMN_PATHS[0], wanted[~is_light])):
            new = texels[self._paths_of[texels] < count]
            known = new[self._slot_of[new] >= 0]
            fresh = new[self._slot_of[new] < 0][: self.capacity - len(self.columns)]
            todo = np.concatenate([known, fresh])[: None if limit is None else limit - traced]
            if len(todo):
                self._trace_columns(todo, count)
                traced += len(todo)
        return traced

    def _light(self, envmap):
        """What each texel contributes to the picture, (H * W,)."""
        return envmap.reshape(-1, 3).astype(np.float64).mean(axis=1) * self.influence.ravel()

    def bright_texels(self, envmap: np.ndarray, tolerance: float = COLUMN_TOLERANCE) -> np.ndarray:
        """List the texels that must be exact for this map, brightest first (see :meth:`resolve`)."""
        omega = np.repeat(latlong.solid_angles(self.grid.height, self.grid.width), self.grid.width)
        # A texel that no sample has met may matter as much as its row: rows are told by many samples.
        seen = np.repeat((self.influence > 0).any(axis=1), self.grid.width)
        radiance = envmap.reshape(-1, 3).astype(np.float64).max(axis=1) * seen
        omega = omega * seen
        total, span = (radiance * omega).sum(), omega.sum()
        if not total > 0:
            return np.zeros(0, np.int64)
        order = np.argsort(-radiance, kind="stable")
        # Variance of what is left when the first k are taken out, k = 0 ... n.
        e, w = radiance[order], omega[order]
        square = total_from(e * e * w)
        linear = total_from(e * w)
        weight = total_from(w)
        variance = np.maximum(square - linear**2 / np.maximum(weight, 1e-30), 0) * span
        error = np.sqrt(variance / self.spp) / total
        enough = np.flatnonzero(error <= tolerance)
        return order[: enough[0] if len(enough) else len(order)]

    def _trace_columns(self, texels: np.ndarray, count: int):
        """Trace the columns of ``texels`` with ``count`` camera paths a pixel; a column that was there is replaced."""
        grid, pixels = self.grid, self.shape[0] * self.shape[1]
        fresh = texels[self._slot_of[texels] < 0]
        self._slot_of[fresh] = len(self.columns) + np.arange(len(fresh))
        self.columns = np.concatenate([self.columns, fresh.astype(np.int64)])
        self._paths_of[texels] = count
        self._clear(self._slot_of[texels])

        traced = np.full(grid.height * grid.width, -1, np.int32)
        traced[texels] = self._slot_of[texels]
        traced = mi.Int32(traced)
        areas = np.diff(latlong.row_edges(grid.height)) / grid.width
        uniform = grid.width * max(grid.height - 1, 1)  # density over (u, v) of one sample in every texel
        block = max(SLICE, _LANES // count // SLICE * SLICE)
        per_pixel = dr.opaque(mi.UInt32, count)
        for start in range(0, pixels, block):
            some = np.arange(start, min(start + block, pixels), dtype=np.uint32)
            lane = dr.arange(mi.UInt32, len(some) * count)
            path = lane % per_pixel
            pixel = lane // per_pixel + dr.opaque(mi.UInt32, start)
            place = (pixel // SLICE) * dr.opaque(mi.UInt32, self.capacity * SLICE) + pixel % SLICE
            first_of_pixel = dr.gather(mi.UInt32, place, dr.arange(mi.UInt32, len(some)) * per_pixel)
            dr.eval(place, first_of_pixel)
            for event in paths.trace(self.scene.mi, some, count, self.bounces, self.seed + 7919):
                if isinstance(event, paths.Escape):
                    self._add_escapes(event, traced, place, uniform, count)
                    continue
                for texel in texels:
                    row, column = divmod(int(texel), grid.width)
                    scramble = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, (int(texel) + self.seed * 31 + event.bounce) & 0xFFFFFFFF))[0]
                    u = paths.lattice(path, scramble)
                    direction, jacobian = grid.direction(dr.opaque(mi.UInt32, row), dr.opaque(mi.UInt32, column), u)
                    value = _connect(self.scene.mi, event, direction, jacobian, uniform / jacobian)
                    value *= dr.opaque(mi.Float, float(areas[row])) * jacobian / mi.Float(per_pixel)
                    target = first_of_pixel + dr.opaque(mi.UInt32, int(self._slot_of[texel])) * SLICE
                    for c in range(3):
                        dr.scatter_add(self._exact, dr.block_sum(value[c], count), target * 4 + c)
                    dr.eval(self._exact)
        padded = np.zeros(max(self.capacity, 1), np.uint32)
        padded[: len(self.columns)] = self.columns
        self._texel_of = mi.UInt32(padded)
        mask = np.ones(grid.height * grid.width, np.float32)
        mask[self.columns] = 0
        self._coarse_mask = mi.Float(mask)
        self._count = dr.opaque(mi.UInt32, len(self.columns))
        dr.make_opaque(self._texel_of, self._coarse_mask)

    def _add_escapes(self, event, slot_of, place, uniform, count):
        """Add paths that left the scene towards the traced texels. Few do; summed on the host, in a fixed order."""
        taps, _, jacobian = self.grid.locate(event.direction)
        weight = _bsdf_weight(event.pdf, uniform / jacobian) / count
        targets, values = [], []
        for texel, share in taps:
            slot = dr.gather(mi.Int32, slot_of, texel)
            value, target = event.throughput * (weight * share), place + mi.UInt32(slot) * SLICE
            wanted = event.active & (slot >= 0) & (weight * share > 0)
            dr.eval(value, target, wanted)  # else what is left to compute, and so the kernel, depends on who was hit
            keep = dr.compress(wanted)
            if len(keep):
                targets.append(dr.gather(mi.UInt32, target, keep).numpy())
                values.append(dr.gather(mi.Color3f, value, keep).numpy().T)
        if targets:
            _, target, value = merge(np.zeros(sum(map(len, targets)), np.uint32), np.concatenate(targets),
                                     np.concatenate(values), len(self._exact) // 4)
            for c in range(3):
                dr.scatter_add(self._exact, mi.Float(value[:, c].copy()), mi.UInt32(target) * 4 + c)
            dr.eval(self._exact)

    def _clear(self, slots):
        """Set the exact columns in ``slots`` to zero."""
        clear = np.zeros(max(self.capacity, 1), bool)
        clear[slots] = True
        i = dr.arange(mi.UInt32, len(self._exact))
        gone = dr.gather(mi.Bool, mi.Bool(clear), (i // (4 * SLICE)) % max(self.capacity, 1))
        self._exact = dr.select(gone, 0, self._exact)
        dr.eval(self._exact)


def total_from(x):
    """Sum of x[k:] for k = 0 ... len(x)."""
    return np.concatenate([np.cumsum(x[::-1])[::-1], [0.0]])


class _Apply(dr.CustomOp):
    """T as a differentiable operation; its reverse pass is the exact adjoint."""

    def eval(self, transport, envmap):
        self.transport = transport
        return transport._apply(envmap)

    def forward(self):
        self.set_grad_out(self.transport._apply(self.grad_in("envmap"), offset=False))

    def backward(self):
        self.set_grad_in("envmap", self.transport._adjoint(self.grad_out()))

    def name(self):
        return "light transport"


# ---------------------------------------------------------------------- recording


def _connect(scene, vertex, direction, jacobian, sampled):
    """Throughput * BSDF * visibility towards a sampled direction, times its balance-heuristic weight.

    ``sampled`` is the solid-angle density of the texel sample there.
    """
    si, bsdf = vertex.si, vertex.si.bsdf()
    active = vertex.active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & (jacobian > 0)
    wo = si.to_local(direction)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    value = mi.Color3f(mi.unpolarized_spectrum(si.to_world_mueller(value, -wo, si.wi)))
    active &= dr.max(value) > 0
    active &= ~scene.ray_test(si.spawn_ray(direction), active)
    weight = sampled / (sampled + pdf)
    return dr.select(active, vertex.throughput * value * weight, 0)


def _bsdf_weight(pdf, sampled):
    """Balance-heuristic weight of a BSDF sample; 1 where nothing else could have sampled it (infinite pdf)."""
    return dr.select(dr.isinf(pdf), 1, pdf / (pdf + sampled))


def _contributions(scene, grid, pixels, spp, bounces, seed):
    """Yield (bounce, lane's pixel, texel, RGB weight) batches of one block of pixels, as device arrays.

    Every path vertex sends one ray to a texel, and the path's own direction stands for another where it leaves the scene.
    """
    lane = dr.arange(mi.UInt32, len(pixels) * spp)
    pixel = dr.gather(mi.UInt32, mi.UInt32(pixels), lane // spp)
    for event in paths.trace(scene, pixels, spp, bounces, seed):
        scramble = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, (seed * 1009 + 512 + event.bounce) & 0xFFFFFFFF))[0]
        u = paths.lattice(mi.permute_kensler(lane % spp, spp, scramble), scramble)
        if isinstance(event, paths.Escape):
            texel, row, jacobian = grid.locate_one(event.direction, u)
            weight = _bsdf_weight(event.pdf, grid.density_at(row) / jacobian)
            yield event.bounce, pixel, texel, dr.select(event.active, event.throughput * (weight / spp), 0)
        else:
            texel, direction, probability, area, jacobian = grid.choose(u)
            row = dr.safe_acos((grid.to_world.T @ direction).y) * dr.inv_pi * (grid.height - 1)
            value = _connect(scene, event, direction, jacobian, grid.density_at(row) / jacobian)
            yield event.bounce, pixel, texel, value * (area * jacobian / (probability * spp))


def _record(scene, grid, pixels, spp, bounces, seed):
    """Trace one block of pixels; returns merged rows, columns, weights as numpy arrays."""
    rows, columns, weights = [], [], []
    for _, pixel, texel, value in _contributions(scene, grid, pixels, spp, bounces, seed):
        peak = dr.max(dr.abs(value))
        keep = dr.compress((peak > 0) & dr.isfinite(peak))
        if len(keep) == 0:
            continue
        rows.append(dr.gather(mi.UInt32, pixel, keep).numpy())
        columns.append(dr.gather(mi.UInt32, texel, keep).numpy())
        weights.append(np.stack([dr.gather(mi.Float, value[c], keep).numpy() for c in range(3)], axis=1))
    if not rows:
        return np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((0, 3), np.float32)
    return merge(np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), grid.height * grid.width)


def _pilot(scene, grid, pixels, seed):
    """Light by map row (H,) and by bounce, under a white sky, from a few samples of some pixels."""
    by_row, by_bounce = np.zeros(grid.height), np.zeros(MAX_BOUNCES + 1)
    for bounce, _, texel, value in _contributions(scene.mi, grid, pixels, 16, MAX_BOUNCES, seed + 104729):
        # Summed on the host: atomics would give other bits, and so other samples, on every run.
        amount = np.nan_to_num(dr.mean(value).numpy().astype(np.float64), nan=0, posinf=0, neginf=0)
        by_row += np.bincount(texel.numpy() // grid.width, amount, minlength=grid.height)
        by_bounce[bounce] += amount.sum()
    return by_row, by_bounce


def _coarse_gb(pixels, spp):
    return pixels * spp * 1.5 * 32 / 1e9


def _other_light(scene, max_depth, seed):
    """Picture (h, w, 3) of all light that does not come from the environment, or None where there is none."""
    if len(scene.mi.emitters()) <= 1:
        return None
    return scene.render(np.zeros((4, 8, 3), np.float32), spp=1024, seed=seed, max_depth=max_depth)


# ---------------------------------------------------------------------- kernels


def _to_packets(flat, count):
    """(n * 3) floats to (n * 4): what one packet load fetches."""
    i = dr.arange(mi.UInt32, count * 4)
    return dr.gather(mi.Float, flat, (i >> 2) * 3 + (i & 3), (i & 3) < 3)


def _scale_packets(packets, scale, count):
    i = dr.arange(mi.UInt32, count * 4)
    return packets * dr.gather(mi.Float, scale, i >> 2)


@dr.syntax
def _exact_product(exact, packets, texel_of, count, pixels, capacity):
    pixel = dr.arange(mi.UInt32, pixels)
    place = (pixel // SLICE) * dr.opaque(mi.UInt32, capacity * SLICE) + pixel % SLICE
    slot = dr.zeros(mi.UInt32, pixels)
    total = mi.Color3f(0)
    while slot < count:
        weight = dr.gather(mi.Vector4f, exact, place)
        value = dr.gather(mi.Vector4f, packets, dr.gather(mi.UInt32, texel_of, slot))
        total += mi.Color3f(weight.x * value.x, weight.y * value.y, weight.z * value.z)
        place += SLICE
        slot += 1
    return total


_SEGMENTS = 16


def _exact_adjoint(exact, packets, count, pixels, capacity):
    """Sum of column * picture over pixels, for every column; pixels are split into segments to occupy every core."""
    part = _exact_adjoint_parts(exact, packets, count, pixels, capacity)
    dr.eval(part)
    slot, total = dr.arange(mi.UInt32, capacity), mi.Color3f(0)
    for segment in range(_SEGMENTS):
        total += dr.gather(mi.Color3f, part, slot + dr.opaque(mi.UInt32, segment * capacity))
    return total


@dr.syntax
def _exact_adjoint_parts(exact, packets, count, pixels, capacity):
    # Neighbouring lanes are neighbouring columns: their weights for a pixel lie 8 packets apart and share cache lines with the next 7 pixels.
    lane = dr.arange(mi.UInt32, capacity * _SEGMENTS)
    size = dr.opaque(mi.UInt32, capacity)
    slot, segment = lane % size, lane // size
    each = -(-(-(-pixels // _SEGMENTS)) // SLICE) * SLICE
    pixel = segment * dr.opaque(mi.UInt32, each)
    stop = dr.minimum(pixel + dr.opaque(mi.UInt32, each), dr.opaque(mi.UInt32, pixels))
    stop = dr.select(slot < count, stop, 0)
    stride = size * SLICE
    total = mi.Color3f(0)
    while pixel < stop:
        weight = dr.gather(mi.Vector4f, exact, (pixel // SLICE) * stride + slot * SLICE + pixel % SLICE)
        value = dr.gather(mi.Vector4f, packets, pixel)
        total += mi.Color3f(weight.x * value.x, weight.y * value.y, weight.z * value.z)
        pixel += 1
    return total
