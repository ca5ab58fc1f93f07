"""Fit a SIREN to an HDR map, robust against changes of its weights (R-SIREN, paper Sec. 4 and 6.1).

The network learns the normalised logarithm of the map (Eq. 1), with a loss in log space and one in radiance
(Eq. 4). Under adversarial weight perturbation the loss is evaluated at theta + gamma ||theta_l|| / ||d_l||
d_l for every weight matrix l, where d is the direction in which a proxy Adam would make the SSIM worse (Eq.
5; Algorithm 1), and the gradient is applied to theta.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.array_cache import DiskCache
from envedit.core.arrays import tensor
from envedit.core.errors import NumericalError
from envedit.core.radiance import require_radiance
from envedit.core.types import Params
from envedit.losses import losses, metrics, optimizer, ssim
from envedit.representations.base import EPSILON, not_negative
from envedit.representations.siren import network as siren
from envedit.representations.siren import output_layer

MOST_REFUSED = 20
"""Non-finite steps after which a fit gives up."""
SAVED_EVERY = 30.0
"""Seconds of training after which it is kept on disk, so that a killed fit goes on from there."""
_RECIPE = 4  # raise when the same settings give another fit
_NUMBERS = ("log_psnr", "peak_ratio", "epochs", "seconds")
_ABOUT = "about"


@dataclass(frozen=True)
class Normalisation:
    """Eq. 1-3: between radiance E and the network's (0, 1); ``low`` and ``span`` of log(E + 0.01)."""

    low: float
    span: float

    @classmethod
    def of(cls, image: np.ndarray, headroom: float = 0.0) -> Normalisation:
        """Measure the range of an image; a constant image is put in the middle of a range of one.

        ``headroom`` is the share of (0, 1) that stays free at either end: a sigmoid reaches 1, where Eq. 1
        puts the sun, nowhere, and an edited sun may have to be brighter.
        """
        logs = np.log(np.asarray(image, np.float64) + EPSILON)
        low, high = float(logs.min()), float(logs.max())
        if high - low <= 1e-4:
            return cls(low - 0.5, 1.0)
        span = (high - low) / (1 - 2 * headroom)
        return cls(low - headroom * span, span)

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Map radiance to [0, 1], in float64 (Eq. 1)."""
        return (np.log(np.asarray(image, np.float64) + EPSILON) - self.low) / self.span

    def decode(self, values: mi.TensorXf) -> mi.TensorXf:
        """Map network output in (0, 1) to finite radiance >= 0 (Eq. 2-3), on tensors and arrays."""
        # dr.exp is infinite from 88.38 on; a flat or black map can lead below 0.
        return not_negative(dr.exp(dr.minimum(values * self.span + self.low, 88)) - EPSILON)


@dataclass
class Fitted:
    """A fitted network: weights as numpy arrays, its normalisation, and how well it does."""

    params: dict[str, np.ndarray]
    normalisation: Normalisation
    log_psnr: float | None
    peak_ratio: float | None
    epochs: int
    seconds: float
    cached: bool


def unpolished(settings: config.Fit) -> config.Fit:
    """Return a recipe that perturbs to the end and leaves the last layer as it was trained.

    A polished fit has the map's sun, sharp and bright; a robust one is vague about it. To move a sun that is
    not there yet is easier: edits of sunny maps that start from a robust fit end better
    (``docs/decisions/fit_of_the_network.md``).
    """
    return replace(settings, awp_until=1.0, light=0.0)


def fit(
    image: np.ndarray,
    network: config.Representation | None = None,
    settings: config.Fit | None = None,
    seed: int = 0,
    rows: tuple[int, int] | None = None,
    *,
    folder: Path | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> Fitted:
    """Fit a SIREN to an image in normalised log space, under weight perturbation (paper, Sec. 4).

    Parameters are those of :func:`envedit.fit`. The fit is read from ``folder`` if the same was made before,
    and continued if it was begun. InputError if a texel is not finite or is negative, NumericalError if too
    many steps were not finite.
    """
    network, settings = network or config.Representation(), settings or config.Fit()
    settings = unpolished(settings) if settings.polish == "never" else settings
    image = np.ascontiguousarray(image, np.float32)
    require_radiance(image, "fit")

    # ---- The same fit from disk
    cache = DiskCache(folder if settings.cache else None)
    key = _key(image, network, settings, seed, rows)
    if stored := cache.load(key):
        return _read(stored)

    # ---- Training, continued if it was begun
    begun = _Begun(cache, key)
    normalisation = Normalisation.of(image, settings.headroom)
    x = points(network, image.shape[:2], rows)
    params = _train(image, normalisation, x, network, settings, seed, begun, progress)
    if settings.light:
        target = normalisation.encode(image).reshape(-1, 3)
        params = output_layer.last_layer(
            params, x, network.omega, target, image.reshape(-1, 3), settings.light
        )

    # ---- How well it does
    got = evaluate(params, normalisation, x, image.shape[:2], network.omega).numpy()
    if not np.isfinite(got).all():  # its last steps were refused, but too few of them to stop
        raise NumericalError("the fit ended with a network that is not finite; lower [fit] lr")
    fitted = Fitted(
        {k: v.numpy() for k, v in params.items()},
        normalisation,
        metrics.log_psnr(got, image),
        metrics.peak_ratio(got, image),
        settings.epochs,
        begun.seconds(),
        False,
    )
    cache.store(key, _stored(fitted))
    begun.forget()
    return fitted


def points(
    network: config.Representation, shape: tuple[int, int], rows: tuple[int, int] | None = None
) -> mi.TensorXf:
    """Return the network's coordinates of the texels of ``rows`` (first, total) of a map, (H * W, inputs)."""
    if network.coordinates == "plane":
        return dr.opaque(siren.coordinates(*shape))
    return dr.opaque(siren.directions(*shape, *(rows or (0, shape[0]))))


def evaluate(
    params: Params, normalisation: Normalisation, x: mi.TensorXf, shape: tuple[int, int], omega: float
) -> mi.TensorXf:
    """Evaluate a network at :func:`points` as linear radiance (H, W, 3), differentiable in its weights."""
    y = siren.evaluate(params, x, omega)
    return normalisation.decode(dr.reshape(y, (*shape, 3)))


class Objective:
    """Eq. 4 for one image: value and gradient with respect to the network's output (H * W, 3)."""

    def __init__(self, image: np.ndarray, normalisation: Normalisation, settings: config.Fit):
        self.shape = image.shape[:2]
        self.normalisation, self.settings = normalisation, settings
        self.logs = tensor(normalisation.encode(image))
        self.radiance = tensor(image)
        self.ssim = ssim.Ssim(self.logs)

    def gradient(self, y: mi.TensorXf, only_ssim: bool = False) -> tuple[mi.Float, mi.TensorXf]:
        """Return the loss (size-1 array) and its gradient with respect to y."""
        y = mi.TensorXf(y)
        dr.enable_grad(y)
        with dr.isolate_grad():
            values = dr.reshape(y, (*self.shape, 3))
            if only_ssim:
                loss = self.ssim(values)
            else:
                loss = dr.opaque(mi.Float, 0)
                if self.settings.log_mse:
                    loss += self.settings.log_mse * losses.image_l2(values, self.logs)
                if self.settings.log_ssim:
                    loss += self.settings.log_ssim * self.ssim(values)
                if self.settings.hdr:
                    radiance = self.normalisation.decode(values)
                    loss += self.settings.hdr * losses.image_l1(radiance, self.radiance)
            dr.backward(loss)
        return dr.detach(loss), dr.grad(y)


# ---- Adversarial weight perturbation (Eq. 5, Algorithm 1) --------------------------------------------------


def ascent(grads: Params, lr: float) -> Params:
    """Return the direction, for every weight matrix, in which a loss of these gradients becomes worse.

    The proxy Adam of the paper takes one step from an offset of zero, so that the direction is not the
    rounding error of two nearly equal weights. Its learning rate cancels in the normalisation but for Adam's
    epsilon. It is made anew every time, as Algorithm 1 shows no state.
    """
    matrices = {name: grad for name, grad in grads.items() if name.endswith(".weight")}
    proxy = optimizer.Adam({name: dr.zeros(mi.TensorXf, grad.shape) for name, grad in matrices.items()}, lr)
    # A refused (non-finite) gradient leaves the direction at zero: no perturbation in this epoch.
    proxy.step({name: -grad for name, grad in matrices.items()})
    return proxy.params


def perturbed(params: Params, direction: Params, gamma: float) -> Params:
    """Return parameters moved by gamma of their norm; a layer without direction or norm stays as it is."""
    out = dict(params)
    for name, d in direction.items():
        norm, norm_of_d = (dr.sqrt(dr.sum(dr.square(x.array))) for x in (params[name], d))
        length = norm * dr.rcp(norm_of_d + 1e-20)
        out[name] = params[name] + mi.TensorXf(gamma * length * d.array, d.shape)
    dr.eval(out)
    return out


# ---- Training ----------------------------------------------------------------------------------------------


def learning_rate(settings: config.Fit, base: float, epoch: int) -> float:
    """Learning rate of an epoch under the recipe's schedule."""
    if settings.schedule == "cosine":
        return optimizer.cosine(base, epoch, settings.epochs)
    if settings.schedule == "warm-restarts":
        return optimizer.cosine_warm_restarts(base, epoch, settings.restart_period)
    return base


def _train(image, normalisation, x, network, settings, seed, begun, progress):
    params = siren.init(seed, network.hidden, network.depth, network.omega, inputs=x.shape[1])
    grids = _grids(image, normalisation, x, settings)
    rng = np.random.default_rng(seed)
    order = list[int]()
    adam = optimizer.Adam(params, settings.lr, (0.9, settings.beta2))
    direction: Params = {}
    first, refused = begun.restore(adam)
    for epoch in range(settings.epochs):
        order = order or list(rng.permutation(len(grids)))
        objective, x = grids[order.pop()]
        if epoch < first:  # only the order of the grids is gone through again
            continue
        params = adam.params
        if settings.awp_gamma > 0 and epoch < settings.awp_until * settings.epochs:
            if epoch % settings.awp_every == 0:
                y, tape = siren.forward(params, x, network.omega)
                _, slope = objective.gradient(y, only_ssim=True)
                # A rate of 0 at the end of a schedule would leave no direction.
                rate = max(learning_rate(settings, settings.awp_lr, epoch), 0.01 * settings.awp_lr)
                direction = ascent(siren.backward(params, tape, slope), rate)
            params = perturbed(params, direction, settings.awp_gamma)
        y, tape = siren.forward(params, x, network.omega)
        loss, slope = objective.gradient(y)
        rate = learning_rate(settings, settings.lr, epoch)
        if not adam.step(siren.backward(params, tape, slope), lr=rate):
            refused += 1
            if refused > MOST_REFUSED:
                raise NumericalError(
                    f"the fit stopped at epoch {epoch}: {refused} steps were not finite; lower [fit] lr"
                )
        if progress and (epoch % 20 == 0 or epoch == settings.epochs - 1):
            progress(epoch + 1, settings.epochs, float(loss[0]))
        if (epoch + 1) % settings.awp_every == 0:  # the next epoch looks for its own direction
            begun.keep(adam, epoch + 1, refused)
    return adam.params


class _Begun:
    """Training that is not over, on disk: a killed fit goes on from there to the same weights."""

    def __init__(self, cache: DiskCache, key: dict):
        self._cache, self._key = cache, key | {"training": True}
        self._started = self._saved = time.perf_counter()
        self._earlier = 0.0

    def seconds(self) -> float:
        """Return the seconds since the fit was begun, those of earlier processes included."""
        return self._earlier + time.perf_counter() - self._started

    def restore(self, adam: optimizer.Adam) -> tuple[int, int]:
        """Bring the optimiser to where it was; returns epochs done and steps refused."""
        state = self._cache.load(self._key)
        if not state:
            return 0, 0
        state = dict(state)
        epoch, refused, self._earlier = state.pop(_ABOUT).tolist()
        adam.load_state_dict(state)
        return int(epoch), int(refused)

    def keep(self, adam: optimizer.Adam, epoch: int, refused: int) -> None:
        """Write the state after ``epoch`` epochs, where that is due."""
        if time.perf_counter() - self._saved < SAVED_EVERY:
            return
        about = np.array([epoch, refused, self.seconds()])
        self._cache.store(self._key, adam.state_dict() | {_ABOUT: about})
        self._saved = time.perf_counter()

    def forget(self) -> None:
        """Delete what a fit that is made does not need."""
        self._cache.remove(self._key)


def _grids(image, normalisation, x, settings):
    """Cut an image into interleaved grids of every stride-th row and column; objective and points of each.

    A grid is a picture itself, so that its SSIM means something. One that were smaller than the window of the
    SSIM would not be: small images are taken whole.
    """
    height, width = image.shape[:2]
    stride = settings.stride if min(height, width) >= settings.stride * ssim.WINDOW else 1
    x = x.numpy().reshape(height, width, -1)
    grids = []
    for row in range(stride):
        for column in range(stride):
            part = (slice(row, None, stride), slice(column, None, stride))
            objective = Objective(np.ascontiguousarray(image[part]), normalisation, settings)
            some = np.ascontiguousarray(x[part]).reshape(-1, x.shape[-1])
            grids.append((objective, tensor(some)))
    return grids


# ---- fits on disk ------------------------------------------------------------------------------------------


def _key(image, network, settings, seed, rows):
    return {
        "network": [network.hidden, network.depth, network.omega, network.coordinates],
        "rows": rows or (0, image.shape[0]),
        "seed": seed,
        "recipe": _RECIPE,
        "image": [image.shape, hashlib.sha256(image.tobytes()).hexdigest()],
        "settings": {k: v for k, v in asdict(settings).items() if k not in ("cache", "polish")},
    }


def _stored(fitted: Fitted) -> dict[str, np.ndarray]:
    """Put a fit into arrays; None becomes NaN."""
    about = [getattr(fitted, name) for name in _NUMBERS]
    range_ = fitted.normalisation
    return fitted.params | {_ABOUT: np.array([range_.low, range_.span, *about], np.float64)}


def _read(arrays: dict[str, np.ndarray]) -> Fitted:
    """Make a fit of :func:`_stored`'s arrays."""
    params = {name: np.array(value) for name, value in arrays.items()}  # copies: these are mapped files
    low, span, *numbers = params.pop(_ABOUT).tolist()
    log_psnr, peak, epochs, seconds = (None if np.isnan(number) else number for number in numbers)
    return Fitted(params, Normalisation(low, span), log_psnr, peak, int(epochs), seconds, True)
