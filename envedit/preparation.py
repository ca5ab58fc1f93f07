"""From a configuration's map, scene and target to an edit that can be optimised.

The sky may be turned as a whole first (``solve/turning.py``); lights are then separated from the background,
or a network is fitted, and it is found out where the edit starts.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from envedit import config, renderers, representations
from envedit.core import latlong
from envedit.core.errors import NumericalError
from envedit.core.rows import Rows
from envedit.core.seeds import Seeds
from envedit.losses.perceptual import distances
from envedit.representations.layers import below_horizon
from envedit.representations.layers.lights import SPARE
from envedit.representations.siren import fit
from envedit.scene import scene
from envedit.scene.renderings import rendered
from envedit.solve import initialization, map_problem, turning
from envedit.solve.edit_job import Job, Watch
from envedit.targets.target import Target

TURNED, CLOSER = 0.5, 0.8
"""A turn is considered if it leaves at most the first share of the residual, or if it leaves at most the
second share and only noise."""
TO_NOISE, DOUBTFUL = 1.25, 4.0
"""Residual of a map over that of T against Mitsuba's rendering of the same map up to which nothing is left to
explain (renderings of one map differ by 0.5 to 1.1 of it on four scenes, under a light 5 % brighter by 1.7
and more); and up to which the turned map is rendered to ask, as T's errors depend on where the sun stands."""
NOISIEST, QUIET = 0.03, 0.008
"""Display residual of T above which it is not used as the noise level (four scenes: at most 0.016), and the
level used instead."""
CHECKED_SPP = 256
"""Samples a pixel of these renderings."""
PREFERRED = 0.05
"""The unturned sky is chosen only if its residual is smaller by this share: a turn adds no content."""


@dataclass(frozen=True)
class Edit:
    """An edit that is ready to be optimised.

    Attributes
    ----------
    job : Job
        With the map, turned, as its original.
    params : dict
        Where it starts.
    crop : ndarray (rows, W, 3)
        Active rows of that map.
    degrees : float
        By how much it has been turned.
    frozen : ndarray of bool (H, W) or None
        Active texels that keep their value; None where the renderer does not know.
    notes : list of str
        What was chosen.
    """

    job: Job
    params: dict
    crop: np.ndarray
    degrees: float
    frozen: np.ndarray | None
    notes: list[str]


@dataclass
class Preparation:
    """What edits of one configuration have in common.

    Attributes
    ----------
    settings : config.Config
        What is to be done.
    lit : scene.Scene
        The scene.
    original : ndarray (H, W, 3)
        The map.
    rows : Rows
        Its active rows.
    folder : Path, optional
        Of the checkpoint.
    watch : Watch
        Receives progress.
    dists : distances.Dists, optional
        As for :class:`.edit_job.Job`.
    clock : callable
        ``with clock(name):`` adds up seconds.
    """

    settings: config.Config
    lit: scene.Scene
    original: np.ndarray
    rows: Rows
    folder: Path | None
    watch: Watch
    dists: distances.Dists | None
    clock: Callable[[str], AbstractContextManager]
    renderer: renderers.Renderer | None = None
    _recordings: initialization.Recordings | None = None

    def trace(self) -> None:
        """Trace the light transport, or prepare the path tracer."""
        with self.clock("transport_s"):
            stored = self.settings.renderer.kind == "transport"
            self.watch.stage("tracing light transport" if stored else "preparing the path tracer")
            shape = self.original.shape[:2]
            self.renderer = renderers.make(self.settings, self.lit, shape, self._count)

    def detailed(self, target: Target) -> bool:
        """Whether the target determines detail of the sky, as a mirror's does: finer grids than usual."""
        if self.settings.representation.kind != "layers" or self._started_before:
            return False
        with self.clock("fit_s"):
            representation: Any = representations.make(
                self.settings, fit.default_folder(), None, self.rows.place, self._horizon()
            )
            representation.encode(self.original[self.rows.slice], self.settings.seed)
        with self.clock("transport_s"):
            found = self._recorded(representation, target)
        return bool(found and found.octaves)

    def edit(self, target: Target) -> Edit:
        """Prepare the edit; the sky is turned where that explains the target better.

        One that goes on from a solution on disk is of the map and the layers as they are.
        """
        if self._started_before:
            edit = self._prepared(target, 0.0, [], search=False, ask=False)
            edit.job.go_on_from(self.settings.optimizer.start, edit.params)
            return edit
        turn, settings = self._turn(target), self.settings
        idle = replace(self, settings=replace(settings, optimizer=replace(settings.optimizer, iterations=0)))
        known = self._noise(target, turn)
        noise = known or 0.0
        worth = (
            turn is not None
            and turn.degrees != 0
            and (
                settings.representation.turn is True
                or turn.error < TURNED * turn.still
                or turn.error < min(TO_NOISE * noise, CLOSER * turn.still)
            )
        )
        if not worth:
            if known is not None and self._still(turn, target) <= TO_NOISE * noise:
                said = "nothing changed: the map already renders to the target within noise"
                said += f" (display residual of the stored transport {noise:.4f})"
                return idle._prepared(target, 0.0, [said], search=False, ask=False)
            return self._prepared(target, 0.0, [])
        said = f"sky turned by {turn.degrees:.2f} degrees"
        said += f": display residual {turn.still:.4f} -> {turn.error:.4f}"
        if self._explained(turn, noise, target.weight):
            said += "; the rest is noise, nothing else changed"
            return idle._prepared(target, turn.degrees, [said], search=False, ask=False)
        turned = self._prepared(target, turn.degrees, [said], search=False)
        if settings.representation.turn is True or not turned.job.newton:
            return turned
        still = self._prepared(target, 0.0, [])
        with self.clock("start_s"):
            self.watch.stage("comparing the edits of the turned and of the unturned sky")
            loss, other = _loss(turned), _loss(still)
        chosen = still if other < loss - 6 * map_problem.INDEPENDENT * np.log1p(PREFERRED) else turned
        chosen.notes.append(
            f"Akaike criterion (lower is better): {loss:.5g} with the sky turned, {other:.5g} without"
        )
        return chosen

    @property
    def _started_before(self):
        """Whether a solution on disk is what Gauss-Newton steps go on from."""
        chosen, stored = self.settings.optimizer, self.settings.renderer.kind == "transport"
        layers = self.settings.representation.kind == "layers"
        return bool(chosen.start) and chosen.kind != "adam" and layers and stored

    def _turn(self, target):
        """Return the turn that explains the target best; None where the sky is not to turn."""
        asked, transport = self.settings.representation.turn, self.renderer.transport
        if asked is False or transport is None or not self.rows.all:
            return None
        if asked == "auto" and target.coverage is not None:  # most of a painted picture is to stay
            return None
        with self.clock("start_s"):
            self.watch.stage("testing turns of the sky")
            seen = self.original, target.picture, target.weight
            return turning.find(transport, *seen, thorough=asked is True)

    def _noise(self, target, turn):
        """Return the residual of T against Mitsuba's rendering of the map; None where an edit is made anyway.

        That is where the target is painted, where nothing is left as it is (a network is no exact copy), and
        where neither the map nor its turn come near the target.
        """
        transport = self.renderer.transport
        if self.settings.representation.kind != "layers" or transport is None or target.coverage is not None:
            return None
        with self.clock("start_s"):
            cache, seed = self.settings.renderer.cache, Seeds.of(self.settings.seed).turn_check
            shown, _, _ = rendered(self.lit, self.original, CHECKED_SPP, seed, cache)
            near = turning.apart(shown, target.picture, target.weight) < 2 * TO_NOISE * NOISIEST
            if not near and (turn is None or turn.error > DOUBTFUL * NOISIEST):
                return None
            found = turning.residual(transport, self.original, shown, target.weight)
        return found if found <= NOISIEST else QUIET

    def _still(self, turn, target):
        """Return the residual of the map as it is."""
        if turn is not None:
            return turn.still
        with self.clock("start_s"):
            return turning.residual(self.renderer.transport, self.original, target.picture, target.weight)

    def _explained(self, turn, noise, weight):
        """Whether the turn alone gives the target, to the noise."""
        if not DOUBTFUL * noise > turn.error > TO_NOISE * noise:
            return turn.error <= TO_NOISE * noise
        with self.clock("start_s"):
            turned = latlong.rotate(self.original, turn.degrees)
            shown = self.lit.render(turned, CHECKED_SPP, Seeds.of(self.settings.seed).turn_check)
            asked = self.renderer.transport, turned, shown, weight
            return turn.error <= TO_NOISE * turning.residual(*asked)

    def _prepared(self, target, degrees, notes, search=True, ask=True):
        """Prepare the edit of the turned map; ``ask``: how fine its gain may be."""
        settings = self.settings
        original = latlong.rotate(self.original, degrees)
        rows = self.rows.slice
        crop, notes = original[rows], list(notes)
        with self.clock("fit_s"):
            kind = settings.representation.kind
            self.watch.stage("separating lights" if kind == "layers" else f"fitting ({kind})")
            horizon = self._horizon()
            representation: Any = representations.make(
                settings,
                fit.default_folder(),
                lambda done, total, loss: self.watch.progress(done, total, f"loss {loss:.4g}"),
                self.rows.place,
                horizon,
            )
            params = representation.encode(crop, settings.seed)
            if kind == "layers" and representation.below is not None:
                notes.append(f"rows below the horizon {representation.below.said}")
        with self.clock("transport_s"):
            recordings = self._recorded(representation, target) if ask else None
        traced = self.renderer.transport
        job = Job(
            settings=settings,
            lit=self.lit,
            original=original,
            first=self.rows.first,
            free=None,
            target=target,
            representation=representation,
            renderer=self.renderer,
            folder=self.folder,
            watch=self.watch,
            dists=self.dists,
        )
        frozen, smooth = None, None
        if recordings:
            if recordings.octaves and search and traced and job.newton:
                smooth = self._smooth(job, params, recordings, crop)
            params = representation.refine(params, recordings.octaves)
        if traced:
            frozen = np.zeros(original.shape[:2], bool)
            if not job.newton:  # its prior holds what the picture does not determine
                known = traced.determined(rows, settings.renderer.influence_threshold)
                frozen[rows] = ~known[rows]
            job.free = ~frozen[rows] if frozen.any() else None
        if recordings:
            params, found = self._started(job, params, recordings, crop, search, smooth)
            notes += found
        return Edit(job, params, crop, degrees, frozen, notes)

    def _recorded(self, representation, target):
        """Return what is looked through for where layers start; None for what is fitted."""
        if not representation.models_edit:
            return None
        if self._recordings is None:
            shape, traced = self.original.shape[:2], self.renderer.transport
            asked = self.settings, self.lit, shape, representation, target, traced, self._count
            self._recordings = initialization.recordings(*asked)
            if traced:
                self.renderer = self._recordings.transport
        return self._recordings

    def _smooth(self, job, params, recordings, crop):
        """Solve by Gauss-Newton for lights and coarse grids, where finer grids go on; None if it fails."""
        with self.clock("start_s"):
            self.watch.stage("solving for lights and coarse gain")
            alone = replace(recordings, octaves=[])
            found = initialization.find(
                job.representation, params, alone, job.target, job.original, only_own=True
            )
            try:
                return job.solved(job.best(found.starts, crop)[0])
            except NumericalError:  # a start that goes nowhere is no reason to stop
                return None

    def _started(self, job, params, recordings, crop, search, smooth=None):
        """Find where layers start, or from the ``smooth`` solution; without a search, from what is there."""
        with self.clock("start_s"):
            job.representation.keep(job.free)
            job.free = None  # the gain keeps to them, while a light may move across the others
            if not search:
                return params, recordings.notes
            self.watch.stage("searching for lights")
            asked = job.representation, params, recordings, job.target, job.original
            ready = initialization.find(*asked, only_own=job.newton)
            job.target = ready.target
            if smooth is not None:
                # What ground is lit by from elsewhere makes up for what coarse grids cannot show.
                kept = {name: value for name, value in smooth.items() if name != "ground"}
                said = ["lights and coarse gain solved for by Gauss-Newton"]
                ready.starts.insert(0, (params | kept, said))
            params, placed = job.best(ready.starts, crop)
            return params, ready.notes + placed

    def _horizon(self):
        """Return what the rows below the horizon do."""
        given = self.settings.input
        if self.settings.representation.kind != "layers":
            return "free"
        return below_horizon.treatment(given.horizon, given.rows, self.original)

    def _count(self, done, total):
        self.watch.progress(done, total, "")


def _loss(edit: Edit) -> float:
    """Return the loss where an edit ends, with every light that it adds; inf if it cannot begin."""
    try:
        return edit.job.tried(edit.params, edit.crop, SPARE, ended=True)
    except NumericalError:
        return np.inf
