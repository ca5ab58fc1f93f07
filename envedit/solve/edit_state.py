"""An edit: what is given, and how parameters become a whole map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from envedit import config
from envedit.core.errors import NumericalError, place_of
from envedit.core.rows import Rows
from envedit.core.types import Params
from envedit.losses.perceptual import distances
from envedit.renderers import Renderer
from envedit.representations.layers.gain import LEVELS
from envedit.representations.layers.unseen import unseen_kept
from envedit.scene.scene import Scene
from envedit.solve import block_jacobian, prior
from envedit.solve.likelihood import Likelihood
from envedit.solve.map_problem import Problem
from envedit.targets.target import Target
from envedit.transport.light_transport import LightTransport


class Interrupted(Exception):
    """Ctrl-C during the edit; ``envmap`` is the map so far, that of the checkpoint where there is one.

    ``input_map`` is the input map in whose units ``envmap`` is, once the run has brought it there.
    """

    input_map: Any

    def __init__(self, envmap: np.ndarray, step: int):
        super().__init__(f"interrupted at iteration {step}")
        self.envmap, self.step = envmap, step


class Stopped(NumericalError):
    """The optimisation could not go on; ``envmap`` is the last good map, ``input_map`` as of Interrupted."""

    input_map: Any

    def __init__(self, message: str, envmap: np.ndarray):
        super().__init__(message)
        self.envmap = envmap


@dataclass
class Watch:
    """What a run reports while it works.

    ``stage(text)`` when a part begins, ``progress(done, total, text)`` within one.
    """

    stage: Callable[[str], None] = lambda text: None
    progress: Callable[[int, int, str], None] = lambda done, total, text: None


@dataclass
class EditState:
    """One edit in progress."""

    settings: config.Config  # what is carried out
    scene: Scene  # what is lit
    original: np.ndarray  # (H, W, 3), the map; turned, where it was
    rows: Rows  # its active rows
    free: np.ndarray | None  # bool (rows, W), active texels that may change; None: all
    # What the renderer is to make; solvers may change its weights and what it is compared with
    target: Target
    # representation, renderer: as for :func:`.adam_loop.optimise`; of layers more than the protocol is used
    representation: Any
    renderer: Renderer
    watch: Watch  # receives progress
    dists: distances.Dists | None = None  # as for :class:`.adam_loop.Objective`
    degrees: float = 0.0  # by how much the map has been turned
    # bool (H, W), active texels that keep their value; None where the renderer does not know
    frozen: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)  # what was chosen
    _blocks: dict = field(default_factory=dict, repr=False)

    @property
    def newton(self) -> bool:
        """Whether Gauss-Newton steps are made: for layers through T, without grids of detail."""
        if not self.representation.models_edit or self.renderer.transport is None:
            return False
        return self.settings.optimizer.kind != "adam" and len(self.representation.gain.sizes) == LEVELS

    @property
    def crop(self) -> np.ndarray:
        """The active rows of the map, (rows, W, 3)."""
        return self.original[self.rows.slice]

    def decode(self, params: Params) -> np.ndarray:
        """Parameters to a whole map on the host, refusing what is not finite."""
        crop = self.representation.decode(params).numpy()
        if self.free is not None:
            crop = np.where(self.free[..., None], crop, self.crop)
        if (bad := ~np.isfinite(crop)).any():
            where = place_of(bad, self.rows.first)
            remedy = "scale the map down" if self.newton else "lower [optimizer] lr"
            raise NumericalError(f"the edited map is not finite at {where}: {remedy}")
        edited = self.original.copy()
        edited[self.rows.slice] = crop
        return unseen_kept(self.original, edited) if self.representation.models_edit else edited

    def problem(self, transport: LightTransport | None = None) -> Problem:
        """Return what is minimised through T, by default the renderer's."""
        traced = transport or self.renderer.transport
        recording = traced.forward
        if recording not in self._blocks:
            shape = self.original.shape[:2]
            self._blocks = {recording: block_jacobian.BlockJacobian(self.representation, traced, shape)}
        target = self.target
        expected = prior.Prior()
        if target.painted:
            expected = prior.of_paint(self.settings.solve.freedom, target.coverage)
        return Problem(
            self.representation,
            traced,
            self.original,
            target.aim,
            Likelihood.of_target(target),
            expected,
            saturates=not target.painted,
            blocks=self._blocks[recording],
            photo=target.photo,
            clipped=target.clipped,
        )
