"""The map that follows what is painted: what is painted on, the paint, and the solution towards it.

While strokes change, the present solution goes on: Gauss-Newton steps from where it is, towards the new
target, which is painted on T E_0.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from envedit import config
from envedit.cli.paint.protocol import Document
from envedit.core.arrays import tensor
from envedit.core.color import tonemap
from envedit.core.rows import Rows
from envedit.losses import metrics
from envedit.representations.choice import layers_of
from envedit.representations.layers import below_horizon
from envedit.representations.layers.oriented import oriented, oriented_share
from envedit.representations.layers.placed_lights import PlacedLights
from envedit.representations.layers.unseen import unseen_kept
from envedit.scene.scene import Scene
from envedit.solve import gauss_newton, hold, map_problem, prior, search
from envedit.solve.likelihood import Likelihood
from envedit.targets import strokes
from envedit.targets.pixel_weights import first_hold, hidden_pixels, pixel_weight
from envedit.targets.target import painted_strokes
from envedit.transport.light_transport import LightTransport

COLUMNS = 32
"""Most exact columns of T that a new map to be painted on gets at once."""


LEAST_CHANGE = 0.5 / 255
"""Change of a display value below which a stroke asks for nothing. Derived: no 8-bit value changes."""


@dataclass(frozen=True)
class Request:
    """What was painted.

    ``base`` and ``target`` (h, w, 3), linear radiance, are what was painted on, and what was asked for;
    ``coverage`` (h, w, 1) is how much each pixel was painted, 0 of those that do not count.
    """

    base: np.ndarray
    target: np.ndarray
    coverage: np.ndarray

    def reached(self, rendering: np.ndarray) -> float:
        """Return the share of the painted change that a rendering has made; 1 where nothing is asked."""
        towards = metrics.painted(rendering, self.target, self.base, self.coverage)["towards"]
        return 1.0 if towards is None else towards

    def of_stroke(self, picture: np.ndarray, cover: np.ndarray) -> float:
        """Return the share of one stroke's change that a picture has, by its coverage (h, w, 1)."""
        asked = (cover * np.abs(tonemap(self.target) - tonemap(self.base))).sum(dtype=np.float64)
        left = (cover * np.abs(tonemap(self.target) - tonemap(picture))).sum(dtype=np.float64)
        return float(np.clip(1 - left / asked, 0, 1)) if asked > 0 else 1.0


class Solution:
    """What is painted on, what is painted, and the solution.

    ``settings`` are of the project, ``scene`` is at the size at which paint is solved, ``placed`` are the
    map's lights, placed by hand, ``transport`` is T, ``rows`` may change.

    ``origin`` (H, W, 3) is the map that is painted on, ``base`` (h, w, 3) its rendering T E_0, and ``kept``
    (H, W) how far texels of it stay as they are, or None. ``target`` (h, w, 3) is the painted picture, and
    ``coverage`` (h, w, 1) how much each pixel was painted; without paint the base, and None. ``still`` is the
    state of the map as it is, ``run`` and ``point`` are the solution. ``searched`` says whether other lights
    were looked for; of the ``explanations`` of the paint, the one of index ``chosen`` is gone on with.
    """

    def __init__(
        self,
        settings: config.Config,
        scene: Scene,
        placed: PlacedLights,
        transport: LightTransport,
        rows: Rows,
    ):
        self.settings, self.scene, self.placed = settings, scene, placed
        self.transport, self.rows = transport, rows
        self.document = Document()
        self.explanations: list[search.Explanation] = []
        self._hidden = hidden_pixels(scene)

    # ---- what is painted on --------------------------------------------------------------------------------

    def aim(self, document: Document) -> None:
        """Take lights, regions and orientation of a document for the map that is painted on, and paint."""
        given = self.settings.input
        changed = self.placed.by_hand(document.lights, document.regions)
        self.origin = oriented(changed.envmap, document.orientation)
        locked = None if changed.locked is None else oriented(changed.locked, document.orientation)
        self.kept = None if changed.kept is None else oriented_share(changed.kept, document.orientation)
        layers = layers_of(
            self.origin[self.rows.slice],
            self.settings,
            self.rows.place,
            horizon=below_horizon.treatment(given.horizon, given.rows, self.origin),
            fixed=None if locked is None else locked[self.rows.slice],
            kept=None if self.kept is None else self.kept[self.rows.slice],
        )
        transport = self.transport.resolved(self.origin, limit=COLUMNS)
        self.base = transport.apply(tensor(self.origin)).numpy()
        self.problem = map_problem.Problem(layers, transport, self.origin, self.base)
        self.still = self.problem.state(layers.start())
        self._start_anew()
        self._painted: tuple[list, strokes.Painted] | None = None
        self.paint(document)

    # ---- paint ---------------------------------------------------------------------------------------------

    def paint(self, document: Document) -> None:
        """Paint the strokes of a document, and aim the solution at them."""
        self.document, self.searched = document, False
        self.explanations, self.chosen = [], 0
        self.hold = first_hold(self.asked_settings)
        painted = self._after(list(document.strokes))
        coverage = None if painted is None else np.where(self._hidden[..., None], 0, painted.coverage)
        self.solving = bool(coverage is not None and coverage.any())
        if not self.solving:
            self._start_anew()
            self.target, self.coverage = self.base, None
            return
        self.target, self.coverage = painted.picture, coverage
        self._weigh()

    def _start_anew(self):
        """Go back to the map as it is."""
        self.start = self.still
        self.run = gauss_newton.Run(self.start, self.start)
        self.point = self.problem.evaluate(self.start, resolve=False)

    @property
    def asked_settings(self) -> config.Config:
        """The configuration, with what the document says of the rest."""
        return replace(self.settings, target=replace(self.settings.target, rest=self.document.rest))

    @property
    def request(self) -> Request:
        """What was painted, and on what."""
        return Request(self.base, self.target, self.coverage)

    def coverages(self) -> list[np.ndarray]:
        """Return how much each pixel is painted by each stroke, were it alone: 0 by one that asks nothing."""
        before, found = self.base, []
        for stroke in self.document.strokes:
            made = self._on_views(replace(self._bare, picture=before), [stroke])
            changed = np.abs(tonemap(made.picture) - tonemap(before)).max() > LEAST_CHANGE
            found.append(made.coverage * changed)
            before = made.picture
        return found

    def likelihood(self, hold_weight: float) -> tuple[np.ndarray, Likelihood]:
        """Return the weight of pixels where those without paint have one, and the likelihood of the paint."""
        weight = pixel_weight(self.coverage, self._hidden, self.settings.target.paint, hold_weight)
        return weight, Likelihood.of_paint(weight, self.coverage, self.base, self.target)

    def _weigh(self):
        """Aim the solution at the paint, with the present weight of what was not painted."""
        self.weight, likelihood = self.likelihood(self.hold)
        self.problem.expect(prior.of_paint(self.document.freedom, self.coverage))
        self.point = self.problem.aimed_at(self.target, likelihood, self.point)
        self.run = gauss_newton.Run(self.run.state, self.start, columns=self.run.columns)

    @property
    def _bare(self):
        """The picture that is painted on, without any paint."""
        return strokes.Painted(self.base, np.zeros((*self.base.shape[:2], 1), np.float32))

    def _after(self, painted):
        """Paint strokes; all but the last as they were painted before, where they are the same."""
        if not painted:
            return None
        first = painted[:-1]
        if self._painted is None or self._painted[0] != first:
            self._painted = first, self._on_views(self._bare, first)
        return self._on_views(self._painted[1], painted[-1:])

    def _on_views(self, before, painted):
        """Paint strokes, each on its view, over what was painted before."""
        tonemap_name = self.settings.target.display_tonemap
        made = painted_strokes(self.scene, before.picture, painted, tonemap_name)
        return replace(made, coverage=1 - (1 - before.coverage) * (1 - made.coverage))

    # ---- steps ---------------------------------------------------------------------------------------------

    @property
    def edited(self) -> np.ndarray:
        """The solution's map (H, W, 3)."""
        return unseen_kept(self.origin, self.point.edited)

    @property
    def converged(self) -> bool:
        """Whether no further step is made towards what is painted."""
        return not self.solving or self.run.finished or len(self.run.history) >= gauss_newton.MOST_STEPS

    def step(self) -> None:
        """Make a Gauss-Newton step."""
        self.point = gauss_newton.descended(self.problem, self.run, self.point)

    def search(self, unless_newer: Callable[[], None]) -> None:
        """Ask whether another start leads further, as the pipeline does.

        A light that jumps, or that is added, is where no small step leads. ``unless_newer`` is called now and
        then; what it raises ends the search.
        """
        now = search.Explanation({}, self.run, self.point, search.score(self.problem, self.run, self.point))
        left = now if self.start is self.still else None
        found = search.search(self.problem, self.still, after_step=unless_newer, left=left)
        self.searched = True
        if found.score < now.score:
            self.run, self.start, self.point = found.run, found.run.start, found.point
        if found.others:
            self.explanations = [replace(found, run=self.run, point=self.point), *found.others]
            self.chosen = 0

    def hold_more(self) -> bool:
        """Give more weight to what was not painted, if it has changed visibly, as an edit does."""
        changed = hold.change(self.point.rendering, self.target, self.coverage, self.weight)
        more = hold.further(self.asked_settings.target, self.hold, changed)
        if more is None:
            return False
        self.hold = more
        self._weigh()
        return True

    def choose(self, index: int) -> None:
        """Go on from another explanation of the paint; that which is shown stays among them."""
        shown = self.explanations[self.chosen]
        self.explanations[self.chosen] = replace(shown, run=self.run, point=self.point)
        other = self.explanations[index].run
        self.chosen, self.start = index, other.start
        self.run = gauss_newton.Run(other.state, other.start, columns=other.columns)
        self.point = gauss_newton.reached(self.problem, self.run)

    def go_on_from(self, run: gauss_newton.Run) -> None:
        """Take a solution that was saved."""
        self.point = gauss_newton.reached(self.problem, run)
        self.run, self.start, self.searched = run, run.start, True
        if run.hold > 1:
            self.hold = run.hold
        self._weigh()

    @contextlib.contextmanager
    def as_held_first(self) -> Iterator[map_problem.Problem]:
        """Give the problem with the first weight of what was not painted, where lights are to be placed."""
        held = self.problem.likelihood
        _, likelihood = self.likelihood(first_hold(self.asked_settings))
        self.problem.aimed_at(self.target, likelihood, self.point)
        try:
            yield self.problem
        finally:
            self.point = self.problem.aimed_at(self.target, held, self.point)
