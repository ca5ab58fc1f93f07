"""How much of a request any light can do: the closest picture that a non-negative map makes.

A rendering is linear in the map, so the closest picture is the solution of a convex problem through T, found
before minutes are spent on an edit. With I = T E + I_0, target t and weights w,

    min over E >= 0  1/2 sum_p w_p s_p^2 (I_p - t_p)^2

where s_p is the slope of the display curve between the pixel's present value and the target, so that the
sum is one of display values. A pixel whose target is white has no residual at any value above.

What may change is E = a E_0 + b, with a gain a and a radiance b, neither negative, in each cell of the map:
a = 1, b = 0 is the original. Cells and not texels, because T is recorded: a column of a single texel
consists of few samples, and a sum of thousands of such columns follows almost any picture in their noise,
which no rendering would show. Of a shadow painted on the plane (matte, analytic sky, 128x128 pixels) 88 %
were within reach texel by texel, and 29 % were left in a rendering of that map; with cells of 5.6 degrees 54
and 49 %, where the rendering's own noise is 10 %. Finer are only texels that T knows better: those seen
directly or in a mirror, and those around a concentrated light, for which exact columns are traced.

Solved by accelerated projected gradient (Beck and Teboulle 2009) with restart (O'Donoghue and Candes 2015),
in the diagonal metric of De Pierro (1995): for y > 0, A'WA is at most diag(A'WA y / y), as A is not negative.
A dual point, the residual made feasible, bounds how far from the least the solution is.

Longer than 400 lines: the model in cells, its solver and its refinement are one algorithm, used nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import tonemap
from envedit.core.errors import InputError, place_of
from envedit.core.rows import Rows
from envedit.core.seeds import SIGNS
from envedit.solve import point_light
from envedit.transport.block_transport import CELLS, tiles
from envedit.transport.light_transport import LightTransport

SHARP = 4.0
"""Samples behind an entry of T from which on the texels of a cell are distinguished."""
PROBES = 8
"""Random pictures by which these samples are counted."""
STEPS, LOOK = 40, 10
"""Most steps of each of the two solutions, and steps between checks of the progress."""
ENOUGH = 0.005
"""A solution ends when its bound, or its progress between two checks, is below this share of the request."""
FLOOR = 0.1
"""Share of the mean that the metric takes every cell to have at least: what is dark can grow."""
LIGHT, SPAN = 0.02, 1
"""Share of the picture's light from which on a place is a light; texels to either side that become exact."""
FAR = 2.0
"""Factor of exposure from which on a solution does not start at the original."""
TOE = 1e-3
"""Least difference of radiance over which the display curve's slope is taken: finite at black."""
HALF = 0.5
"""Below this share :attr:`Reach.warning` warns."""
SMOOTH = 2
"""Order of the products of coordinates that the sky around a light may take on."""
FULL = 0.25
"""Difference of display values that :func:`unreachable` shows in full colour."""


@dataclass(frozen=True)
class Reach:
    """What is within reach.

    Attributes
    ----------
    share : float
        1 - mean |closest - target| / mean |initial - target| over the painted pixels, by coverage, on
        display values clip(x, 0, 1)^(1/2.2); from 0 to 1, and 1 if nothing is asked.
    picture : ndarray (h, w, 3) float32
        The closest picture, linear radiance.
    residual : ndarray (h, w, 3) float32
        Display values of the target less those of the closest picture: positive where no light is bright
        enough without brightening what must stay, negative where none is dark enough.
    envmap : ndarray (H, W, 3) float32
        A map that renders to the picture; it answers this question only and does not look like a sky.
    bound : float
        How much the weighted squared difference could still fall in the last solution, at most, as a share
        of the initial one. Loose where few texels see a pixel: up to 0.7 where 300 steps instead of 80 gain
        0.03 in ``share``.
    steps : int
        Steps of the two solutions, each a product with T and one with its adjoint.
    too_dark : float
        Share of the residual in the painted region that is positive.
    all_painted : bool
        No pixel is held.
    """

    share: float
    picture: np.ndarray
    residual: np.ndarray
    envmap: np.ndarray
    bound: float = 0.0
    steps: int = 0
    too_dark: float = 0.0
    all_painted: bool = False

    @property
    def note(self) -> str:
        """One sentence for the report."""
        return f"{_percent(self.share)} % of the painted change is feasible under some map"

    @property
    def warning(self) -> str | None:
        """One sentence if less than half is within reach, else None."""
        if self.share >= HALF:
            return None
        left = "brighter" if self.too_dark >= HALF else "darker"
        without = "" if self.all_painted else f" without making pixels {left} that are held"
        return (
            f"only {_percent(self.share)} % of the painted change is feasible under any map: "
            f"most of the rest cannot become {left}{without}; see unreachable.png"
        )


def _percent(share):
    return int(100 * share)  # cut, not rounded: 49.6 % is less than half


def unreachable(reach: Reach) -> np.ndarray:
    """Show the infeasible rest as display values (h, w, 3) in [0, 1].

    White: feasible. Red: stays darker than painted. Blue: stays brighter. Full colour is a difference of
    :data:`FULL` in display values, whatever the request, so that pictures can be compared. Shown is the
    channel that differs most.
    """
    most = np.abs(reach.residual).argmax(axis=2)
    signed = np.take_along_axis(reach.residual, most[..., None], axis=2)[..., 0] / FULL
    red, blue = np.clip(signed, 0, 1), np.clip(-signed, 0, 1)
    return np.stack([1 - blue, 1 - np.maximum(red, blue), 1 - red], axis=2).astype(np.float32)


def reachable(
    transport: LightTransport,
    original: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray | None = None,
    rows: Rows | None = None,
    free: np.ndarray | None = None,
    painted: np.ndarray | None = None,
    rendered: np.ndarray | None = None,
    known: np.ndarray | None = None,
) -> Reach:
    """Find the closest picture that any non-negative map makes.

    Parameters
    ----------
    transport : LightTransport
        T; gets exact columns for the bright texels of the original, and around a light that the target needs.
    original : ndarray (H, W, 3)
        The map, linear radiance.
    target : ndarray (h, w, 3)
        The target, linear radiance.
    weight : ndarray (h, w, 1), optional
        How much each pixel counts; all the same by default.
    rows : Rows, optional
        Active rows; the light of the others stays. All by default.
    free : ndarray of bool (rows, W), optional
        Texels of the active rows that may change; all by default.
    painted : ndarray (h, w), optional
        Coverage of the region that the request is about, 0 to 1; where None, all pixels that count.
    rendered : ndarray (h, w, 3), optional
        The rendering that was painted on. Its difference from T E is noise, and is no part of the request.
    known : ndarray (H, W, 3), optional
        A map that answers the request already, such as an edit's: the closest picture is no farther than its.

    Returns
    -------
    Reach

    Raises
    ------
    InputError
        A pixel of the target is not finite.
    ValueError
        Shapes do not match, or nothing is painted or counts.

    Notes
    -----
    A target that was rendered has noise of its own, which is out of reach: under a map that is known to make
    the picture, 15 to 20 % of a request of 0.07 in display values are such noise at 128x128 pixels.
    """
    # ---- Search: in cells, then with single texels around the most concentrated light
    question = _Question(transport, original, target, weight, rows, free, painted, rendered)
    initial, asked = question.initial, question.asked
    best, bound, steps = (asked, question.original, initial), 0.0, 0
    if asked > 0 and question.any_light():
        groups = _cells(transport, question.original.shape[:2])
        model = _Model(question, groups)
        x, picture = _exposed(question, model)
        for last in (False, True):
            x, taken, bound = _solve(model, x, picture)
            steps += taken
            found = model.map(x)
            picture = question.apply(found)
            distance = question.distance(picture)
            if distance < best[0]:
                best = distance, found, picture
            if not last:
                model, x = _around_light(question, model, x, found)
                picture = question.apply(model.map(x))
    if known is not None and asked > 0:
        transport.resolve(known)
        picture = question.apply(known)
        best = min(best, (question.distance(picture), known, picture), key=lambda one: one[0])
    # ---- What is left
    distance, envmap, picture = best
    residual = tonemap(question.target) - tonemap(picture)
    left = np.abs(residual) * question.painted[..., None]
    too_dark = float(left[residual > 0].sum() / max(left.sum(), 1e-30))
    share = float(np.clip(1 - distance / asked, 0, 1)) if asked > 0 else 1.0
    shown, left_over, lit = (np.asarray(a, np.float32) for a in (picture, residual, envmap))
    all_painted = bool((question.painted > 0).all())
    return Reach(share, shown, left_over, lit, bound, steps, too_dark, all_painted)


class _Question:
    """What is asked, checked, and what may change."""

    def __init__(self, transport, original, target, weight, rows, free, painted, rendered):
        self.transport = transport
        self.original = np.ascontiguousarray(original, np.float32)
        height, width, _ = self.original.shape
        self.active = np.zeros((height, width), bool)
        self.active[slice(None) if rows is None else rows.slice] = True if free is None else free
        shape = transport.shape
        self.target = _shaped("target", target, (*shape, 3))
        if (bad := ~np.isfinite(self.target)).any():
            raise InputError(f"target: pixel at {place_of(bad)} is not finite: repair it before painting")
        self.weight = np.ones((*shape, 1)) if weight is None else _shaped("weight", weight, (*shape, 1))
        counts = (self.weight[..., 0] > 0).astype(np.float64)
        self.painted = counts if painted is None else _shaped("painted", painted, shape)
        if not (self.painted.sum() > 0 and self.weight.sum() > 0):
            raise ValueError("reachable: no pixel is painted or counts")
        transport.resolve(self.original)
        self.initial = self.apply(self.original)
        if rendered is not None:
            self.target = self.target + self.initial - _shaped("rendered", rendered, (*shape, 3))
        self.target = np.maximum(self.target, 0)
        self.asked = self.distance(self.initial)
        if self.asked < 1e-6:  # float32
            self.asked = 0.0

    def apply(self, envmap):
        return self.transport.apply(tensor(envmap)).numpy().astype(np.float64)

    def distance(self, picture):
        """Mean absolute difference of display values in the painted region."""
        apart = np.abs(tonemap(picture) - tonemap(self.target)).mean(axis=2)
        return float((apart * self.painted).sum() / self.painted.sum())

    def any_light(self):
        return bool((self.transport.influence[self.active] > 0).any())

    def weights(self, picture):
        """Pixel weights (h, w, 3) under which squared differences of radiance are those of display values."""
        low = np.clip(np.minimum(picture, self.target), 0, 1)
        # What is above 1 is shown as 1: the slope falls with the distance.
        high = np.maximum(np.maximum(np.minimum(self.target, 1), picture), low + TOE)
        rise = tonemap(high) - tonemap(low)
        slope, flat = rise / (high - low), (low >= 1) | (rise <= 0)
        return self.weight * np.where(flat, 1 / 2.2, slope) ** 2


def _shaped(name, values, shape):
    values = np.asarray(values, np.float64)
    if values.shape != shape:
        raise ValueError(f"reachable: {name} must have shape {shape}, got {values.shape}")
    return values


def _cells(transport, shape):
    """Group the texels that change together, (H, W): cells, and single texels where T is sharp.

    An entry w stands for about w times as many samples as a pixel has. Its mean over a cell's light is
    sum w^2 / sum w, and sum w^2 is the mean of (T's)^2 over pictures s of random signs (Hutchinson 1990).
    """
    height, width = shape
    flat, _ = tiles(height, width, _size(width))
    cell, rng = flat.reshape(shape), np.random.default_rng(SIGNS)
    square = np.zeros((height, width))
    for _ in range(PROBES):
        signs = rng.choice(np.array([-1, 1], np.float32), size=(*transport.shape, 3))
        square += (transport.adjoint(tensor(signs)).numpy().astype(np.float64) ** 2).mean(axis=2)
    total = np.bincount(flat, transport.influence.ravel().astype(np.float64))
    samples = transport.spp * np.bincount(flat, square.ravel() / PROBES) / np.maximum(total, 1e-30)
    single = (samples > SHARP)[cell]
    single.ravel()[transport.columns] = True
    return _split(cell, single)


def _split(groups, single):
    """Give every texel where ``single`` a group of its own."""
    groups = groups.copy()
    groups[single] = groups.max() + 1 + np.arange(single.sum())
    return np.unique(groups, return_inverse=True)[1].reshape(groups.shape)


class _Model:
    """E = a E_0 + b in each group of texels; variables x = (a, b), (2, groups, 3)."""

    def __init__(self, question, groups):
        self.question, self.groups, self.count = question, groups, int(groups.max()) + 1
        self.transport, self.active = question.transport, question.active[..., None]
        self.original = question.original.astype(np.float64)
        self.base = question.apply(np.where(self.active, 0, question.original))

    def start(self):
        return np.stack([np.ones((self.count, 3)), np.zeros((self.count, 3))])

    def radiance(self, x):
        return x[0][self.groups] * self.original + x[1][self.groups]

    def map(self, x):
        return np.where(self.active, self.radiance(x), self.original).astype(np.float32)

    def render(self, x):
        """Picture (h, w, 3) of the light that may change."""
        return self.render_map(self.radiance(x))

    def render_map(self, radiance):
        picture = self.transport.linear(tensor(np.where(self.active, radiance, 0)))
        return picture.numpy().astype(np.float64)

    def adjoint(self, picture):
        light = self.transport.adjoint(tensor(picture)).numpy() * self.active
        return np.stack([self.sums(light * self.original), self.sums(light)])

    def sums(self, values):
        flat = self.groups.ravel()
        return np.stack([np.bincount(flat, v, self.count) for v in values.reshape(-1, 3).T], axis=1)


def _exposed(question, model):
    """Start from the original, made darker where it is brighter than the target by :data:`FAR` and more.

    Where a map is too bright by orders, a step that takes away nearly all of the difference in radiance takes
    away nothing of what a display shows.
    """
    light, x = question.initial - model.base, model.start()
    weight = question.weights(question.target)
    along = (weight * light * (np.minimum(question.target, 1) - model.base)).sum(axis=(0, 1))
    gain = np.maximum(along, 0) / np.maximum((weight * light**2).sum(axis=(0, 1)), 1e-300)
    gain = np.where(gain > 1 / FAR, 1, gain)
    x[0] *= gain
    return x, model.base + gain * light


def _solve(model, x, picture):
    """Solve the convex problem from ``x``, whose rendering is ``picture``; per channel.

    Returns
    -------
    x : ndarray (2, groups, 3)
    steps : int
    bound : float
        Primal less dual value, as a share of the primal value of the original.
    """
    # ---- The problem, linearised at the picture
    question = model.question
    weight = question.weights(picture)
    white = question.target >= 1  # any value above will do
    aim = np.minimum(question.target, 1) - model.base

    def rest(light):
        r = aim - light
        return np.where(white, np.maximum(r, 0), r)

    # ---- Metric (De Pierro)
    one = model.render(np.stack([np.zeros((model.count, 3)), np.ones((model.count, 3))]))
    light = picture - model.base
    # A sky of one radiance that is as bright as the picture or the target.
    bright = (weight * np.maximum(light, aim)).sum(axis=(0, 1))
    mean = np.maximum(bright / np.maximum((weight * one).sum(axis=(0, 1)), 1e-30), 1e-12)
    # A single texel can grow by as much light as a cell.
    size = np.bincount(model.groups.ravel(), minlength=model.count)[:, None]
    y = x + FLOOR * np.stack([np.ones((model.count, 3)), mean * size.max() / size])
    metric = model.adjoint(weight * model.render(y)) / y
    seen = metric > 1e-9 * metric.max(axis=1, keepdims=True)
    step = np.where(seen, 1 / np.maximum(metric, 1e-300), 0)

    # ---- Accelerated projected gradient
    slack = np.where(white, 0, 1.0)  # pulled back, it is positive: it makes a dual point feasible
    pulled = model.adjoint(weight * slack)
    start = 0.5 * (weight * rest(question.initial - model.base) ** 2).sum()
    z, z_light, momentum = x, light, np.ones(3)
    value, bound, taken = np.inf, 1.0, 0
    while taken < STEPS:
        gradient = -model.adjoint(weight * rest(z_light))
        new = np.maximum(z - step * gradient, 0)
        new_light = model.render(new)
        uphill = (gradient * (new - x)).sum(axis=(0, 1)) > 0
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = np.where(uphill, 0, (momentum - 1) / following)
        momentum = np.where(uphill, 1, following)
        z, z_light = new + ahead * (new - x), new_light + ahead * (new_light - light)
        x, light, taken = new, new_light, taken + 1
        if taken % LOOK and taken < STEPS:
            continue
        # ---- Bound, by a dual point
        r = rest(light)
        before, value = value, 0.5 * (weight * r * r).sum()
        slope = np.where(seen, model.adjoint(weight * r) / np.maximum(pulled, 1e-300), 0)
        with np.errstate(over="ignore", invalid="ignore"):  # no dual point where all is to be white
            dual = r - np.maximum(slope.max(axis=(0, 1)), 0) * slack
            along, power = (weight * dual * aim).sum(axis=(0, 1)), (weight * dual * dual).sum(axis=(0, 1))
            least = np.nan_to_num(0.5 * np.maximum(along, 0) ** 2 / np.maximum(power, 1e-300), posinf=0).sum()
        bound = float(np.clip((value - least) / max(start, 1e-300), 0, 1))
        if bound < ENOUGH or before - value < ENOUGH * start / 4:
            break
    return x, taken, bound


def _around_light(question, model, x, found):
    """Give the most concentrated light a place of its own: exact columns, and single texels around it.

    A light as wide as a cell casts soft shadows; and where few samples carry much light, T is noisy: with the
    sun spread over its cell, a target was estimated to be infeasible that a rendering showed to be 92 %
    reached.
    """
    # ---- Where light was added, most of it beyond the surroundings
    transport, active = question.transport, question.active
    height, width = active.shape
    influence = transport.influence * active
    total = (found.mean(axis=2, dtype=np.float64) * influence).sum()
    more = np.maximum(found.astype(np.float64) - question.original, 0)
    more.reshape(-1, 3)[transport.bright_texels(question.original)] = 0  # exact, and may grow as they are
    light = more.mean(axis=2) * influence
    size = _size(width)
    beyond = _around(light, 2 * size) - _around(light, 4 * size) / 4  # the surroundings taken off
    row, column = (int(i) for i in np.unravel_index(np.argmax(beyond), beyond.shape))
    room = transport.capacity - len(transport.columns)
    if not beyond[row, column] > LIGHT * total or room < 2 * point_light.PROBES:
        return model, x
    # ---- Its place, by exact columns
    directions, omega = latlong.directions(height, width), latlong.lookup_solid_angles(height, width)
    near = _window(row, column, 2 * size, height, width)
    excess = np.maximum(light[near] - np.median(light[near]), 0)
    towards = (directions[near] * excess[..., None]).sum(axis=(0, 1))
    if not np.linalg.norm(towards) > 0:
        return model, x
    towards /= np.linalg.norm(towards)
    sky = [model.render_map(np.repeat(g[..., None], 3, 2)) for g in _smooth(directions)]
    mixed = np.stack([*sky, question.initial - model.base]).reshape(len(sky) + 1, -1, 3)
    aim, known = np.minimum(question.target, 1), question.target.reshape(-1, 3)
    first, last = np.flatnonzero(active.any(axis=1))[[0, -1]]
    place, flux = point_light.refine(
        transport, (aim - model.base).reshape(-1, 3), known, question.weight.reshape(-1, 1), mixed,
        towards, np.ones(3), int(first), int(last),
    )  # fmt: skip
    # ---- Single texels there
    row, column = (round(float(v)) for v in latlong.texel_position(place, height, width))
    single = np.zeros_like(active)
    single[_window(row, column, SPAN, height, width)] = True
    single &= active
    transport.probe(np.flatnonzero(single))
    finer = _Model(question, _split(model.groups, single))
    values = np.zeros((2, finer.count, 3))
    values[:, finer.groups] = x[:, model.groups]
    # The light of the cells around moves there.
    cells = finer.groups[near]
    values[1, cells.ravel()] = np.minimum(values[1, cells.ravel()], np.median(values[1, cells], axis=(0, 1)))
    row = min(max(row, 0), height - 1)
    if single[row, column % width]:
        values[1, finer.groups[row, column % width]] += flux / omega[row]
    return finer, values


def _smooth(directions):
    """Products of the direction's coordinates up to second order, not negative: (n, H, W)."""
    height, width, _ = directions.shape
    products = point_light.products(directions.reshape(-1, 3), SMOOTH).T
    return (products - products.min(axis=1, keepdims=True) + 1e-3).reshape(-1, height, width)


def _size(width):
    """Texels along a cell."""
    return max(1, -(-width // CELLS))


def _window(row, column, radius, height, width):
    """Index of the texels around one."""
    rows = np.arange(max(row - radius, 0), min(row + radius + 1, height))
    return rows[:, None], np.arange(column - radius, column + radius + 1) % width


def _around(values, radius):
    """Sum over a square of texels around each, periodic in the columns."""
    height, width = values.shape
    padded = np.pad(np.pad(values, ((radius, radius), (0, 0))), ((0, 0), (radius, radius)), mode="wrap")
    total = np.pad(padded, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    n = 2 * radius + 1
    return total[n:, n:] - total[:-n, n:] - total[n:, :-n] + total[:-n, :-n]
