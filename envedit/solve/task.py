"""The problem that a target poses: how likely its residuals are, and how far the map may change for it."""

from __future__ import annotations

import numpy as np

from envedit import config
from envedit.representations.layers.layers import Layers
from envedit.solve import prior
from envedit.solve.block_jacobian import BlockJacobian
from envedit.solve.likelihood import SIGMA, Likelihood, on_average_one
from envedit.solve.map_problem import Photographed, Problem
from envedit.targets.target import Target
from envedit.transport.light_transport import LightTransport


def likelihood(target: Target) -> Likelihood:
    """Return the likelihood of a target's residuals: of a rendering, or of paint where it has coverage."""
    if target.coverage is None:
        return Likelihood(on_average_one(target.weight, target.picture.shape[:2]))
    return Likelihood.of_paint(target.weight, target.coverage, target.initial, target.picture)


def problem(
    settings: config.Config,
    target: Target,
    layers: Layers,
    transport: LightTransport,
    envmap: np.ndarray,
    blocks: BlockJacobian | None = None,
) -> Problem:
    """Return what is minimised; parameters are those of :class:`.Problem`, and ``solve.freedom`` counts."""
    painted, photograph = target.coverage is not None, None
    if target.photo is not None:
        photo = target.photo
        photograph = Photographed(photo.camera.log_factor - photo.centre, photo.precision)
    expected = prior.of_paint(settings.solve.freedom, target.coverage) if painted else prior.Prior()
    return Problem(
        layers,
        transport,
        envmap,
        target.aim,
        likelihood(target),
        expected,
        saturates=not painted,
        blocks=blocks,
        photo=photograph,
        clipped=target.clipped,
    )


def sigma(target: Target) -> float:
    """Return the standard error of display values: that of the target, at least :data:`SIGMA`."""
    return SIGMA if target.noise is None else max(SIGMA, float(np.median(target.noise)))
