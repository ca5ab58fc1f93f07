"""How much of what was painted lights explain: those of the map, and one more anywhere in its sky.

Unknown are factors, one a channel: of each light of the map, of all the rest of it, which changes by no more
than photographed skies do, and of another light. The mean of what was not painted changes by little more than
what is visible. The light is tried in each cell of the block transport (5.6 degrees), then in each texel
around the best cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envedit import renderers
from envedit.core.arrays import tensor
from envedit.core.color import tonemap
from envedit.losses import display_curve
from envedit.representations.layers.separation import separate
from envedit.solve.likelihood import STATEMENTS, Likelihood
from envedit.solve.prior import PHOTOGRAPHED
from envedit.targets.pixel_weights import FOLLOWING, hidden_pixels, pixel_weight
from envedit.targets.target import beside
from experiments.painted_edits.painters import Paint, View

ERROR = 1 / 3
"""Standard error of paint here, over its largest in an edit: paint is to be followed as far as it can be."""
STEPS, LARGEST_STEP = 25, 1.5
"""Levenberg-Marquardt steps, of all places at once, and the largest of a log factor."""
FIRST_SHARE = 0.1
"""Light that is added at first, over the light in the picture."""
STARTS = 0.0, -5.0
"""Log factors that the map's lights have at first: as they are, and out."""
SKY_LOG_FACTOR = 2 * PHOTOGRAPHED[0].whole
"""Largest log factor of all the map but its lights: two standard deviations between photographed skies."""
LIGHT_LOG_FACTOR = 8.0
"""Largest log factor of a light."""
NEAR_COSINE = np.cos(np.radians(6.0))
"""Cosine of the angle from a cell within which texels are tried."""


def share(settings, view: View, initial: np.ndarray, paint: Paint) -> float:
    """Return the share of the painted change that lights explain; negative where they lead away from it.

    ``initial`` (h, w, 3) is the rendering that was painted on. Display values of blocks of pixels are
    compared.
    """
    # ---- Pictures of the map without its lights, and of each of these
    envmap = view.envmap
    transport = renderers.trace(settings, view.scene, envmap.shape[:2]).resolved(envmap)
    separated = separate(envmap)
    parts = [envmap - separated.core]
    for light in separated.lights:
        core = np.zeros((envmap.shape[0] * envmap.shape[1], 3))
        core[light.texels] = light.radiance
        parts.append(core.reshape(envmap.shape))
    overview = transport.overview()
    pictures = transport.linear(tensor(np.float32(parts))).numpy()

    # ---- What is compared
    coverage = np.float32(paint.coverage[..., None])
    likelihood = Likelihood.of_paint(
        weight=pixel_weight(coverage, hidden_pixels(view.scene), paint=1.0, hold=FOLLOWING),
        coverage=coverage,
        initial=initial,
        picture=paint.picture,
    )
    other = transport.other_light()
    size = np.bincount(overview.block_of)
    painted = overview.to_blocks(coverage)[:, 0] * size / coverage.sum()
    comparison = _Comparison(
        parts=np.stack([overview.to_blocks(picture) for picture in pictures]),
        other=overview.to_blocks(other),
        aim=overview.to_blocks(beside(pictures.sum(axis=0) + other, initial, paint.picture)),
        precision=painted / (ERROR * likelihood.paint_noise) ** 2,
        rest=overview.to_blocks(likelihood.share)[:, 0] * size,
        white=likelihood.white,
    )

    # ---- The best cell of the sky, and the best texel there
    sky = np.flatnonzero(overview.directions[:, 1] > 0)
    at, of_cell = comparison.best(overview.matrix[:, :, sky].transpose(2, 1, 0))
    near = overview.directions @ overview.directions[sky[at]] > NEAR_COSINE
    texels = np.flatnonzero(near[overview.cell_of])
    columns = transport.probe(texels).reshape(len(texels), *initial.shape)
    _, of_texel = comparison.best(np.stack([overview.to_blocks(column) for column in columns]))
    return max(comparison.share(of_cell), comparison.share(of_texel))


@dataclass(frozen=True)
class _Comparison:
    """Blocks of pixels, by which lights are compared.

    ``parts`` (m, n, 3) are radiance under parts of the map, the first under all but its lights, ``other``
    (n, 3) under other lamps, ``aim`` (n, 3) what is wanted. ``precision`` (n,) is the inverse variance of
    the paint in a block, ``rest`` (n,) what the block counts in the mean of what was not painted.
    """

    parts: np.ndarray
    other: np.ndarray
    aim: np.ndarray
    precision: np.ndarray
    rest: np.ndarray
    white: float

    def share(self, radiance):
        """Return the share of the paint that radiance (n, 3) has."""
        now = self.parts.sum(axis=0) + self.other
        left, asked = (
            np.abs(tonemap(one) - tonemap(self.aim)).mean(axis=1) @ self.precision for one in (radiance, now)
        )
        return float(1 - left / asked)

    def best(self, lit):
        """Return which of the lights of pictures (k, n, 3) explains most, and radiance (n, 3) with it."""
        candidates = []
        for start in STARTS:
            channels = [self._of_channel(c, lit[..., c], start) for c in range(3)]
            radiance, misfit = (np.stack(part, axis=-1) for part in zip(*channels, strict=True))
            at = int(misfit.sum(axis=1).argmin())
            candidates.append((misfit[at].sum(), at, radiance[at]))
        _, at, radiance = min(candidates, key=lambda one: one[0])
        return at, radiance

    def _of_channel(self, c, lit, start):
        """Return radiance (k, n) of a channel under the best factors with each of k lights, and misfits."""
        light = FIRST_SHARE * (self.parts[..., c].sum(axis=0) + self.other[:, c]).mean()
        lit = lit.astype(np.float64)
        lit *= light / np.maximum(lit.mean(axis=1, keepdims=True), 1e-30)
        parts = np.concatenate(
            [np.broadcast_to(self.parts[..., c], (len(lit), *self.parts.shape[:2])), lit[:, None]],
            axis=1,
        )
        shown = self._display(self.aim[None, :, c])
        x = np.zeros(parts.shape[:2])
        x[:, 1:-1] = start
        largest = np.full(parts.shape[1], LIGHT_LOG_FACTOR)
        largest[0] = SKY_LOG_FACTOR
        damping = np.full(len(lit), 1e-2)
        radiance = _radiance(x, parts, self.other[:, c])
        misfit = self._misfit(self._display(radiance) - shown)
        for _ in range(STEPS):
            hessian, gradient = self._normal(x, parts, radiance, shown)
            diagonal = np.einsum("kii->ki", hessian)
            diagonal += damping[:, None] * diagonal + 1e-9
            step = np.linalg.solve(hessian, -gradient[..., None])[..., 0]
            tried = np.clip(x + np.clip(step, -LARGEST_STEP, LARGEST_STEP), -largest, largest)
            there = _radiance(tried, parts, self.other[:, c])
            then = self._misfit(self._display(there) - shown)
            better = then < misfit
            x = np.where(better[:, None], tried, x)
            radiance = np.where(better[:, None], there, radiance)
            misfit = np.where(better, then, misfit)
            damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-6, 1e6)
        return radiance, misfit

    def _display(self, radiance):
        return display_curve.values(np.float32(radiance)[..., None], self.white)[..., 0].astype(np.float64)

    def _misfit(self, off):
        """Return what residuals (k, n) of display values count, (k,)."""
        return off**2 @ self.precision + STATEMENTS * (off @ self.rest) ** 2

    def _normal(self, x, parts, radiance, shown):
        """Return half the Gauss-Newton Hessian and half the gradient of the misfit, (k, i, i) and (k, i)."""
        off = self._display(radiance) - shown
        slope = display_curve.slope(np.float32(radiance)[..., None], self.white)[..., 0]
        jacobian = np.exp(x)[..., None] * parts * slope[:, None]
        weighted = jacobian * self.precision
        mean = jacobian @ self.rest
        hessian = weighted @ jacobian.transpose(0, 2, 1) + STATEMENTS * mean[..., None] * mean[:, None]
        pull = (off @ self.rest)[:, None]
        return hessian, np.einsum("kin,kn->ki", weighted, off) + STATEMENTS * mean * pull


def _radiance(x, parts, other):
    return np.einsum("ki,kin->kn", np.exp(x), parts) + other
