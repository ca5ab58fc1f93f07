"""``envedit run --budget``: the finest settings with which a run is expected to end within so many seconds.

What levels of settings cost and lose was measured on a reference machine, two cores of an AVX-512 Xeon
(``experiments/tradeoff``). Three renderings and a few products of matrices compare this machine, in this
scene and under this map, with it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envedit import config, inputs
from envedit.cli import doctor
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError
from envedit.scene.scene import QUIET_DECIBELS, QUIET_LEAST, QUIET_MOST

LATE = 1.3  # times its budget that a run may take; what is expected to take longer is refused
REFERENCE_RENDER = 1.66e-7  # seconds a pixel and sample of Mitsuba's path tracer, on the reference machine
REFERENCE_RATE = 160.0  # GFLOP/s of the calibrating products there
TEXEL_SECONDS = 4.4e-7  # there, to read, edit and write a texel at the resolution of the file
PAINTED_FACTOR = 1.6  # times that tracing and search take for a painted picture; two edits: 1.5 to 2.1
COMPILE_FACTOR = 8.0  # seconds of compiling over those of the first rendering: expected 12 s, taken 13 s
CALIBRATION_WIDTH = 64  # texels of the map, and pixels of the picture
CALIBRATION_SPP = 64
PRODUCT_SIZE = 512
PRODUCTS = 8


class Level(NamedTuple):
    """Settings, what they cost (mean of six runs), and what they lose (mean over three maps, two scenes)."""

    name: str
    map: int  # width, texels
    film: int  # width, pixels
    spp: int | str  # samples a pixel of target and result
    traced_s: float  # seconds of tracing and search, of a square picture with nothing on disk
    numbers_s: float  # seconds of separation, edit and report
    render_db: float  # PSNR of the rendering below the standard preset's
    map_db: float  # PSNR of the map below the standard preset's


# Larger pictures are solved on 128 x 128 pixels in any case. A map of 96 and a picture of 32 across took as
# long as the coarsest and lost 2.0 dB more. "fine" saves samples of target and result, not of the edit.
LEVELS = (
    Level("coarse", 96, 48, 64, 1.7, 3.1, 3.6, 1.9),
    Level("draft", 128, 64, "auto", 4.3, 4.8, 2.6, 0.8),
    Level("fine", 256, 128, 64, 15.1, 6.6, 1.3, 0.2),
    Level("standard", 256, 128, "auto", 15.1, 6.6, 0.0, 0.0),
)


@dataclass(frozen=True)
class Calibration:
    """How fast this machine is, and what is to be done."""

    render: float  # seconds a pixel and sample
    machine: float  # time of the products over the reference machine's
    compile_s: float  # seconds that compiling will take
    quiet_spp: int  # samples a pixel that "auto" will take
    aspect: float = 1.0  # height of the picture over its width
    texels: int = 0  # of the file that the edit is applied to
    painted: bool = False


def apply(
    settings: config.Config, budget: float, elapsed: float = 0.0, base: Path | None = None
) -> tuple[config.Config, str]:
    """Choose the level for a budget, of which some seconds have elapsed; returns settings and a note.

    ConfigError where the representation is not layers or the renderer not the stored transport, where the
    target is in pixels of the rendering, or where even the coarsest level would take more than :data:`LATE`
    times the budget. Errors of scene and map, and ``base``, are as of :func:`.scene.load`.
    """
    _check(settings)
    begun = time.perf_counter()
    measured = calibrate(settings, base)
    level, expected = choose(measured, budget, elapsed + time.perf_counter() - begun)
    chosen = replace(
        settings,
        input=_at_width(settings.input, level.map),
        scene=_film_at(settings.scene, level.film),
        target=replace(settings.target, spp=level.spp),
        output=replace(settings.output, spp=level.spp),
    )
    loss = "the standard preset"
    if level.name != "standard":
        loss = f"{level.render_db:.1f} dB less of rendering and {level.map_db:.1f} dB less of map than {loss}"
        loss += ", on average"
    return chosen, (
        f"budget of {budget:g} s: level '{level.name}', map {level.map} and picture {level.film} across, "
        f"{level.spp} samples a pixel; {expected:.0f} s expected; {loss}"
    )


def _check(settings):
    """Refuse settings whose times are not known, or that are in pixels of a rendering of unknown size."""
    if settings.representation.kind != "layers" or settings.renderer.kind != "transport":
        raise ConfigError(
            f'--budget: got [representation] kind = "{settings.representation.kind}" and [renderer] kind = '
            f'"{settings.renderer.kind}", expected "layers" and "transport", whose times are known: '
            "run without --budget"
        )
    target = settings.target
    strokes_in_pixels = any(stroke.get("units") == "pixels" for stroke in target.strokes)
    in_pixels = {"file": target.kind == "image", "mask": target.mask, "strokes": strokes_in_pixels}
    if key := next((key for key, present in in_pixels.items() if present), None):
        raise ConfigError(
            f"--budget: target.{key} is in pixels of the rendering, whose size a budget chooses: "
            "run without --budget" + (', or give strokes units = "fraction"' if key == "strokes" else "")
        )


def _at_width(settings, width):
    """Return the input at another width; rows that were given as numbers are of the same part of the sky."""
    rows = settings.rows
    if not isinstance(rows, str):
        first = rows[0] * width // settings.width
        end = -(-(rows[1] + 1) * width // settings.width)
        rows = first, max(first, min(end, width // 2) - 1)
    return replace(settings, width=width, rows=rows)


def _film_at(settings, width):
    """Return the scene at another width; a height that was given keeps its ratio."""
    height = settings.height and max(1, round(width * settings.height / settings.width))
    return replace(settings, width=width, height=height)


def choose(measured: Calibration, budget: float, elapsed: float) -> tuple[Level, float]:
    """Return the finest level that is expected to end in time, and its seconds; ConfigError without any."""
    seconds = [elapsed + expect(level, measured) for level in LEVELS]
    finest = max((k for k in range(len(LEVELS)) if seconds[k] <= budget), default=0)
    if seconds[finest] <= LATE * budget:
        return LEVELS[finest], seconds[finest]
    cure = ", or set output.full=false" if measured.texels else ""
    raise ConfigError(
        f"--budget {budget:g}s: cannot be kept, the coarsest settings take about {seconds[0]:.0f} s "
        f"here: give at least {seconds[0]:.0f}s{cure}"
    )


def expect(level: Level, measured: Calibration) -> float:
    """Return the seconds that a run is expected to take after the calibration."""
    spp = measured.quiet_spp if isinstance(level.spp, str) else level.spp
    samples = 3 * spp * level.film**2 * measured.aspect  # of target, initial rendering and result
    traced = level.traced_s * measured.aspect * (PAINTED_FACTOR if measured.painted else 1)
    numbers = level.numbers_s + TEXEL_SECONDS * measured.texels
    rendering = measured.render * (samples + traced / REFERENCE_RENDER)
    return rendering + numbers * measured.machine + measured.compile_s


def calibrate(settings: config.Config, base: Path | None = None) -> Calibration:
    """Measure this machine in this scene under this map."""
    scene = inputs.load_scene(_film_at(settings.scene, CALIBRATION_WIDTH), base)
    input_map = inputs.read_map(settings.input, scene, CALIBRATION_WIDTH)
    in_file = settings.output.full and input_map.source != inputs.SUNSKY

    # ---- Renderings, the first of which compiles
    times = []
    pictures = []
    for seed in range(3):
        begun = time.perf_counter()
        pictures.append(tonemap(scene.render(input_map.radiance, CALIBRATION_SPP, seed)))
        times.append(time.perf_counter() - begun)
    warm = min(times[1:])
    variance = float(np.var(pictures, axis=0, ddof=1).mean())
    quiet_spp = CALIBRATION_SPP * variance * 10 ** (QUIET_DECIBELS / 10)
    return Calibration(
        render=warm / (scene.width * scene.height * CALIBRATION_SPP),
        machine=REFERENCE_RATE / max(doctor.matmul_rate(PRODUCT_SIZE, PRODUCTS) for _ in range(3)),
        compile_s=COMPILE_FACTOR * max(times[0] - 2 * warm, 0.0),
        quiet_spp=int(np.clip(quiet_spp, QUIET_LEAST, QUIET_MOST)),
        aspect=scene.height / scene.width,
        texels=input_map.size[0] * input_map.size[1] if in_file else 0,
        painted=settings.target.painted,
    )
