"""Light transport T: a rendering is linear in the environment map, I = T E + I_0.

T is traced once for a scene, its camera and a texel grid, without looking at any map. Of its two tiers
(docs/light_transport.md) the coarse one (``recording.py``) renders the smooth part of a map with little
error, but a single bright texel is hit by few samples; :meth:`LightTransport.resolved` adds columns of the
exact one (``exact_columns.py``) for the texels that are bright in a given map:

    T E = T_coarse (E outside the columns) + T_exact (E inside them)

A transport is a value: what it renders depends on the map alone. Others that differ in their columns share
its recording and the columns in memory, which are traced when they are used first.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.config.validators import MOST_DIM, Integer, named
from envedit.core import latlong, seeds
from envedit.core.array_cache import DiskCache, under
from envedit.core.arrays import tensor
from envedit.core.errors import InputError, counted
from envedit.core.radiance import require_radiance, unmasked
from envedit.core.types import ArrayLike, Progress
from envedit.scene import built_scene
from envedit.scene.scene import Scene
from envedit.transport import bright_texels, sampling_plan
from envedit.transport.block_transport import Overview
from envedit.transport.exact_columns import Bound, Columns, ColumnStore
from envedit.transport.influence import determined
from envedit.transport.recording import other_light, record_all
from envedit.transport.sampling_plan import COLUMN_PATHS, COLUMNS_STORED, FEW_PATHS, SamplingPlan
from envedit.transport.sparse_matrix import ColourMatrix, scale_packets, to_packets
from envedit.transport.texel_sampling import Grid

COLUMN_SHARES = (0.0, 0.01, 0.1)
"""Shares of the picture's light from which on a column has so many paths (:data:`.COLUMN_PATHS`)."""
COLUMNS_A_LOOK = 32
"""Columns that an edit traces for a map at once, the brightest; transient speckle is ignored."""
LEAST_LIGHT = 1 / 256
"""Light of a texel, as a share of the brightest's, below which it gets no column for a picture of its own."""
TYPICAL_PIXELS = 128 * 128
"""Of larger pictures the error is predicted for the whole picture: errors of neighbours are independent."""
_RECORDING = 3  # raise when the same scene, grid and seed give another recording, or other arrays of it


class LightTransport:
    """T for one scene, camera and texel grid, I = T E + I_0; built by :meth:`build`.

    See docs/light_transport.md.

    Attributes
    ----------
    influence : ndarray (H, W)
        T' 1: how much a unit of radiance in each texel adds to the picture, summed over pixels and averaged
        over channels.
    shape : (int, int)
        Height and width of the picture.
    spp, bounces, capacity : int
        Paths a pixel of the coarse tier, surface points along a path, most exact columns.
    exact : Columns
        Which columns are exact.
    depth_error : float
        Share of the picture under a white sky that comes from deeper paths.
    epoch : int
        Number of the recording: others are independent estimates of the same T (:meth:`recorded_again`).
    cached : bool
        The first recording was found on disk.
    paths, tolerance : (int, int, int), float
        Paths a pixel of exact columns, and the error of the coarse tier from which on there are any.
    warnings : tuple of str
        What the user should know: how much light comes by longer paths.
    """

    def __init__(self, scene: Scene, grid: Grid, plan: SamplingPlan, seed: int):
        self.scene = scene
        self.grid = grid
        self.shape = (scene.height, scene.width)
        self.spp = plan.spp
        self.bounces = plan.bounces
        self.capacity = plan.capacity
        self.epoch = 0
        self._base_seed = seed
        self._choices = plan.choices
        self._lost = 0
        self.cached = False
        self.depth_error = plan.depth_error
        self.warnings = plan.warnings
        self.paths = plan.paths
        self.tolerance = plan.tolerance
        self.exact = Columns.none()
        self._bound: Bound | None = None
        self._overview: Overview | None = None
        self._stored: tuple[DiskCache, dict[str, Any]] = DiskCache(None), {}
        self._paths_bytes = plan.paths_bytes
        self._store = self._empty_store()

    def _empty_store(self):
        return ColumnStore(
            scene=self.scene,
            grid=self.grid,
            bounces=self.bounces,
            capacity=COLUMNS_STORED * self.capacity,
            seed=self.seed,
            paths_bytes=self._paths_bytes,
        )

    # ---- building ------------------------------------------------------------------------------------------

    @classmethod
    def build(
        cls,
        scene: Scene | mi.Scene | Mapping[str, Any] | str | PathLike[str],
        height: int = 128,
        width: int = 256,
        *,
        spp: int | str = "auto",
        max_depth: int | str = "auto",
        seed: int = 0,
        memory_gb: float | str = 2.0,
        few: bool = False,
        folder: Path | None = None,
        progress: Progress | None = None,
    ) -> LightTransport:
        """Trace T.

        Parameters
        ----------
        scene : Scene, mitsuba.Scene, dict or path
            Scene, camera and film, of :func:`envedit.load_scene`; or what that takes, for a rendering 128
            pixels wide.
        height, width : int
            Texel grid of the maps that T will be applied to: 128 x 256, the standard preset's.
        spp : int or "auto"
            Texel samples a pixel of the coarse tier.
        max_depth : int or "auto"
            Mitsuba's path depth (1: sky seen directly, 2: direct light). "auto" stops where further
            bounces add less than :data:`.sampling_plan.DEPTH_TOLERANCE` of the picture under a white sky.
        seed : int
            Seed of the recording.
        memory_gb : float or "auto"
            Bound on the memory of T; "auto": 2.
        few : bool
            The maps have few parameters: exact columns need fewer paths, and fewer texels have one.
        folder : Path, optional
            Where the recording is kept under a hash of all it depends on; None: nowhere.
        progress : callable, optional
            Called with (done, total) pixel blocks.

        Raises
        ------
        ConfigError
            An argument is of another type or out of its range, or the scene's parameters or sensors cannot
            be used.
        InputError
            The scene cannot be loaded, no pixel receives light from the environment, T does not fit into
            ``memory_gb``, or the grid is smaller than Mitsuba takes.

        Examples
        --------
        >>> transport = LightTransport.build("sphere")  # doctest: +SKIP
        >>> picture = transport.apply(envedit.sunsky(256)).numpy()  # doctest: +SKIP
        """
        # ---- Scene and options, checked
        if mi.variant() is None:
            mi.set_variant("llvm_ad_rgb")
        scene = built_scene.load(scene, config.Scene())
        height, width = (
            named(side, Integer(1, MOST_DIM), n) for side, n in (("height", height), ("width", width))
        )
        latlong.check_envmap_size(height, width)
        renderer = config.Renderer(spp=spp, max_depth=max_depth, memory_gb=memory_gb)
        config.Config(seed=seed)  # checks it

        # ---- How T is sampled, by a few paths under a white sky
        cache = DiskCache(None if folder is None else Path(folder))
        origin = {
            "version": [_RECORDING, mi.__version__, mi.variant()],
            "scene": [scene.digest, scene.width, scene.height],
            "grid": [height, width, np.asarray(scene.to_world).tolist()],
            "seed": seed,
        }
        grid = height, width
        light = sampling_plan.white_sky(cache, origin | {"part": "pilot"}, scene, grid, seed)
        allowed = sampling_plan.allowed(renderer.memory_gb)
        plan = sampling_plan.choose(scene, grid, light, renderer.spp, renderer.max_depth, allowed, few)
        transport = cls(scene, Grid(height, width, scene.to_world, plan.mass), plan, seed)

        # ---- The recording, from disk or traced
        key = origin | {"part": "recording"} | plan.key()
        transport._stored = cache, key | {"part": "overview"}
        recording = cache.load(key)
        if recording is None:
            offset = other_light(scene, plan.lamps, seed)
            offset = np.zeros(1, np.float32) if offset is None else offset.ravel()
            transport._offset = dr.opaque(mi.Float(offset))
            transport._record(progress)
            cache.store(key, transport._recording())
        else:
            transport._take(recording)
        return transport

    def _record(self, progress=None):
        """Trace the coarse tier with the seed of the present epoch."""
        texels = self.grid.texels
        pixels = self.shape[0] * self.shape[1]
        rows, columns, weights, lost = record_all(
            self.scene, self.grid, self.spp, self.bounces, self.seed, progress
        )
        self._lost += lost
        self.forward = ColourMatrix(rows, columns, weights, (pixels, texels))
        self.reverse = ColourMatrix(columns, rows, weights, (texels, pixels))
        influence = np.bincount(columns, weights.astype(np.float64).mean(axis=1), minlength=texels)
        self.influence = influence.reshape(self.grid.shape).astype(np.float32)

    def recorded_again(self, epoch: int) -> LightTransport:
        """Return another recording of the same T, by its number, with as many exact columns as this one."""
        other = copy.copy(self)
        other.epoch = epoch
        other._record()
        other._lost += self._store.lost
        other._bound, other._overview = None, None
        other._stored = DiskCache(None), {}
        other._store = other._empty_store()
        return other

    def _recording(self):
        """Return the first recording as arrays, for :meth:`_take`."""
        parts = {"forward": self.forward.arrays(), "reverse": self.reverse.arrays()}
        return {
            "influence": self.influence,
            "lost": np.array(self._lost, np.int64),
            "offset": self._offset.numpy(),
            **{f"{part}/{name}": array for part, arrays in parts.items() for name, array in arrays.items()},
        }

    def _take(self, arrays):
        """Take the first recording from arrays."""
        self.cached = True
        self._lost = int(arrays["lost"])
        self.influence = np.array(arrays["influence"])
        self._offset = dr.opaque(mi.Float(arrays["offset"]))
        for part in ("forward", "reverse"):
            setattr(self, part, ColourMatrix.from_arrays(under(arrays, f"{part}/")))

    # ---- what it is ----------------------------------------------------------------------------------------

    @property
    def seed(self) -> int:
        """Seed of the present recording."""
        return seeds.recording(self._base_seed, self.epoch)

    @property
    def choices(self) -> list[str]:
        """What was chosen automatically with the measurement that decided, and what was left out of T."""
        count = self._lost + self._store.lost
        if not count:
            return list(self._choices)
        lost = counted(count, "contribution of a camera path", "contributions of camera paths")
        return [*self._choices, f"light transport: left out as not finite: {lost}"]

    @property
    def columns(self) -> np.ndarray:
        """Texels that have an exact column, int64 (n,)."""
        return self.exact.texels

    @property
    def memory_bytes(self) -> int:
        """Bytes held by both tiers, without the camera paths that are kept for further columns."""
        return self.forward.bytes + self.reverse.bytes + self._store.bytes

    def summary(self) -> dict:
        """Return what T consists of, by name, for metrics.json."""
        return {
            "cached": self.cached,
            "entries": self.forward.entries,
            "memory_bytes": self.memory_bytes,
            "columns": len(self.columns),
            "path_depth": self.bounces + 1,
            "depth_error": self.depth_error,
            "samples": self.spp,
        }

    def determined(self, rows: slice, threshold: float) -> np.ndarray:
        """Say which texels this view determines, bool (H, W); see :func:`.influence.determined`."""
        samples = self.forward.entries * self.grid.mass.numpy() / self.grid.width
        return determined(self.influence, samples, rows, threshold)

    def release(self) -> None:
        """Let go of T's memory; nothing can be asked of it afterwards."""
        del self.forward, self.reverse, self._store

    def overview(self) -> Overview:
        """Return T between blocks of pixels and cells of texels; summed up once and kept on disk."""
        if self._overview is None:
            cache, key = self._stored
            overview = Overview(self.shape, self.grid.shape, self.scene.rows)
            stored = cache.load(key)
            if stored is None:
                stored = {"matrix": overview.summed(self.forward)}
                cache.store(key, stored)
            overview.matrix = stored["matrix"]
            self._overview = overview
        return self._overview

    # ---- using ---------------------------------------------------------------------------------------------

    def apply(self, envmap: mi.TensorXf | np.ndarray) -> mi.TensorXf:
        """Render a map: I = T E + I_0, differentiable in a tensor.

        What a texel lights is exact to Monte Carlo noise where the map is smooth; for one with a sun ask
        that of :meth:`resolved`.

        Parameters
        ----------
        envmap : TensorXf or ndarray (H, W, 3)
            Linear radiance as it reaches the scene, of the size that T was built for.

        Returns
        -------
        TensorXf (h, w, 3)
            Linear radiance.

        Raises
        ------
        InputError
            The map has another shape, or is no array of numbers.
        """
        return dr.custom(_Apply, self, _as_tensor(envmap, (*self.grid.shape, 3), "map"))

    def linear(self, maps: mi.TensorXf) -> mi.TensorXf:
        """Render maps without the light of other lamps: T E, not differentiable.

        ``maps`` (H, W, 3), or several (k, H, W, 3), are linear radiance of any sign; several are little more
        work than one. Returns (h, w, 3), or (k, h, w, 3).
        """
        many = maps.shape[0] if maps.ndim == 4 else 1
        _check_shape(maps, (*maps.shape[:-3], *self.grid.shape, 3), "map")
        return mi.TensorXf(self._products(maps, many), (*maps.shape[:-3], *self.shape, 3))

    def other_light(self) -> np.ndarray:
        """Return the picture of other lamps, I_0, (h, w, 3); zeros where there are none."""
        light = self._offset.numpy()
        return np.zeros((*self.shape, 3), np.float32) if light.size == 1 else light.reshape(*self.shape, 3)

    def pictures(self, maps: np.ndarray, rows: slice, most: int = COLUMNS_A_LOOK) -> np.ndarray:
        """Render maps that are black but for few texels, without the light of other lamps.

        ``maps`` (k, rows, W, 3) are radiance in some ``rows``, of any sign. Costs what their texels cost, not
        what T does. The texels with most light, at most ``most``, are rendered by columns with the fewest
        paths where they have none. Returns (k, h, w, 3) float32, in memory channel by channel.
        """
        flat = maps.reshape(len(maps), -1, 3)
        some = np.flatnonzero(flat.any(axis=(0, 2)))
        texels = some + rows.start * self.grid.width
        values = flat[:, some]
        paths = self.exact.paths_of(texels)
        main = np.isin(texels, self.main(maps, rows, most))
        paths[main] = np.maximum(paths[main], self.paths[0])
        exact = paths > 0
        total = self.reverse.transposed(texels[~exact], values[:, ~exact])
        if exact.any():
            columns = self._store.read(Columns(texels[exact], paths[exact]))
            for c in range(3):
                total[..., c] += values[:, exact, c] @ columns[..., c]
        return total.reshape(len(maps), *self.shape, 3)

    def main(self, maps: np.ndarray, rows: slice, most: int = COLUMNS_A_LOOK) -> np.ndarray:
        """Return the texels with most light in the picture, of maps as :meth:`pictures` has them."""
        light = np.abs(maps).sum(axis=(0, 3), dtype=np.float64) * self.influence[rows]
        order = np.argsort(-light.ravel(), kind="stable")[:most]
        main = order[light.ravel()[order] > light.max(initial=0) * LEAST_LIGHT]
        return main + rows.start * self.grid.width

    def adjoint(self, image: mi.TensorXf | np.ndarray) -> mi.TensorXf:
        """Pull a picture (h, w, 3) back to the map: T' I, (H, W, 3); InputError for another shape."""
        return self._adjoint(_as_tensor(image, (*self.shape, 3), "picture"))

    def _apply(self, envmap, offset=True):
        flat = self._products(envmap)
        return mi.TensorXf(flat + self._offset if offset else flat, (*self.shape, 3))

    def _products(self, maps, count=1):
        """T times maps, flat."""
        packets = to_packets(maps.array, self.grid.texels, count)
        self._bound = self._store.bind(self.exact, self._bound)
        masked = scale_packets(packets, self._bound.mask, self.grid.texels, count)
        exact = self._store.product(packets, self._bound, count)
        both = zip(self.forward.apply(masked, count), exact, strict=True)
        pictures = [dr.ravel(coarse + exact) for coarse, exact in both]
        return pictures[0] if count == 1 else dr.concat(pictures)

    def _adjoint(self, image):
        packets = to_packets(image.array, self.shape[0] * self.shape[1])
        self._bound = self._store.bind(self.exact, self._bound)
        (coarse,) = self.reverse.apply(packets)
        coarse *= self._bound.mask
        flat = dr.ravel(coarse)
        self._store.add_adjoint(flat, packets, self._bound)
        return mi.TensorXf(flat, (*self.grid.shape, 3))

    # ---- which texels are exact ----------------------------------------------------------------------------

    def probe(self, texels: np.ndarray) -> np.ndarray:
        """Return the columns of texels, of those without one with the fewest paths: (n, pixels, 3)."""
        return self._store.read(self._probed(texels))

    def _probed(self, texels):
        texels = np.asarray(texels, np.int64)
        return Columns(texels, np.maximum(self.exact.paths_of(texels), self.paths[0]))

    def with_probed(self, texels: np.ndarray) -> LightTransport:
        """Return T with exact columns for distinct texels, of those without one with the fewest paths."""
        return self._with_first(self._probed(texels))

    def with_columns(self, exact: Columns) -> LightTransport:
        """Return T with these exact columns, and no others; the first of them where there are too many."""
        other = copy.copy(self)
        other.exact = Columns(exact.texels[: self.capacity], exact.paths[: self.capacity])
        other._bound = None
        return other

    def restored(self, exact: Columns) -> LightTransport:
        """Return what :meth:`with_columns` does of columns from a file; InputError if they cannot be T's."""
        if not (
            exact.texels.ndim == exact.paths.ndim == 1
            and exact.texels.dtype.kind in "iu"
            and exact.paths.dtype.kind in "iu"
            and len(exact.texels) == len(exact.paths) == len(np.unique(exact.texels))
            and len(exact) <= self.capacity
            and _within(exact.texels, 0, self.grid.texels - 1)
            and _within(exact.paths, 1, max(*COLUMN_PATHS, *FEW_PATHS))
        ):
            raise InputError("the checkpoint is not of this light transport: run without --resume")
        return self.with_columns(Columns(exact.texels.astype(np.int64), exact.paths.astype(np.int64)))

    def _with_first(self, first):
        """Return T with some columns in place of its own, and then its own, while there is room."""
        rest = ~np.isin(self.exact.texels, first.texels)
        texels = np.concatenate([first.texels, self.exact.texels[rest]])
        paths = np.concatenate([first.paths, self.exact.paths[rest]])
        return self.with_columns(Columns(texels, paths))

    def resolved(
        self,
        envmap: ArrayLike,
        tolerance: float | None = None,
        limit: int | None = None,
        lasting: np.ndarray | None = None,
    ) -> LightTransport:
        """Return T with exact columns for the texels that the coarse tier would render with too much error.

        The brightest texels are taken out until the error that is predicted for the rest
        (:mod:`.bright_texels`) stays under ``tolerance``.

        Parameters
        ----------
        envmap : array_like (H, W, 3)
            Map that is about to be rendered.
        tolerance : float, optional
            Relative error allowed for the coarse part; :attr:`tolerance` by default.
        limit : int, optional
            Take at most so many new columns.
        lasting : ndarray of bool (H * W,), optional
            Texels that may have the most paths; all by default.

        Returns
        -------
        LightTransport
            The columns of this one stay while there is room; then those make room that have been bright in
            no map for longest.

        Raises
        ------
        InputError
            The map has another shape, is no array of numbers, or is masked.
        """
        envmap = _as_array(envmap, (*self.grid.shape, 3), "map")
        bright = self.bright_texels(envmap, tolerance)[: self.capacity]

        # ---- Paths by a texel's share of the picture's light
        tier = np.searchsorted(COLUMN_SHARES, self.shares(envmap)[bright], side="left") - 1
        tier = np.maximum(tier, 0)
        if lasting is not None:
            # The last tier is for lights that have lasted; others stop one below.
            tier = np.minimum(tier, np.where(lasting[bright], len(self.paths), len(self.paths) - 2))
        paths = self.exact.paths_of(bright)
        wanted = np.asarray(self.paths)[tier]

        # ---- New ones, those with most paths first
        new = np.flatnonzero(paths < wanted)
        new = new[np.argsort(-tier[new], kind="stable")][:limit]
        paths[new] = wanted[new]
        return self._with_first(Columns(bright[paths > 0], paths[paths > 0]))

    def warm_up(self) -> None:
        """Trace one column of each kind: what grows bright later needs no other kernel."""
        if self.capacity:
            self._store.warm_up(int(self.influence.argmax()), self.paths)

    def shares(self, envmap: np.ndarray) -> np.ndarray:
        """Return the share of the picture's light that comes from each texel of a map, (H * W,)."""
        light = envmap.reshape(-1, 3).astype(np.float64).mean(axis=1) * self.influence.ravel()
        total = light.sum()
        return light / total if total > 0 else np.zeros_like(light)

    def coarse_error(self, envmap: ArrayLike) -> float:
        """Predict the relative error of the coarse tier for a map, beside the columns that there are.

        Raises
        ------
        InputError
            If the map has another shape, or a texel is not finite or negative: no error can be predicted
            then.
        """
        envmap = _as_array(envmap, (*self.grid.shape, 3), "map")
        require_radiance(envmap, "light transport")
        rest = np.ones(self.grid.texels, bool)
        rest[self.columns] = False
        radiance, omega = self._radiance(envmap)
        return bright_texels.error(radiance, omega, self._samples, rest)

    @property
    def _samples(self):
        """Samples from which errors are predicted: of a pixel, or of a typical picture's pixel if larger."""
        return self.spp * max(1.0, self.shape[0] * self.shape[1] / TYPICAL_PIXELS)

    def _radiance(self, envmap):
        """List every texel's radiance, its largest channel, and solid angle; 0 where no light comes from."""
        omega = np.repeat(latlong.solid_angles(*self.grid.shape), self.grid.width)
        # A texel that no sample has met may matter as much as its row: rows are known from many samples.
        reached = np.repeat((self.influence > 0).any(axis=1), self.grid.width)
        return envmap.reshape(-1, 3).astype(np.float64).max(axis=1) * reached, omega * reached

    def bright_texels(self, envmap: np.ndarray, tolerance: float | None = None) -> np.ndarray:
        """List the texels that must be exact for this map, brightest first (see :meth:`resolved`)."""
        tolerance = self.tolerance if tolerance is None else tolerance
        radiance, omega = self._radiance(envmap)
        return bright_texels.brightest(radiance, omega, self._samples, tolerance)


def _within(numbers, least, most):
    """Return whether all of some numbers, of which there may be none, are in a range."""
    return bool(((least <= numbers) & (numbers <= most)).all())


def _as_tensor(values, shape, what):
    """Return a map or a picture as a tensor; InputError where it has another shape or holds no numbers."""
    if not isinstance(values, mi.TensorXf):
        return tensor(_as_array(values, shape, what))
    _check_shape(values, shape, what)
    return values


def _as_array(values: ArrayLike, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return a map or a picture as an array; InputError where it has another shape or holds no numbers."""
    array = unmasked(values, "light transport")
    if array.dtype.kind not in "fiub":
        kind = type(values).__name__
        raise InputError(f"light transport: the {what} must be an array of numbers, got {kind}")
    _check_shape(array, shape, what)
    return array


def _check_shape(values, shape, what):
    if tuple(values.shape) != shape:
        raise InputError(f"light transport: the {what} must have shape {shape}, got {tuple(values.shape)}")


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
