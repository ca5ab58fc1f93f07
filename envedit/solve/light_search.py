"""Initialise an edit: where lights are and how bright the sky is, estimated from the target.

Three steps, from far to near, all through T and none from where a light was:

1. a matching pursuit over the whole sphere (``matching_pursuit.py``);
2. for every light that moves, exact columns of T around its cell: the same, to a fraction of a texel;
3. multiplicative updates (Richardson 1972, Lucy 1974) of the lights' flux and of the gain of the sky, from a
   coarse grid to a fine one.

The result is close to the solution. With Gauss-Newton steps only 1 and 2 run (``only_own``).

Longer than 400 lines: the three steps share one :class:`Question`, and are read in their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE
from envedit.core.rotations import rotation_vector
from envedit.core.types import Params
from envedit.representations.layers.gain import LEVELS, VEIL
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK, SPARE, Lights
from envedit.representations.layers.separation import glow_at
from envedit.solve.matching_pursuit import GAIN_ORDER, Given, Place, place, products, relative
from envedit.transport.block_transport import Overview
from envedit.transport.light_transport import LightTransport

KEPT_FLUX = 3.0
"""A light that moves starts with its own flux unless the estimate is this many times more or less."""
LEAST, MOST = 0.05, 20.0
"""Bounds of every factor that a start may have."""
UPDATES = 30
"""Multiplicative updates of :func:`spread`."""
SPACINGS = (2, 1)
"""Distances of the probes of :func:`refine`, texels: first five by five of them, then three by three."""
PROBES = 25
"""Exact columns that are looked at together."""


@dataclass(frozen=True, eq=False)
class SearchProblem:
    """What a search for lights is given.

    Attributes
    ----------
    layers : Layers
        Lights and background of the map's active rows.
    transport : LightTransport
        T; gets exact columns for the texels that are looked at.
    picture : ndarray (h, w, 3)
        The target, linear radiance.
    weight : ndarray (h, w, 1) or None
        How much each pixel counts.
    envmap : ndarray (H, W, 3)
        The whole original map.
    """

    layers: Layers
    transport: LightTransport
    picture: np.ndarray
    weight: np.ndarray | None
    envmap: np.ndarray


def start(problem: SearchProblem, params: dict, only_own: bool = False) -> tuple[dict, list[str]]:
    """Find where the optimisation of layers starts.

    Parameters
    ----------
    problem : SearchProblem
        Map, target and what renders.
    params : dict
        Of the layers, as ``encode`` returned them.
    only_own : bool
        Place the map's own lights only: gain and further lights are found by Gauss-Newton steps.

    Returns
    -------
    params : dict
        Of the start.
    notes : list of str
        What was found.
    """
    layers, transport, picture, weight = problem.layers, problem.transport, problem.picture, problem.weight
    scene = Question(problem)
    overview, lights = transport.overview(), layers.separation.lights
    spare = 0 if only_own else SPARE
    places = place(scene.given(), scene.target, lights, spare, layers.lights.flux[-1])
    notes, pictures = [], []
    factor = np.ones((len(overview.omega), 3))
    for i, (light, found) in enumerate(zip(lights, places, strict=False)):
        name = f"light {i + 1} of {len(lights)} ({100 * light.share:.3g} % of the map's light)"
        if not found.flux.max() > 0:
            notes.append(f"{name}: removed, its estimated flux is zero")
            continue
        direction, flux = light.direction, 1.0
        if found.direction is not None and transport.capacity < PROBES:
            direction = found.direction
            notes.append(f"{name}: placed to a few degrees; renderer.memory_gb is too small to refine it")
        elif found.direction is not None:
            others = list(scene.cores(places, i)) if len(lights) > 1 else []
            direction, flux = scene.refine(found.direction, layers.lights.flux[i], light.glow, others)
            angle = np.degrees(np.arccos(np.clip(direction @ light.direction, -1, 1)))
            notes.append(f"{name}: the steps start with it {angle:.1f} degrees from its place in the map")
        else:
            notes.append(f"{name}: the steps start with it at its place in the map")
        places[i] = Place(direction if found.direction is not None else None, np.full(3, flux))
        if only_own:
            continue
        pictures.append((i, scene.light(i, places[i])))
        if light.glow is not None:
            factor *= 1 + glow_at(light.glow, scene.cells @ direction)
    for i in range(len(lights), len(places)):
        if places[i].flux.max() > 0:
            notes.append("added a light, in a direction in which the map has none")
            pictures.append((i, scene.light(i, places[i])))

    state = dict(params)
    if only_own:
        return state | scene.placed(places), notes

    # Flux and gain, from the coarse grid to the finest.
    stack = np.zeros((3, len(overview.matrix[0]), 0))
    if pictures:
        stack = np.stack([overview.to_blocks(p).T for _, p in pictures], axis=2)
    total = np.ones((len(pictures), 3))
    for level in range(LEVELS):
        if np.prod(layers.gain.sizes[level]) > len(overview.omega):
            break  # finer than the overview resolves
        hats = scene.hats(level) * factor.T[..., None]
        gain, strength = spread(overview, scene.target, weight, picture, hats, stack)
        gain = np.clip(gain, LEAST, MOST)
        name = f"gain.{level}"
        logs = np.log(gain).reshape(*layers.gain.sizes[level], 3) / layers.scales[name]
        state[name] = tensor(logs)
        factor = factor * scene.in_cells(level, gain)
        strength = np.clip(strength, LEAST, MOST)
        total, stack = total * strength, stack * strength.T[:, None, :]
    for (i, _), s in zip(pictures, total, strict=True):
        places[i] = Place(places[i].direction, places[i].flux * s)
    return state | scene.placed(places), notes


class Question:
    """What is asked: the picture less all that is fixed, and what may make it."""

    def __init__(self, problem: SearchProblem):
        layers, transport, envmap = problem.layers, problem.transport, problem.envmap
        self.layers, self.transport, self.weight = layers, transport, problem.weight
        first, _ = layers.rows
        height, width = layers.shape
        rows = slice(first, first + height)
        # Ground that is kept stays as it is; a mirror goes by the sky.
        explained = layers.active if layers.mirrored else rows
        rest = envmap.copy()
        rest[explained] = 0
        self.known = problem.picture
        self.target = problem.picture - transport.apply(tensor(rest)).numpy()
        self.active: np.ndarray = np.zeros(envmap.shape[:2], bool)
        self.active[rows] = True
        self.active = self.active.ravel()
        self.start, self.rows = first * width, rows
        self.omega = np.repeat(latlong.lookup_solid_angles(*envmap.shape[:2]), width)
        background = np.zeros(envmap.shape)
        background[explained] = layers.background() if layers.mirrored else layers.separation.background
        self.background = background.reshape(-1, 3)
        self.gained: np.ndarray = np.zeros(envmap.shape[:2], bool)
        self.gained[explained] = True
        self.gained = self.gained.ravel()
        self.directions = self._seen(latlong.directions(*envmap.shape[:2]))
        self.cells = self._seen(transport.overview().directions)
        self.shape = envmap.shape
        self._gains: list[np.ndarray] | None = None

    def _seen(self, directions):
        """Directions by which gain and glow go: what mirrors the sky goes by what it mirrors."""
        return np.abs(directions, where=[False, self.layers.mirrored, False], out=directions.copy())

    def given(self) -> Given:
        """Return what a pursuit is given."""
        rest = self.background, self.omega, self.active, self.start, self.cells
        return Given(self.transport.overview(), self.weight, self.known, *rest)

    def render(self, values: np.ndarray) -> np.ndarray:
        """Picture (h, w, 3) of a map (H * W, 3) alone, without other lamps' light."""
        return self.transport.linear(tensor(values.reshape(self.shape))).numpy()

    def refine(
        self,
        direction: np.ndarray,
        flux: np.ndarray,
        glow: np.ndarray | None,
        others: Sequence[np.ndarray] = (),
    ) -> tuple[np.ndarray, float]:
        """Find the direction of a light, and its flux as a factor; ``others``' pictures may be mixed in."""
        if self._gains is None:
            gains = products(self.directions.reshape(-1, 3), GAIN_ORDER)
            maps = self.background * gains.T[..., None]
            seen = self.transport.linear(tensor(maps.reshape(-1, *self.shape)))
            self._gains = list(seen.numpy().reshape(len(maps), -1, 3))
        mixed = [*self._gains, *(other.reshape(-1, 3) for other in others)]
        if glow is not None:
            shine = glow_at(glow, self.directions @ direction).reshape(-1, 3)
            mixed.append(self.render(self.background * shine).reshape(-1, 3))
        weight = None if self.weight is None else self.weight.reshape(-1, 1)
        target, known = self.target.reshape(-1, 3), self.known.reshape(-1, 3)
        last = self.rows.stop - 1
        direction, factors = refine(
            self.transport, target, known, weight, np.stack(mixed), direction, flux, self.rows.start, last
        )
        factor = float(np.median(factors))
        kept = 1 / KEPT_FLUX < factor < KEPT_FLUX
        return direction, 1.0 if kept else float(np.clip(factor, LEAST, MOST))

    def parameters(self, places: Sequence[Place]) -> tuple[np.ndarray, np.ndarray]:
        """Rotation vectors and log fluxes of lights as they are placed."""
        return rotations(self.layers.lights, places)

    def placed(self, places: Sequence[Place]) -> Params:
        """Parameters of lights as they are placed."""
        turn, flux = self.parameters(places)
        scales = self.layers.scales
        return {"turn": tensor(turn / scales["turn"]), "flux": tensor(flux / scales["flux"])}

    def light(self, i: int, found: Place) -> np.ndarray:
        """Picture of one light as it is placed, through exact columns."""
        core = np.zeros(self.shape, np.float32)
        core[self.rows] = self._core(i, found)
        self.transport.resolve(core + self.background.reshape(self.shape))
        return self.render(core)

    def _core(self, i, found):
        """Radiance (rows, W, 3) of one light as it is placed."""
        dark = [Place(None, np.zeros(3))] * self.layers.lights.count
        dark[i] = found
        turn, flux = self.parameters(dark)
        size = tensor(np.zeros((len(turn), 1)))
        asked = tensor(turn), tensor(flux), size, self.layers.shape, self.layers.rows
        return self.layers.lights.core(*asked).numpy()

    def cores(self, places: Sequence[Place], without: int) -> np.ndarray:
        """Pictures (n, h, w, 3) of all lights but one as they are placed, without their glow."""
        cores = []
        for i, found in enumerate(places):
            if i != without and found.flux.max() > 0:
                cores.append(self._core(i, found))
        rows = slice(self.rows.start, self.rows.stop)
        return self.transport.pictures(np.stack(cores), rows) if cores else np.zeros((0, *self.known.shape))

    def hats(self, level: int) -> np.ndarray:
        """Radiance of what a gain adds, times each hat of a grid, in cells: (3, cells, nodes)."""
        overview = self.transport.overview()
        base = self.background[self.gained]
        base = (1 - VEIL) * base + VEIL * (base @ LUMINANCE)[:, None]
        rows, columns = self.layers.gain.sizes[level]
        cell, omega = self._cells()
        cells, nodes = len(overview.omega), rows * columns
        hats = np.zeros((3, cells * nodes))
        for node, share in self._hats(level):
            for c in range(3):
                hats[c] += np.bincount(cell * nodes + node, share * omega * base[:, c], cells * nodes)
        total = np.bincount(overview.cell_of, self.omega, cells)
        return hats.reshape(3, cells, nodes) / np.maximum(total, 1e-30)[None, :, None]

    def in_cells(self, level: int, gain: np.ndarray) -> np.ndarray:
        """Mean of a gain (nodes, 3) over each cell, by its logarithm: (cells, 3)."""
        cell, omega = self._cells()
        cells = len(self.transport.overview().omega)
        logs = np.zeros((cells, 3))
        for node, share in self._hats(level):
            for c in range(3):
                logs[:, c] += np.bincount(cell, share * omega * np.log(gain[node, c]), cells)
        return np.exp(logs / np.maximum(np.bincount(cell, omega, cells), 1e-30)[:, None])

    def _hats(self, level):
        layers = self.layers
        return layers.hats(level) if layers.mirrored else layers.gain.hats(level, layers.shape)

    def _cells(self):
        return self.transport.overview().cell_of[self.gained], self.omega[self.gained]


def rotations(lights: Lights, places: Sequence[Place]) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation vectors and log fluxes, (count, 3) each, of lights as they are placed."""
    turn, flux = np.zeros((lights.count, 3)), np.full((lights.count, 3), DARK)
    for i, found in enumerate(places):
        if found.direction is not None:
            turn[i] = rotation_vector(lights.centres[i], found.direction)
        flux[i] = np.log(np.maximum(found.flux, np.exp(DARK)))
    return turn, flux


def spread(
    overview: Overview,
    target: np.ndarray,
    weight: np.ndarray | None,
    known: np.ndarray,
    hats: np.ndarray,
    lights: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Find strengths, not negative, of overlapping hats of background and of lights that make a picture.

    Multiplicative updates (Richardson 1972, Lucy 1974), a <- a * H'(w I / H a) / H' w, from a = 1: they stay
    positive, and what the picture does not determine stays 1.

    Parameters
    ----------
    overview : Overview
        T at a glance.
    target, known : ndarray (h, w, 3)
        The picture, less the light of all that cannot change; and as it is.
    weight : ndarray (h, w, 1), optional
        How much each pixel counts.
    hats : ndarray (3, cells, n)
        Radiance of the background times each hat.
    lights : ndarray (3, blocks, m)
        Pictures of the lights.

    Returns
    -------
    hats, lights : ndarray (n, 3), (m, 3)
        Strengths.
    """
    target = np.maximum(overview.to_blocks(target), 0)
    # Lucy's own weights, counts of photons, are the pixels' brightness.
    w = relative(overview.to_blocks(known), target, None if weight is None else overview.to_blocks(weight))
    n = hats.shape[2]
    found = np.ones((n + lights.shape[2], 3))
    for c in range(3):
        h = np.concatenate([overview.matrix[c] @ hats[c], lights[c]], axis=1)
        down = w @ h
        seen = down > 1e-9 * max(down.max(), 1e-30)
        a = found[:, c]
        for _ in range(UPDATES):
            picture = h @ a
            ratio = target[:, c] / np.maximum(picture, 1e-6 * max(picture.max(), 1e-30))
            a[seen] *= (h.T @ (w * ratio))[seen] / down[seen]
    return found[:n], found[n:]


def refine(
    transport: LightTransport,
    target: np.ndarray,
    known: np.ndarray,
    weight: np.ndarray | None,
    gains: np.ndarray,
    direction: np.ndarray,
    flux: np.ndarray,
    first: int,
    last: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the place of a light to a fraction of a texel, by exact columns around a first guess.

    Parameters
    ----------
    transport : LightTransport
        T; gets exact columns for the texels that are looked at.
    target : ndarray (pixels, 3)
        The picture, less all that is not this light or the background.
    known : ndarray (pixels, 3)
        The target itself.
    weight : ndarray (pixels, 1) or None
        How much each pixel counts.
    gains : ndarray (n, pixels, 3)
        Pictures that may be mixed in at will: the background under gains of low order, the glow.
    direction : ndarray (3,)
        First guess.
    flux : ndarray (3,)
        Flux of the light.
    first, last : int
        Rows it may be in.

    Returns
    -------
    direction : ndarray (3,)
        Of the best place.
    factor : ndarray (3,)
        Its flux as a factor of ``flux``.
    """
    height, width = transport.grid.height, transport.grid.width
    omega = latlong.lookup_solid_angles(height, width)
    scale = relative(known, target, weight)
    spans, rest = [], []
    for c in range(3):
        q, r = np.linalg.qr((gains[..., c] * scale).T)
        q = q[:, np.abs(np.diag(r)) > 1e-6 * np.abs(r).max()]
        spans.append(q)
        y = target[:, c] * scale
        rest.append(y - q @ (q.T @ y))

    def score(texels):
        columns = transport.probe(texels) * (flux / omega[texels // width][:, None])[:, None, :]
        found, factor = 0.0, []
        for c in range(3):
            a = (columns[..., c] * scale).T
            a = a - spans[c] @ (spans[c].T @ a)
            power, along = (a * a).sum(axis=0), a.T @ rest[c]
            found = found + np.maximum(along, 0) ** 2 / np.maximum(power, 1e-30)
            factor.append(np.maximum(along, 0) / np.maximum(power, 1e-30))
        return found, np.stack(factor, axis=1)

    row, column = (float(x) for x in latlong.texel_position(direction, height, width))
    row, column = round(row), round(column)
    for spacing, reach in zip(SPACINGS, (2, 1), strict=True):
        steps = np.arange(-reach, reach + 1) * spacing
        rows = np.unique(np.clip(row + steps, first, last))
        columns = (column + steps) % width
        between = len(np.unique(columns)) == len(columns)  # on a map of few texels the steps meet
        columns = columns if between else np.unique(columns)
        texels = (rows[:, None] * width + columns).ravel()
        found, factor = score(texels)
        best = int(found.argmax())
        row, column = divmod(int(texels[best]), width)
    # Between the texels around the best, by how much each explains.
    grid = found.reshape(len(rows), len(columns))
    i, j = np.unravel_index(best, grid.shape)
    row, column = row + _vertex(grid[:, j], i), column + (_vertex(grid[i], j) if between else 0.0)
    theta, phi = np.pi * row / (height - 1), 2 * np.pi * (column + 0.5) / width
    return latlong.on_sphere(theta, phi), factor[best]


def _vertex(values, i):
    """Return the vertex of the parabola through three neighbours, from the middle, within half a step."""
    if not 0 < i < len(values) - 1:
        return 0.0
    a, b, c = values[i - 1 : i + 2]
    bend = a - 2 * b + c
    return float(np.clip(0.5 * (a - c) / bend, -0.5, 0.5)) if bend < 0 else 0.0
