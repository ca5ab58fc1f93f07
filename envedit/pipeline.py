"""One run from configuration to result: load, prepare, optimise, judge.

Nothing here prints or writes but the checkpoint; ``run.py`` does, with what this returns.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import (
    carry,
    checkpoint,
    config,
    edit,
    envmap,
    files,
    fit,
    image,
    metrics,
    optim,
    scene,
    search,
    sky,
    target,
)
from . import reach as reaches
from .errors import NumericalError
from .layers import Layers
from .pathtrace import PathTracer
from .separate import Separation
from .transport import LightTransport

JUDGE_SEED = 9_000_011
"""Seed of the renderings that are judged; the optimiser never sees their samples."""
INITIAL_SPP = 128
"""Samples a pixel of the initial rendering, which is far from the target."""

TRIAL_STEPS, TRIAL_GAIN = 30, 0.05
"""Steps after which the better of two starts is chosen, and by which share of the loss it must be better."""


@dataclass
class Result:
    """What a run found.

    Attributes
    ----------
    envmap : ndarray (H, W, 3)
        The edited map; rows outside the active ones are the original's, bit for bit, and so are frozen texels
        but where layers move a light or its glow across them.
    renders, maps : dict
        ``initial``, ``target``, ``edited``; linear radiance. ``maps["target"]`` is None where it is unknown.
    metrics : dict
        As in metrics.json.
    history : list of dict
        A row an iteration.
    notes, warnings : list of str
        What was chosen automatically; what the user should know.
    influence : ndarray (H, W), optional
        T' 1, how much each texel adds to the picture; None where the renderer does not know.
    frozen : ndarray of bool (H, W), optional
        Active texels that were kept, as this view does not determine them; None as above.
    separation : separate.Separation, optional
        Lights and background of the active rows, where the representation has them.
    reach : reach.Reach, optional
        How much of a painted request any light can do; None where T is not at hand or nothing was painted.
    found : Found, optional
        What the map was decoded from, for :func:`at_full_resolution`.
    """

    envmap: np.ndarray
    renders: dict
    maps: dict
    metrics: dict
    history: list
    notes: list[str]
    warnings: list[str]
    influence: np.ndarray | None = None
    frozen: np.ndarray | None = None
    separation: Separation | None = None
    reach: reaches.Reach | None = None
    found: Found | None = None

    @property
    def render(self) -> np.ndarray:
        """The rendering under the edited map, by Mitsuba with fresh samples."""
        return self.renders["edited"]


@dataclass(frozen=True)
class Found:
    """A representation of the active rows with its parameters; ``free`` as for :func:`.carry.carry`."""

    representation: object
    params: dict
    first_row: int
    free: np.ndarray | None


class Interrupted(Exception):
    """Ctrl-C during the edit, after the checkpoint was written; ``envmap`` is the map so far."""

    def __init__(self, envmap: np.ndarray, step: int):
        super().__init__(f"interrupted at iteration {step}")
        self.envmap, self.step = envmap, step


class Stopped(NumericalError):
    """The optimisation could not go on; ``envmap`` is the last good map."""

    def __init__(self, message: str, envmap: np.ndarray):
        super().__init__(message)
        self.envmap = envmap


@dataclass
class Watch:
    """What a run tells while it works.

    ``stage(text)`` when a part begins, ``progress(done, total, text)`` within one.
    """

    stage: Callable[[str], None] = lambda text: None
    progress: Callable[[int, int, str], None] = lambda done, total, text: None


@dataclass
class _Clock:
    """Wall seconds by name."""

    seconds: dict = field(default_factory=dict)

    @contextlib.contextmanager
    def __call__(self, name):
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def load_map(settings: config.Input) -> tuple[np.ndarray, list[str]]:
    """Load the map of a configuration at working width; returns it with warnings."""
    if settings.envmap == "sunsky":
        return sky.sunsky(settings.width, settings.azimuth, settings.elevation, settings.turbidity), []
    picture, info = image.load_envmap(settings.envmap, settings.width, settings.repair)
    return picture, list(info["warnings"])


def at_full_resolution(settings: config.Input, result: Result) -> np.ndarray | None:
    """Carry a result to the resolution of its input's file; None where that has no more texels.

    Raises
    ------
    InputError, NumericalError
        If the file cannot be read any more, or the carried map is not finite.
    """
    if settings.envmap == "sunsky":
        return None
    source, _ = image.load_envmap(settings.envmap, None, settings.repair)
    if source.shape[1] <= settings.width:
        return None
    found, before = result.found, result.maps["initial"]
    first, last = active_rows(settings.rows, before.shape[0])
    rows = first, last - first + 1
    return carry.carry(found.representation, found.params, before, result.envmap, source, rows, found.free)


def active_rows(rows, height: int) -> tuple[int, int]:
    """Return the first and last row that may change; "upper": above the horizon (paper, Sec. 5.1)."""
    if rows == "upper":
        return 0, (height + 1) // 2 - 1
    return (0, height - 1) if rows == "all" else (rows[0], rows[1])


def make_renderer(settings: config.Config, lit: scene.Scene, shape, progress=None):
    """Build the renderer of a configuration for maps of the given (H, W)."""
    chosen = settings.renderer
    if chosen.kind == "path":
        return PathTracer(lit, chosen.spp, chosen.max_depth, settings.seed)
    return trace(settings, lit, shape, progress)


def trace(settings: config.Config, lit: scene.Scene, shape, progress=None) -> LightTransport:
    """Trace the light transport of a configuration for maps of the given (H, W), or take it from disk."""
    chosen = settings.renderer
    return LightTransport.build(
        lit,
        *shape,
        spp=chosen.spp,
        max_depth=chosen.max_depth,
        seed=settings.seed,
        memory_gb=chosen.memory_gb,
        refresh=0 if chosen.refresh == "auto" else chosen.refresh,
        few=settings.representation.kind == "layers",
        folder=files.cache_folder("transport") if chosen.cache else None,
        progress=progress,
    )


def run(
    settings: config.Config,
    *,
    folder: Path | None = None,
    resume: bool = False,
    base: Path | None = None,
    watch: Watch | None = None,
    picture: np.ndarray | None = None,
    mask: np.ndarray | None = None,
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
        Told of progress.
    picture : ndarray (h, w, 3), optional
        A painted picture, linear radiance, in place of the configuration's target.
    mask : ndarray (h, w), optional
        Where it was painted, in [0, 1]; None: where it differs from the initial rendering.

    Raises
    ------
    EnveditError
        With the exit code of its cause.
    Interrupted
        After Ctrl-C during the edit; the checkpoint has been written.
    Stopped
        If the optimisation cannot go on.
    """
    watch, clock, begun = watch or Watch(), _Clock(), time.perf_counter()
    warnings: list[str] = []
    with clock("target_s"):
        watch.stage("loading")
        original, found = load_map(settings.input)
        warnings += found
        height, width, _ = original.shape
        first, last = active_rows(settings.input.rows, height)
        lit = scene.load(
            settings.scene.file,
            settings.scene.width,
            settings.scene.height,
            dict(settings.scene.parameters),
            base,
        )
        watch.stage("rendering the target")
        wanted = target.make(settings, lit, original, picture, mask)
        warnings += wanted.warnings
        few = INITIAL_SPP if settings.output.spp == "auto" else min(INITIAL_SPP, settings.output.spp)
        initial = wanted.initial
        if initial is None:
            initial = lit.render(original, spp=few, seed=settings.seed + JUDGE_SEED)
    if settings.loss.dists:
        warnings.append("loss.dists is off: no backbone weights are given")

    crop = original[first : last + 1]
    with clock("fit_s"):
        layered = settings.representation.kind == "layers"
        watch.stage("separating lights" if layered else f"fitting ({settings.representation.kind})")
        representation = envmap.make(
            settings,
            fit.default_folder(),
            lambda done, total, loss: watch.progress(done, total, f"loss {loss:.4g}"),
            (first, height),
        )
        params = representation.encode(crop, settings.seed)
    with clock("transport_s"):
        watch.stage(
            "tracing light transport"
            if settings.renderer.kind == "transport"
            else "preparing the path tracer"
        )
        renderer = make_renderer(
            settings, lit, (height, width), lambda done, total: watch.progress(done, total, "")
        )
        # Now: a resumed run may take up a later recording, but must freeze the same texels.
        traced = renderer if isinstance(renderer, LightTransport) else None
        rows, frozen = slice(first, last + 1), None
        if traced:
            frozen = np.zeros((height, width), bool)
            frozen[rows] = ~traced.determined(rows, settings.renderer.influence_threshold)[rows]

    notes, free = [], ~frozen[rows] if traced and frozen.any() else None
    within = None
    if traced and wanted.coverage is not None:
        with clock("reach_s"):
            watch.stage("asking what any light could do")
            within = reaches.reachable(
                traced, original, wanted.picture, wanted.weight, rows, free, wanted.coverage[..., 0], initial
            )
            notes.append(within.note)
            warnings += [within.warning] if within.warning else []
    judged_by = wanted
    if traced and wanted.coverage is not None:
        wanted = replace(wanted, picture=_as_seen(traced, original, wanted))
    if isinstance(representation, Layers):
        with clock("start_s"):
            watch.stage("searching for lights")
            enough = replace(settings, renderer=replace(settings.renderer, spp="auto"))
            through = traced or trace(enough, lit, (height, width))
            representation.keep(free)
            free = None  # a light may move across texels that are kept otherwise
            asked = judged_by.picture, wanted.weight, original
            if wanted.coverage is None:
                starts = [search.start(representation, params, through, *asked)]
            else:
                begin = representation, params, through, initial, *asked
                daring = (False, True) if (wanted.coverage < 1).any() else (False,)
                starts = [search.start_painted(*begin, bold=bold) for bold in daring]
                if representation.separation.lights:
                    starts.append(search.softened(representation, params))
    job = _Job(settings, lit, original, first, free, wanted, representation, renderer, folder, watch)
    if isinstance(representation, Layers):
        with clock("start_s"):
            params, placed = job.best(starts, crop)
            notes += placed
    with clock("edit_s"):
        watch.stage("editing")
        params, state = job.optimise(params, crop, resume)
        edited = job.decode(params)
        wanted = job.wanted if judged_by is wanted else judged_by

    with clock("judge_s"):
        watch.stage("rendering the result")
        final, judged = lit.sampled(edited, settings.output.spp, settings.seed + JUDGE_SEED + 1)
    seconds = clock.seconds
    iterations = len(state.history)
    tonemap = settings.output.tonemap
    fitted = getattr(representation, "fitted", None)
    measured = {
        "render": metrics.compare(final, wanted.picture, tonemap),
        "initial": metrics.compare(initial, wanted.picture, tonemap),
        "envmap": None
        if wanted.envmap is None
        else metrics.compare(edited[rows], wanted.envmap[rows], tonemap),
        "fit": None
        if fitted is None
        else {
            "log_psnr": fitted.log_psnr,
            "peak_ratio": fitted.peak_ratio,
            "epochs": fitted.epochs,
            "cached": fitted.cached,
        },
        "timing": {
            "import_s": None,
            **{
                f"{part}_s": round(seconds.get(f"{part}_s", 0.0), 3)
                for part in ("target", "fit", "transport", "reach", "start", "edit", "judge")
            },
            "report_s": None,
            "total_s": round(time.perf_counter() - begun, 3),
            "per_iteration_ms": float(np.median([row["step_ms"] for row in state.history]))
            if iterations
            else None,
        },
        "iterations": state.step,
        "non_finite_steps": state.bad_steps,
        "tonemap": _TONEMAP_TEXT.get(tonemap, tonemap),
        "active_rows": [first, last],
        "transport": None,
        "painted": None,
    }
    if wanted.coverage is not None:
        measured["painted"] = metrics.painted(final, wanted.picture, initial, wanted.coverage, tonemap)
        measured["painted"]["reachable"] = None if within is None else within.share
    if wanted.envmap is not None:
        measured["sun_offset_texels"] = metrics.sun_offset(edited[rows], wanted.envmap[rows])
        measured["initial_envmap"] = metrics.compare(original[rows], wanted.envmap[rows], tonemap)
    notes = [wanted.source, *renderer.choices, *notes, f"result rendered with {judged} samples a pixel"]
    if traced:
        share = float(frozen[rows].mean())
        measured["transport"] = {
            **traced.summary(),
            "predicted_error": traced.coarse_error(edited),
            "frozen": share,
        }
        if share:
            least = f"their influence is below {settings.renderer.influence_threshold:g} of the mean"
            notes.append(f"{100 * share:.2g} % of the active texels keep their value: {least}")
    measured["choices"] = notes
    return Result(
        edited,
        {"initial": initial, "target": wanted.picture, "edited": final},
        {"initial": original, "target": wanted.envmap, "edited": edited},
        measured,
        state.history,
        notes,
        warnings,
        traced.influence if traced else None,
        frozen,
        getattr(representation, "separation", None),
        within,
        Found(representation, params, first, free),
    )


def _as_seen(traced, original, wanted):
    """Return a painted picture as T sees it: its change added to T E_0.

    What is not painted is then matched exactly by the map as it is, and no gain is spent on the noise of T
    and of the rendering that was painted on.
    """
    traced.resolve(original)
    seen = traced.apply(mi.TensorXf(original)).numpy()
    return np.maximum(wanted.picture + (seen - wanted.initial), 0).astype(np.float32)


_TONEMAP_TEXT = {"gamma": "clip(E, 0, 1)^(1/2.2)"}


@dataclass
class _Job:
    """One edit in progress: loop, checkpoints, and the map that parameters stand for."""

    settings: config.Config
    lit: scene.Scene
    original: np.ndarray
    first: int
    free: np.ndarray | None
    wanted: target.Target
    representation: object
    renderer: object
    folder: Path | None
    watch: Watch

    def decode(self, params) -> np.ndarray:
        """Parameters to a whole map on the host, refusing what is not finite."""
        crop = self.representation.decode(params).numpy()
        rows = slice(self.first, self.first + crop.shape[0])
        if self.free is not None:
            crop = np.where(self.free[..., None], crop, self.original[rows])
        if not np.isfinite(crop).all():
            row, column = np.argwhere(~np.isfinite(crop).all(axis=2))[0]
            raise NumericalError(
                f"the edited map is not finite at row {self.first + row}, column {column}: "
                "lower [optimizer] lr"
            )
        edited = self.original.copy()
        edited[rows] = crop
        return edited

    def best(self, starts, crop):
        """Return the start, (parameters, notes), that gets farthest in a few steps."""
        notes = {tuple(notes) for _, notes in starts}
        if len(notes) == 1:
            return starts[0]
        reached = []
        for params, _ in starts:
            few = replace(self.settings.optimizer, iterations=TRIAL_STEPS)
            wanted = self.wanted.picture, self.wanted.weight
            objective = edit.Objective(self.settings.loss, *wanted, crop, TRIAL_STEPS)
            _, state = edit.optimise(
                self.representation,
                params,
                self.renderer,
                objective,
                self.original,
                self.first,
                few,
                free=self.free,
            )
            reached.append(state.history[-1]["loss"])
        least = int(np.argmin(reached)) if min(reached) < (1 - TRIAL_GAIN) * reached[0] else 0
        losses = ", ".join(f"{loss:.3g}" for loss in reached)
        chosen = [
            *starts[least][1],
            f"start {least + 1} of {len(starts)}: losses after {TRIAL_STEPS} steps {losses}",
        ]
        return starts[least][0], chosen

    def optimise(self, params, crop, resume):
        """Run the loop from the start, or from the checkpoint; returns parameters and state."""
        chosen, wanted = self.settings.optimizer, self.wanted
        lr = self.representation.lr if chosen.lr == "auto" else chosen.lr
        adam, state = optim.Adam(params, lr, (0.9, chosen.beta2)), edit.State()
        what = checkpoint.digest(self.settings, self.lit.digest, [self.original, *wanted.asked])
        if self.folder and resume and (found := checkpoint.load(self.folder, what)):
            state, optimiser, traced, picture = found
            adam.load_state_dict(optimiser)
            self.renderer.restore(traced)
            # Rendered anew, the target may differ in its last bits: Mitsuba's film adds in any order.
            wanted = self.wanted = replace(wanted, picture=picture)
        objective = edit.Objective(self.settings.loss, wanted.picture, wanted.weight, crop, chosen.iterations)
        saved = time.perf_counter()

        with _ctrl_c() as interrupt:

            def after_step(state, adam):
                nonlocal saved
                self.watch.progress(state.step, chosen.iterations, f"loss {state.history[-1]['loss']:.4g}")
                stop, due = interrupt.is_set(), time.perf_counter() - saved >= chosen.checkpoint_s
                due |= state.step == chosen.iterations  # what follows may be interrupted too
                if self.folder and (stop or due):
                    traced = self.renderer.state()
                    checkpoint.save(self.folder, what, state, adam.state_dict(), traced, wanted.picture)
                    saved = time.perf_counter()
                if stop:
                    raise Interrupted(self.decode(adam.params), state.step)

            try:
                return edit.optimise(
                    self.representation,
                    params,
                    self.renderer,
                    objective,
                    self.original,
                    self.first,
                    chosen,
                    free=self.free,
                    adam=adam,
                    state=state,
                    after_step=after_step,
                )
            except NumericalError as error:
                raise Stopped(str(error), self.decode(adam.params)) from error


@contextlib.contextmanager
def _ctrl_c():
    """Turn Ctrl-C into an event, so that a step is never cut in half; a second Ctrl-C is not waited for."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def handle(number, frame):
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


def select_variant(settings: config.Config) -> None:
    """Select the Mitsuba variant of a configuration; the one piece of global state."""
    mi.set_variant(settings.variant)
