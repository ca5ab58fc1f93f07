"""What the runs of a table left: numbers and pictures, read from their folders."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path

import numpy as np

from envedit import config
from envedit.core import latlong
from envedit.core.errors import EnveditError, InputError
from envedit.images import images
from envedit.losses import metrics
from experiments.painted_edits.run import layers
from experiments.sweep.process import DONE

from .plan import Cell


def done(out, cells: list[Cell]) -> list[Cell]:
    """Pick the cells whose runs are done."""
    return [cell for cell in cells if (cell.folder(out) / DONE).exists()]


def numbers(out, cell: Cell) -> dict | None:
    """Read the measurements of a run: metrics.json of an edit, fit.json of a fit; None where it is not done.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    folder = cell.folder(out)
    if not (folder / DONE).exists():
        return None
    path = folder / ("metrics.json" if cell.store == "edits" else "fit.json")
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); remove its folder and run again") from None


def seconds(out, cells: list[Cell]) -> dict[Cell, tuple[float | None, float]]:
    """Return the seconds of the fit, and of all the rest, of every edit that is done.

    A fit that lay on disk cost its run nothing: its seconds are those that are kept with it. None where there
    is no fit; the rest is NaN where a run was interrupted and resumed, whose time nobody took.
    """
    found = {}
    for cell in done(out, cells):
        if cell.store != "edits":
            continue
        read, ended = numbers(out, cell), json.loads((cell.folder(out) / DONE).read_bytes())
        timing, about = read["timing"], read["fit"]
        rest = timing["total_s"] - (timing["fit_s"] if about else 0)
        found[cell] = about and about["seconds"], math.nan if ended.get("resumed") else rest
    return found


def pictures(out, cell: Cell) -> dict[str, np.ndarray | None]:
    """Read the pictures of a run, linear radiance; maps are cut to the active rows.

    Returns
    -------
    dict
        Of an edit ``initial_map``, ``true_map`` (None where it is not known), ``map``, ``initial``,
        ``target``, ``render``. Of a fit ``original``, ``fitted``, ``noisy``. Empty where it is not done.
    """
    folder = cell.folder(out)
    if not (folder / DONE).exists():
        return {}
    if cell.store != "edits":
        return {name: images.read(str(folder / f"{name}.exr"))[0] for name in ("original", "fitted", "noisy")}
    first, last = numbers(out, cell)["active_rows"]
    rows = slice(first, last + 1)
    edited, original = layers(folder)
    true = _true_map(folder, original)
    found = {"initial_map": original[rows], "true_map": None if true is None else true[rows]}
    found["map"] = edited[rows]
    for name, file in (("initial", "initial"), ("target", "target"), ("render", "edited")):
        found[name] = images.read(str(folder / f"render_{file}.exr"))[0]
    return found


def _true_map(folder: Path, original):
    settings = config.load(folder / "config.toml")
    if settings.target.kind != "envmap":
        return None
    if not settings.target.file:
        return latlong.rotate(original, settings.target.degrees)
    with contextlib.suppress(EnveditError):  # it may have been moved since
        return images.load_envmap(settings.target.file, original.shape[1], settings.input.repair)[0]
    return None


def of_paint(out, cell: Cell) -> dict:
    """Measure a painted edit against its original map: ``ssim`` of the two, ``sharp`` high frequencies.

    ``sharp`` is the ratio of :func:`.metrics.high_frequency_energy`, NaN where the original has none.
    """
    shown = pictures(out, cell)
    edited, original = shown["map"], shown["initial_map"]
    before = metrics.high_frequency_energy(original)
    sharp = metrics.high_frequency_energy(edited) / before if before else math.nan
    return {"ssim": metrics.compare(edited, original)["ssim"], "sharp": sharp}
