"""The renderer that a configuration asks for: the stored transport, or the paper's path tracer."""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core import array_cache, extensions
from envedit.core.errors import ConfigError, InputError
from envedit.core.types import Progress
from envedit.scene.path_tracer import PathTracer
from envedit.scene.scene import Scene
from envedit.transport import sampling_plan
from envedit.transport.exact_columns import Columns
from envedit.transport.light_transport import COLUMN_SHARES, COLUMNS_A_LOOK, LightTransport

RESOLVE_EVERY = 10
"""Steps after which a renderer looks for texels that have grown bright."""
LASTING_LOOKS = 5
"""Looks in a row at which a texel must have been a main light before a renderer spends most paths on it."""


class Renderer(Protocol):
    """What the edit loop renders with."""

    @property
    def choices(self) -> list[str]:
        """What was chosen automatically."""

    transport: Any
    """The stored T that it renders through, a :class:`.LightTransport`; None where there is none."""

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render (H, W, 3) linear radiance to (h, w, 3), differentiable in the map."""

    def state(self) -> dict:
        """Return what a checkpoint must hold."""

    def restore(self, state: dict) -> None:
        """Continue from :meth:`state`."""


class StoredRenderer:
    """Renders through a stored T, whose exact columns follow a map that changes from step to step.

    With ``refresh`` T is recorded again after so many steps: a new, independent estimate of the same T.
    """

    def __init__(self, transport: LightTransport, refresh: int = 0):
        self.transport = transport
        self.refresh = refresh
        self._looks = np.zeros(transport.grid.texels, np.uint8)

    @property
    def choices(self) -> list[str]:
        """What was chosen automatically."""
        return self.transport.choices

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render (H, W, 3) linear radiance to (h, w, 3), differentiable in the map.

        Now and then it is checked whether the map has grown bright where T is coarse.
        """
        if self.refresh and step // self.refresh != self.transport.epoch:
            self.transport = self.transport.recorded_again(step // self.refresh)
        if step == 0:
            self.transport.warm_up()
        if step % RESOLVE_EVERY == 0:
            self._look(dr.detach(envmap).numpy())
        return self.transport.apply(envmap)

    def _look(self, envmap):
        """Take columns for a map that will still change: moving lights get fewer paths than lasting ones."""
        is_main = self.transport.shares(envmap) > COLUMN_SHARES[-1]
        self._looks = np.where(is_main, np.minimum(self._looks, LASTING_LOOKS) + 1, 0).astype(np.uint8)
        lasting = self._looks >= LASTING_LOOKS
        self.transport = self.transport.resolved(envmap, limit=COLUMNS_A_LOOK, lasting=lasting)

    def state(self) -> dict:
        """Return what a checkpoint must hold: which columns are exact, looks, and the recording's number."""
        exact = self.transport.exact
        epoch = np.int64(self.transport.epoch)
        return {"columns": exact.texels, "paths": exact.paths, "looks": self._looks, "epoch": epoch}

    def restore(self, state: dict) -> None:
        """Continue from an earlier :meth:`state`; InputError if it is no state of such a renderer."""
        own = {name: np.asarray(value) for name, value in state.items()}
        kinds = {name: (array.dtype, array.shape) for name, array in own.items()}
        looks = {"looks": (np.uint8, self._looks.shape), "epoch": (np.int64, ())}
        known = own.keys() == {"columns", "paths", *looks} and kinds == kinds | looks
        if not (known and 0 <= own["epoch"] < 2**31):
            raise InputError("the checkpoint is not of this light transport: run without --resume")
        transport = self.transport
        if int(own["epoch"]) != transport.epoch:
            transport = transport.recorded_again(int(own["epoch"]))
        self.transport = transport.restored(Columns(own["columns"], own["paths"]))
        self._looks = own["looks"].copy()


def make(
    settings: config.Config, scene: Scene, shape: tuple[int, int], progress: Progress | None = None
) -> Renderer:
    """Build the renderer of a configuration for maps of ``shape`` (H, W).

    ``progress`` receives the blocks of pixels done, and all.
    """
    chosen = settings.renderer
    if chosen.kind == "path":
        return PathTracer(scene, chosen.spp, chosen.max_depth, settings.seed)
    if chosen.kind != "transport":
        renderer: Renderer = extensions.load(extensions.RENDERERS, chosen.kind)(settings, scene, shape)
        return renderer
    refresh = 0 if isinstance(chosen.refresh, str) else chosen.refresh
    return StoredRenderer(trace(settings, scene, shape, progress), refresh)


def check(settings: config.Config, scene: Scene, shape: tuple[int, int]) -> None:
    """Refuse, before anything is rendered, what :func:`make` will refuse.

    ConfigError if a path tracer is asked for several views, InputError if T does not fit into memory.
    """
    chosen = settings.renderer
    if chosen.kind == "path" and len(scene.views) > 1:
        raise ConfigError(
            f'renderer.kind: got "path" with {len(scene.views)} views, which only "transport" renders: '
            "set it, or [scene] sensors to one of them"
        )
    if chosen.kind == "transport":
        sampling_plan.choose_samples(
            scene, chosen.spp, shape[0] * shape[1], sampling_plan.allowed(chosen.memory_gb)
        )


def trace(
    settings: config.Config, scene: Scene, shape: tuple[int, int], progress: Progress | None = None
) -> LightTransport:
    """Trace the light transport of a configuration, or take it from disk; arguments as :func:`make`."""
    chosen = settings.renderer
    return LightTransport.build(
        scene,
        *shape,
        spp=chosen.spp,
        max_depth=chosen.max_depth,
        seed=settings.seed,
        memory_gb=chosen.memory_gb,
        few=settings.representation.kind == "layers",
        folder=array_cache.cache_folder("transport") if chosen.cache else None,
        progress=progress,
    )
