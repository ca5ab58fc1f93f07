"""Light transport T: a rendering is linear in the environment map, I = T E + I_0.

T is traced once for a scene, its camera and a texel grid, without looking at any map; then rendering is a
matrix product and its adjoint is exact. Nothing changes from step to step, so no Monte Carlo noise bends the
objective (see docs/architecture.md).

Two tiers, both unbiased:

* the **coarse** tier is a sparse matrix of recorded samples (``recording.py``), spread evenly over
  directions; it renders the smooth part of a map with little error, but a single bright texel is hit by few
  samples;
* the **exact** tier holds whole columns of T (``columns.py``), one ray per path vertex to that very texel.
  :meth:`LightTransport.resolve` adds them for the texels that are bright in a given map.

T E = T_coarse (E outside the columns) + T_exact (E inside them). What it costs follows the light, not the
grid.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from . import latlong
from .columns import ExactColumns
from .errors import ConfigError
from .grid import Grid
from .recording import choose_bounces, choose_samples, other_light, pilot, record_all, row_mass
from .sparse import ColourMatrix, scale_packets, to_packets

COLUMN_TOLERANCE = 0.03
"""Relative error of the coarse tier above which columns are added."""
COLUMN_PATHS = (8, 48)
"""Paths a pixel of a column: for a bright texel, and for one with more than SHARE_OF_A_LIGHT of the light."""
SHARE_OF_A_LIGHT = 0.01
RESOLVE_EVERY = 10
"""Steps after which a renderer looks for texels that have grown bright."""


class LightTransport:
    """T for one scene, camera and texel grid; built by :meth:`build`.

    Attributes
    ----------
    influence : ndarray (H, W)
        T' 1: how much a unit of radiance in each texel adds to the picture, summed over pixels and averaged
        over channels.
    shape : (int, int)
        Height and width of the picture.
    spp, bounces, capacity : int
        Paths a pixel of the coarse tier, surface points along a path, most exact columns.
    epoch : int
        Number of the present recording; only a ``refresh`` raises it.
    """

    def __init__(self, scene, grid, spp, bounces, seed, capacity, refresh, choices, progress):
        self.scene, self.grid, self.shape = scene, grid, (scene.height, scene.width)
        self.spp, self.bounces, self.capacity, self.refresh = spp, bounces, capacity, refresh
        self.epoch, self._base_seed, self._choices, self._lost = 0, seed, choices, 0
        offset = other_light(scene, bounces + 1, seed)
        self._record(progress)
        self._exact = ExactColumns(scene, grid, bounces, capacity)
        self._offset = dr.opaque(mi.Float, 0) if offset is None else dr.opaque(mi.Float(offset.ravel()))

    # ------------------------------------------------------------------ building

    @classmethod
    def build(
        cls,
        scene,
        height: int,
        width: int,
        *,
        spp="auto",
        max_depth="auto",
        seed: int = 0,
        memory_gb=2.0,
        refresh: int = 0,
        progress=None,
    ) -> LightTransport:
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
            Mitsuba's path depth (1: sky seen directly, 2: direct light). "auto" stops where further
            bounces add less than :data:`.recording.DEPTH_TOLERANCE` of the picture under a white sky.
        seed : int
            Seed of the recording.
        memory_gb : float or "auto"
            Bound on the memory of T; "auto": 2.
        refresh : int
            Steps after which :meth:`render` records T afresh; 0: never.
        progress : callable, optional
            Called with (done, total) pixel blocks.

        Raises
        ------
        ConfigError
            ``spp`` or ``max_depth`` is below 1.
        InputError
            No pixel receives light from the environment, or T does not fit into ``memory_gb``.
        """
        memory_gb = 2.0 if memory_gb == "auto" else float(memory_gb)
        for name, value in (("spp", spp), ("max_depth", max_depth)):
            if value != "auto" and not value >= 1:
                raise ConfigError(
                    f"renderer.{name}: came {value}, wanted a whole number of at least 1, or auto"
                )
        sphere = latlong.solid_angles(height, width)
        rows_light, bounce_light = pilot(scene, Grid(height, width, scene.to_world, sphere), seed)
        bounces, choices = choose_bounces(scene, max_depth, bounce_light)
        grid = Grid(height, width, scene.to_world, row_mass(sphere, rows_light))
        spp, capacity, choice = choose_samples(scene, spp, height * width, memory_gb)
        return cls(scene, grid, spp, bounces, seed, capacity, refresh, [*choices, choice], progress)

    def _record(self, progress=None):
        """Trace the coarse tier with the seed of the present epoch."""
        texels, pixels = self.grid.texels, self.shape[0] * self.shape[1]
        rows, columns, weights, lost = record_all(
            self.scene, self.grid, self.spp, self.bounces, self.seed, progress
        )
        self._lost += lost
        self.forward = ColourMatrix(rows, columns, weights, (pixels, texels))
        self.reverse = ColourMatrix(columns, rows, weights, (texels, pixels))
        influence = np.bincount(columns, weights.astype(np.float64).mean(axis=1), minlength=texels)
        self.influence = influence.reshape(self.grid.height, self.grid.width).astype(np.float32)

    # ------------------------------------------------------------------ what it is

    @property
    def seed(self) -> int:
        """Seed of the present recording."""
        return self._base_seed + 1_000_003 * self.epoch

    @property
    def choices(self) -> list[str]:
        """What was chosen automatically with the measurement that decided, and what was left out of T."""
        if not self._lost:
            return list(self._choices)
        lost = f"light transport: {self._lost} contributions of camera paths were not finite and are left out"
        return [*self._choices, lost]

    @property
    def columns(self) -> np.ndarray:
        """Texels that have an exact column, int64 (n,), in the order in which they were added."""
        return self._exact.texels

    @property
    def memory_bytes(self) -> int:
        """Bytes held by both tiers."""
        return self.forward.bytes + self.reverse.bytes + self._exact.bytes

    # ------------------------------------------------------------------ using

    def apply(self, envmap: mi.TensorXf) -> mi.TensorXf:
        """Render: (H, W, 3) linear radiance to (h, w, 3), differentiable, T E + I_0."""
        _check(envmap, (self.grid.height, self.grid.width, 3), "map")
        return dr.custom(_Apply, self, envmap)

    def adjoint(self, image: mi.TensorXf) -> mi.TensorXf:
        """Pull a picture (h, w, 3) back to the map: T' I, (H, W, 3)."""
        _check(image, (*self.shape, 3), "picture")
        return self._adjoint(image)

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render a map: the interface that all renderers share.

        T does not depend on the step; but now and then it is checked whether the map has grown bright where
        T is coarse, and with ``refresh`` everything is recorded again: a new, independent estimate of the
        same T.
        """
        if self.refresh and step // self.refresh != self.epoch:
            self.epoch = step // self.refresh
            self._record()
            self._exact.retrace(self.seed)
        if step % RESOLVE_EVERY == 0:
            self._warm_up()
            self.resolve(dr.detach(envmap).numpy())
        return self.apply(envmap)

    def _warm_up(self):
        """Trace one column of each kind in the first step: what grows bright later needs no other kernel."""
        if len(self.columns) == 0 and self._exact.room:
            most = np.array([int(self.influence.argmax())])
            for count in COLUMN_PATHS:
                self._exact.trace(most, count, self.seed)

    def state(self) -> dict:
        """Return what a checkpoint must hold: the exact columns, their order and paths, and the epoch."""
        return {**self._exact.state(), "epoch": np.int64(self.epoch)}

    def restore(self, state: dict) -> None:
        """Trace the columns of an earlier :meth:`state`."""
        if int(state["epoch"]) != self.epoch:
            self.epoch = int(state["epoch"])
            self._record()
        self._exact.restore(state, self.seed)

    def _apply(self, envmap, offset=True):
        packets = to_packets(envmap.array, self.grid.texels)
        coarse = self.forward.apply(scale_packets(packets, self._exact.mask, self.grid.texels))
        exact = self._exact.product(packets)
        flat = dr.ravel(coarse + exact)
        return mi.TensorXf(flat + self._offset if offset else flat, (*self.shape, 3))

    def _adjoint(self, image):
        packets = to_packets(image.array, self.shape[0] * self.shape[1])
        coarse = self.reverse.apply(packets) * self._exact.mask
        flat = dr.ravel(coarse)
        self._exact.add_adjoint(flat, packets)
        return mi.TensorXf(flat, (self.grid.height, self.grid.width, 3))

    # ------------------------------------------------------------------ which texels are exact

    def resolve(self, envmap, tolerance: float = COLUMN_TOLERANCE, limit: int | None = None) -> int:
        """Trace exact columns for the texels that the coarse tier would render with too much error.

        The coarse tier's relative error for a map is predicted as the standard deviation of E over its mean,
        over sqrt(samples a pixel); the brightest texels are taken out until the rest stays under
        ``tolerance``.

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
            Number of columns traced. Texels stay exact for good; at the capacity no more are added.
        """
        envmap, exact = np.asarray(envmap), self._exact
        wanted = self.bright_texels(envmap, tolerance)
        light = envmap.reshape(-1, 3).astype(np.float64).mean(axis=1) * self.influence.ravel()
        is_light = light[wanted] > SHARE_OF_A_LIGHT * light.sum()
        traced = 0
        for count, texels in ((COLUMN_PATHS[1], wanted[is_light]), (COLUMN_PATHS[0], wanted[~is_light])):
            new = texels[exact.paths_of[texels] < count]
            known = new[exact.slot_of[new] >= 0]
            fresh = new[exact.slot_of[new] < 0][: exact.room]
            todo = np.concatenate([known, fresh])[: None if limit is None else limit - traced]
            if len(todo):
                exact.trace(todo, count, self.seed)
                traced += len(todo)
        return traced

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
        square, linear, weight = _total_from(e * e * w), _total_from(e * w), _total_from(w)
        variance = np.maximum(square - linear**2 / np.maximum(weight, 1e-30), 0) * span
        error = np.sqrt(variance / self.spp) / total
        enough = np.flatnonzero(error <= tolerance)
        return order[: enough[0] if len(enough) else len(order)]


def _check(tensor, shape, what):
    if tuple(tensor.shape) != shape:
        raise ValueError(f"light transport: the {what} must have shape {shape}, got {tuple(tensor.shape)}")


def _total_from(x):
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
