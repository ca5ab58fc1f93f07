"""An edit and its two ways to be solved: Gauss-Newton for layers through T, Adam for all else."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from envedit.core.types import Params
from envedit.solve import adam_loop, adam_solver
from envedit.solve.edit_state import EditState
from envedit.solve.layers_solver import LayersSolver


@dataclass
class Job(EditState):
    """One edit in progress, with its solvers."""

    @cached_property
    def layers(self) -> LayersSolver:
        """Solver of layers; also finds where Adam starts, if their detail is left to it."""
        return LayersSolver(self)

    def optimise(self, params: Params, crop: np.ndarray, resume: bool) -> tuple[Params, adam_loop.State]:
        """Optimise from the start, or from the checkpoint; returns parameters and state.

        Parameters and errors are those of :func:`.adam_solver.optimise` and :meth:`.LayersSolver.optimise`.
        """
        if self.newton:
            return self.layers.optimise(params, resume)
        return adam_solver.optimise(self, params, crop, resume)
