"""Adam that owns its parameters, and the schedules of learning rates and loss weights.

.. code-block:: python

   adam = Adam({"w": w, "b": b}, lr=1e-3)
   for step in range(total):
       with dr.isolate_grad():
           leaves = adam.leaves()                       # fresh leaves of the AD graph
           dr.backward(loss(leaves))
       adam.step({name: dr.grad(leaf) for name, leaf in leaves.items()}, lr=cosine(1e-3, step, total))
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import drjit as dr
import numpy as np

from envedit.core.types import Arrays, Params, Tensor

# ---- Adam --------------------------------------------------------------------------------------------------

EPS = 1e-8
"""Above 0, so that 0 / 0 cannot arise."""


class Adam:
    r"""Adam with epsilon after the bias correction, as PyTorch has it (`drjit.opt.Adam` adds it before).

    .. code-block:: text

       m <- b1 m + (1 - b1) g        v <- b2 v + (1 - b2) g^2
       p <- p - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)         Kingma and Ba 2015, Algorithm 1

    A step is refused as a whole where a gradient, its square (above 1.8e19 in single precision), a moment or
    a parameter would not be finite: v would stay infinite, and the parameter stuck for good. What a step
    leads to is seen in the next one only: `take_back` returns to the parameters before it.

    ``params``, tensors of one precision, are starting values, which are copied: read them as
    ``adam.params[name]``. ``lr`` is that of a `step` that is not given its own, ``betas`` are the decay of
    the two moments, in [0, 1); ``eps`` is :data:`EPS`.
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
    ):
        self.lr = lr
        self.betas = tuple(betas)
        self.t = 0
        # Copies in memory of Dr.Jit's own: a literal would be part of the first step's kernel, and an array
        # wrapped around numpy's memory is not aligned, which is part of a kernel too and costs a compilation.
        self.params = {name: dr.opaque(dr.detach(value)) for name, value in params.items()}
        self._before = dict(self.params)
        self._kind = type(next(iter(self.params.values())))
        self._m = {name: dr.opaque(self._kind, 0, value.shape) for name, value in self.params.items()}
        self._v = {name: dr.opaque(self._kind, 0, value.shape) for name, value in self.params.items()}

    def leaves(self) -> Params:
        """Return the parameters as a new dict of leaves with gradients enabled."""
        leaves = {name: type(value)(value) for name, value in self.params.items()}
        dr.enable_grad(leaves)
        return leaves

    def step(self, grads: Mapping[str, Tensor], lr: float | None = None) -> bool:
        """Update all parameters in one evaluation, by a gradient for each, of its shape.

        Returns whether the step was taken; where it is refused, nothing has changed.
        """
        lr = self.lr if lr is None else lr
        b1, b2 = self.betas
        t = self.t + 1
        flat = dr.array_t(self._kind)
        index = dr.uint32_array_t(flat)
        # In memory: kernels do not depend on the step then.
        rate = dr.opaque(flat, lr / (1 - b1**t))
        root = dr.opaque(flat, math.sqrt(1 - b2**t))
        new = {}
        refused = []
        for name, p in self.params.items():
            g = dr.detach(grads[name]).array
            m = b1 * self._m[name].array + (1 - b1) * g
            v = b2 * self._v[name].array + (1 - b2) * dr.square(g)
            update = rate * m / (dr.sqrt(v) / root + EPS)
            new[name] = p.array - update, m, v
            # v takes up the gradient's square; an infinite one gives finite steps, of zero, for good.
            good = dr.isfinite(v) & dr.isfinite(new[name][0])
            # A flag each: a second scatter to the same one would force an evaluation in between.
            flag = dr.opaque(index, 0)
            dr.scatter(flag, index(1), index(0), ~good)
            refused.append(flag)

        # ---- All in one evaluation; a step that is not finite is refused as a whole
        dr.eval(new, refused)
        if any(flag[0] for flag in refused):
            return False
        self._before = dict(self.params)
        for name, (p, m, v) in new.items():
            shape = self.params[name].shape
            self.params[name] = self._kind(p, shape)
            self._m[name] = self._kind(m, shape)
            self._v[name] = self._kind(v, shape)
        self.t = t
        return True

    def take_back(self) -> None:
        """Return to the parameters that the last step was taken from; twice is as once.

        The moments stay, as the gradients that they are means of were finite.
        """
        self.params = dict(self._before)

    def state_dict(self) -> Arrays:
        """Return everything that a later `load_state_dict` needs, as a flat dict of numpy arrays."""
        state: Arrays = {"step": np.array(self.t, np.int64)}
        for part, values in self._parts():
            state |= {f"{part}/{name}": np.array(value) for name, value in values.items()}
        return state

    def _parts(self):
        return ("params", self.params), ("before", self._before), ("m", self._m), ("v", self._v)

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue exactly where `state_dict` of the same parameters was taken."""
        for name, value in self.params.items():
            for part, target in self._parts():
                flat = dr.array_t(self._kind)(np.ascontiguousarray(state[f"{part}/{name}"]).ravel())
                target[name] = dr.opaque(self._kind(flat, value.shape))
        self.t = int(state["step"])


# ---- Schedules: functions of the step, counted from 0 ------------------------------------------------------


def cosine(lr: float, step: int, total: int) -> float:
    """Anneal from ``lr`` at step 0 to 0 at step ``total``, and stay there (CosineAnnealingLR).

    ``lr (1 + cos(pi step / total)) / 2``.
    """
    return lr * 0.5 * (1 + math.cos(math.pi * min(step / total, 1.0)))


def cosine_warm_restarts(lr: float, step: int, period: int) -> float:
    """Anneal from ``lr`` towards 0 again and again, every ``period`` steps.

    Loshchilov and Hutter 2017, Eq. 5, with T_mult = 1 and a minimum of 0: PyTorch's
    CosineAnnealingWarmRestarts.
    """
    return cosine(lr, step % period, period)


def ramp(start: float, end: float, step: float, total: int) -> float:
    """Walk geometrically from ``start`` at step 0 to ``end`` at step ``total - 1``, and stay there.

    ``start (end / start)^(step / (total - 1))``; a run of one step stays at ``start``.
    """
    if start == end:
        return start
    share = min(step / max(total - 1, 1), 1.0)
    return start ** (1 - share) * end**share
