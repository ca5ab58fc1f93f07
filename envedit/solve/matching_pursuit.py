"""Which lights a target requires, and where on the sphere: a matching pursuit through the overview of T.

The atoms are pictures of a light in each cell of the sphere, its glow taken along; the background may
meanwhile take on any gain of low order. The strongest light is placed first, each where it explains most of
what is left (orthogonal matching pursuit: Mallat and Zhang 1993, Pati et al. 1993). The result does not
depend on where a light was, with one exception: a light stays where it is if that explains 98 % as much.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.representations.layers.lights import interpolated_glow
from envedit.representations.layers.separation import Light, glow_at
from envedit.transport.block_transport import CELLS, Overview

STAY = 0.98
"""A light stays where it was if that explains this share of what the best place explains."""
LEAST_FLUX = 1e-3
"""A light whose flux falls below this share of what it was is taken away."""
GAIN_ORDER = 2
"""Order of the gains, as polynomials of the direction, that the background may take on meanwhile."""
APART = 20.0
"""Degrees from all others that an added light has at least."""
ADDED_ORDER = 4
"""Order of the background's gains that must fail to explain what a new light explains."""
ADDED = 0.6
"""A light is added where it explains this share of what all others leave unexplained."""
ADDED_LIGHT = 0.03
"""And adds this share to the light of the picture."""
SEEN, UNWANTED = 1e-3, 1e-2
"""A light that adds less than the first share to the picture, and would explain less than the second of its
square anywhere, stays as it is."""
UNEXPLAINED = 0.003
"""Share of the squared picture that must be left unexplained before a light is added."""
FAINT = 0.2
"""Pixels are weighted by 1 / (brightness + this share of the mean brightness)."""
ROUNDING = 1e-12
"""Cosine between a column and what is left unexplained below which the column does not explain it."""
NEAR, NEARLY = 1.6, 0.8
"""A light lies between cells at most so many cells from the best one, diagonal neighbours among them, that
explain more than this share of what it does."""


@dataclass(frozen=True)
class Place:
    """Where a light is to start: direction (3,), None where it stays, and flux per channel as a factor."""

    direction: np.ndarray | None
    flux: np.ndarray


@dataclass(frozen=True)
class Given:
    """What a pursuit is given beside the picture that is to be explained.

    Attributes
    ----------
    overview : Overview
        T at a glance.
    weight : ndarray (h, w, 1) or None
        How much each pixel counts.
    known : ndarray (h, w, 3)
        The target itself: how bright a pixel is.
    background : ndarray (H * W, 3)
        The map without its lights; 0 where it cannot change.
    omega : ndarray (H * W,)
        Solid angle of every texel, as a rendering receives it.
    active : ndarray of bool (H * W,)
        Texels that may change.
    start : int
        Texel from which those of the lights are counted.
    directions : ndarray (cells, 3)
        Directions by which gain and glow go in each cell of the overview.
    """

    overview: Overview
    weight: np.ndarray | None
    known: np.ndarray
    background: np.ndarray
    omega: np.ndarray
    active: np.ndarray
    start: int
    directions: np.ndarray

    def flux(self, light: Light) -> np.ndarray:
        """Return the flux of a light's texels, (n, 3)."""
        return light.radiance * self.omega[self.start + light.texels][:, None]

    def cells(self, light: Light) -> np.ndarray:
        """Return the cell that each texel of a light is in, (n,)."""
        return self.overview.cell_of[self.start + light.texels]


def place(
    given: Given, picture: np.ndarray, lights: list[Light], spare: int, spare_flux: np.ndarray
) -> list[Place]:
    """Place every light.

    Parameters
    ----------
    given : Given
        What the search is given.
    picture : ndarray (h, w, 3)
        The target, less the light of everything that cannot change.
    lights : list of Light
        The map's lights.
    spare : int
        Lights that may be added.
    spare_flux : ndarray (3,)
        Flux of a spare light.

    Returns
    -------
    list of Place
        For the map's lights, then for the spare ones; flux 0: not there.
    """
    overview, search = given.overview, Pursuit(given, picture)
    directions: list[np.ndarray | None] = []
    atoms: list[np.ndarray] = []
    stays = [search.atom_of(given.cells(one), given.flux(one), one.direction, one.glow) for one in lights]
    for i, light in enumerate(lights):
        atom, stay = search.atoms(given.flux(light).sum(axis=0), light.glow), stays[i]
        # Those that are not placed yet may be where they were: one that moves does not stand in for them.
        rest = search.beside(other[..., 0] for other in stays[i + 1 :])
        score = rest.scores(atom)
        unseen = np.abs(stay).sum() < SEEN * search.light and score.max() < UNWANTED * search.asked()
        if unseen:  # nothing is known of it, and no other place explains more
            directions.append(None)
            atoms.append(None)
            continue
        if rest.scores(stay)[0] >= STAY * score.max():
            directions.append(None)
            chosen = stay[..., 0]
        else:
            best = int(score.argmax())
            directions.append(search.between(score, best))
            chosen = atom[..., best]
        atoms.append(chosen)
        search.explain(chosen)
    seen = [i for i, a in enumerate(atoms) if a is not None]
    factors = np.ones((len(lights), 3))
    factors[seen] = search.solve([atoms[i] for i in seen])
    atoms = [atoms[i] for i in seen]
    # Whether lights are missing is asked only where much is left.
    missing = search.left() > UNEXPLAINED * search.asked()
    if missing:
        search.allow(products(given.directions, ADDED_ORDER))
        atom = search.atoms(spare_flux, None)
    for _ in range(spare if missing else 0):
        score = search.scores(atom)
        old = [one.direction if d is None else d for one, d in zip(lights, directions, strict=False)]
        for there in [*old, *directions[len(lights) :]]:
            score[overview.directions[search.candidates] @ there > np.cos(np.radians(APART))] = 0
        best = int(score.argmax())
        candidate = atom[..., best]
        grown = search.solve([*atoms, candidate])
        light = (candidate * grown[-1][:, None]).sum()
        if not (score[best] > ADDED * search.left() and light > ADDED_LIGHT * search.light):
            break
        directions.append(search.between(score, best))
        atoms.append(candidate)
        search.explain(candidate)
        factors = np.concatenate([factors, np.ones((1, 3))])
        factors[[*seen, *range(len(lights), len(factors))]] = grown
    places = []
    for direction, factor in zip(directions, factors, strict=True):
        gone = factor.max() < LEAST_FLUX
        places.append(Place(direction, np.zeros(3) if gone else np.maximum(factor, LEAST_FLUX)))
    return places + [Place(None, np.zeros(3))] * (len(lights) + spare - len(places))


def relative(known: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Weigh pixels, or blocks of them, so that equal relative errors count alike.

    That is weight / (brightness + floor).

    Parameters
    ----------
    known, target : ndarray (..., 3)
        The picture, whose channels' mean is the brightness, and what is to be explained of it. The floor is
        :data:`FAINT` of the mean brightness; of paint on black, of the paint's own.
    weight : ndarray (..., 1), optional
        How much each pixel counts.

    Returns
    -------
    ndarray (...)
        ``weight`` itself where there is nothing at all.
    """
    bright = known.mean(axis=-1, dtype=np.float64)
    mean = bright.mean() or np.abs(target).mean()
    count = np.ones(bright.shape) if weight is None else weight[..., 0]
    return count / (bright + FAINT * mean) if mean > 0 else count


class Pursuit:
    """The residual picture, block by block, and what explains it; channels are apart.

    Parameters
    ----------
    given : Given
        What a pursuit is given.
    picture : ndarray (h, w, 3)
        What is to be explained, linear radiance.
    """

    def __init__(self, given: Given, picture: np.ndarray):
        overview, omega = given.overview, given.omega
        self.overview = overview
        blocks = overview.to_blocks(picture)
        count = None if given.weight is None else overview.to_blocks(given.weight)
        self.weight = relative(overview.to_blocks(given.known), blocks, count)
        target = blocks.T
        self.light = float(np.abs(target * self.weight).sum())
        cells = overview.to_cells(given.background, omega)
        self.background = np.where(np.isfinite(cells), cells, 0)
        share = overview.to_cells(given.active[:, None].astype(float), omega)[:, 0]
        self.candidates = np.flatnonzero(share >= 0.5 * max(share.max(), 1e-30))
        self.directions = d = given.directions
        self.cosine = mi.Float(np.float32(d @ d[self.candidates].T).ravel())
        self.target = [w * self.weight for w in target]
        self.residual = list(self.target)
        self.spans = [np.zeros((len(blocks), 0)) for _ in range(3)]
        self.allow(products(d, GAIN_ORDER))

    def allow(self, gains: np.ndarray) -> None:
        """Let the background take on any mixture of gains, (cells, n)."""
        for c in range(3):
            span = self.overview.matrix[c] @ (self.background[:, c : c + 1] * gains) * self.weight[:, None]
            q, r = np.linalg.qr(self._off(c, self._off(c, span)))
            q = q[:, np.abs(np.diag(r)) > 1e-4 * max(np.linalg.norm(span, axis=0).max(), 1e-30)]
            self.spans[c] = np.concatenate([self.spans[c], q], axis=1)
            self.residual[c] = self._off(c, self.residual[c])

    def _off(self, c, x):
        return x - self.spans[c] @ (self.spans[c].T @ x)

    def atoms(self, flux: np.ndarray, glow: np.ndarray | None) -> np.ndarray:
        """Pictures of a light of ``flux`` (3,) in each candidate cell: (3, blocks, candidates), weighted.

        ``glow`` as of :class:`.separation.Light`; it comes along.
        """
        matrix, size = self.overview.matrix, (len(self.directions), len(self.candidates))
        unit = (flux[:, None] / self.overview.omega[self.candidates]).astype(np.float32)
        found = np.stack([m[:, self.candidates] * u for m, u in zip(matrix, unit, strict=True)])
        if glow is not None:
            shine = interpolated_glow(dr.opaque(mi.Float(np.float32(glow).ravel())), self.cosine)
            for c in range(3):
                lit = mi.TensorXf(shine[c], size) * tensor(self.background[:, c : c + 1])
                found[c] += dr.matmul(tensor(matrix[c]), lit).numpy()
        return found * self.weight[:, None]

    def atom_of(
        self, cells: np.ndarray, flux: np.ndarray, centre: np.ndarray, glow: np.ndarray | None
    ) -> np.ndarray:
        """Picture, (3, blocks, 1), of a light with flux (n, 3) in cells (n,) and its glow around a centre."""
        found, shine = [], None if glow is None else glow_at(glow, self.directions @ centre)
        for c in range(3):
            light = np.bincount(cells, flux[:, c], len(self.overview.omega)) / self.overview.omega
            if glow is not None:
                light = light + self.background[:, c] * shine[:, c]
            found.append(self.overview.matrix[c] @ light * self.weight)
        return np.stack(found)[..., None]

    def scores(self, atoms: np.ndarray) -> np.ndarray:
        """Squared residual that each atom, (3, blocks, n), explains, summed over channels: (n,)."""
        score: Any = 0.0
        for c in range(3):
            atom = self._off(c, atoms[c])
            power = (atom * atom).sum(axis=0)
            score = score + np.maximum(atom.T @ self.residual[c], 0) ** 2 / np.maximum(power, 1e-30)
        return score

    def between(self, score: np.ndarray, best: int) -> np.ndarray:
        """Direction of the best cell, drawn towards neighbours that explain nearly as much."""
        d = self.overview.directions[self.candidates]
        near = d @ d[best] > np.cos(np.radians(NEAR * 360 / CELLS))
        weight = np.maximum(score[near] - NEARLY * score[best], 0) ** 2
        middle = (d[near] * weight[:, None]).sum(axis=0)
        return middle / np.linalg.norm(middle)

    def explain(self, atom: np.ndarray) -> None:
        """Let an atom of any strength explain what it can."""
        for c in range(3):
            new = self._off(c, atom[c])
            size = np.linalg.norm(new)
            whole: Any = max(np.linalg.norm(atom[c]), 1e-30)
            if size > 1e-6 * whole:
                self.spans[c] = np.concatenate([self.spans[c], (new / size)[:, None]], axis=1)
                self.residual[c] = self._off(c, self.residual[c])

    def beside(self, atoms: Iterable[np.ndarray]) -> Pursuit:
        """Return a pursuit in which these atoms have explained what they can; this one stays as it is."""
        other = copy.copy(self)
        other.spans, other.residual = list(self.spans), list(self.residual)
        for atom in atoms:
            other.explain(atom)
        return other

    def left(self) -> float:
        """Squared residual."""
        return sum(float(r @ r) for r in self.residual)

    def asked(self) -> float:
        """Squared picture."""
        return sum(float(w @ w) for w in self.target)

    def solve(self, atoms: Sequence[np.ndarray]) -> np.ndarray:
        """Strength of each atom per channel, (n, 3), not negative, beside one gain of the background.

        The gain is a factor per channel that is the same everywhere.
        """
        found = np.zeros((len(atoms), 3))
        for c in range(3):
            span = self.overview.matrix[c] @ self.background[:, c] * self.weight
            columns = np.stack([span, *(a[c] for a in atoms)], axis=1)
            found[:, c] = not_negative(columns, self.target[c])[1:]
        return found


def products(d: np.ndarray, order: int) -> np.ndarray:
    """Return a basis of the polynomials up to an order on the sphere, at unit vectors d: (n, functions).

    Products of powers of x, y and z, of which z^2 = 1 - x^2 - y^2 is left out.
    """
    x, y, z = d.T
    powers = [(i, j, k) for i in range(order + 1) for j in range(order + 1 - i) for k in range(2)]
    return np.stack([x**i * y**j * z**k for i, j, k in powers if i + j + k <= order], axis=1)


def not_negative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve min |a x - b| with x >= 0: the active-set method of Lawson and Hanson (1974), chapter 23.

    A column that was taken out comes in again where its gradient asks for it, so that the result is optimal.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    x, used = np.zeros(a.shape[1]), np.zeros(a.shape[1], bool)
    least = ROUNDING * np.linalg.norm(a, axis=0) * np.linalg.norm(b)
    barred = np.zeros_like(used)  # columns that would come in with a negative value, by rounding
    for _ in range(3 * len(x)):
        descent = a.T @ (b - a @ x)
        usable = ~used & ~barred & (descent > least)
        if not usable.any():
            break
        new = int(np.argmax(np.where(usable, descent, -np.inf)))
        used[new] = True
        while used.any():
            best = np.zeros_like(x)
            best[used] = np.linalg.lstsq(a[:, used], b, rcond=None)[0]
            if best[new] <= 0 and x[new] == 0:
                used[new], barred[new] = False, True
                break
            if (best[used] > 0).all():
                x, barred = best, np.zeros_like(used)
                break
            below = used & (best <= 0)
            share = x[below] / (x[below] - best[below])
            x[used] += share.min() * (best - x)[used]
            used &= x > 0
            used[np.flatnonzero(below)[np.argmin(share)]] = False
            x[~used] = 0
    return x
