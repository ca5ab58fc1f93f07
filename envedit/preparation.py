"""From a configuration's map, scene and target to an edit that can be optimised.

The sky may be turned as a whole first (``solve/turning.py``); lights are then separated from the background,
or a network is fitted, and it is found out where the edit starts.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from envedit import config, renderers, representations
from envedit.core import latlong, resampling
from envedit.core.array_cache import cache_folder
from envedit.core.errors import NumericalError
from envedit.core.rows import Rows
from envedit.core.seeds import Seeds
from envedit.images import map_regions
from envedit.inputs import InputMap
from envedit.losses.perceptual import distances
from envedit.representations.layers import below_horizon
from envedit.representations.siren.siren import Siren
from envedit.scene.renderings import rendered
from envedit.scene.scene import Scene
from envedit.solve import initialization, sky_factor, turning
from envedit.solve.edit_state import EditState, Watch
from envedit.solve.layers_solver import LayersSolver
from envedit.solve.likelihood import INDEPENDENT, sizes
from envedit.solve.search import STRONG_EVIDENCE
from envedit.targets.target import Target

TO_NOISE = 1.25
"""Residual of a map's rendering over that of a second one of the same map up to which the map explains the
target. Between renderings of one map the ratio is 1, with a standard error of 0.06 in 256 areas."""
TURN_PATHS = 2**20
"""Paths of a rendering that is compared to find a turn, all pixels together, up to a factor of two; at most
as many as the target's."""


@dataclass
class Preparation:
    """What edits of one configuration have in common."""

    settings: config.Config  # what is to be done
    scene: Scene  # what is lit
    map: InputMap  # what is edited; where it is locked or kept, the sky is not turned
    rows: Rows  # its active rows
    watch: Watch  # receives progress
    dists: distances.Dists | None  # as for :class:`.edit_state.EditState`
    clock: Callable[[str], AbstractContextManager]  # ``with clock(name):`` adds up seconds
    renderer: renderers.Renderer | None = None  # once :meth:`traced` has made it
    _recordings: initialization.Recordings | None = None

    @property
    def original(self) -> np.ndarray:
        """The map's radiance, (H, W, 3)."""
        return self.map.radiance

    def traced(self) -> Self:
        """Trace the light transport, or prepare the path tracer."""
        with self.clock("transport_s"):
            stored = self.settings.renderer.kind == "transport"
            self.watch.stage("tracing light transport" if stored else "preparing the path tracer")
            shape = self.original.shape[:2]
            self.renderer = renderers.make(self.settings, self.scene, shape, self._count)
        return self

    def detailed(self, target: Target) -> bool:
        """Whether the target determines detail of the sky, as a mirror's does: finer grids than usual."""
        if self.settings.representation.kind != "layers" or self._started_before:
            return False
        with self.clock("fit_s"):
            representation, _ = self._encoded(self.original[self.rows.slice])
        with self.clock("transport_s"):
            return bool(self._recorded(representation, target).octaves)

    def edit(self, target: Target) -> LayersSolver:
        """Prepare the edit; the sky is turned where that explains the target better.

        One that goes on from a solution on disk is of the map and the layers as they are.
        """
        if self._started_before:
            solver = self._prepared(target, 0.0, [], search=False)
            solver.go_on_from(self.settings.optimizer.start)
            return solver
        # ---- Maps that explain the target to its noise are taken as they are
        if self._explains(self.original, target):
            note = "nothing changed: the map already renders to the target within noise"
            return self._idle(target, 0.0, note)
        turn = self._turn(target)
        if turn is None or turn.degrees == 0:
            return self._prepared(target, 0.0, [])
        note = f"sky turned by {turn.degrees:.2f} degrees"
        note += f": display residual {turn.still:.4f} -> {turn.error:.4f}"
        if self._explains(latlong.rotate(self.original, turn.degrees), target):
            return self._idle(target, turn.degrees, f"{note}; the rest is noise, nothing else changed")

        # ---- Edits of the turned and of the unturned map
        always = self.settings.representation.turn is True
        if not always and turn.left >= turning.EXPLAINED:
            return self._prepared(target, 0.0, [])
        turned = self._prepared(target, turn.degrees, [note])
        if always or turned.begun is None:
            return turned
        still = self._prepared(target, 0.0, [])
        with self.clock("start_s"):
            self.watch.stage("comparing the edits of the turned and of the unturned sky")
            score, other = (one.settle() for one in (turned, still))
        # The map has as many turns as columns, each of which could have been the best: the mean likelihood
        # of all counts.
        score += 2 * np.log(self.original.shape[1] / turn.alike)
        chosen = still if other < score - STRONG_EVIDENCE else turned
        chosen.edit.notes.append(
            f"-2 log evidence (lower is likelier): {score:.5g} with the sky turned, {other:.5g} without"
        )
        return chosen

    @property
    def _started_before(self):
        """Whether a solution on disk is what Gauss-Newton steps go on from."""
        return bool(self.settings.optimizer.start) and self.settings.newton

    def _turn(self, target):
        """Return the turn that explains the target best; None where the sky is not to turn."""
        chosen, transport = self.settings.representation.turn, self.renderer.transport
        if chosen is False or transport is None or not self.rows.all:
            return None
        if self.map.locked is not None or self.map.kept is not None:
            return None
        if chosen == "auto" and target.painted:  # most of a painted picture is to stay
            return None
        with self.clock("start_s"):
            self.watch.stage("testing turns of the sky")
            seeds = Seeds(self.settings.seed)
            drawn = seeds.turn_check, seeds.target_again
            # A power of four, for as many strata across as down.
            spp = 4 ** (max(1, TURN_PATHS // (self.scene.width * self.scene.height)).bit_length() // 2)
            known = target.spp is not None and target.envmap is not None
            spp = min(spp, target.spp) if known else spp
            return turning.find(
                transport,
                lambda envmap, k: self.scene.render(envmap, spp, drawn[k]),
                self.original,
                target.picture,
                target.known_weight,
                thorough=chosen is True,
            )

    def _explains(self, envmap, target):
        """Whether a map gives the target, to the noise of a rendering with as many samples.

        Residuals of pixels and of areas are compared with those between two renderings of the map.
        """
        if target.spp is None:  # painted
            return False
        seeds = Seeds(self.settings.seed)
        with self.clock("target_s"):
            shown = self._shown(envmap, target, seeds.turn_check)
            misfits = _misfits(shown, target.picture, target.known_weight)
            # A mean of n values in [0, 1] has a standard error of at most 1 / (2 sqrt(n)).
            if misfits[0] > (2 * target.spp) ** -0.5:
                return False
            again = self._shown(envmap, target, seeds.target_again)
            noise = _misfits(shown, again, target.known_weight)
            return all(misfit <= TO_NOISE * least for misfit, least in zip(misfits, noise, strict=True))

    def _shown(self, envmap, target, seed):
        """Render a map with as many samples as the target had."""
        spp = "auto" if self.settings.target.spp == "auto" else target.spp
        return rendered(self.scene, envmap, spp, seed, self.settings.renderer.cache, target.spp)[0]

    def _idle(self, target, degrees, note):
        """Prepare an edit that leaves the turned map as it is, whatever the representation asked for."""
        settings = replace(
            self.settings,
            representation=replace(self.settings.representation, kind="layers"),
            optimizer=replace(self.settings.optimizer, iterations=0),
        )
        return replace(self, settings=settings)._prepared(target, degrees, [note], search=False)

    def _prepared(self, target, degrees, notes, search=True):
        """Prepare the edit of the turned map; ``search``: for lights, and for how fine its gain may be."""
        settings, rows = self.settings, self.rows.slice
        original = latlong.rotate(self.original, degrees)
        crop = original[rows]

        # ---- The representation of the map
        with self.clock("fit_s"):
            kind = settings.representation.kind
            self.watch.stage("separating lights" if kind == "layers" else f"fitting ({kind})")
            representation, params = self._encoded(crop)
            if kind == "layers" and representation.below is not None:
                notes.append(f"rows below the horizon {representation.below.said}")
        with self.clock("transport_s"):
            recordings = self._recorded(representation, target) if search else None
        octaves = recordings.octaves if recordings else []
        job = EditState(
            settings=settings,
            scene=self.scene,
            original=original,
            rows=self.rows,
            free=None,
            target=target,
            representation=representation,
            renderer=self.renderer,
            watch=self.watch,
            dists=self.dists,
            degrees=degrees,
            notes=notes,
        )
        solver = LayersSolver(job, params)

        # ---- Which lights, and where; which pixels count, and whether coarse grids are not enough
        if recordings and (settings.optimizer.iterations or not job.newton):
            with self.clock("start_s"):
                run = self._explained(solver, octaves, recordings.transport)
            if octaves:
                octaves = self._finer(solver, recordings)
                solver.coarse = not octaves
            if job.newton and not octaves:
                solver.begun = run

        # ---- Which texels keep their value
        job.frozen = self._frozen(determined=bool(octaves) or not job.newton)
        if job.frozen is not None and job.frozen.any():
            job.free = ~job.frozen[rows]
        if self.map.kept is not None and kind != "layers":  # which know it themselves
            open_texels = self.map.kept[rows] < map_regions.KEPT_SHARE
            job.free = open_texels if job.free is None else job.free & open_texels

        # ---- How bright the sky of a network begins
        if isinstance(representation, Siren):
            notes += self._brightened(representation, original, job.free, target)

        # ---- Finer grids
        if recordings:
            job.representation = representation.keeping(job.free)
            job.free = None  # the gain keeps to them, while a light may move across the others
            notes += recordings.notes
        if octaves:
            job.representation = job.representation.refined(octaves)
            solver.params = job.representation.start() | solver.params
        return solver

    def _finer(self, solver, recordings):
        """Return the octaves of finer grids that are needed; pixels that do not count for them weigh less."""
        job = solver.edit
        envmap = job.original.copy()
        envmap[job.rows.slice] = job.representation.decode(solver.params).numpy()
        if self._explains(envmap, job.target):
            job.notes.append("coarse grids explain the target to its noise: no finer ones are solved for")
            return []
        job.target, notes = initialization.trusted(envmap, recordings, job.target)
        job.notes += notes
        return recordings.octaves

    def _frozen(self, determined: bool) -> np.ndarray | None:
        """Return which texels keep their value, (H, W); None where no transport is stored.

        Those that the picture does not determine; none for Gauss-Newton, whose prior holds them.
        """
        traced = self.renderer.transport
        if not traced:
            return None
        rows = self.rows.slice
        frozen = np.zeros(self.original.shape[:2], bool)
        if determined:
            frozen[rows] = ~traced.determined(rows, self.settings.renderer.influence_threshold)[rows]
        return frozen

    def _brightened(self, network, original, free, target):
        """Set the factor of a network's sky; returns notes. What was not painted is to stay, and has none."""
        transport = self.renderer.transport
        if transport is None or target.painted or target.photo is not None:
            return []
        active = np.zeros(original.shape[:2], bool)
        active[self.rows.slice] = True if free is None else free
        with self.clock("start_s"):
            network.factor = sky_factor.find(transport, original, active, target.picture, target.known_weight)
        if (network.factor == 1).all():
            return []
        factors = ", ".join(f"{factor:.3g}" for factor in network.factor)
        return [f"the sky begins {factors} (red, green, blue) times as bright"]

    def _encoded(self, crop: np.ndarray) -> tuple[Any, dict]:
        """Return the representation of a map's active rows, and parameters; a fit reports its progress."""
        chosen = self.settings.input
        horizon: below_horizon.Horizon = "free"
        if self.settings.representation.kind == "layers":
            horizon = below_horizon.treatment(chosen.horizon, chosen.rows, self.original)
        return representations.encoded(
            crop,
            self.settings,
            cache_folder("fits"),
            lambda done, total, loss: self.watch.progress(done, total, f"loss {loss:.4g}"),
            self.rows.place,
            horizon,
            None if self.map.locked is None else self.map.locked[self.rows.slice],
            None if self.map.kept is None else self.map.kept[self.rows.slice],
        )

    def _explained(self, solver, octaves, transport):
        """Find the lights that explain the target, and for Adam the sky; returns the run that leads there."""
        self.watch.stage("searching for lights")
        explanation = solver.explain(transport)
        edit = solver.edit
        subject = "the paint" if edit.target.painted else "the target"
        evidence = f"-2 log evidence {explanation.score:.1f}"
        edit.notes.append(f"likeliest explanation of {subject}: {explanation.name} ({evidence})")
        if octaves or not edit.newton:
            self.watch.stage("solving for lights and coarse gain")
            with contextlib.suppress(NumericalError):  # a start that goes nowhere is no reason to stop
                solved = solver.solved(explanation.run, transport)
                # What ground is lit by from elsewhere makes up for what coarse grids cannot show.
                solved.pop("ground", None)
                solver.params = solver.params | solved
        return explanation.run

    def _recorded(self, representation, target):
        """Return what is looked through for where layers start; None for what is fitted."""
        if not representation.models_edit:
            return None
        if self._recordings is None:
            traced = self.renderer.transport
            self._recordings = initialization.recordings(
                self.settings,
                self.scene,
                self.original.shape[:2],
                representation,
                target,
                traced,
                self._count,
            )
            if traced:
                self.renderer.transport = self._recordings.transport
        return self._recordings

    def _count(self, done, total):
        self.watch.progress(done, total, "")


def _misfits(rendering, picture, weight):
    """Return the display residual, mean of its size over pixels and over areas.

    Of areas, as many as residuals are independent, noise is smaller, and a small change of the light is not.
    """
    off = turning.residuals(rendering, picture) * weight / weight.mean(dtype=np.float64)
    height, width, _ = off.shape
    across = math.isqrt(INDEPENDENT)
    parts = off, resampling.fit(off, min(across, height), min(across, width))
    return [float(sizes(part).mean()) for part in parts]
