"""The renderer that a configuration asks for: the stored transport, or the paper's path tracer."""

from __future__ import annotations

from typing import Protocol

import mitsuba as mi

from envedit import config
from envedit.core import array_cache, extensions
from envedit.core.errors import ConfigError
from envedit.core.types import Progress
from envedit.scene.path_tracer import PathTracer
from envedit.scene.scene import Scene
from envedit.transport import sampling_plan
from envedit.transport.light_transport import LightTransport


class Renderer(Protocol):
    """What the edit loop renders with."""

    @property
    def choices(self) -> list[str]:
        """What was chosen automatically."""

    @property
    def transport(self) -> LightTransport | None:
        """The stored T that it renders through, where there is one."""

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render (H, W, 3) linear radiance to (h, w, 3), differentiable in the map."""

    def state(self) -> dict:
        """Return what a checkpoint must hold."""

    def restore(self, state: dict) -> None:
        """Continue from :meth:`state`."""


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
    return trace(settings, scene, shape, progress)


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
        refresh=0 if isinstance(chosen.refresh, str) else chosen.refresh,
        few=settings.representation.kind == "layers",
        folder=array_cache.cache_folder("transport") if chosen.cache else None,
        progress=progress,
    )
