"""One run from configuration to result: load, prepare, optimise, judge.

Nothing here prints or writes but the checkpoint; ``cli`` and ``report`` do, with what this returns.
Longer than 400 lines: runs with and without an edit stand side by side, with what both are judged by.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config, inputs, renderers
from envedit.core.errors import NumericalError, unwrapped
from envedit.core.radiance import BRIGHTEST
from envedit.core.rows import Rows
from envedit.core.seeds import Seeds
from envedit.export import adjustments, light_list
from envedit.export.file_resolution import Found
from envedit.losses import metrics, naturalness
from envedit.losses.perceptual import backbones, distances, installed
from envedit.preparation import Preparation
from envedit.report import variants
from envedit.results import Result
from envedit.scene.renderings import rendered
from envedit.solve import feasibility as reaches
from envedit.solve.edit_job import Interrupted, Stopped, Watch, keeping
from envedit.targets import working_size
from envedit.targets.target import Target
from envedit.targets.target import make as make_target
from envedit.targets.working_size import at_size

__all__ = ["Interrupted", "Stopped", "Watch", "run"]

LEAST_GAIN = 0.05
"""Share of the residual below which an edit has achieved nothing, or made nothing worse: 0.45 dB."""


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


@unwrapped()
def run(
    settings: config.Config,
    *,
    folder: Path | None = None,
    resume: bool = False,
    base: Path | None = None,
    watch: Watch | None = None,
    memory: inputs.Given | None = None,
) -> Result:
    """Carry out an edit.

    Parameters
    ----------
    settings : config.Config
        What to do.
    folder : Path, optional
        Where checkpoints are written while the loop runs; None: nowhere.
    resume : bool
        Continue from the checkpoint in ``folder`` if there is one.
    base : Path, optional
        Folder that file names in scene parameters are relative to.
    watch : Watch, optional
        Receives progress.
    memory : inputs.Given, optional
        Arrays and a scene in place of the configuration's files.

    Raises
    ------
    EnveditError
        With the exit code of its cause.
    Interrupted
        After Ctrl-C during the edit; the checkpoint, where there is one, is of the last step that was kept.
    Stopped
        If the optimisation cannot go on.
    """
    watch, clock, begun = watch or Watch(), _Clock(), time.perf_counter()
    memory = memory or inputs.Given()
    warnings: list[str] = []
    without = installed.missing(settings)
    settings = installed.settled(settings)
    dists, lpips = _perceptual(settings)
    if settings.loss.dists and dists is None:
        warnings.append(f"{without}, or set loss.dists to 0")

    # ---- Scene, map and target
    with clock("target_s"):
        watch.stage("loading")
        lit = memory.scene or inputs.load_scene(settings.scene, base)
        given = inputs.read_map(settings.input, lit, settings.input.width, memory.envmap)
        original, said = given.radiance, inputs.notes(settings.input, lit, given)
        said += [without] if without and not settings.loss.dists else []
        warnings += given.warnings
        if lit.own.added:
            part = 100 * inputs.share(lit, original, Seeds.of(settings.seed).judged)
            said.append(f"the map gives {part:.3g} % of the picture's light; scene.scale changes that")
        height, width, _ = original.shape
        rows = inputs.active_rows(settings.input.rows, height)
        target = None
        if settings.target.kind != "none":
            small = working_size.smaller(settings, lit)
            renderers.check(settings, small, (height, width))
            watch.stage("rendering the target")
            target = make_target(settings, lit, original, memory.picture, memory.mask, memory.target_map)
            warnings += target.warnings
        if target is None or (target.envmap is not None and np.array_equal(target.envmap, original)):
            warnings += config.unused(settings)
            found = _adjusted(settings, lit, given, target, warnings, watch, clock, begun, lpips)
            return replace(found, memory=memory, base=base)
        solved = target if small is lit else working_size.worked_on(settings, lit, small, original, target)

    # ---- Transport, at the size that the edit is solved at
    start = Preparation(settings, small, original, rows, folder, watch, dists, clock)
    start.trace()
    if small is not lit:
        if start.detailed(solved):
            small, solved = lit, target
            start = Preparation(settings, lit, original, rows, folder, watch, dists, clock)
            start.trace()
        else:
            said.append(f"solved on a picture of {small.width}x{small.height} pixels")
    traced = start.renderer.transport
    if traced and solved.coverage is not None:
        traced.resolve(original)
        solved = solved.seen_as(traced.apply(mi.TensorXf(original)).numpy(), solved.initial)

    # ---- The edit: where it starts, and its optimisation
    edit = start.edit(solved)
    job, frozen, representation = edit.job, edit.frozen, edit.job.representation
    renderer, within, notes = job.renderer, None, list(edit.notes)
    traced = renderer.transport
    solver = "gauss-newton" if job.newton else "adam"
    warnings += config.unused(settings, solver if job.settings is settings else None)  # None: no step is made
    in_file_units = functools.partial(_in_file_units, given, edit.degrees)
    with clock("edit_s"), in_file_units():
        watch.stage("editing")
        params, state = job.optimise(edit.params, edit.crop, resume)
        found_map = job.decode(params)
        with keeping(found_map):
            edited, adjusted = adjustments.adjust(found_map, settings.lights, settings.output, given.scale)
        solved = job.target  # a resumed run has the picture that it began with
        if small is lit:
            target = solved
    predicted = None
    if traced:
        warnings += traced.warnings
        with in_file_units(), keeping(edited):
            predicted = traced.coarse_error(edited)

    # ---- What any light can do, under the weights of paint and rest that the edit has come to
    if traced and solved.coverage is not None:
        with clock("reach_s"):
            watch.stage("estimating how much of the target is feasible")
            asked = traced, original, solved.picture, solved.weight, rows, None, solved.coverage[..., 0]
            within = reaches.reachable(*asked, solved.initial, known=found_map)
            picture, residual = (at_size(one, small, lit) for one in (within.picture, within.residual))
            within = replace(within, picture=picture, residual=residual)
            notes.append(within.note)
            warnings += [within.warning] if within.warning else []

    # ---- The result, rendered with fresh samples
    with clock("judge_s"), in_file_units(), keeping(edited):
        watch.stage("rendering the result")
        spp, seed = settings.output.spp, Seeds.of(settings.seed).judged
        final, judged, noise = lit.sampled(edited, spp, seed)
        # The same samples: what differs is the map.
        unedited, _, _ = rendered(lit, original, spp, seed, settings.renderer.cache, judged)
        initial = unedited if target.initial is None else target.initial
        by_hand = settings.input.rotate_degrees
        alike = _alike(settings, lit, target, original, judged)
        lights, core = light_list.of_edit(given, edited, lit.to_world, by_hand, edit.degrees)

    # ---- Other explanations of paint
    others = []
    with clock("judge_s"), in_file_units(), keeping(edited):
        for other in job.others:
            watch.stage("rendering other explanations")
            changed, _ = adjustments.adjust(job.map_of(other), settings.lights, settings.output, given.scale)
            in_file = given.as_stored(changed, edit.degrees)
            curve = settings.output.tonemap
            others.append(variants.rendered(other, changed, in_file, lit, target, curve, seed))

    # ---- Notes
    notes += [job.note] if job.note else []
    if others:
        notes.append(f"other explanations: {', '.join(one.summary for one in others)}")
    notes += [said_of] if (said_of := light_list.summary(lights, height)) else []
    if representation.models_edit:
        kept = 100 * float((found_map == job.original)[rows.slice].all(axis=2).mean())
        notes.append(f"{kept:.3g} % of the active texels are unchanged, bit for bit")
    notes = [*said, target.source, *renderer.choices, *notes, *adjusted]
    notes.append(f"result rendered with {judged} samples a pixel")

    # ---- Measures, and what to warn of
    renders = {"initial": initial, "target": target.picture, "edited": final}
    maps = {"initial": original, "target": target.envmap, "edited": edited}
    with in_file_units(), keeping(edited):
        stored = given.as_stored(edited, edit.degrees)
        measured = _measure(settings, renders, maps, rows, alike, target.coverage, within, lpips, lit, noise)
    if measured["painted"] and measured["painted"]["towards"] is None:
        notes.append("the painted change is below the noise of the renderings: no share of it is measured")
    measured["variants"] = [one.measures for one in others]
    if measured["painted"] and (unnatural := naturalness.warning(measured["natural"])):
        warnings.append(unnatural)
    rate = "; lower optimizer.lr" if job.raised_rate else ""
    pair, where = [measured[name] for name in ("render", "initial")], ""
    if target.coverage is not None:
        painted, where = target.coverage[..., 0] > 0, " where painted"
        tonemap = settings.output.tonemap
        pair = [metrics.compare(one, target.picture, tonemap, None, painted) for one in (final, unedited)]
    after, before = (metrics.score(one, pair, 2) for one in pair)
    measured["worse"] = metrics.worse(*pair)
    if measured["worse"]:
        warnings.append(
            f"the result is farther from the target than the input{where}: {after} now, {before} before; "
            f"the edited map is kept anyway: look at it before you use it{rate}"
        )
    of_maps = [measured.get(name) for name in ("envmap", "initial_envmap")]
    if all(of_maps) and metrics.gained(*of_maps) < -LEAST_GAIN:
        after_map, before_map = (metrics.score(one, [], 2) for one in of_maps)
        warnings.append(
            f"the edited map is farther from the target's than the input is: {after_map} now, {before_map} "
            "before: the picture does not determine it"
        )
    solving = job.settings.optimizer.iterations > 0 and not measured["worse"]
    if solving and metrics.off(pair[0], pair) and metrics.gained(*pair) < LEAST_GAIN:
        warnings.append(
            f"the edit achieved nothing in {state.step} steps: {after} from the target{where} now, {before} "
            "before; check the target's exposure, and that the map lights what is to change"
        )
    if state.bad_steps:
        warnings.append(
            f"{state.bad_steps} of {state.step} iterations had a non-finite loss or gradient and were "
            f"undone, and the learning rate was lowered for a while{rate}"
        )
    measured |= {
        "fit": _of_fit(representation.fitted),
        "timing": clock.table(state.history, time.perf_counter() - begun),
        "iterations": state.step,
        "non_finite_steps": state.bad_steps,
        "transport": None,
        "turn_degrees": edit.degrees,
    }
    if traced:
        share = float(frozen[rows.slice].mean())
        measured["transport"] = {**traced.summary(), "predicted_error": predicted, "frozen": share}
        if share:
            least = f"their influence is below {settings.renderer.influence_threshold:g} of the mean"
            notes.append(f"{100 * share:.3g} % of the active texels keep their value: {least}")
    measured["choices"] = notes
    return Result(
        envmap=stored,
        given=given,
        to_world=lit.to_world,
        alpha=lit.alpha,
        renders=renders,
        maps=maps,
        metrics=measured,
        history=state.history,
        notes=notes,
        warnings=warnings,
        views=lit.views,
        lights=lights,
        core=core,
        influence=traced.influence if traced else None,
        frozen=frozen,
        separation=representation.separation,
        scene=lit.path,
        reach=within,
        found=Found(representation, params, job.free, edit.degrees, found_map),
        posterior=job.posterior,
        variants=others,
        settings=settings,
        memory=memory,
        base=base,
    )


def _adjusted(settings, lit, given, target, warnings, watch, clock, begun, lpips):
    """Adjust a map that is not edited: there is no target, or the map is the target's own.

    Without a target it is compared with the initial rendering.
    """
    original = given.radiance
    with clock("edit_s"):
        watch.stage("adjusting the map")
        edited, notes = adjustments.adjust(original, settings.lights, settings.output, given.scale)
    with clock("judge_s"), _in_file_units(given), keeping(edited):
        watch.stage("rendering the result")
        seeds, spp, keep = Seeds.of(settings.seed), settings.output.spp, settings.renderer.cache
        final, judged, _ = lit.sampled(edited, spp, seeds.judged)
        if target is None:
            initial, _, _ = rendered(lit, original, spp, seeds.painted_initial, keep)
            source = "no target: the result is compared with the initial rendering"
            target = Target(initial, None, None, source, initial=initial)
        else:
            initial, _, _ = rendered(lit, original, spp, seeds.judged, keep, judged)
            source = f"{target.source}; that is the input map, bit for bit: nothing is solved"
        renders = {"initial": initial, "target": target.picture, "edited": final}
        maps, rows = {"initial": original, "target": target.envmap, "edited": edited}, Rows.of(len(original))
        alike = _alike(settings, lit, target, original, judged)
        measured = _measure(settings, renders, maps, rows, alike, None, None, lpips, lit)
        stored = given.as_stored(edited)
        lights, core = light_list.of_edit(given, edited, lit.to_world, settings.input.rotate_degrees)
    notes = [
        *inputs.notes(settings.input, lit, given),
        source,
        *notes,
        *filter(None, [light_list.summary(lights, len(original))]),
        f"rendered with {judged} samples a pixel",
    ]
    measured |= {
        "fit": None,
        "timing": clock.table([], time.perf_counter() - begun),
        "iterations": 0,
        "non_finite_steps": 0,
        "worse": False,
        "transport": None,
        "turn_degrees": 0.0,
        "choices": notes,
    }
    more = {"scene": lit.path, "given": given, "to_world": lit.to_world, "alpha": lit.alpha}
    more |= {"settings": settings}
    return Result(stored, renders, maps, measured, [], notes, warnings, lit.views, lights, core, **more)


def _alike(settings, lit, target, original, judged):
    """Return two pictures that differ by noise alone: a map rendered as the result is, and as the target was.

    The map is that of the target; where the picture was painted, the one whose rendering was painted on; of a
    picture of the scene it is not known: None.
    """
    envmap, picture = target.envmap, target.picture
    if envmap is None:
        envmap, picture = original, target.initial
    if picture is None:
        return None
    spp, seed, keep = settings.output.spp, Seeds.of(settings.seed).judged, settings.renderer.cache
    again, _, _ = rendered(lit, envmap, spp, seed, keep, judged)
    return again, picture


@contextlib.contextmanager
def _in_file_units(given, degrees=0.0):
    """Let an edit that is cut short carry its map in the units of the file, and whose units these are.

    Where they leave float32, the map is cut at what the file could have been read with.
    """
    try:
        yield
    except (Interrupted, Stopped) as stop:
        stop.given = given
        try:
            stop.envmap = given.as_stored(stop.envmap, degrees)
        except NumericalError:
            most = np.float32(BRIGHTEST * min(given.scale, 1.0))
            stop.envmap = given.as_stored(np.minimum(stop.envmap, most), degrees)
        raise


def _perceptual(settings):
    """Load DISTS, where the loss has it, and LPIPS; None where there are no weights."""
    files, dists, lpips = installed.files(settings), None, None
    if "vgg" in files:
        dists = distances.Dists(backbones.Backbone.load("vgg", files["vgg"]), files["dists"])
    if "backbone" in files:
        lpips = distances.Lpips(settings.perceptual.network, files["backbone"], files["heads"])
    return dists, lpips


def _measure(settings, renders, maps, rows, alike, coverage, within, lpips, lit, noise=None):
    """Compare renderings and maps: the part of the metrics that says how good the result is.

    ``alike`` are two pictures that differ by noise alone: no rendering can be expected to do better.
    """
    tonemap = settings.output.tonemap
    before, target, after = (renders[name] for name in ("initial", "target", "edited"))
    seen = None if lit.alpha is None else lit.alpha > 0
    measured = {
        "render": metrics.compare(after, target, tonemap, lpips, seen, lit.rows),
        "initial": metrics.compare(before, target, tonemap, lpips, seen, lit.rows),
        "ceiling": alike and metrics.compare(alike[0], alike[1], tonemap, lpips, seen, lit.rows),
        "envmap": None,
        "tonemap": _TONEMAP_TEXT.get(tonemap, tonemap),
        "active_rows": [rows.first, rows.last],
        "natural": naturalness.natural(maps["edited"], maps["initial"], maps["target"]),
        "painted": None,
    }
    if len(lit.views) > 1:
        measured["views"] = _of_views(lit.views, renders, alike, coverage, lpips, seen, tonemap, noise)
    if coverage is not None:
        measured["painted"] = metrics.painted(after, target, before, coverage, tonemap, seen, noise)
        measured["painted"]["reachable"] = None if within is None else within.share
    if maps["target"] is not None:
        original, true, edited = (maps[name][rows.slice] for name in ("initial", "target", "edited"))
        measured["envmap"] = metrics.compare(edited, true, tonemap, lpips)
        measured["sun_offset_texels"] = metrics.sun_offset(edited, true)
        measured["initial_envmap"] = metrics.compare(original, true, tonemap, lpips)
    return measured


def _of_views(views, renders, alike, coverage, lpips, seen, tonemap, noise):
    """Compare the renderings of each view."""
    found = []
    for view in views:
        before, target, after = (renders[name][view.rows] for name in ("initial", "target", "edited"))
        counts = None if seen is None else seen[view.rows]
        some = tonemap, lpips, counts
        of_view = {"name": view.name}
        of_view |= {"render": metrics.compare(after, target, *some)}
        of_view |= {"initial": metrics.compare(before, target, *some), "painted": None}
        of_view["ceiling"] = alike and metrics.compare(alike[0][view.rows], alike[1][view.rows], *some)
        if coverage is not None:
            error = None if noise is None else noise[view.rows]
            cover = coverage[view.rows]
            of_view["painted"] = metrics.painted(after, target, before, cover, tonemap, counts, error)
        found.append(of_view)
    return found


def _of_fit(fitted):
    names = "log_psnr", "peak_ratio", "epochs", "cached", "seconds"
    return None if fitted is None else {name: getattr(fitted, name) for name in names}


_TONEMAP_TEXT = {"gamma": "clip(E, 0, 1)^(1/2.2)"}
