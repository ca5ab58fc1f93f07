"""The paper's renderer: Mitsuba's differentiable path tracer, with fresh samples at every step.

Unbiased, but its noise bends any non-linear loss (docs/light_transport.md): it is here as the reference that
the paper used, not for speed.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from envedit.core import installed_plugins, latlong
from envedit.core.errors import ConfigError
from envedit.scene.scene import Scene

AUTO_SPP = 16
AUTO_DEPTH = 6
_MOST_SAMPLES = 2**32 - 1  # of a wavefront of Mitsuba's


class PathTracer:
    """Render a map with path replay backpropagation (Vicini et al. 2021, Mitsuba's ``prb``).

    Parameters
    ----------
    scene : Scene
        The scene; its environment map is replaced at every step.
    spp : int
        Samples a pixel, for the picture and again for its gradient; as many more as the scene's sampler
        needs to fill its grid.
    max_depth : int
        Longest path in segments.
    seed : int
        Base seed; every step draws two seeds of its own from it, one for the picture and one for the
        gradient.

    Raises
    ------
    ConfigError
        There are more samples than Mitsuba can trace at once.
    """

    transport = None

    def __init__(self, scene: Scene, spp: int | str = "auto", max_depth: int | str = "auto", seed: int = 0):
        self.scene = scene
        self.spp = _whole(scene, AUTO_SPP if isinstance(spp, str) else spp)
        if self.spp * scene.width * scene.height > _MOST_SAMPLES:
            raise ConfigError(
                f"renderer.spp: {self.spp} samples of {scene.width}x{scene.height} pixels are more than one "
                f"rendering can hold, {_MOST_SAMPLES}: lower [renderer] spp or [scene] width"
            )
        most = AUTO_DEPTH if scene.max_depth < 0 else min(AUTO_DEPTH, scene.max_depth)
        self.depth = most if isinstance(max_depth, str) else max_depth
        self.seed = seed
        self.choices = [f"path tracing: {self.spp} samples a pixel, path depth {self.depth}"]
        installed_plugins.come_first()
        asked = {"max_depth": self.depth, "rr_depth": self.depth + 1, "hide_emitters": scene.hide_emitters}
        self._integrator = mi.load_dict({"type": "prb", **asked})
        self._index: mi.UInt32 | None = None

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render (H, W, 3) linear radiance to (h, w, 3), differentiable in the map."""
        height, width, _ = envmap.shape
        if self._index is None:
            self._index = dr.opaque(mi.UInt32(latlong.halo_index(height, width)))
        data = dr.gather(mi.Float, envmap.array, self._index)
        params = self.scene.params
        params[self.scene.envmap_key] = mi.TensorXf(data, (height, width + 2, 3))
        params.update()
        seed = mi.sample_tea_32(2 * step, self.seed)
        picture = mi.render(
            self.scene.mi,
            params,
            integrator=self._integrator,
            spp=self.spp,
            seed=int(seed[0]),
            seed_grad=int(seed[1]),
        )
        return picture[..., :3] if self.scene.hide_emitters else picture

    def state(self) -> dict:
        """Return what a checkpoint must hold: nothing, the seeds follow from the step."""
        return {}

    def restore(self, state: dict) -> None:
        """Continue from :meth:`state`."""


def _whole(scene, spp):
    """Round up to the counts of Mitsuba's multijitter, which else warns at every step."""
    if scene.mi.sensors()[0].sampler().class_name() != "MultijitterSampler":
        return spp
    rows = math.isqrt(spp)
    return rows * -(-spp // rows)
