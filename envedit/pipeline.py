"""One run from configuration to result: load, solve, adjust, render, measure.

Nothing here prints or writes but the checkpoint; ``cli`` and ``report`` do, with what this returns.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config, inputs, renderers
from envedit.core import color
from envedit.core.errors import NumericalError, counted, unwrapped
from envedit.core.radiance import BRIGHTEST
from envedit.core.rows import Rows
from envedit.core.seeds import Seeds
from envedit.export import adjustments, light_list
from envedit.export.file_resolution import Found
from envedit.losses import metrics, naturalness
from envedit.losses.perceptual import installed
from envedit.maps import map_lights
from envedit.preparation import Preparation
from envedit.report import variants
from envedit.representations.layers.layers import Layers
from envedit.results import Result
from envedit.scene.renderings import rendered
from envedit.solve import adam_loop, adam_solver, feasibility
from envedit.solve.checkpoint import Checkpoints
from envedit.solve.edit_state import Interrupted, Stopped, Watch
from envedit.solve.likelihood import SIGMA, Likelihood, sizes
from envedit.targets import working_size
from envedit.targets.pixel_weights import hidden_pixels
from envedit.targets.target import Target
from envedit.targets.target import make as make_target
from envedit.targets.working_size import at_size

__all__ = ["Interrupted", "Stopped", "Watch", "run"]

OF_FIT = ("log_psnr", "peak_ratio", "epochs", "cached", "seconds")
"""What the metrics have of the fit of a network."""
TONEMAP_TEXT = {"gamma": "clip(E, 0, 1)^(1/2.2)"}
"""What the metrics call a tonemap, where that is not its name."""
OUTLIER_DEVIATIONS = 3.0
"""Standard deviations beyond which a pixel of a photograph shows what no light of the map explains."""
LEAST_GAIN = 0.05
"""Share of the residual below which an edit has achieved nothing, or made nothing worse: 0.45 dB."""

MOST_ELSEWHERE = 30.0
"""Change of what was not painted, over that of paint, from which on there is a warning. Of 91 edits of
``experiments painted_edits.artists`` half have at most 4.3, 95 % at most 20, one more than 30."""


@unwrapped()
def run(
    settings: config.Config,
    *,
    folder: Path | None = None,
    resume: bool = False,
    base: Path | None = None,
    watch: Watch | None = None,
    replacements: inputs.Replacements = inputs.NO_REPLACEMENTS,
) -> Result:
    """Carry out an edit.

    Checkpoints are written to ``folder`` while the loop runs; None: nowhere. With ``resume`` the run
    continues from the checkpoint that is there, if there is one. ``base`` and ``watch`` are as of
    :func:`.api.edit`; ``replacements`` has arrays and a scene in place of the configuration's files.

    EnveditError has the exit code of its cause. Interrupted is raised after Ctrl-C during the edit; the
    checkpoint, where there is one, is of the last step that was kept. Stopped if the optimisation cannot go
    on.
    """
    edit = _Edit(settings, base, watch or Watch(), replacements)
    try:
        edit.load()
        if edit.to_solve:
            edit.prepare()
            edit.solve(Checkpoints(folder, resume, settings.optimizer.checkpoint_s))
        else:
            edit.leave()
        edit.adjust()
        if edit.transport and edit.target.painted:
            edit.check_feasibility()
        edit.render()
        edit.render_variants()
        edit.measure()
        if edit.target.photo:
            edit.compare_photograph()
        if edit.job:
            edit.warn_of_quality()
        return edit.result()
    except (Interrupted, Stopped) as stop:
        edit.hand_over(stop)
        raise
    except NumericalError as error:
        if edit.edited is None:
            raise
        stopped = Stopped(str(error), edit.edited)
        edit.hand_over(stopped)
        raise stopped from error


@dataclass
class _Clock:
    """Wall seconds by name."""

    seconds: dict = field(default_factory=dict)

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def table(self, history: list[dict], total: float) -> dict:
        """Return the timing of the metrics, but for what the command line adds."""
        parts = ("target", "fit", "transport", "reach", "start", "edit", "judge")
        steps = [row["step_ms"] for row in history]
        return {
            "import_s": None,
            **{f"{part}_s": round(self.seconds.get(f"{part}_s", 0.0), 3) for part in parts},
            "solve_s": round(self.seconds.get("start_s", 0.0) + self.seconds.get("edit_s", 0.0), 3),
            "report_s": None,
            "total_s": round(total, 3),
            "per_iteration_ms": float(np.median(steps)) if steps else None,
        }


class _Edit:
    """A run: its stages are methods, which are called in the order in which they stand.

    ``transport`` and ``job`` are None where the map is left as it is; ``edited`` is None until it is solved
    for; ``notes`` and ``warnings`` grow from stage to stage.
    """

    transport = None
    job = None
    edited = None
    feasible = None
    outliers = None
    frozen = None
    degrees = 0.0
    level = 1.0

    def __init__(self, settings, base, watch, replacements):
        self.begun = time.perf_counter()
        self.clock = _Clock()
        networks = installed.load(settings)
        self.settings = networks.settings
        self.dists = networks.dists
        self.lpips = networks.lpips
        self.base = base
        self.watch = watch
        self.replacements = replacements
        self.seeds = Seeds(settings.seed)
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.others: list[variants.Variant] = []
        self.state = adam_loop.State()
        if networks.note and self.settings.loss.dists:
            self.warnings.append(f"{networks.note}, or set loss.dists to 0")
        elif networks.note:
            self.notes.append(networks.note)

    def load(self):
        """Load the scene and the map, and make the target; ``small`` is the scene at the size to solve at."""
        settings = self.settings
        with self.clock("target_s"):
            self.watch.stage("loading")
            array = self.replacements.envmap
            self.scene = self.small = self.replacements.scene or inputs.load_scene(settings.scene, self.base)
            self.map = inputs.read_map(settings.input, self.scene, settings.input.width, array)
            self.original = self.map.radiance
            self.rows = inputs.active_rows(settings.input.rows, len(self.original))
            self.warnings += self.map.warnings
            self.notes[:0] = inputs.notes(settings.input, self.scene, self.map)
            if self.scene.own.added:
                share = 100 * inputs.share(self.scene, self.original, self.seeds.judged)
                self.notes.append(
                    f"the map gives {share:.3g} % of the picture's light; scene.scale changes that"
                )
            self.target = None
            if settings.target.kind == "none":
                return
            expected = settings.target.painted
            self.small = working_size.smaller(settings, self.scene, painted=expected)
            renderers.check(settings, self.small, self.original.shape[:2])
            self.watch.stage("rendering the target")
            self.target = make_target(settings, self.scene, self.original, self.replacements)
            self.warnings += self.target.warnings
            painted = self.target.coverage is not None
            if painted != expected:  # an image of another light, or paint as an array
                self.small = working_size.smaller(settings, self.scene, painted)

    @property
    def to_solve(self):
        """Whether there is a target, and another map than the target's own."""
        if self.target is None:
            return False
        return self.target.envmap is None or not np.array_equal(self.target.envmap, self.original)

    def leave(self):
        """Leave the map as it is: without a target it is compared with the initial rendering."""
        self.warnings += config.unused(self.settings)
        self.rows = Rows.of(len(self.original))
        self.edited = self.solved_map = self.original
        self.watch.stage("adjusting the map")
        if self.target is None:
            with self.clock("judge_s"):
                spp, cache = self.settings.output.spp, self.settings.renderer.cache
                initial, _, _ = rendered(self.scene, self.original, spp, self.seeds.painted_initial, cache)
            everywhere = np.ones((*initial.shape[:2], 1), np.float32)
            self.target = Target(initial, everywhere, None, "", initial=initial)
            self.notes.append("no target: the result is compared with the initial rendering")
        else:
            source = self.target.source
            self.notes.append(f"{source}; that is the input map, bit for bit: nothing is solved")

    def prepare(self):
        """Trace the light transport, at the size that the edit is solved at, and find where it starts."""
        target = self.target
        if self.small is not self.scene:
            with self.clock("target_s"):
                target = working_size.worked_on(self.settings, self.scene, self.small, self.original, target)
        preparation = self._traced()
        if self.small is not self.scene and preparation.detailed(target):
            self.small = self.scene
            target = self.target
            preparation = self._traced()
        if self.small is not self.scene:
            self.notes.append(f"solved on a picture of {self.small.width}x{self.small.height} pixels")
        self.notes.append(self.target.source)
        transport = preparation.renderer.transport
        if transport and target.painted:
            rendering = transport.resolved(self.original).apply(mi.TensorXf(self.original)).numpy()
            target = target.seen_as(rendering, target.initial)
        self.solver = preparation.edit(target)
        self.job = self.solver.edit
        self.degrees = self.job.degrees
        self.frozen = self.job.frozen
        self.transport = self.job.renderer.transport
        self.notes += [*self.job.renderer.choices, *self.job.notes]

    def _traced(self):
        return Preparation(
            self.settings,
            self.small,
            self.map,
            self.rows,
            self.watch,
            self.dists,
            self.clock,
        ).traced()

    def solve(self, checkpoints):
        """Find the map that explains the target."""
        solver = "gauss-newton" if self.job.newton else "adam"
        no_step = self.job.settings is not self.settings
        self.warnings += config.unused(self.settings, None if no_step else solver)
        with self.clock("edit_s"):
            self.watch.stage("editing")
            if self.job.newton:
                self.params, self.state = self.solver.optimise(checkpoints)
            else:
                self.params, self.state = adam_solver.optimise(self.job, self.solver.params, checkpoints)
            self.transport = self.job.renderer.transport
            self.edited = self.solved_map = self.job.decode(self.params)
        photo = self.target.photo
        if self.small is self.scene:
            self.target = self.job.target  # a resumed run has the picture that it began with
        elif photo is not None:
            self.target = self.target.developed(photo.of_array(self.job.target.photo.array))
        if photo is not None and photo.stops is None:
            self.set_level()

    def set_level(self):
        """Set the factor by which a map of a photograph keeps the mean log irradiance of six planes.

        One picture does not separate the map's level from exposure, and this differs least between skies.
        Beside other lamps, and where rows or regions keep their radiance, the level is determined.
        """
        if self.scene.own.added or not self.rows.all or self.map.kept is not None:
            return
        before, after = (
            color.luminance(map_lights.irradiance(sky, np.array(list(map_lights.AXES.values()))))
            for sky in (self.original, self.solved_map)
        )
        if before.min() > 0 and after.min() > 0:
            self.level = float(np.exp(np.log(before / after).mean()))
            self.target = self.target.developed(self.target.photo.exposed_by(-np.log(np.full(3, self.level))))

    def hand_over(self, stop):
        """Bring the map of an edit that is cut short to the units of the file; say whose units these are.

        Where these leave float32, it is cut at what the file could have been read with.
        """
        stop.input_map = self.map
        try:
            stop.envmap = self.map.as_stored(stop.envmap, self.degrees)
        except NumericalError:
            most = np.float32(BRIGHTEST * min(self.map.scale, 1.0))
            stop.envmap = self.map.as_stored(np.minimum(stop.envmap, most), self.degrees)

    def adjust(self):
        """Adjust lights, exposure and colours as the configuration asks; predict the transport's error."""
        with self.clock("edit_s"):
            self.edited, self.adjustments = self._adjusted(self.solved_map)
        if self.transport:
            self.warnings += self.transport.warnings
            self.predicted_error = self.transport.coarse_error(self.edited)

    def _adjusted(self, envmap):
        envmap = envmap if self.level == 1 else envmap * np.float32(self.level)
        return adjustments.adjust(envmap, self.settings.lights, self.settings.output, self.map.scale)

    def check_feasibility(self):
        """Estimate what any light can do for the paint, under the weights that the edit has come to."""
        target = self.job.target
        with self.clock("reach_s"):
            self.watch.stage("estimating how much of the target is feasible")
            feasible = feasibility.reachable(
                self.transport,
                self.original,
                target.picture,
                Likelihood.of_target(target),
                self.rows,
                painted=target.coverage[..., 0],
                rendered=target.initial,
                known=self.solved_map,
                kept=self.map.kept,
            )
            picture = at_size(feasible.picture, self.small, self.scene)
            residual = at_size(feasible.residual, self.small, self.scene)
        self.feasible = replace(feasible, picture=picture, residual=residual)
        self.notes.append(feasible.note)
        self.warnings += [feasible.warning] if feasible.warning else []

    def render(self):
        """Render the result with fresh samples, and what it is compared with."""
        target = self.target
        with self.clock("judge_s"):
            self.watch.stage("rendering the result")
            spp = self.settings.output.spp
            edited, samples, noise = self.scene.sampled(self.edited, spp, self.seeds.judged)
            self.samples = samples
            self.noise = noise
            unedited = self._rendered(self.original)
            initial = unedited if target.initial is None else target.initial
            self.renders = {"initial": initial, "target": target.picture, "edited": edited}
            self.maps = {"initial": self.original, "target": target.envmap, "edited": self.edited}
            # Pictures that differ by noise alone: of the target's map, or of the one that was painted on.
            self.ceiling = None
            if target.envmap is not None:
                self.ceiling = self._rendered(target.envmap), target.picture
            elif target.initial is not None:
                self.ceiling = unedited, target.initial
            by_hand = self.settings.input.orientation
            layers = self.job.representation if self.job else None
            moves = layers.light_moves(self.params) if isinstance(layers, Layers) else []
            self.lights, self.core = light_list.of_edit(
                self.map, self.edited, self.scene.to_world, by_hand, self.degrees, moves
            )

    def _rendered(self, envmap):
        """Render a map with the same samples as the result: what differs is the map."""
        spp, cache = self.settings.output.spp, self.settings.renderer.cache
        return rendered(self.scene, envmap, spp, self.seeds.judged, cache, self.samples)[0]

    def render_variants(self):
        """Render the other explanations of paint, and measure how far they follow it."""
        target, tonemap = self.target, self.settings.output.tonemap
        seen = ~hidden_pixels(self.scene)
        for explanation in self.solver.others if self.job else ():
            with self.clock("judge_s"):
                self.watch.stage("rendering other explanations")
                changed, _ = self._adjusted(self.solver.map_of(explanation))
                render = self.scene.render(changed, variants.SPP, self.seeds.judged)
                followed = metrics.painted(
                    render, target.picture, target.initial, target.coverage, tonemap, seen
                )
                variant = variants.Variant(
                    name=explanation.name,
                    evidence=explanation.score,
                    envmap=self.map.as_stored(changed, self.degrees),
                    render=render,
                    run=explanation.run,
                    **followed,
                )
                self.others.append(variant)

    def measure(self):
        """Set the metrics: how good renderings and map are, and what the solver did."""
        # ---- Renderings and maps
        tonemap = self.settings.output.tonemap
        self.stored = self.map.as_stored(self.edited, self.degrees)
        self.metrics = self._compared(slice(None), self.scene.rows)
        self.metrics |= {
            "envmap": None,
            "tonemap": TONEMAP_TEXT.get(tonemap, tonemap),
            "active_rows": [self.rows.first, self.rows.last],
            "natural": naturalness.natural(self.edited, self.original, self.target.envmap),
        }
        if len(self.scene.views) > 1:
            views = [{"name": view.name, **self._compared(view.rows)} for view in self.scene.views]
            self.metrics["views"] = views
        painted = self.metrics["painted"]
        if painted:
            painted["reachable"] = None
            if self.feasible:  # estimated from below: what was reached is feasible
                painted["reachable"] = max(self.feasible.share, painted["towards"] or 0.0)
        if self.target.envmap is not None:
            initial, target, edited = (
                self.maps[name][self.rows.slice] for name in ("initial", "target", "edited")
            )
            self.metrics["envmap"] = metrics.compare(edited, target, tonemap, self.lpips)
            self.metrics["sun_offset_texels"] = metrics.sun_offset(edited, target)
            self.metrics["initial_envmap"] = metrics.compare(initial, target, tonemap, self.lpips)

        # ---- The solver
        fitted = self.job.representation.fitted if self.job else None
        self.metrics |= {
            "variants": [one.measures for one in self.others],
            "worse": False,
            "fit": fitted and {name: getattr(fitted, name) for name in OF_FIT},
            "iterations": self.state.step,
            "non_finite_steps": self.state.bad_steps,
            "transport": None,
            "turn_degrees": self.degrees,
            "camera": None,
        }
        if self.transport:
            frozen = float(self.frozen[self.rows.slice].mean())
            self.metrics["transport"] = {
                **self.transport.summary(),
                "predicted_error": self.predicted_error,
                "frozen": frozen,
            }

    def compare_photograph(self):
        """Set the camera of the metrics, and the pixels that the light does not explain."""
        photo = self.target.photo
        self.outliers = self._unexplained(photo.missed(self.renders["edited"]))
        share = float(self.outliers.mean()) / float((self.target.weight > 0).mean())
        self.metrics["camera"] = {**photo.measures, "outliers": share}

        # ---- What is said of it
        if photo.aligns and not photo.recognised:
            line = "target.file: its outlines are not clearly those of the scene: is it of this view?"
            self.warnings.append(line)
        line = f"camera: {photo.summary}"
        if photo.stops is None:
            line += "; one picture does not separate exposure from the map's level: surfaces keep their mean "
            line += "irradiance, or target.exposure fixes it"
        self.notes.append(line)
        self.notes.append(f"{100 * share:.3g} % of the photograph's pixels are not explained by light")

    def _unexplained(self, residual):
        """Return where the residual of a photograph (h, w, 3) is beyond what is known, bool (h, w)."""
        likelihood = replace(Likelihood.of_target(self.target), least_noise=SIGMA)
        of_rendering = 0.0 if self.noise is None else self.noise
        deviations = sizes(residual)[..., 0] / np.hypot(likelihood.noise(residual), of_rendering)
        return (deviations > OUTLIER_DEVIATIONS) & (likelihood.weight[..., 0] > 0)

    def _compared(self, rows, views=()):
        """Compare rows of the renderings with those of the target."""
        renders = self.renders
        seen = ~hidden_pixels(self.scene)[rows]
        if photo := self.target.photo:
            renders = {name: photo.displayed(picture) for name, picture in renders.items()}
            seen &= photo.counts[..., 0] > 0
        initial, target, edited = (renders[name][rows] for name in ("initial", "target", "edited"))
        tonemap = self.settings.output.tonemap

        def compare(picture, other):
            return metrics.compare(picture, other, tonemap, self.lpips, seen, views)

        measures = {
            "render": compare(edited, target),
            "initial": compare(initial, target),
            "ceiling": None,
            "painted": None,
        }
        if self.ceiling:
            again, picture = self.ceiling
            measures["ceiling"] = compare(again[rows], picture[rows])
        if self.target.painted:
            noise = None if self.noise is None else self.noise[rows]
            coverage = self.target.coverage[rows]
            measures["painted"] = metrics.painted(edited, target, initial, coverage, tonemap, seen, noise)
        return measures

    def _changed_elsewhere(self):
        """Return the change of what was not painted over that which is painted; 0 where that is noise."""
        target, painted = self.target, self.metrics["painted"]
        if painted["towards"] is None or painted["elsewhere"] is None:
            return 0.0
        name = self.settings.output.tonemap
        before, after = (color.tonemap(picture, name) for picture in (target.initial, target.picture))
        seen = ~hidden_pixels(self.scene)[..., None]
        requested = float((target.coverage * np.abs(after - before) * seen).mean())
        return painted["elsewhere"] * float(((1 - target.coverage) * seen).mean()) / max(requested, 1e-30)

    def warn_of_quality(self):
        """Warn of an edit that has made things worse, or nothing better; set ``worse`` of the metrics."""
        measures, state = self.metrics, self.state
        if measures["painted"] and (unnatural := naturalness.warning(measures["natural"])):
            self.warnings.append(unnatural)

        # ---- The rendering, of painted targets the share of the paint
        pair = [measures["render"], measures["initial"]]
        after, before = (metrics.score(one, pair, 2) for one in pair)
        rate = "; lower optimizer.lr" if adam_solver.raised_rate(self.job) else ""
        if measures["painted"]:
            towards = measures["painted"]["towards"]
            measures["worse"] = towards is not None and towards < 0
            nothing = towards is not None and 0 <= towards < LEAST_GAIN
            how = f"{100 * (towards or 0):.0f} % of the painted change"
        else:
            measures["worse"] = metrics.gained(*pair) < 0
            nothing = metrics.off(pair[0], pair) and metrics.gained(*pair) < LEAST_GAIN
            how = f"{after} now, {before} before"
        if measures["worse"]:
            self.warnings.append(
                f"the result is farther from the target than the input: {how}; the edited map is kept "
                f"anyway: look at it before you use it{rate}"
            )

        # ---- What was not painted
        if measures["painted"] and (times := self._changed_elsewhere()) > MOST_ELSEWHERE:
            self.warnings.append(
                f"what was not painted has changed {times:.0f} times as much as the paint requires, all "
                'pixels together: [target] rest = "keep" or a stroke of type "hold" keeps it, another '
                "explanation may change less"
            )

        # ---- The map
        of_maps = [measures.get(name) for name in ("envmap", "initial_envmap")]
        if all(of_maps) and metrics.gained(*of_maps) < -LEAST_GAIN:
            after_map, before_map = (metrics.score(one, [], 2) for one in of_maps)
            self.warnings.append(
                f"the edited map is farther from the target's than the input is: {after_map} now, "
                f"{before_map} before: the picture does not determine it"
            )

        # ---- The solver
        solving = self.job.settings.optimizer.iterations > 0 and not measures["worse"]
        if solving and nothing:
            steps = counted(state.step, "step", "steps")
            self.warnings.append(
                f"the edit achieved nothing in {steps}: {how}; check the target's exposure, and that the map "
                "lights what is to change"
            )
        if state.bad_steps:
            self.warnings.append(
                f"{state.bad_steps} of {state.step} iterations had a non-finite loss or gradient and were "
                f"undone, and the learning rate was lowered for a while{rate}"
            )

    def result(self):
        """Return what the run has found."""
        # ---- What is said of the edit
        job, notes = self.job, self.notes
        if job and self.solver.note:
            notes.append(self.solver.note)
        if self.others:
            notes.append(f"other explanations: {', '.join(one.summary for one in self.others)}")
        if lights := light_list.summary(self.lights, len(self.original)):
            notes.append(lights)
        if job and job.representation.models_edit:
            kept = (self.solved_map == job.original)[self.rows.slice].all(axis=2).mean()
            notes.append(f"{100 * float(kept):.3g} % of the active texels are unchanged, bit for bit")
        notes += [*self.adjustments, f"result rendered with {self.samples} samples a pixel"]
        if self.metrics["painted"] and self.metrics["painted"]["towards"] is None:
            notes.append(
                "the painted change is below the noise of the renderings: no share of it is measured"
            )
        if self.transport and self.metrics["transport"]["frozen"]:
            share = 100 * self.metrics["transport"]["frozen"]
            least = f"their influence is below {self.settings.renderer.influence_threshold:g} of the mean"
            notes.append(f"{share:.3g} % of the active texels keep their value: {least}")
        self.metrics["timing"] = self.clock.table(self.state.history, time.perf_counter() - self.begun)
        self.metrics["choices"] = notes

        # ---- All that was found
        found = None
        if job:
            found = Found(
                job.representation, self.params, job.free, self.degrees, self.solved_map, self.level
            )
        return Result(
            envmap=self.stored,
            renders=self.renders,
            maps=self.maps,
            metrics=self.metrics,
            history=self.state.history,
            notes=notes,
            warnings=self.warnings,
            views=self.scene.views,
            lights=self.lights,
            core=self.core,
            to_world=self.scene.to_world,
            influence=self.transport.influence if self.transport else None,
            frozen=self.frozen,
            scene=self.scene.path,
            reach=self.feasible,
            input_map=self.map,
            alpha=self.scene.alpha,
            found=found,
            posterior=self.solver.posterior if job else None,
            photo=self.target.photo,
            outliers=self.outliers,
            variants=self.others,
            settings=self.settings,
            replacements=self.replacements,
            base=self.base,
        )
