"""The paper's renderer: Mitsuba's differentiable path tracer, with fresh samples at every step.

Unbiased, but its noise bends any non-linear loss (docs/light_transport.md): it is here as the reference that
the paper used, not for speed. The same seed gives the same bits with any number of threads: pictures are
summed by :mod:`.film`, and gradients, which Mitsuba adds in the order in which threads come to a texel, are
traced by one thread.
"""

from __future__ import annotations

import contextlib
import math

import drjit as dr
import mitsuba as mi

from envedit.core import installed_plugins, latlong
from envedit.core.arrays import tensor
from envedit.core.errors import ConfigError
from envedit.scene import film
from envedit.scene.scene import Scene

AUTO_SPP = 16
AUTO_DEPTH = 6
_MOST_SAMPLES = 2**32 - 1  # of a wavefront of Mitsuba's


class PathTracer:
    """Render a map with path replay backpropagation (Vicini et al. 2021, Mitsuba's ``prb``).

    ConfigError if there are more samples than Mitsuba can trace at once.

    ``spp`` samples a pixel are taken for the picture and again for its gradient, and as many more as the
    scene's sampler needs to fill its grid. ``max_depth`` is the longest path in segments. Every step replaces
    the scene's environment map and draws two seeds of its own from ``seed``, one for the picture and one for
    the gradient. With ``one_thread`` gradients are traced by one thread, so that their sums have a fixed
    order; else by all.
    """

    transport = None

    def __init__(
        self,
        scene: Scene,
        spp: int | str = "auto",
        max_depth: int | str = "auto",
        seed: int = 0,
        one_thread: bool = True,
    ):
        self.scene, self.one_thread = scene, one_thread
        self.spp = _filling_the_sampler(scene, AUTO_SPP if isinstance(spp, str) else spp)
        if self.spp * scene.width * scene.height > _MOST_SAMPLES:
            raise ConfigError(
                f"renderer.spp: {self.spp} samples of {scene.width}x{scene.height} pixels are more than one "
                f"rendering can hold, {_MOST_SAMPLES}: lower [renderer] spp or [scene] width"
            )
        own = scene.integrator
        most = AUTO_DEPTH if own.max_depth < 0 else min(AUTO_DEPTH, own.max_depth)
        self.depth = most if isinstance(max_depth, str) else max_depth
        self.seed = seed
        self.choices = [f"path tracing: {self.spp} samples a pixel, path depth {self.depth}"]
        installed_plugins.come_first()
        options = {"max_depth": self.depth, "rr_depth": self.depth + 1, "hide_emitters": own.hide_emitters}
        self._integrators = [mi.load_dict({"type": kind, **options}) for kind in ("path", "prb")]
        self._index: mi.UInt32 | None = None

    def render(self, envmap: mi.TensorXf, step: int) -> mi.TensorXf:
        """Render (H, W, 3) linear radiance to (h, w, 3), differentiable in the map."""
        height, width, _ = envmap.shape
        if self._index is None:
            self._index = dr.opaque(mi.UInt32(latlong.halo_index(height, width)))
        data = mi.TensorXf(dr.gather(mi.Float, envmap.array, self._index), (height, width + 2, 3))
        seeds = [int(seed) for seed in mi.sample_tea_32(2 * step, self.seed)]
        return dr.custom(_Rendering, data, self, seeds)

    def picture(self, data: mi.TensorXf, seed: int) -> mi.TensorXf:
        """Render the map as Mitsuba holds it, (H, W + 2, 3), without derivatives."""
        self._set(data)
        rendering = film.render(self.scene.mi, self._integrators[0], self.spp, seed)[..., :3]
        return tensor(rendering)

    def gradient(self, data: mi.TensorXf, seed: int, picture: mi.TensorXf) -> mi.TensorXf:
        """Pull a picture back to the map as Mitsuba holds it: the adjoint of rendering."""
        data = mi.TensorXf(data)
        dr.enable_grad(data)
        self._set(data)
        with dr.resume_grad(), film.threads(1) if self.one_thread else contextlib.nullcontext():
            self._integrators[1].render_backward(
                self.scene.mi, self.scene.params, picture, seed=seed, spp=self.spp
            )
            adjoint = dr.grad(data)
            dr.eval(adjoint)
            dr.sync_thread()
        return adjoint

    def _set(self, data):
        self.scene.params[self.scene.envmap_key] = data
        self.scene.params.update()

    def state(self) -> dict:
        """Return what a checkpoint must hold: nothing, the seeds follow from the step."""
        return {}

    def restore(self, state: dict) -> None:
        """Continue from :meth:`state`."""


class _Rendering(dr.CustomOp):
    """Pictures and gradients of a path tracer, from seeds of their own."""

    def eval(self, data, tracer, seeds):
        self.data, self.tracer, self.seeds = data, tracer, seeds
        return tracer.picture(data, self.seeds[0])

    def backward(self):
        adjoint = self.tracer.gradient(self.data, self.seeds[1], self.grad_out())
        self.set_grad_in("data", adjoint)

    def name(self):
        return "path tracing"


def _filling_the_sampler(scene, spp):
    """Round up to the counts of Mitsuba's multijitter, which else warns at every step."""
    if scene.mi.sensors()[0].sampler().class_name() != "MultijitterSampler":
        return spp
    rows = math.isqrt(spp)
    return rows * -(-spp // rows)
