"""What the runs of a table left: numbers and pictures, read from their folders."""

from __future__ import annotations

import json
import math

import numpy as np

from envedit.core.errors import InputError
from envedit.images import images
from envedit.sweep import DONE
from experiments.harness import Case, Done
from experiments.painted_edits import experiment as painted_edits

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
    path = folder / ("fit.json" if cell.fitted else "metrics.json")
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
        if cell.fitted:
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
    if cell.fitted:
        return {name: images.read(str(folder / f"{name}.exr"))[0] for name in ("original", "fitted", "noisy")}
    done = Done(Case("", {}), folder)
    original, edited, true = done.maps
    found = {"initial_map": original[done.rows], "true_map": None if true is None else true[done.rows]}
    found["map"] = edited[done.rows]
    for name, file in (("initial", "initial"), ("target", "target"), ("render", "edited")):
        found[name] = done.picture(f"render_{file}")
    return found


def of_paint(out, cell: Cell) -> dict:
    """Measure a painted edit as :func:`experiments.painted_edits.experiment.measure` does."""
    return painted_edits.measure(Done(Case("", {}), cell.folder(out)))
