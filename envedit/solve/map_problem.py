"""What an edit with layers minimises, and its derivatives; ``docs/solver.md``, "The edit as one problem".

Unknowns x: the log gain g of every node, and of every light that is lit its log flux per channel, its
direction (two angles) and its log size. With display values d(.) (``display_curve.py``), T the transport and
E(x) the map that the layers compose, minimised is

    F(x) = misfit of the residual  +  x' K x  +  how much more of the sky is white

* The misfit is that of ``likelihood.py``: how unlikely the residual of display values d(T E(x)) - d(t) is.
* K is the inverse covariance of a sky's change (:class:`Prior`): of the gain along luminance, blue-amber and
  green-magenta; of lights flux, size and direction.
* White sky counts where the target is painted (``white_sky.py``).

Of a photograph, what is compared with the target is d(exp(c) T E(x)): the log factor c of a channel, exposure
and white balance, is an unknown too, whose deviation from none the penalty holds. Where the photograph is
white, only a rendering that is darker differs from it.

The residual is exact, through T; so is the gradient by gain and saturation. Other derivatives are those of
``derivatives.py``.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.rotations import rotation_between
from envedit.losses import display_curve
from envedit.representations.layers.layers import Layers
from envedit.solve.block_jacobian import BlockJacobian
from envedit.solve.derivatives import NARROW_ANGLE, Derivatives
from envedit.solve.likelihood import Likelihood
from envedit.solve.normal_equations import Normal, solved
from envedit.solve.prior import AXES, Prior
from envedit.solve.unknowns import LOG_SATURATIONS, Point, Unknowns
from envedit.solve.white_sky import WhiteSky
from envedit.targets.photo import Photo
from envedit.transport.light_transport import COLUMNS_A_LOOK, LightTransport

LARGEST_STEP = {
    "gain": 2.0,
    "flux": 1.5,
    "turn": np.radians(4.0),
    "size": 0.7,
    "saturation": 1.0,
    "camera": 1.0,
}
"""Largest step of an unknown: beyond it the linear model does not hold."""


@dataclass(frozen=True)
class Posterior:
    """How well a picture determines the sky."""

    # deviation, prior: (H, W), standard deviation of the log luminance gain with and without the picture; 0
    # outside the active rows
    deviation: np.ndarray
    prior: np.ndarray
    # Draws parameters of the layers with a generator of numbers: in Laplace's approximation, as likely as
    # picture and prior make them. None where the normal equations cannot be solved
    sample: Callable[[np.random.Generator], dict] | None = None

    @property
    def identified(self) -> np.ndarray:
        """Share of the prior's variance that the picture removes, (H, W): 0 nothing is known, 1 all is."""
        share = np.square(self.deviation / np.maximum(self.prior, 1e-12))
        return np.where(self.prior > 0, np.clip(1 - share, 0, 1), 0).astype(np.float32)


class Problem(Unknowns):
    """F and its derivatives for one picture.

    Parameters
    ----------
    layers : Layers
        After ``encode``.
    transport : LightTransport
        T.
    envmap : ndarray (H, W, 3)
        The original.
    picture : ndarray (h, w, 3)
        The target, linear radiance.
    likelihood : Likelihood, optional
        Of its residuals; by default that of a rendering all of whose pixels count the same.
    prior : Prior
        How far a sky changes.
    saturates : bool
        The saturation of its colours is an unknown.
    blocks : BlockJacobian, optional
        Of another problem of these layers and this transport; made where None.
    photo : Photo, optional
        The photograph that the target is.
    clipped : ndarray of bool (h, w, 3), optional
        Where the target is a lower bound.
    """

    def __init__(
        self,
        layers: Layers,
        transport: LightTransport,
        envmap: np.ndarray,
        picture: np.ndarray,
        likelihood: Likelihood | None = None,
        prior: Prior | None = None,
        saturates: bool = False,
        blocks: BlockJacobian | None = None,
        photo: Photo | None = None,
        clipped: np.ndarray | None = None,
    ):
        super().__init__(layers, saturates, photo is not None)
        self.photo, self.clipped = photo, clipped
        self.transport, self.envmap, self.rows = transport, envmap, layers.active
        self.blocks = blocks or BlockJacobian(layers, transport, envmap.shape[:2])
        self.derivatives = Derivatives(self, self.blocks)
        self.expect(prior or Prior())
        self._aim(picture, likelihood)

    def expect(self, prior: Prior) -> None:
        """Take another prior."""
        self.prior = prior
        self._precisions = prior.gain_precisions(self.layers.gain, self.ground)
        self._gain_precision = sum(
            np.kron(np.outer(axis, axis), of_axis)
            for axis, of_axis in zip(AXES, self._precisions, strict=True)
        )

    def _aim(self, picture, likelihood):
        self.picture = picture
        self.likelihood = likelihood or Likelihood(np.ones((*picture.shape[:2], 1), np.float32))
        self.target = display_curve.values(picture, self.likelihood.white)
        unpainted = self.likelihood.unpainted
        self.white_sky = WhiteSky.of(self.envmap, unpainted) if unpainted > 0 else None

    def aimed_at(self, picture: np.ndarray, likelihood: Likelihood | None, point: Point) -> Point:
        """Take another target, with its likelihood; returns a point with its residual from that target."""
        self._aim(picture, likelihood)
        return replace(point, residual=self.residual(point.state, point.rendering))

    # ---- F -------------------------------------------------------------------------------------------------

    def evaluate(self, state: dict, transport: LightTransport | None = None, resolve: bool = True) -> Point:
        """Compose and render the map of a state through T, by default the problem's.

        ``resolve``: with further exact columns where the map is bright.
        """
        transport = transport or self.transport
        sky, core = (part.numpy() for part in self.layers.parts(self.params(state)))
        with np.errstate(over="ignore", invalid="ignore"):
            crop, edited = sky + core, self.envmap.copy()
        edited[self.rows] = crop
        if not np.isfinite(crop).all():
            return Point(state, edited, sky, transport, None, None)
        if resolve:
            transport = transport.resolved(edited, limit=COLUMNS_A_LOOK)
            transport = transport.with_probed(transport.main(core[None], self.rows))
        rendering = transport.apply(tensor(edited)).numpy()
        residual = self.residual(state, rendering)
        if not np.isfinite(residual).all():
            return Point(state, edited, sky, transport, None, None)
        return Point(state, edited, sky, transport, rendering, residual)

    def residual(self, state: dict, rendering: np.ndarray) -> np.ndarray:
        """Return display values of a rendering (h, w, 3), under a camera's factor, less the target's."""
        shown = display_curve.values(rendering * self._exposure(state), self.likelihood.white)
        residual = np.float64(shown) - self.target
        if self.clipped is None:
            return residual
        return np.where(self.clipped, np.minimum(residual, 0), residual)

    def _exposure(self, state):
        """Return the factor of every channel between a rendering and the picture, (3,) or 1."""
        return np.exp(state["camera"][0]).astype(np.float32) if self.photographed else np.float32(1)

    def _slope(self, point):
        """Return the derivative of the residual by radiance, (h, w, 3)."""
        exposure = self._exposure(point.state)
        slope = display_curve.slope(point.rendering * exposure, self.likelihood.white) * exposure
        if self.clipped is None:
            return slope
        return np.where(self.clipped & (point.residual >= 0), 0, slope).astype(np.float32)

    def loss(self, point: Point, start: dict, sigma: float) -> float:
        """Return F."""
        return self.likelihood.misfit(point.residual, sigma) + self.penalty(point, start)

    def unlikeliness(self, point: Point, start: dict) -> float:
        """Return -2 log posterior density at the noise that the residual shows, but for a constant."""
        return self.likelihood.at_best(point.residual) + self.penalty(point, start)

    def penalty(self, point: Point, start: dict) -> float:
        """Return what F has beside the misfit; ``start`` is where the search has put the lights."""
        whitened = 0.0 if self.white_sky is None else self.white_sky.loss(point.edited)
        return self.from_start(point.state, start) + whitened

    def whitens(self, point: Point) -> bool:
        """Whether more of the sky is white than was, where that counts."""
        return self.white_sky is not None and self.white_sky.loss(point.edited) > 0

    def from_start(self, state: dict, start: dict) -> float:
        """Return x' K x."""
        unknowns = self.named(state)
        rest = self._from_prior(state, start, unknowns)[3 * self.nodes :]
        total = rest @ self._precision_beside_gain(unknowns) @ rest
        along = AXES @ state["gain"].T  # a third of the products that channels take
        return float(total + sum(g @ k @ g for g, k in zip(along, self._precisions, strict=True)))

    # ---- normal equations ----------------------------------------------------------------------------------

    def normal(
        self,
        point: Point,
        start: dict,
        sigma: float,
        angle: float = NARROW_ANGLE,
        descent: bool = True,
        bounded: bool = False,
    ) -> Normal:
        """Linearise F at a point: gradient / 2 and Gauss-Newton Hessian / 2.

        The gradient by gain and saturation is exact, through T; their part of the Hessian, and what it has in
        common with lights, is that of the block transport. ``angle`` is as of :meth:`.Derivatives.at`.
        Without ``descent`` only the Hessian is asked for, and the gradient is 0. ``bounded``: no more of the
        sky should be white than was, also where a step would lead there.
        """
        state, n = point.state, self.nodes
        blocks, linear = self.blocks, self.derivatives.at(point, angle)
        pictures, profile = linear.pictures, linear.profile
        unknowns = 3 * n + len(pictures)
        hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        mean_by_unknowns = np.zeros((3, unknowns))

        # ---- Weights of pixels, and of the mean of what was not painted
        robust = self.likelihood.weights(point.residual, sigma)
        share, mean = self.likelihood.linear_mean(point.residual)
        slope = self._slope(point)

        # ---- Lights and saturation, by pixels
        rest = slice(3 * n, unknowns)
        flat = (pictures * (slope * np.sqrt(robust))).reshape(len(pictures), slope.size)
        hessian[rest, rest] = flat @ flat.T
        gradient[rest] = flat @ (np.sqrt(robust) * point.residual).ravel()
        mean_by_unknowns[:, rest] = np.einsum("khwc,hwc->ck", pictures, slope * share)
        gradient[rest] += mean @ mean_by_unknowns[:, rest]

        # ---- Gain, and what it has in common with lights, by blocks
        of_gain = slope * profile
        squared = blocks.summed(of_gain**2 * robust)
        pulled = blocks.summed(of_gain * robust * point.residual)
        mean_by_blocks = blocks.summed(of_gain * share)
        lights_in_blocks = []
        for c, j in enumerate(linear.jacobian):
            part = slice(c * n, (c + 1) * n)
            scaled = tensor(j * np.sqrt(squared[:, c : c + 1]))
            hessian[part, part] = dr.matmul(scaled, scaled, At=True).numpy()
            weighted = pictures[..., c] * (slope**2 * profile * robust)[..., c]
            in_blocks = blocks.sums(weighted.reshape(len(pictures), robust.size)).T
            hessian[rest, part] = in_blocks.T @ j
            hessian[part, rest] = hessian[rest, part].T
            mean_by_unknowns[c, part] = mean_by_blocks[:, c] @ j
            lights_in_blocks.append(in_blocks)

        # ---- The gradient by gain and saturation, through T
        if descent:
            weighted = slope * (robust * point.residual + share * mean)
            light = point.transport.adjoint(np.float32(weighted)).numpy()[self.rows]
            by_nodes, by_saturation = self._by_sky(point, light)
            gradient[: 3 * n] = by_nodes.T.ravel()
            if self.saturates:
                gradient[-1] = by_saturation

        # ---- The mean of what was not painted, white sky, and the prior
        hessian += mean_by_unknowns.T @ mean_by_unknowns
        self._add_white(hessian, gradient, point, linear, bounded)
        precision = self._precision(linear.named)
        hessian += precision
        if descent:
            gradient += precision @ self._from_prior(state, start, linear.named)
        return Normal(
            hessian=hessian,
            gradient=gradient if descent else np.zeros(unknowns),
            precision=precision,
            linear=linear,
            robust=robust,
            slope=slope,
            squared=squared,
            pulled=pulled,
            lights=lights_in_blocks,
            mean=mean,
            mean_by_unknowns=mean_by_unknowns,
            mean_by_pixels=share * slope,
            mean_by_blocks=mean_by_blocks,
        )

    def curvature(self, point: Point, start: dict) -> Normal:
        """Return the normal equations without descent, at the noise that the residual shows."""
        return self.normal(point, start, self.likelihood.noise(point.residual), descent=False)

    def _add_white(self, hessian, gradient, point, linear, bounded):
        """Add what white sky is to the normal equations."""
        if self.white_sky is None:
            return
        slope, white = self.white_sky.linear(point.edited, bounded)
        if slope.any():
            slope = slope[self.rows]
            by_nodes, by_saturation = self._by_sky(point, slope)
            others = [0.0] * 3 * self.photographed + [by_saturation] * self.saturates
            by_unknowns = np.concatenate([by_nodes.T.ravel(), linear.by_lights(slope), others])
            hessian += np.outer(by_unknowns, by_unknowns)
            gradient += white * by_unknowns

    def _by_sky(self, point, light):
        """Return the derivatives of the sum of the active rows times ``light``, of the same shape.

        By every node's log gain, (n, 3), and by the log saturation; 0 where that is no unknown.
        """
        params = self.params(point.state)
        names = self.grids + ["saturation"] * self.saturates
        with dr.isolate_grad():
            dr.enable_grad([params[name] for name in names])
            sky, _ = self.layers.parts(params)
            dr.backward(dr.sum(sky.array * tensor(light).array))
            derivatives = [
                np.float64(dr.grad(params[name]).numpy()) / self.layers.scales[name] for name in names
            ]
        colour = float(derivatives.pop()[0, 0]) if self.saturates else 0.0
        return np.concatenate([one.reshape(-1, 3) for one in derivatives]), colour

    def _precision(self, unknowns):
        """Return K of the gain, channel by channel, and of the unknowns beside it."""
        gain = 3 * self.nodes
        precision = np.zeros((gain + len(unknowns),) * 2)
        precision[:gain, :gain] = self._gain_precision
        precision[gain:, gain:] = self._precision_beside_gain(unknowns)
        return precision

    def _precision_beside_gain(self, unknowns):
        precision = np.zeros((len(unknowns),) * 2)
        for k, (name, i, axis) in enumerate(unknowns):
            if name == "flux":
                precision[k, k - axis : k - axis + 3] = self.prior.flux_precision[axis]
            elif name == "camera":
                precision[k, k - axis : k - axis + 3] = self.photo.precision[axis]
            elif name == "size" and i >= self.layers.lights.own:
                precision[k, k] = self.prior.added_size**-2.0
            else:
                precision[k, k] = getattr(self.prior, name) ** -2.0
        return precision

    def _from_prior(self, state, start, unknowns):
        """Return x: how far the unknowns are from where the prior draws them.

        That is the start, but for the flux of the map's own lights, which is drawn to the original's.
        """
        own = self.layers.lights.own
        values = []
        for name, i, axis in unknowns:
            if name == "turn":
                turn = rotation_between(self.direction(start, i), self.direction(state, i))
                values.append(turn @ axis)
            elif name == "camera":
                values.append(self.photo.off_centre[axis] + state[name][i, axis])
            elif name == "saturation" or (name == "flux" and i < own):
                values.append(state[name][i, axis])
            else:
                values.append(state[name][i, axis] - start[name][i, axis])
        return np.concatenate([state["gain"].T.ravel(), values])

    def step(self, state: dict, normal: Normal, damping: float) -> dict | None:
        """Return the state after a damped step; None if the step is not finite."""
        # Marquardt's diagonal; where the prior makes nodes go together, all of the prior is damped: with its
        # diagonal alone the sky as a whole would hardly move.
        diagonal = np.diag_indices_from(normal.hessian)
        damped = normal.hessian.copy()
        damped[diagonal] *= 1 + damping
        if self.prior.freedom is not None:
            damped += damping * normal.precision
            damped[diagonal] -= damping * normal.precision[diagonal]
        try:
            step = -solved(np.linalg.cholesky(damped), normal.gradient)
            if self.saturates:
                step = self._within(step, state["saturation"][0, 0], damped, normal)
        except np.linalg.LinAlgError:  # radiance beyond what squares of single precision hold
            return None
        if not np.isfinite(step).all():
            return None
        return self.moved(state, step, normal.linear.named, LARGEST_STEP)

    def _within(self, step, now, damped, normal):
        """Return a step, solved anew for all else where it takes the saturation out of its bounds."""
        k = 3 * self.nodes + normal.linear.named.index(("saturation", 0, 0))
        if LOG_SATURATIONS[0] <= now + step[k] <= LOG_SATURATIONS[1]:
            return step
        to = np.clip(now + step[k], *LOG_SATURATIONS) - now
        rest = np.arange(len(step)) != k
        gradient = normal.gradient[rest] + damped[rest, k] * to
        step[rest] = -solved(np.linalg.cholesky(damped[np.ix_(rest, rest)]), gradient)
        step[k] = to
        return step

    def posterior(self, state: dict, normal: Normal) -> Posterior:
        """Return what the normal equations at a solution say of it."""
        n = self.nodes
        prior = np.linalg.inv(3 * self._precisions[0])
        mean = np.zeros((len(normal.hessian), n))
        for c in range(3):
            mean[c * n + np.arange(n), np.arange(n)] = 1 / 3
        sample = None
        covariance = prior  # where nothing can be said beyond it
        with contextlib.suppress(np.linalg.LinAlgError):
            lower = np.linalg.cholesky(normal.hessian)
            half = np.linalg.solve(lower, mean)
            if np.isfinite(half).all():
                covariance = half.T @ half
                # Not this problem, which keeps T in memory.
                unknowns = Unknowns(self.layers, self.saturates, self.photographed)
                sample = functools.partial(_sample, unknowns, state, lower, normal.linear.named)
        spread = [self.blocks.spread(one) for one in (covariance, prior)]
        whole = np.zeros((2, *self.envmap.shape[:2]), np.float32)
        whole[:, self.rows] = spread
        return Posterior(deviation=whole[0], prior=whole[1], sample=sample)


def _sample(unknowns, state, lower, names, rng):
    """Return parameters at a step of covariance (L L')^-1 from a state."""
    step = np.linalg.solve(lower.T, rng.standard_normal(len(lower)))
    return unknowns.params(unknowns.moved(state, step, names))
