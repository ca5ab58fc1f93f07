"""Where a light raises the likelihood of paint most, all else as it is.

Nothing but the light is to explain the paint: its pictures are compared as they are, display curve and all,
at the largest noise that paint has.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import flat, tensor
from envedit.core.rotations import rotation_vector
from envedit.losses import display_curve
from envedit.representations.layers.aureoles import glow_strength
from envedit.representations.layers.lights import LOBE_DEGREES
from envedit.solve.light_places import (
    PLACES_APART_COSINE,
    PROBE_SPACINGS,
    Place,
    is_apart,
    lit_ground,
    most_promising,
    probed,
)
from envedit.solve.likelihood import Likelihood, of_mean
from envedit.solve.map_problem import Problem
from envedit.solve.unknowns import with_light
from envedit.transport.light_transport import LightTransport

OWN_FLUX_FACTORS = 2.0 ** np.arange(-2, 1.5, 0.5)
"""Fluxes that a light of the map is tried with elsewhere, over its own."""
ADDED_FLUX_SHARES, ADDED_FLUXES = (1 / 64, 2.0), 15
"""Least and largest flux that an added light is tried with, and how many: by what it and its glow add to the
light in the picture, and by what it adds alone."""
LARGER_DEGREES = (2.0, 8.0)
"""Radii of larger lights that are tried: what is painted into something smooth is as large as its image."""
ROWS_OF_A_LANE = 64
"""Pixels, or blocks of them, that are summed up one after the other: so few that all cores are busy."""
POSITIVE_EVIDENCE = 2.0
"""Difference of -2 log likelihood up to which two places promise as much as each other: "not worth more than
a bare mention" (Kass and Raftery 1995)."""


def best(
    problem: Problem, state: dict, transport: LightTransport, k: int, away: np.ndarray | None = None
) -> list[Place]:
    """List where light ``k``, dark in a state, raises the likelihood most, through ``transport``.

    All cells of the sky are tried through the block transport, with several fluxes each, and texels around
    the best ones through exact columns. Texels are :data:`.light_places.PLACES_APART_COSINE` apart, also from
    ``away``. A light that is added is the smallest there that promises as much as the best one.
    """
    lights, blocks, likelihood = problem.layers.lights, problem.blocks, problem.likelihood
    point = problem.evaluate(state, transport, resolve=False)
    _, directions = blocks.sky
    if point.residual is None or not len(directions):
        return []
    trial = _TriedLight(problem, point, k)
    weight = blocks.summed(likelihood.weight)
    total = np.maximum(weight, 1e-30)
    compared = _Comparison(
        likelihood=likelihood,
        own=trial.own,
        before=blocks.summed(likelihood.weight * point.rendering) / total,
        target=blocks.summed(likelihood.weight * problem.picture) / total,
        weight=weight[:, 0],
        share=blocks.summed(likelihood.share)[:, 0],
    )
    cores = blocks.cells(trial.ground).of(lights.flux[k])
    _, unlikeliness = compared.best(cores, trial.glows_of_cells())
    if away is not None:
        unlikeliness = np.where(directions @ away > PLACES_APART_COSINE, np.inf, unlikeliness)
    places: list[Place] = []
    texels: list[np.ndarray] = []
    for at in most_promising(directions, -unlikeliness):
        sizes = trial.sizes(directions[at])
        if is_apart(sizes[0].direction, texels):
            texels.append(sizes[0].direction)
            places.append(_smallest(sizes))
    return places


def _smallest(sizes):
    """Return the first of places, by size, that promises as much as the best one."""
    least = max(place.promise for place in sizes) - POSITIVE_EVIDENCE
    return next(place for place in sizes if not place.promise < least)  # the first where none is finite


class _TriedLight:
    """A light in place of none, in the picture of a point: its core, and its glow in the sky around it."""

    def __init__(self, problem, point, k):
        layers = problem.layers
        self.problem, self.point, self.transport, self.k = problem, point, point.transport, k
        self.own, self.flux = k < layers.lights.own, layers.lights.flux[k]
        self.ground = lit_ground(problem, point)
        self._slope = None
        if layers.lights.glows[k] is not None:
            self._slope = layers.glow_slope(problem.params(point.state), point.sky)
        self._compared = _Comparison(
            likelihood=problem.likelihood,
            own=self.own,
            before=point.rendering.reshape(-1, 3),
            target=problem.picture.reshape(-1, 3),
            weight=problem.likelihood.weight.ravel(),
            share=problem.likelihood.share.ravel(),
        )

    def glows_of_cells(self):
        """Return pictures of the glow around each cell of the sky, (blocks, n) per channel; None of none."""
        if self._slope is None:
            return None
        lights = self.problem.layers.lights
        return self.problem.blocks.glows(self._slope, functools.partial(lights.glow_around, self.k))

    def glow(self, direction):
        """Return the picture (pixels, 3) of the glow around a direction, of the flux; None of none."""
        if self._slope is None:
            return None
        problem, layers = self.problem, self.problem.layers
        turn = rotation_vector(layers.lights.centres[self.k], direction)
        placed = with_light(self.point.state, self.k, turn=turn, flux=0.0)
        sky, cores = (part.numpy() for part in layers.parts(problem.params(placed)))
        change = np.zeros_like(problem.envmap)
        change[problem.rows] = sky - self.point.sky
        picture = self.transport.linear(tensor(change)).numpy()
        if self.ground is not None:  # ground that the core shines on is in the core's picture
            core = cores - (self.point.edited[problem.rows] - self.point.sky)
            picture -= np.float32(layers.ground_light.irradiance(core[: layers.shape[0]]) * self.ground)
        return picture.reshape(-1, 3)

    def sizes(self, direction):
        """List the places at a direction, the best texel around it first; an added light may be larger."""
        glow = self.glow(direction)
        texel, core = self._texel(direction, glow)
        larger = () if self.own else LARGER_DEGREES
        cores = [core, *(self._lobe(direction, degrees) for degrees in larger)]
        glows = None if glow is None else np.stack([self.glow(texel), *[glow] * len(larger)])
        factors, unlikeliness = self._best(np.stack(cores), glows)
        directions = [texel, *[direction] * len(larger)]
        made = zip(directions, factors, unlikeliness, (LOBE_DEGREES, *larger), strict=True)
        return [Place(d, np.full(3, np.log(f)), -float(u), degrees) for d, f, u, degrees in made]

    def _texel(self, direction, glow):
        """Return the direction of the best texel around one, through exact columns, and its picture."""
        height, width = self.problem.envmap.shape[:2]
        row, column = (round(float(x)) for x in latlong.texel_position(direction, height, width))
        for spacing in PROBE_SPACINGS:
            texels, pictures = probed(
                self.problem, self.transport, row, column, self.flux, spacing, reach=1, ground=self.ground
            )
            glows = None if glow is None else np.repeat(glow[None], len(texels), axis=0)
            _, unlikeliness = self._best(pictures, glows)
            at = int(np.argmin(unlikeliness))
            row, column = divmod(int(texels[at]), width)
        return latlong.directions(height, width)[row, column], pictures[at]

    def _lobe(self, direction, degrees):
        """Return the picture (pixels, 3) of the core of a lobe of some radius."""
        layers = self.problem.layers
        turn = rotation_vector(layers.lights.centres[self.k], direction)
        placement = turn, np.zeros(3), layers.lights.log_size(degrees)
        core = layers.cores_of(self.k, [placement])
        picture = self.transport.pictures(core, self.problem.rows, most=0)
        if self.ground is not None:
            light = layers.ground_light.irradiance(core[0, : layers.shape[0]])
            picture += np.float32(light * self.ground)
        return picture.reshape(-1, 3)

    def _best(self, cores, glows):
        """Return the best factors of the flux of lights, and -2 log likelihood then; (k, pixels, 3) both."""
        by_channels = None if glows is None else [tensor(one) for one in glows.T]
        return self._compared.best([tensor(one) for one in cores.T], by_channels)


@dataclass(frozen=True)
class _Comparison:
    """Pixels or blocks of them, by which pictures of a light are compared.

    ``before`` and ``target`` are linear radiance (n, 3); ``weight`` (n,) and ``share`` (n,) those of the
    likelihood. ``own``: the light is one of the map.
    """

    likelihood: Likelihood
    own: bool
    before: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    share: np.ndarray

    def best(
        self, cores: list[mi.TensorXf], glows: list[mi.TensorXf] | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the likeliest factor of the flux of k lights, and -2 log likelihood then, (k,) both.

        ``cores`` are their pictures (n, k), per channel, and ``glows`` those of their glows; None: of none.
        """
        factors = np.repeat(OWN_FLUX_FACTORS[:, None], cores[0].shape[1], axis=1)
        if not self.own:  # of any flux; on black, as much as was painted
            light = self.before.mean() or max(float(self.target.mean()), 1e-30)
            of_core = np.mean([dr.mean(one, axis=0).numpy() for one in cores], axis=0)
            of_light = of_core
            if glows is not None:
                of_light = of_core + np.mean([dr.mean(one, axis=0).numpy() for one in glows], axis=0)
            least, most = ADDED_FLUX_SHARES
            factors = np.geomspace(
                least * light / np.maximum(of_light, 1e-30),
                most * light / np.maximum(of_core, 1e-30),
                ADDED_FLUXES,
            )
        squares, means = self._sums(cores, glows, np.float32(factors))
        area, noise = self.likelihood.area, self.likelihood.largest_noise
        unlikeliness = squares / (area * noise**2) + of_mean(means)
        least = unlikeliness.argmin(axis=0)[None]
        factor = np.take_along_axis(factors, least, axis=0)[0]
        return factor, unlikeliness.min(axis=0)

    def _sums(self, cores, glows, factors):
        """Return what is left of display values beside lights of some factors (f, k), summed over n.

        Squares times :attr:`weight`, (f, k), and values times :attr:`share`, (f, k, 3).
        """
        count, k = cores[0].shape
        parts = -(-count // ROWS_OF_A_LANE)
        lane = dr.arange(mi.UInt32, parts * k)  # of one light, and some rows
        width = dr.opaque(mi.UInt32, k)
        slab = lane // width
        column = lane - slab * width
        first = slab * dr.opaque(mi.UInt32, ROWS_OF_A_LANE)
        stop = dr.minimum(first + dr.opaque(mi.UInt32, ROWS_OF_A_LANE), dr.opaque(mi.UInt32, count))
        strengths, factors = (
            [dr.gather(mi.Float, flat(mi.Float, row), column) for row in some]
            for some in (glow_strength(factors), factors)
        )
        before = flat(mi.Float, np.float32(self.before))
        goal = display_curve.to_display(tensor(self.target), self.likelihood.white).array
        white = dr.opaque(mi.Float, self.likelihood.white)
        weight, share = (flat(mi.Float, np.float32(one)) for one in (self.weight, self.share))
        dr.eval(goal)

        def add(row, squares, means):
            w, part = dr.gather(mi.Float, weight, row), dr.gather(mi.Float, share, row)
            for c, picture in enumerate(cores):
                more = dr.gather(mi.Float, picture.array, row * width + column)
                glow = mi.Float(0)
                if glows is not None:
                    glow = dr.gather(mi.Float, glows[c].array, row * width + column)
                now, to = (dr.gather(mi.Float, one, 3 * row + c) for one in (before, goal))
                for i, (factor, strength) in enumerate(zip(factors, strengths, strict=True)):
                    off = display_curve.shown(now + more * factor + glow * strength, white) - to
                    squares[i] = squares[i] + mi.Float64(w * dr.square(off))
                    means[3 * i + c] = means[3 * i + c] + mi.Float64(part * off)
            return row + 1, squares, means

        begun = first, [mi.Float64(0)] * len(factors), [mi.Float64(0)] * (3 * len(factors))
        _, squares, means = dr.while_loop(begun, lambda row, *_: row < stop, add)
        dr.eval(squares, means)
        squares, means = (
            np.stack([one.numpy().reshape(parts, k).sum(axis=0) for one in some]) for some in (squares, means)
        )
        return squares, means.reshape(-1, 3, k).transpose(0, 2, 1)
