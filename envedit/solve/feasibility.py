"""How much of a request any light can do: the closest picture that a non-negative map makes.

A rendering is linear in the map, so the closest picture is the solution of a convex problem through T, found
before minutes are spent on an edit. With I = T E + I_0, target t and weights w,

    min over E >= 0  1/2 sum_p w_p s_p^2 (I_p - t_p)^2

where s_p is the slope of the display curve between the pixel's present value and the target, so that the
sum is one of display values. A pixel whose target is white has no residual at any value above. The mean of
what was not painted stays as the likelihood says (``likelihood.py``), whose weights w are.

What may change is E = a E_0 + b, with a gain a and a radiance b, neither negative, in each cell of the map:
a = 1, b = 0 is the original. Cells and not texels, because T is recorded: a column of a single texel consists
of few samples, and a sum of thousands of such columns follows almost any picture in their noise, which no
rendering would show (docs/decisions/cells_of_feasibility.md). Finer are only texels that T knows better:
those seen directly or in a mirror, and those that have exact columns.

Solved by accelerated projected gradient (Beck and Teboulle 2009) with restart (O'Donoghue and Candes 2015),
in the diagonal metric of De Pierro (1995): for y > 0, A'WA is at most diag(A'WA y / y), as A is not negative.
A light as small as a sun casts sharper shadows than a cell: an edit's own map, where one is known, is
compared as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from envedit.core.arrays import tensor
from envedit.core.color import tonemap
from envedit.core.rows import Rows
from envedit.core.seeds import SIGNS
from envedit.images import map_regions
from envedit.solve.gain_bandwidth import PROBES
from envedit.solve.likelihood import STATEMENTS, Likelihood
from envedit.transport.block_transport import sky_cells
from envedit.transport.light_transport import LightTransport

SHARP_SAMPLES = 4.0
"""Samples behind an entry of T from which on the texels of a cell are distinguished."""
LINEARISATIONS, STEPS = 8, 10
"""How often the display curve is linearised, and steps of the solution each time. Measured:
docs/decisions/cells_of_feasibility.md."""
METRIC_FLOOR = 0.1
"""Share of the mean that the metric takes every cell to have at least: what is dark can grow."""
LEAST_SLOPE_SPAN = 1e-3
"""Least difference of radiance over which the display curve's slope is taken: finite at black."""
WARNED_SHARE = 0.5
"""Below this share :attr:`Reach.warning` warns."""


@dataclass(frozen=True)
class Reach:
    """What is within reach."""

    # 1 - mean |closest - target| / mean |initial - target| over the painted pixels, by coverage, on display
    # values clip(x, 0, 1)^(1/2.2); from 0 to 1, and 1 if nothing is asked
    share: float
    picture: np.ndarray  # (h, w, 3) float32, the closest picture, linear radiance
    # (h, w, 3) float32, display values of the target less those of the closest picture: positive where no
    # light is bright enough without brightening what must stay, negative where none is dark enough
    residual: np.ndarray
    # (H, W, 3) float32, a map that renders to the picture; it does not look like a sky
    envmap: np.ndarray
    too_dark: float = 0.0  # share of the residual in the painted region that is positive
    all_painted: bool = False  # no pixel is held

    @property
    def note(self) -> str:
        """One sentence for the report."""
        return f"{_percent(self.share)} % of the painted change is feasible under some map"

    @property
    def warning(self) -> str | None:
        """One sentence if less than half is within reach, else None."""
        if self.share >= WARNED_SHARE:
            return None
        left = "brighter" if self.too_dark >= WARNED_SHARE else "darker"
        without = "" if self.all_painted else f" without making other pixels {left}"
        return (
            f"only {_percent(self.share)} % of the painted change is feasible under any map: "
            f"most of the rest cannot become {left}{without}; see unreachable.png"
        )


def _percent(share):
    return int(100 * share)  # cut, not rounded: 49.6 % is less than half


def reachable(
    transport: LightTransport,
    original: np.ndarray,
    target: np.ndarray,
    likelihood: Likelihood,
    rows: Rows,
    painted: np.ndarray,
    rendered: np.ndarray | None = None,
    known: np.ndarray | None = None,
    kept: np.ndarray | None = None,
    after_step: Callable[[], None] = lambda: None,
) -> Reach:
    """Find the closest picture that any non-negative map makes.

    Parameters
    ----------
    transport : LightTransport
        T.
    original : ndarray (H, W, 3)
        The map, linear radiance.
    target : ndarray (h, w, 3)
        The target, linear radiance.
    likelihood : Likelihood
        How much each pixel counts, and the mean of what was not painted.
    rows : Rows
        Active rows; the light of the others stays.
    painted : ndarray (h, w)
        Coverage of the region that the request is about, 0 to 1.
    rendered : ndarray (h, w, 3), optional
        The rendering that was painted on. Its difference from T E is noise, and is no part of the request.
    known : ndarray (H, W, 3), optional
        A map that answers the request already, such as an edit's: the closest picture is no farther than its.
    kept : ndarray (H, W), optional
        How far texels stay as they are; the light of those that mostly do stays.
    after_step : callable, optional
        Called now and then; what it raises ends the search.

    Returns
    -------
    Reach

    Notes
    -----
    A target that was rendered has noise of its own, which is out of reach: under a map that is known to make
    the picture, 15 to 20 % of a request of 0.07 in display values are such noise at 128x128 pixels.
    """
    # ---- The request
    original = np.ascontiguousarray(original, np.float32)
    active = np.zeros(original.shape[:2], bool)
    active[rows.slice] = True
    if kept is not None:
        active &= kept < map_regions.KEPT_SHARE
    transport = transport.resolved(original)
    initial = _rendering(transport, original)
    aim = target.astype(np.float64)
    if rendered is not None:
        aim = aim + initial - rendered
    request = _Request(initial, np.maximum(aim, 0), likelihood, painted.astype(np.float64))
    distance = request.distance(initial)
    if distance < 1e-6:  # float32
        distance = 0.0

    # ---- The closest of the original's picture, the solution's, and that of the map that is known
    candidates = [(original, initial)]
    if distance > 0 and (transport.influence[active] > 0).any():
        candidates.append(_solution(transport, original, active, request, after_step))
    if distance > 0 and known is not None:
        transport = transport.resolved(known)
        candidates.append((known, _rendering(transport, known)))
    envmap, picture = min(candidates, key=lambda one: request.distance(one[1]))

    # ---- What is left
    residual = tonemap(request.target) - tonemap(picture)
    left = np.abs(residual) * request.painted[..., None]
    return Reach(
        share=float(np.clip(1 - request.distance(picture) / distance, 0, 1)) if distance > 0 else 1.0,
        picture=picture.astype(np.float32),
        residual=residual.astype(np.float32),
        envmap=envmap.astype(np.float32),
        too_dark=float(left[residual > 0].sum() / max(left.sum(), 1e-30)),
        all_painted=bool((request.painted > 0).all()),
    )


@dataclass(frozen=True)
class _Request:
    """Pictures (h, w, 3) before the edit and as wanted, and what is painted (h, w)."""

    initial: np.ndarray
    target: np.ndarray
    likelihood: Likelihood
    painted: np.ndarray

    def distance(self, picture):
        """Mean absolute difference of display values in the painted region."""
        apart = np.abs(tonemap(picture) - tonemap(self.target)).mean(axis=2)
        return float((apart * self.painted).sum() / self.painted.sum())

    def weights(self, picture):
        """Pixel weights (h, w, 3) under which squared differences of radiance are those of display values."""
        return self.likelihood.weight * self.slope(picture) ** 2

    def slope(self, picture):
        """Slope (h, w, 3) of the display curve between a picture and the target."""
        low = np.clip(np.minimum(picture, self.target), 0, 1)
        # What is above 1 is shown as 1: the slope falls with the distance.
        high = np.maximum(np.maximum(np.minimum(self.target, 1), picture), low + LEAST_SLOPE_SPAN)
        rise = tonemap(high) - tonemap(low)
        slope, flat = rise / (high - low), (low >= 1) | (rise <= 0)
        return np.where(flat, 1 / 2.2, slope)

    def mean_of_rest(self, picture):
        """Weights (h, w, 3) of radiance in the mean of what was not painted, in units of a pixel's error.

        The likelihood's last part over its first: of a mean beyond what is visible, the absolute value.
        """
        mean = self.likelihood.mean(tonemap(picture) - tonemap(self.target))
        beyond = max(1.0, float(np.sqrt(np.square(mean).mean())))
        sigma = self.likelihood.paint_noise or 0.0
        scale = sigma * np.sqrt(STATEMENTS * self.likelihood.area / beyond)
        return scale * self.likelihood.share * self.slope(picture)


def _rendering(transport, envmap):
    return transport.apply(tensor(envmap)).numpy().astype(np.float64)


def _cells(transport, shape):
    """Group the texels that change together, (H, W): cells, and single texels where T is sharp.

    An entry w stands for about w times as many samples as a pixel has. Its mean over a cell's light is
    sum w^2 / sum w, and sum w^2 is the mean of (T's)^2 over pictures s of random signs (Hutchinson 1990).
    """
    flat, _ = sky_cells(shape[0], shape[1])
    square, rng = np.zeros(shape), np.random.default_rng(SIGNS)
    for _ in range(PROBES):
        signs = rng.choice(np.array([-1, 1], np.float32), size=(*transport.shape, 3))
        square += (transport.adjoint(tensor(signs)).numpy().astype(np.float64) ** 2).mean(axis=2)
    total = np.bincount(flat, transport.influence.ravel().astype(np.float64))
    samples = transport.spp * np.bincount(flat, square.ravel() / PROBES) / np.maximum(total, 1e-30)
    single = (samples > SHARP_SAMPLES)[flat]
    single[transport.columns] = True
    groups = np.where(single, flat.max() + 1 + np.arange(len(flat)), flat)
    return np.unique(groups, return_inverse=True)[1].reshape(shape)


def _solution(transport, original, active, request, after_step):
    """Solve the convex problem, anew where its solution leads; returns the map and its rendering."""
    groups = _cells(transport, original.shape[:2])
    size = np.bincount(groups.ravel())[:, None]
    active, texels = active[..., None], original.astype(np.float64)
    fixed = _rendering(transport, np.where(active, 0, original))
    white = request.target >= 1  # any value above will do
    aim = np.minimum(request.target, 1) - fixed

    def radiance(x):
        return x[0][groups] * texels + x[1][groups]

    def render(x):
        """Return the picture of the light that may change, under x = (a, b), (2, groups, 3)."""
        return transport.linear(tensor(np.where(active, radiance(x), 0))).numpy().astype(np.float64)

    def adjoint(picture):
        light = transport.adjoint(tensor(picture)).numpy() * active
        return np.stack([_sums(light * texels, groups), _sums(light, groups)])

    # ---- Start: the original, darker where it is too bright by far and a display shows no difference
    ones, zeros = np.ones((len(size), 3)), np.zeros((len(size), 3))
    light, weight = request.initial - fixed, request.weights(request.target)
    along = np.maximum((weight * light * aim).sum(axis=(0, 1)), 0)
    gain = along / np.maximum((weight * light**2).sum(axis=(0, 1)), 1e-300)
    gain = np.where(gain > 0.5, 1, gain)
    x, light = np.stack([gain * ones, zeros]), gain * light
    one = render(np.stack([zeros, ones]))

    z, z_light, momentum = x, light, np.ones(3)
    for _ in range(LINEARISATIONS):
        weight, share = request.weights(fixed + light), request.mean_of_rest(fixed + light)

        def pulled(residual, weight=weight, share=share):
            """Return the adjoint of a weighted residual, and of its mean over the rest."""
            return adjoint(weight * residual + share * (share * residual).sum(axis=(0, 1)))

        # ---- Metric (De Pierro), for a sky of one radiance that is as bright as the picture or the target
        bright = (weight * np.maximum(light, aim)).sum(axis=(0, 1))
        mean = np.maximum(bright / np.maximum((weight * one).sum(axis=(0, 1)), 1e-30), 1e-12)
        # A single texel can grow by as much light as a cell.
        y = x + METRIC_FLOOR * np.stack([ones, mean * size.max() / size])
        metric = pulled(render(y)) / y
        used = metric > 1e-9 * metric.max(axis=1, keepdims=True)
        step = np.where(used, 1 / np.maximum(metric, 1e-300), 0)

        # ---- Accelerated projected gradient, each channel by itself; its momentum outlives a linearisation
        for _ in range(STEPS):
            residual = aim - z_light
            gradient = -pulled(np.where(white, np.maximum(residual, 0), residual))
            new = np.maximum(z - step * gradient, 0)
            new_light = render(new)
            uphill = (gradient * (new - x)).sum(axis=(0, 1)) > 0
            following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            ahead = np.where(uphill, 0, (momentum - 1) / following)
            momentum = np.where(uphill, 1, following)
            z, z_light = new + ahead * (new - x), new_light + ahead * (new_light - light)
            x, light = new, new_light
            after_step()
    envmap = np.where(active, radiance(x), original).astype(np.float32)
    return envmap, _rendering(transport, envmap)


def _sums(values, groups):
    """Sum a map over its groups: (groups, 3)."""
    return np.stack([np.bincount(groups.ravel(), v) for v in values.reshape(-1, 3).T], axis=1)
