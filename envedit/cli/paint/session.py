"""One painting: the scene, its transport, the map that follows what is painted, and what pages are shown.

Everything here runs on the thread that owns Dr.Jit. What an edit asks for at once is done by
:meth:`Session.update`; what takes longer, in pieces by :meth:`Session.advance`, until it returns False or a
new edit comes.

The solution (``solution.py``) is towards paint on T E_0, of a large picture on the film on which paint is
solved; pages are shown that of other edits. The edit that is saved is the pipeline's, which takes the
solution here, and judges its result.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from envedit import inputs, pipeline, renderers
from envedit.cli.paint import advice, picking
from envedit.cli.paint.project import MATCHED, SOLUTION, Project
from envedit.cli.paint.protocol import TABLES, Edit, Pick
from envedit.cli.paint.solution import COLUMNS, Solution
from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import brightest_shown, tonemap
from envedit.core.errors import ConfigError, InputError
from envedit.core.seeds import Seeds
from envedit.core.types import Views
from envedit.export import adjustments, file_resolution
from envedit.images import images, map_regions
from envedit.losses import display_curve
from envedit.losses.perceptual import installed
from envedit.report import output_folder, preview, run_folder
from envedit.representations.layers.lights import DARK
from envedit.representations.layers.oriented import oriented
from envedit.representations.layers.placed_lights import PlacedLights, angles
from envedit.scene.scene import Scene
from envedit.solve import checkpoint, feasibility, gauss_newton, search
from envedit.solve.unknowns import with_light
from envedit.targets import working_size

DRAGGED_COLUMNS = 16
"""Most exact columns of T in one frame while a light is dragged, with the fewest paths."""
QUICK_SPP = 32
"""Paths a pixel of the transport that estimates what a dragged light changes: an eighth of the texels'
weights to read in every frame, and its errors cancel where nothing changes."""
SHARPER = 2
"""Pixels of the rendering that is shown when idle, along an axis, for one of the picture that is edited."""
PASS, FIRST_PASSES, PASSES = 16, 4, 16
"""Samples a pixel of one pass of that rendering; passes before feasibility is asked for, and in all."""
MEMORY_EVERY_S = 10.0
"""Seconds of work after which freed buffers are given back: that takes 0.1 s, 1 % of the time."""
SKY_WIDTH = 2048
"""Most texels across of the map that is shown large: more than most displays have."""


class SupersededError(Exception):
    """A newer edit has come: what was going on is given up."""


class Tell:
    """What a session reports; :class:`.server.Hub` sends it to the pages."""

    def frame(self, kind: str, source: str, image: np.ndarray, rows: Views = (slice(None),)) -> None:
        """Show an image (h, w, 3), with the rows of each view in it."""

    def say(self, message: dict) -> None:
        """Send a message."""


def give_back_memory() -> None:
    """Return to the system what Dr.Jit and the C library keep of freed buffers for the next ones.

    Problems that were solved, which hold large arrays, are in reference cycles: they are collected first.
    """
    gc.collect()
    dr.flush_malloc_cache()
    with contextlib.suppress(OSError, AttributeError, TypeError):  # glibc's alone
        ctypes.CDLL(None).malloc_trim(0)


class Session:
    """A painting that is open; ``tell`` receives frames and progress, ``newer`` asks if an edit waits."""

    def __init__(self, project: Project, tell: Tell, newer: Callable[[], bool] = lambda: False):
        # ---- What is edited, and what has come of it
        self.project = project
        self.tell = tell
        self.resting = False
        self.phase = "done"
        self.status: dict[str, Any] = {"iterations": 0, "steps": 0, "number": 0, "client": ""}
        self.reach: feasibility.Reach | None = None  # of what is painted, once it is known
        # As painted.toml has them: what is painted, and the solution of it, "" without one
        self._kept, self._kept_solution = project.document, SOLUTION if project.start else ""
        self._saving: bool = False
        self._dragged = False
        self.newer = lambda: not self._saving and newer()
        self._memory_due = 0.0  # when freed buffers are given back while work goes on
        self._rendered: tuple[int, Any] | None = None  # passes and their sum
        self._shown: np.ndarray | None = None  # the solution's rendering that the pages show
        self._sharp: Scene | None = None
        self._wide: inputs.InputMap | None = None  # the map as it is shown large

        # ---- Scene and map
        settings = project.settings
        if project.photo:
            self._match(project.photo)
        self._stage("loading the scene")
        self.scene, solved_on = self._films(inputs.load_scene(settings.scene, project.base))
        self._stage("reading the map")
        self.given = inputs.read_map(settings.input, self.scene, settings.input.width)
        self.notes = [*filter(None, [project.note]), *self.given.warnings]
        source = Path(settings.input.envmap)
        matched = source.name == MATCHED
        # In the scene's radiance
        self.photograph = images.read(source.with_name("render_target.exr"))[0] if matched else None
        self.map = self.given.radiance
        self.rows = inputs.active_rows(settings.input.rows, len(self.map))

        # ---- Light transport, that of fewer pixels to solve with, and of fewer samples while a pointer moves
        renderers.check(settings, self.scene, self.map.shape[:2])
        self._stage("tracing light transport")
        self.transport = self._traced(settings, self.scene)
        small = self.transport if solved_on is self.scene else self._traced(settings, solved_on)
        self._quick = self._of_fewer_samples()
        self._recorded = self._quick is self.transport

        # ---- Lights, and the rendering as it is
        self._stage("separating lights")
        self.placed = PlacedLights(self.map, settings.input.horizon)
        self.picking = picking.Picking(self.scene, self.placed, self.transport, self.rows)
        self.before = self.transport.apply(tensor(self.map)).numpy()

        # ---- What solves for an edit
        self.solution = Solution(settings, solved_on, self.placed, small, self.rows)
        # What is painted, with a stroke that is being drawn or a light that is being dragged, and without
        self.document = self.finished = self._usable(project.document)
        self._aim(self.document)
        if project.start and self.solving:
            self._go_on_from(project.start)

    def _of_fewer_samples(self):
        """Return a transport of at most :data:`QUICK_SPP` samples a pixel."""
        settings = self.project.settings
        if self.transport.spp <= QUICK_SPP:
            return self.transport
        return self._traced(replace(settings, renderer=replace(settings.renderer, spp=QUICK_SPP)), self.scene)

    def _traced(self, settings, scene):
        """Return the transport of a scene, with columns of the map as it is."""
        traced = renderers.trace(settings, scene, self.map.shape[:2], self._progress)
        return traced.resolved(self.map, limit=COLUMNS)

    def _usable(self, document):
        """Return a document without the strokes on views that the scene has not, each with a note."""
        kept = []
        for i, stroke in enumerate(document.strokes):
            try:
                self.scene.view(stroke.get("view", 0), f"target.strokes[{i}].view")
            except ConfigError as error:
                self.notes = [*self.notes, f"{error}: the stroke is left out"]
            else:
                kept.append(stroke)
        return replace(document, strokes=tuple(kept))

    @property
    def exposure(self) -> float:
        """Stops that show most pixels below white (:func:`.brightest_shown`), in quarters; 0 on black."""
        bright = brightest_shown(self.before)
        return float(np.clip(np.round(-4 * np.log2(bright)) / 4, -8, 8)) if bright > 0 else 0.0

    # ---- edits ---------------------------------------------------------------------------------------------

    def update(self, edit: Edit) -> None:
        """Take a document: paint, move lights, and show what is known at once.

        One that cannot be painted or shown is refused: the last that was finished stays, and pages get it
        back.
        """
        began = time.perf_counter()
        before, self.document = self.document, edit.document
        moved = before.placing != edit.document.placing
        # What is feasible under any map does not depend on how far this one may go.
        reach = self.reach if replace(before, freedom=edit.document.freedom) == edit.document else None
        self.phase, self._rendered, self.resting = edit.phase, None, False
        whose = {"steps": self.status["steps"], "number": edit.number, "client": edit.client}
        self.status = {"iterations": 0, **whose}
        try:
            if edit.phase == "dragging":
                self._drag()
            elif moved or self._dragged:
                self._aim(edit.document)
            elif edit.document.solved_as(before):  # the solution stays, and which explanation was chosen
                self.advised = False
            else:
                self._paint()
                self.reach = reach
            self._show()
        except Exception:
            self.phase = "done"
            self._aim(self.finished)
            self._show()
            self.tell_document()
            raise
        if edit.phase == "done":
            self.finished = self.document
            self.tell_document(edit.client)
            if self.document != self._kept:
                self._keep(self._kept_solution if self.document.solved_as(self._kept) else "")
        self.status["ms"] = round(1000 * (time.perf_counter() - began), 1)
        self._give_back_memory()  # edits may come so fast that nothing is done between them
        self.tell_state()

    def _keep(self, solution):
        """Write ``painted.toml``, with the solution of what is painted, "" without one."""
        self.project.keep(self.document, solution)
        self._kept, self._kept_solution = self.document, solution

    def give_up_unfinished(self) -> None:
        """Go back to the document that was finished last: the page that draws or drags has gone, or saves."""
        if self.phase != "done":
            self.update(Edit(self.finished))

    def tell_document(self, client: str = "") -> None:
        """Say what is painted, to all pages but the one that has painted it."""
        self.tell.say({"type": "document", "client": client, "document": self.finished.plain()})

    @property
    def solving(self) -> bool:
        """Whether there is paint to be followed."""
        return not self._dragged and self.solution.solving

    def _aim(self, document):
        """Take lights and orientation of a document for the map that is painted on."""
        self.document, self._dragged = document, False
        self._paint(self.solution.aim)
        self._tell_lights()

    def _paint(self, how=None):
        """Paint the document's strokes, as :meth:`.Solution.paint` does or :meth:`.Solution.aim`."""
        explained = bool(self.solution.explanations)
        (how or self.solution.paint)(self.document)
        self.reach, self.advised, self._rendered = None, False, None
        if explained:
            self._tell_explanations()

    def _drag(self):
        """Show the map with its lights placed, and what paint has added to it before."""
        if not self._dragged:
            self._render_quickly()
        self._dragged = True
        document = self.document
        placed = map_regions.changed(self.placed.place(document.lights), document.regions)
        # To look for its lights takes longer than a frame.
        origin = oriented(placed, document.orientation, lights=[])
        added = self.solution.point.edited - self.solution.origin
        found = np.maximum(origin + added, 0).astype(np.float32)
        bright = self._quick.bright_texels(found)[:DRAGGED_COLUMNS]
        self._dragging = self._quick.with_probed(bright)
        changed = self._dragging.apply(tensor(found)).numpy() - self._still_quick
        self._preview = found, np.maximum(self._still + changed, 0)

    def _render_quickly(self):
        """Render the solution, and through few samples, for what a dragged light changes."""
        edited = self.solution.point.edited
        self._still = self._by_transport(edited)
        self._quick = self._quick.resolved(edited, limit=COLUMNS)
        self._still_quick = self._quick.apply(tensor(edited)).numpy()

    def _go_on_from(self, file):
        """Take the solution that was saved of this document."""
        try:
            self.solution.go_on_from(checkpoint.load_solution(Path(file), self.solution.still))
        except InputError as error:
            self.notes = [*self.notes, str(error)]

    # ---- what goes on --------------------------------------------------------------------------------------

    def advance(self) -> bool:
        """Do the next piece of work; False where there is none left."""
        more = not self._dragged and not self.resting and self._worked()
        self._give_back_memory(resting=not more and self.phase == "done")
        return more

    def _give_back_memory(self, resting=False):
        """Give freed buffers back when nothing is left to do, and when that is due."""
        if resting or time.monotonic() > self._memory_due:
            give_back_memory()
            self._memory_due = time.monotonic() + MEMORY_EVERY_S

    def _worked(self):
        """Do a piece of work; False where there is none left."""
        try:
            if self._solved_further(settled=self.phase == "done"):
                return True
            if self.phase != "done":
                return False
            if self._render(FIRST_PASSES):
                return True
            if not self._recorded:  # paths, before the first light is dragged: that takes seconds
                self._recorded = True
                self._render_quickly()
                return True
            if self.solving and self.reach is None:
                self._reach()
                return True
            if self.solving and not self.advised:
                self._advise()
                return True
            return self._render(PASSES)
        except SupersededError:
            return True

    def _solved_further(self, settled):
        """Make a step, try other lights or hold the rest more; False where nothing is due.

        Other lights are tried once the paint is ``settled``, after as many steps as each of them is given.
        """
        if not self.solving:
            return False
        solution = self.solution
        enough = solution.converged or len(solution.run.history) >= search.EXPLANATION_STEPS
        if settled and enough and not solution.searched:
            self._search()
        elif not solution.converged:
            self._step()
        elif settled and solution.hold_more():
            self.status["hold"], self._rendered = solution.hold, None
        else:
            return False
        return True

    @property
    def state(self) -> str:
        """What goes on: saving, moving (of lights), solving or rendering; done: nothing is left to do."""
        if self._saving:
            return "saving"
        if self._dragged:
            return "moving"
        if self.resting:
            return "done"
        if self.phase != "done" or not self.converged or (self.solving and not self.advised):
            return "solving"
        return "rendering" if self._rendered is None or self._rendered[0] < PASSES else "done"

    @property
    def converged(self) -> bool:
        """Whether no further step is made towards what is painted."""
        return not self.solving or self.solution.converged

    def _step(self):
        began = time.perf_counter()
        self.solution.step()
        self.status["iterations"] = len(self.solution.run.history)
        self.status["steps"] += 1
        self.status["ms"] = round(1000 * (time.perf_counter() - began), 1)
        self._show()
        self.tell_state()
        if self.converged:
            self._tell_lights()

    def _search(self):
        """Ask whether another start leads further; a newer edit ends it."""
        self._tell_doing("looking for other lights")
        before = self.solution.run
        self.solution.search(self._unless_newer)
        if self.solution.run is not before:
            self._rendered = None
        self._tell_solution()

    def _tell_explanations(self):
        """Show the explanations of the paint in the pages."""
        explanations, chosen = self.solution.explanations, self.solution.chosen
        reached = self.solution.request.reached if explanations else None
        listed = [{"name": one.name, "reached": reached(one.point.rendering)} for one in explanations]
        self.tell.say({"type": "explanations", "chosen": chosen, "explanations": listed})
        if explanations:
            renderings = np.concatenate([one.point.rendering for one in explanations])
            height = len(renderings) // len(explanations)
            rows = tuple(slice(i * height, (i + 1) * height) for i in range(len(explanations)))
            self.tell.frame("explanation", "transport", renderings, rows)

    def choose(self, index: int) -> None:
        """Go on from another explanation of the paint; that which is shown stays among them."""
        if self._dragged or not 0 <= index < len(self.solution.explanations):
            return  # of what was painted before
        self.solution.choose(index)
        self._rendered, self.resting, self.advised = None, False, False
        self.status = {"iterations": 0, **{name: self.status[name] for name in ("steps", "number", "client")}}
        self._tell_solution()

    def _unless_newer(self):
        self._give_back_memory()
        if self.newer():
            raise SupersededError

    def _render(self, passes):
        """Add a pass to Mitsuba's rendering of the map that is shown; False where it has so many."""
        if self._rendered is None:
            self._rendered = 0, 0.0
        done, total = self._rendered
        if done >= passes:
            return False
        total = total + self._pass(done, self._adjusted(self._edited()))
        done += 1
        self._rendered = done, total
        if done in (1, 2, 4, 8, PASSES):
            self._shown = None
            self.tell.frame("render", "mitsuba", total / done, self._sharp.rows)
            self.tell_state()
        return True

    def _pass(self, i, shown):
        """Return one pass of Mitsuba's rendering of a map, at the size that is shown when idle."""
        if self._sharp is None:
            self._sharp = working_size.scaled(self.scene, SHARPER) or self.scene
        return self._sharp.render(shown, PASS, Seeds(self.project.settings.seed).pass_of_page(i))

    def _films(self, scene):
        """Return the scene on the films that are shown and solved on; as it is if strokes are in pixels."""
        if any(one.get("units") == "pixels" for one in self.project.document.strokes):
            return scene, scene
        settings = self.project.settings
        shown = working_size.smaller(settings, scene)
        small = working_size.smaller(settings, scene, painted=True)
        return shown, shown if small.width == shown.width else small

    def _reach(self):
        """Ask how much of what is painted any light could do; a newer edit ends it."""
        self._tell_doing("estimating how much of the target is feasible")
        solution = self.solution
        self.reach = feasibility.reachable(
            solution.transport,
            solution.origin,
            solution.target,
            solution.problem.likelihood,
            self.rows,
            painted=solution.coverage[..., 0],
            rendered=solution.base,
            known=solution.point.edited,
            kept=solution.kept,
            after_step=self._unless_newer,
        )
        self._tell_unreachable()
        self.tell_state()

    def _advise(self):
        """Say what reaches more, where little is reached; a newer edit ends it."""
        solution, document, self.advised = self.solution, self.document, True
        request = solution.request
        white = solution.transport.linear(tensor(np.ones_like(self.map))).numpy()
        lamps = solution.transport.apply(tensor(np.zeros_like(self.map))).numpy()
        rendering, alone = solution.point.rendering, solution.coverages()
        text, actions = advice.said(document, request, rendering, self.reach, alone, white, lamps)
        if text:
            self.advised = False
            self._tell_doing("looking for a better place of the light")
            self._unless_newer()
            with solution.as_held_first() as problem:
                listed = picking.lights(self.placed, document)
                state = solution.run.state
                actions += advice.lights(problem, solution.still, state, request, listed, document)
            self.advised = True
            self.status["advice"] = {"text": text, "actions": [asdict(action) for action in actions]}
        self.tell_state()

    def _tell_unreachable(self):
        """Show what of the paint is not feasible, once that is known."""
        if self.reach is not None:
            unreachable = preview.unreachable(self.reach)
            self.tell.frame("unreachable", "transport", unreachable, self.solution.scene.rows)

    # ---- what is shown -------------------------------------------------------------------------------------

    def _edited(self):
        """Return the map as it is edited (H, W, 3), before exposure and colours."""
        return self._preview[0] if self._dragged else self.solution.edited

    def _adjusted(self, edited):
        """Return a map as it is shown: with exposure and temperature; the map itself without."""
        document, settings = self.document, self.project.settings
        output = replace(settings.output, exposure=document.exposure, temperature=document.temperature)
        return adjustments.adjust(edited, settings.lights, output, self.given.scale)[0]

    def _show(self):
        edited = self._edited()
        shown = self._adjusted(edited)
        of = self._preview[1] if self._dragged else self.solution.point.rendering
        if of is not self._shown or shown is not edited:  # a stroke being drawn has changed nothing yet
            self._shown = of if shown is edited else None
            self.tell.frame("render", "transport", self._rendering(edited, shown), self.scene.rows)
            self.tell.frame("map", "transport", shown)
        if not self._dragged:
            solution = self.solution
            both, white = (solution.target, solution.point.rendering), solution.problem.likelihood.white
            target, reached = (display_curve.values(one, white) for one in both)
            self.tell.frame("difference", "transport", target - reached, solution.scene.rows)

    def _rendering(self, edited, shown):
        """Return the rendering that is shown of the edited map, adjusted or not."""
        if not self._dragged:
            return self._by_transport(shown)
        return self._preview[1] if shown is edited else self._dragging.apply(tensor(shown)).numpy()

    def _by_transport(self, envmap):
        """Render a map at the size that is shown."""
        return self.transport.resolved(envmap, limit=COLUMNS).apply(tensor(envmap)).numpy()

    def sky(self) -> None:
        """Show the map large, as it is edited and as it was given, at the resolution of its file."""
        if self._dragged:
            return
        document, settings = self.document, self.project.settings.input
        self._tell_doing("composing the map at the resolution of its file")
        if self._wide is None:
            self._wide = self.given.at_file_size(settings, SKY_WIDTH)
        placed = {name: value for name, value in document.plain().items() if TABLES[name] == "input"}
        by_hand = replace(settings, **placed)
        given = replace(self.given, placed=self.placed if document.lights or document.regions else None)
        solution = self.solution
        params = solution.problem.solution_params(solution.run.state)
        edit = file_resolution.Found(solution.problem.layers, params, None, 0.0, solution.point.edited)
        _, carried = file_resolution.carried(by_hand, given, self._wide, edit, solution.origin)
        self.tell.frame("sky-before", "transport", self._wide.radiance)
        self.tell.frame("sky", "transport", self._adjusted(carried))
        self.tell_state()

    def again(self) -> None:
        """Show everything anew, to a page that has just come."""
        self.resting, self._shown = False, None
        self.tell.frame("before", "transport", self.before, self.scene.rows)
        if self.photograph is not None:
            self.tell.frame("photograph", "transport", self.photograph)
        self._tell_unreachable()
        self._rendered = None
        self._tell_solution()

    def _tell_solution(self):
        """Show the solution, and say what it is."""
        self._tell_explanations()
        self._show()
        self._tell_lights()
        self.tell_state()

    def _tell_lights(self):
        """Say which lights the map has, and where the solution has put them."""
        own = []
        height, width = self.map.shape[:2]
        omega = latlong.lookup_solid_angles(height, width)
        for i, light in enumerate(self.placed.lights):
            azimuth, elevation = angles(light.direction)
            flux = self.placed.layers.lights.flux[i].tolist()
            radius = math.degrees(math.sqrt(omega[light.texels // width].sum() / math.pi))
            there = {"light": i + 1, "azimuth": azimuth, "elevation": elevation}
            own.append(there | {"flux": flux, "radius": radius})
        found = []
        problem, state = self.solution.problem, self.solution.run.state
        for i in problem.shining(state):
            azimuth, elevation = angles(problem.direction(state, i))
            flux = problem.layers.lights.flux[i] * np.exp(state["flux"][i])
            found.append({"azimuth": azimuth, "elevation": elevation, "flux": flux.tolist()})
        self.tell.say({"type": "lights", "own": own, "found": found})

    def tell_state(self) -> None:
        """Say what goes on, and how good the solution is: what is reached of the paint, and feasible."""
        reached = reachable = None
        if self.solving:
            reached = self.solution.request.reached(self.solution.point.rendering)
            reachable = None if self.reach is None else max(self.reach.share, reached)
        rendered = self._rendered[0] * PASS if self._rendered else 0
        share = {"reached": reached, "reachable": reachable}
        self.tell.say({"type": "status", "state": self.state, "samples": rendered, **share, **self.status})

    def _tell_doing(self, text):
        self.tell.say({"type": "doing", "text": text})

    def _stage(self, text):
        self.tell.say({"type": "status", "state": "loading", "text": text})

    def _progress(self, done, total, text=""):
        self.tell.say({"type": "progress", "done": done, "total": total, "text": text})

    def pick(self, asked: Pick) -> None:
        """Say whose highlight or shadow a pixel shows, or where its light must go (:mod:`.picking`)."""
        answer = {"type": "picked", "number": asked.number, "client": asked.client}
        shown = picking.lights(self.placed, self.document)
        problem, solved = self.solution.problem, self.solution.run.state
        centres = problem.layers.lights.centres
        own = {k: picking.index_of(shown, centres[k]) for k in problem.shining(self.solution.still)}
        if asked.of == "shares":
            added = {k: None for k in problem.added(solved)}
            self.tell.say(answer | self._shares(asked, own | added))
            return
        for k, i in {} if self._dragged else own.items():
            if i is not None:  # where paint has put it
                shown[i] = replace(shown[i], direction=problem.direction(solved, k))
        self.tell.say(answer | self.picking.answer(asked, self.document, shown))

    def _shares(self, asked, index):
        """Return whose light a pixel shows: ``shares`` of the map's lights, by their index in the list.

        ``index`` has that of the layers' lights; -1 is for those that paint has added.
        """
        seen = self.picking.seen(min(asked.view, len(self.scene.rows) - 1), asked.x, asked.y)
        solution, rows = self.solution, self.rows.slice
        whole = float((seen * solution.point.edited.mean(axis=2)).sum())
        shares: dict[int, float] = {}
        for k, i in index.items() if whole > 0 else ():
            dark = solution.problem.params(with_light(solution.run.state, k, flux=DARK))
            lost = (solution.point.edited[rows] - solution.problem.layers.decode(dark).numpy()).mean(axis=2)
            i = -1 if i is None else i
            shares[i] = shares.get(i, 0.0) + float((seen[rows] * lost).sum()) / whole
        return {"light": max(shares, key=lambda i: shares[i], default=-1), "shares": list(shares.items())}

    # ---- results -------------------------------------------------------------------------------------------

    def save(self) -> list[str]:
        """Write ``painted.toml`` and the folder of an ``envedit run`` of it; returns its warnings.

        Its map is that of the solution that is shown, which is solved to its end first.
        """
        self._saving = True
        try:
            return self._save()
        finally:
            self._saving = False

    def _save(self):
        project, folder = self.project, self.project.folder

        # ---- The solution that is shown, to its end
        if self._dragged:
            self._aim(self.document)
        shown = self._adjusted(self._edited())
        while self._solved_further(settled=True):
            pass
        start = SOLUTION if self.solving else ""
        self._keep(start)
        if start:
            run = self.solution.run
            solved = gauss_newton.Run(run.state, run.start, hold=self.solution.hold)
            checkpoint.save_solution(folder / SOLUTION, solved)

        # ---- The run that has its map
        settings = installed.settled(project.configured(self.document, start))

        def stage(text):
            self.tell.say({"type": "saving", "text": text})

        result, warnings = self._carried_out(settings, folder, stage)

        # ---- What was saved, no less sharp than what is shown, and how it differs
        saved, rows = result.maps["edited"], result.rows
        rendering = result.renders["edited"]
        passed = self._pass(0, saved)
        if passed.shape[1] > rendering.shape[1]:
            rest = (self._pass(i, saved) for i in range(1, PASSES))
            rendering, rows = sum(rest, passed) / PASSES, self._sharp.rows
        self.tell.frame("render", "saved", rendering, rows)
        self.tell.frame("map", "saved", saved)
        self._shown = None
        self.resting = True  # what is shown is what was saved
        files = [name for name in output_folder.names(folder) if (folder / name).is_file()]
        notes = [self._differs(shown, saved), *(note for note in result.notes if "target.hold =" in note)]
        whose = {name: self.status[name] for name in ("number", "client")}
        told = {"folder": folder.name, "files": files, "warnings": warnings, "notes": notes} | whose
        self.tell.say({"type": "saved", **told})
        return warnings

    def _carried_out(self, settings, folder, stage):
        """Carry a configuration out as `envedit run` does; returns the result, and warnings of its files."""
        base = self.project.base
        read = output_folder.inputs_of(settings, base)
        with output_folder.results_in(folder, output_folder.names(folder), read):
            watch = pipeline.Watch(stage, self._progress)
            result = pipeline.run(settings, folder=folder, base=base, watch=watch)
            stage("writing")
            return result, run_folder.write(folder, result, import_s=0.0)

    def _match(self, settings):
        """Find the light of a photograph; its map is painted on, at the resolution of the input's file."""
        folder = Path(settings.output.dir)

        def stage(text):
            self._stage(f"matching the photograph: {text}")

        self._carried_out(installed.settled(settings), folder, stage)
        full = folder / "edited_full.exr"
        shutil.copyfile(full if full.exists() else folder / "edited.exr", folder / MATCHED)

    def _differs(self, shown, saved):
        """Say by how much the rendering of the map that was saved differs from the one that was shown."""
        transport = self.transport.resolved(np.maximum(shown, saved))
        before, after = (tonemap(transport.apply(tensor(one)).numpy()) for one in (shown, saved))
        change = np.abs(after - before)
        return (
            f"the picture differs from the one shown before by {change.mean():.2g} of a display value on "
            f"average, {change.max():.2g} at most"
        )
