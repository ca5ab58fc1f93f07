"""A budget instead of knobs: settings for this machine, scene and map that end within so many seconds.

Levels from coarse to fine, each with what it cost and lost on a reference machine (``experiments/tradeoff``).
Three renderings and a few products of matrices measure how fast this machine is in this scene,
and how noisy the scene is under this map; the finest level that is expected to end in time is taken.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import numpy as np

from envedit import config, inputs
from envedit.core.arrays import tensor
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError
from envedit.scene.scene import QUIET_DECIBELS, QUIET_LEAST, QUIET_MOST

LATE = 1.3
"""A run may take so many times its budget; what is expected to take longer is refused."""
_MAP, _FILM, _SPP = 64, 64, 64  # texels and pixels across, samples of the renderings that calibrate
_SIDE, _PRODUCTS = 512, 8  # of the product of matrices


@dataclass(frozen=True)
class Level:
    """Settings, and what they cost on the reference machine: two cores of an AVX-512 Xeon.

    Attributes
    ----------
    name : str
        What to report to the user.
    map, film : int
        Widths: texels, pixels.
    spp : int or "auto"
        Samples a pixel of target and result.
    traced_s : float
        Seconds of tracing T and of the search, of a picture as wide as high, where nothing of the scene is on
        disk yet; mean of six runs.
    numbers_s : float
        Seconds of separation, edit and report; likewise.
    render_db, map_db : float
        What it loses of the standard preset's PSNR, of rendering and map: mean over three maps and two
        scenes, all judged alike (``experiments/tradeoff``).
    """

    name: str
    map: int
    film: int
    spp: int | str
    traced_s: float
    numbers_s: float
    render_db: float
    map_db: float


LEVELS = (
    Level("coarse", 96, 48, 64, 1.7, 3.1, 3.6, 1.9),
    Level("draft", 128, 64, "auto", 4.3, 4.8, 2.6, 0.8),
    Level("fine", 256, 128, 64, 15.1, 6.6, 1.3, 0.2),
    Level("standard", 256, 128, "auto", 15.1, 6.6, 0.0, 0.0),
)
"""The standard preset is the finest: larger pictures are solved on 128x128 pixels in any case. A map of 96
and a picture of 32 across took as long as the coarsest and lost 2.0 dB more of the rendering. What "fine"
saves are samples of target and result, which the edit does not need and the reported PSNR does."""
REFERENCE_RENDER = 1.66e-7
"""Seconds a pixel and sample of Mitsuba's path tracer on the reference machine (a sphere)."""
REFERENCE_PRODUCT = 0.0134
"""Seconds of the calibrating products on the reference machine."""
PAINTED = 1.6
"""Times that tracing and search take where a picture is painted on: what any light can do is asked, and there
are several starts. Two edits at the four levels: 1.5 to 2.1."""
FULL = 4.4e-7
"""Seconds a texel of the file, on the reference machine, to read, carry and write at its resolution."""
COMPILED = 8.0
"""Seconds of compiling all kernels over those of the calibrating rendering's, where none is on disk; an
estimate, which one run bore out (12 s expected, 13 s taken)."""


@dataclass(frozen=True)
class Work:
    """What is to be done, as far as time asks.

    Attributes
    ----------
    aspect : float
        Height of the picture over its width.
    texels : int
        Of the file that the edit is carried to; 0: none.
    painted : bool
        The target is painted on the rendering.
    """

    aspect: float = 1.0
    texels: int = 0
    painted: bool = False


@dataclass(frozen=True)
class Calibration:
    """How fast this machine is.

    Attributes
    ----------
    render : float
        Seconds a pixel and sample.
    machine : float
        Time of a product of matrices over the reference machine's.
    compile_s : float
        Seconds that compiling will take.
    quiet_spp : int
        Samples that a rendering of "auto" will take.
    """

    render: float
    machine: float
    compile_s: float
    quiet_spp: int


def apply(
    settings: config.Config, budget: float, elapsed: float = 0.0, base: Path | None = None
) -> tuple[config.Config, str]:
    """Choose the level for a budget.

    Parameters
    ----------
    settings : config.Config
        What is to be done; [input] width, [scene] width and height, and samples of target and result
        are replaced.
    budget : float
        Seconds from the start of the program to its end.
    elapsed : float
        Seconds that have passed.
    base : Path, optional
        As for :func:`.scene.load`.

    Returns
    -------
    settings : config.Config
        With the level's.
    note : str
        What was chosen, what it is expected to take and to lose.

    Raises
    ------
    ConfigError
        The representation is not layers or the renderer not the stored transport, the target is in pixels of
        the rendering, or even the coarsest level would take more than :data:`LATE` times the budget.
    EnveditError
        Scene or map cannot be read.
    """
    if settings.representation.kind != "layers" or settings.renderer.kind != "transport":
        raise ConfigError(
            f'--budget: got [representation] kind = "{settings.representation.kind}" and [renderer] kind = '
            f'"{settings.renderer.kind}", expected "layers" and "transport", whose times are known: '
            "run without --budget"
        )
    _check_pixels(settings.target)
    begun = time.perf_counter()
    found, work = calibrate(settings, base)
    elapsed += time.perf_counter() - begun
    level, expected = choose(found, budget, elapsed, work)
    chosen = replace(
        settings,
        input=_at_width(settings.input, level.map),
        scene=_film_at(settings.scene, level.film),
        target=replace(settings.target, spp=level.spp),
        output=replace(settings.output, spp=level.spp),
    )
    return chosen, (
        f"budget of {budget:g} s: level '{level.name}', map {level.map} and picture {level.film} across, "
        f"{level.spp} samples a pixel; {expected:.0f} s expected; {loss(level)}"
    )


def _at_width(settings: config.Input, width: int) -> config.Input:
    """Return the input at another width; rows that were given as numbers are of the same part of the sky."""
    rows = settings.rows
    if not isinstance(rows, str):
        first, end = rows[0] * width // settings.width, -(-(rows[1] + 1) * width // settings.width)
        rows = first, max(first, min(end, width // 2) - 1)
    return replace(settings, width=width, rows=rows)


def _film_at(settings: config.Scene, width: int) -> config.Scene:
    """Return the scene at another width; a height that was given keeps its ratio."""
    height = settings.height and max(1, round(width * settings.height / settings.width))
    return replace(settings, width=width, height=height)


def _check_pixels(target: config.Target) -> None:
    """Refuse what is given in pixels of a rendering whose size a budget chooses."""
    inside = any(stroke.get("units") == "pixels" for stroke in target.strokes)
    for key, given in (("file", target.kind == "image"), ("mask", target.mask), ("strokes", inside)):
        if given:
            raise ConfigError(
                f"--budget: target.{key} is in pixels of the rendering, whose size a budget chooses: "
                "run without --budget" + (', or give strokes units = "fraction"' if inside else "")
            )


def loss(level: Level) -> str:
    """Say what a level is expected to lose."""
    if level.name == "standard":
        return "the standard preset"
    parts = [
        f"{abs(db):.1f} dB {'less' if db > 0 else 'more'} of {what}"
        for db, what in ((level.render_db, "rendering"), (level.map_db, "map"))
        if db
    ]
    return " and ".join(parts) + " than the standard preset, on average"


def expect(level: Level, found: Calibration, work: Work) -> float:
    """Expect the seconds of a run after the calibration."""
    pixels = level.film**2 * work.aspect
    each = found.quiet_spp if isinstance(level.spp, str) else level.spp
    samples = 3 * each  # of target, initial rendering and result
    traced = level.traced_s * work.aspect * found.render / REFERENCE_RENDER * (PAINTED if work.painted else 1)
    numbers = (level.numbers_s + FULL * work.texels) * found.machine
    return found.render * pixels * samples + traced + numbers + found.compile_s


def choose(found: Calibration, budget: float, elapsed: float, work: Work) -> tuple[Level, float]:
    """Return the finest level that is expected to end in time, and the seconds it is expected to take.

    Raises
    ------
    ConfigError
        Even the coarsest takes too long.
    """
    times = [elapsed + expect(level, found, work) for level in LEVELS]
    for level, expected in reversed(list(zip(LEVELS, times, strict=True))):
        if expected <= budget:
            return level, expected
    if times[0] <= LATE * budget:
        return LEVELS[0], times[0]
    cure = ", or set output.full=false" if work.texels else ""
    raise ConfigError(
        f"--budget {budget:g}s: cannot be kept, the coarsest settings take about {times[0]:.0f} s here: "
        f"give at least {times[0]:.0f}s{cure}"
    )


def calibrate(settings: config.Config, base: Path | None = None) -> tuple[Calibration, Work]:
    """Measure this machine in this scene under this map."""
    lit = inputs.load_scene(_film_at(settings.scene, _FILM), base)
    given = inputs.read_map(settings.input, lit, _MAP)
    envmap = given.radiance
    texels = 0 if given.source == inputs.SUNSKY else given.size[0] * given.size[1]
    times, pictures = [], []
    for seed in range(3):
        begun = time.perf_counter()
        pictures.append(tonemap(lit.render(envmap, _SPP, seed)))
        times.append(time.perf_counter() - begun)
    warm = min(times[1:])
    variance = float(np.var(pictures, axis=0, ddof=1).mean())
    quiet = int(np.clip(_SPP * variance * 10 ** (QUIET_DECIBELS / 10), QUIET_LEAST, QUIET_MOST))
    pixels = lit.width * lit.height
    found = Calibration(
        warm / (pixels * _SPP),
        _product_seconds() / REFERENCE_PRODUCT,
        COMPILED * max(times[0] - 2 * warm, 0.0),
        quiet,
    )
    texels = texels if settings.output.full else 0
    return found, Work(lit.height / lit.width, texels, settings.target.kind in ("image", "strokes"))


def _product_seconds():
    """Seconds of a few products of matrices, the fastest of three times, without compiling."""
    a = tensor(np.full((_SIDE, _SIDE), 1e-3))
    taken = []
    for _ in range(4):
        dr.sync_thread()
        begun, x = time.perf_counter(), a
        for _ in range(_PRODUCTS):
            x = dr.matmul(x, a)
            dr.eval(x)
        dr.sync_thread()
        taken.append(time.perf_counter() - begun)
    return min(taken[1:])
