"""The one optimisation loop: find parameters whose map renders to the target (Eq. 10, Sec. 6.2).

The loop knows neither what the parameters mean nor how the picture is made: it decodes, renders, compares,
pulls the gradient back, and lets Adam step. Where loss or gradient is not finite no step is taken: the
parameters go back to the last ones that had both, as the step from there may have been too long, the
learning rate is halved, and the bad step is counted. The learning rate recovers after good steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.arrays import flat, tensor
from envedit.core.errors import NumericalError
from envedit.core.types import Params, Views
from envedit.losses import losses, optimizer
from envedit.losses.display_curve import to_display
from envedit.losses.perceptual import distances
from envedit.losses.ssim import Ssim, StackedSsim
from envedit.renderers import Renderer
from envedit.representations.base import Representation

MOST_BAD_STEPS = 20
"""Non-finite steps in a row after which the loop gives up."""
RECOVERY = 10
"""Good steps after which one halving of the learning rate is undone, as bad samples may be rare."""


class Objective:
    """The weighted sum of Eq. 10 for one target and one original map.

    Parameters
    ----------
    weights : config.Loss
        A number or a (start, end) ramp for every term; terms of weight 0 are not computed.
    picture : ndarray (h, w, 3)
        Target, linear radiance.
    pixel_weight : ndarray (h, w, 1)
        How much each pixel counts.
    original : ndarray (rows, W, 3)
        The active rows of the original map.
    iterations : int
        Length of the run, over which ramps are walked.
    dists : distances.Dists, optional
        The term of that name, between display values of the map and the original; None: it is off.
    every : int
        Steps from one evaluation of it to the next: a convolutional network takes longer than all the rest.
        Its gradient counts so many times then; in between the loss has its last value.
    views : sequence of slice
        Rows of each view, where the picture is of several.
    """

    def __init__(
        self,
        weights: config.Loss,
        picture: np.ndarray,
        pixel_weight: np.ndarray,
        original: np.ndarray,
        iterations: int,
        dists: distances.Dists = None,
        every: int = 1,
        views: Views = (),
    ):
        self.iterations = iterations
        self.ramps = {
            name: value if isinstance(value, tuple) else (value, value)
            for name, value in asdict(weights).items()
            if value and (name != "dists" or dists)
        }
        self._target = dr.opaque(to_display(tensor(picture)))
        self._weight = tensor(pixel_weight)
        self._original = tensor(original)
        self._ssim: Ssim | StackedSsim
        if len(views) > 1:
            self._ssim = StackedSsim(self._target, self._weight, views)
        else:
            self._ssim = Ssim(self._target, self._weight)
        self._dists = dists.against(to_display(self._original)) if "dists" in self.ramps else None
        self._every, self._last = every, None

    def __call__(
        self, rendering: mi.TensorXf, crop: mi.TensorXf, step: int
    ) -> tuple[mi.Float, dict[str, mi.Float]]:
        """Weigh a rendering and the active rows of its map.

        Returns
        -------
        total : Float
            The weighted sum, a size-1 array.
        terms : dict
            Its weighted terms by name, size-1 arrays.
        """
        terms, more = {}, 0.0
        shown = to_display(rendering)
        for name, (start, end) in self.ramps.items():
            if name == "dists" and step % self._every and self._last is not None:
                terms[name] = self._last
                continue
            if name == "ssim":
                term = self._ssim(shown)
            elif name == "dists":
                term = self._dists(to_display(crop))
            elif name in ("image_l1", "image_l2"):
                term = losses.LOSSES[name](shown, self._target, self._weight)
            else:
                term = losses.LOSSES[name](crop, self._original)
            terms[name] = term * dr.opaque(mi.Float, optimizer.ramp(start, end, step, self.iterations))
            if name == "dists":
                value = dr.detach(terms[name])
                more = (self._every - 1) * (terms[name] - value)  # 0, with the gradient of the steps between
                self._last = dr.select(dr.isfinite(value), value, 0 if self._last is None else self._last)
        return sum(terms.values()) + more, terms

    def resume(self, history: list[dict]) -> None:
        """Go on from a run's last step."""
        if history and "dists" in history[-1]:
            self._last = dr.opaque(mi.Float, history[-1]["dists"])


@dataclass
class State:
    """Everything a run needs to continue: what a checkpoint holds."""

    step: int = 0
    bad_steps: int = 0
    bad_in_a_row: int = 0
    slowdown: float = 1.0
    history: list[dict] = field(default_factory=list)


def place_rows(original: mi.TensorXf, crop: mi.TensorXf, first: int) -> mi.TensorXf:
    """Replace rows ``first`` ... of a map (H, W, 3) by ``crop``, differentiably in the crop.

    The gradient of the crop is a slice, in which NaN shows: a sum with atomics drops it on LLVM.
    """
    last = first + crop.shape[0]
    above = [original[:first]] if first > 0 else []
    below = [original[last:]] if last < original.shape[0] else []
    return dr.concat([*above, crop, *below]) if above or below else crop


class _Slopes:
    """Notes, on the way back, whether gradients are finite; made anew for every step.

    The parameters' own do not show it: what lies in between may add gradients with atomics, which drop NaN on
    LLVM. Mitsuba's path tracer does.
    """

    def __init__(self):
        self.flags = []

    def pass_on(self, x):
        """Return a tensor as it is; its gradient is looked at."""
        return dr.custom(_Slope, x, self)

    def finite(self) -> bool:
        """Say whether all gradients that came by were finite."""
        return not any(flag[0] for flag in self.flags)


class _Slope(dr.CustomOp):
    def eval(self, x, slopes):
        self.slopes = slopes
        return mi.TensorXf(x)

    def backward(self):
        slope, flag = self.grad_out(), dr.opaque(mi.UInt32, 0)
        dr.scatter(flag, mi.UInt32(1), mi.UInt32(0), ~dr.isfinite(slope.array))
        self.slopes.flags.append(flag)
        self.set_grad_in("x", slope)

    def name(self):
        return "finite gradient"


def adam_for(representation: Representation, params: Params, settings: config.Optimizer) -> optimizer.Adam:
    """Make the optimiser that a configuration asks for; a rate of "auto" is the representation's own."""
    rate = representation.lr if isinstance(settings.lr, str) else settings.lr
    return optimizer.Adam(params, rate, (0.9, settings.beta2))


def optimise(
    representation: Representation,
    params: Params,
    renderer: Renderer,
    objective: Objective,
    envmap: np.ndarray,
    first_row: int,
    settings: config.Optimizer,
    *,
    free: np.ndarray | None = None,
    adam: optimizer.Adam | None = None,
    state: State | None = None,
    after_step: Callable[[State, optimizer.Adam], None] | None = None,
) -> tuple[dict, State]:
    """Run the loop.

    Parameters
    ----------
    representation : object
        ``decode(params)`` gives the active rows (rows, W, 3).
    params : dict
        Where to start.
    renderer : object
        ``render(envmap, step)``.
    objective : Objective
        What to minimise.
    envmap : ndarray (H, W, 3)
        The original; rows outside the active ones stay as they are.
    first_row : int
        First active row.
    settings : config.Optimizer
        Iterations and learning rate.
    free : ndarray of bool (rows, W), optional
        Texels of the active rows that may change; the others stay the original's, whatever the parameters.
    adam, state : optional
        To continue an earlier run; changed in place.
    after_step : callable, optional
        Called with state and optimiser after every step: progress and checkpoints. What it raises ends the
        run.

    Returns
    -------
    params, state
        Parameters after the last good step, which nothing was computed from yet; ``adam.take_back()``
        returns to those before it.

    Raises
    ------
    NumericalError
        After :data:`MOST_BAD_STEPS` non-finite steps in a row; ``adam`` has the last parameters whose loss
        and gradients were finite.
    """
    adam, state = adam or adam_for(representation, params, settings), state or State()
    fixed = tensor(envmap)
    if free is not None:
        original = flat(mi.Float, np.float32(envmap[first_row : first_row + len(free)]))
        changes = flat(mi.Bool, np.repeat(free, 3))
    while state.step < settings.iterations:
        start = time.perf_counter()
        leaves, slopes = adam.leaves(), _Slopes()
        with dr.isolate_grad():
            crop = representation.decode(leaves)
            if free is not None:
                crop = mi.TensorXf(dr.select(changes, crop.array, original), crop.shape)
            crop = slopes.pass_on(crop)
            rendering = renderer.render(place_rows(fixed, crop, first_row), state.step)
            rendering = slopes.pass_on(rendering)
            total, terms = objective(rendering, crop, state.step)
            dr.backward(total)
        dr.eval(total, terms, slopes.flags)
        grads = {name: dr.grad(leaf) for name, leaf in leaves.items()}
        finite = bool(dr.isfinite(total)[0]) and slopes.finite()
        rate = adam.lr
        if settings.schedule == "cosine":
            rate = optimizer.cosine(rate, state.step, settings.iterations)
        rate *= state.slowdown
        if finite and adam.step(grads, lr=rate):
            state.bad_in_a_row = 0
            state.slowdown = min(1.0, state.slowdown * 2 ** (1 / RECOVERY))
        else:
            adam.take_back()
            state.bad_steps += 1
            state.bad_in_a_row += 1
            state.slowdown *= 0.5
            if state.bad_in_a_row >= MOST_BAD_STEPS:
                raise NumericalError(
                    f"the edit stopped at iteration {state.step}: {MOST_BAD_STEPS} steps in a row were not "
                    "finite; the last good map is kept; lower [optimizer] lr or look at the target for "
                    "extreme pixels"
                )
        values = {"loss": total, **terms}
        state.history.append(
            {
                "iteration": state.step,
                **{name: float(value[0]) for name, value in values.items()},
                "lr": rate,
                "step_ms": round(1000 * (time.perf_counter() - start), 3),
            }
        )
        state.step += 1
        if after_step:
            after_step(state, adam)
    return adam.params, state
