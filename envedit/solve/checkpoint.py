"""A run's state on disk, so that a killed run resumes to the same result.

One ``checkpoint.npz``: the optimiser's parameters and moments, the loop's counters and history, which
columns of the light transport are exact, the target's picture, and a digest of what the run was asked to
do. It is written to a temporary name and renamed: a file that is there is whole.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from envedit import config
from envedit.core.array_cache import under
from envedit.core.atomic_files import opened, replacing
from envedit.core.errors import InputError
from envedit.core.types import FilePath
from envedit.solve import gauss_newton
from envedit.solve.adam_loop import State

NAME = "checkpoint.npz"
_FORMAT = 9  # raise when what is stored, or what the loop makes of it, changes


def digest(settings: config.Config, scene: str, inputs: list[np.ndarray]) -> str:
    """Hash what decides an edit: its configuration but for what is done with its result, scene and pixels."""
    text = config.to_toml(replace(settings, output=config.Output(), lights=config.Lights()))
    sha = hashlib.sha256(f"{_FORMAT}\n{text}\n{scene}".encode())
    for array in inputs:
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()


class Checkpoints:
    """Where a run leaves its state now and then, every so many ``seconds``; nowhere without a ``folder``.

    With ``resume`` it goes on from what was left there.
    """

    def __init__(self, folder: Path | None, resume: bool, seconds: float):
        self.folder = folder
        self.resume = resume
        self.seconds = seconds
        self._saved = time.perf_counter()

    def load(self, what: str) -> tuple[State, dict, dict, np.ndarray] | None:
        """Return what :func:`load` does, where the run is to go on from it; None otherwise."""
        return load(self.folder, what) if self.folder and self.resume else None

    def due(self, last: bool) -> bool:
        """Whether to :meth:`save` after a step, at the latest after the ``last``."""
        return self.folder is not None and (last or time.perf_counter() - self._saved >= self.seconds)

    def save(self, what: str, state: State, optimiser: dict, renderer: dict, picture: np.ndarray) -> None:
        """Save as :func:`save` does, where there is a folder."""
        if self.folder is not None:
            save(self.folder, what, state, optimiser, renderer, picture)
            self._saved = time.perf_counter()


def save(folder: Path, what: str, state: State, optimiser: dict, renderer: dict, picture: np.ndarray) -> None:
    """Write ``checkpoint.npz`` into a folder."""
    arrays = {f"optimiser/{k}": v for k, v in optimiser.items()} | {
        f"renderer/{k}": v for k, v in renderer.items()
    }
    text = json.dumps({"digest": what, "state": asdict(state)})
    with replacing(folder / NAME) as temporary, open(temporary, "wb") as file:
        np.savez(file, meta=np.frombuffer(text.encode(), np.uint8), target=picture, **arrays)


def load(folder: Path, what: str) -> tuple[State, dict, dict, np.ndarray] | None:
    """Read ``checkpoint.npz`` back; None where there is none.

    Raises
    ------
    InputError
        If it is damaged or belongs to another configuration or other input files.
    """
    path = folder / NAME
    if not os.path.lexists(path):
        return None
    try:
        arrays = _arrays(path)
        meta, picture = json.loads(arrays["meta"].tobytes()), arrays["target"]
        optimiser, renderer = under(arrays, "optimiser/"), under(arrays, "renderer/")
        state, stored_digest = State(**meta["state"]), meta["digest"]
        whole = state.step, state.bad_steps, state.bad_in_a_row
        if not (
            all(type(n) is int and n >= 0 for n in whole)
            and isinstance(state.slowdown, int | float)
            and 0 < state.slowdown <= 1
            and isinstance(state.history, list)
            and all(isinstance(row, dict) for row in state.history)
            and picture.dtype == np.float32
            and all(np.isfinite(a).all() for a in (picture, *optimiser.values()))
        ):
            raise ValueError("what it holds is no state of a run")
    except Exception as error:  # what zipfile, zlib and numpy make of damage has many names
        reason = " ".join(str(error).split())[:160]
        reason = reason if reason.isprintable() else ascii(reason)
        raise InputError(
            f"{path}: the checkpoint cannot be read ({reason}): delete it, or run without --resume"
        ) from error
    if stored_digest != what:
        raise InputError(
            f"{path}: belongs to another configuration or other input files, or to an older envedit: "
            "run without --resume to start afresh"
        )
    return state, optimiser, renderer, picture


def save_solution(path: Path, run: gauss_newton.Run) -> None:
    """Write where a solution stands, for another run to go on from (``optimizer.start``)."""
    arrays: dict[str, Any] = run.arrays()
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)


def load_solution(path: FilePath, like: dict[str, np.ndarray]) -> gauss_newton.Run:
    """Read what :func:`save_solution` wrote, as a run without steps; ``like`` has unknowns of its shapes.

    Raises
    ------
    InputError
        It cannot be read, or is not of this map.
    """
    remedy = "save again in `envedit paint`, or leave [optimizer] start out"
    try:
        run = gauss_newton.Run.of_arrays(_arrays(Path(path)), [])
    except Exception as error:  # what zipfile, zlib and numpy make of damage has many names
        reason = ascii(" ".join(str(error).split())[:160])
        raise InputError(f"{path}: the solution cannot be read ({reason}): {remedy}") from error
    for one in (run.state, run.start):
        same = one.keys() == like.keys() and all(one[name].shape == like[name].shape for name in like)
        if not same or not all(np.isfinite(array).all() for array in one.values()):
            raise InputError(f"{path}: is the solution of another map or another configuration: {remedy}")
    return gauss_newton.Run(run.state, run.start, hold=max(1.0, float(run.hold)))


def _arrays(path):
    """Return the arrays of an npz file by name; many kinds of errors if it is none."""
    # Opened here: np.load leaves a file open that is no archive.
    with opened(path) as file, np.load(file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("an entry is no array")  # numpy gives the bytes of such an entry
    return arrays


def remove(folder: Path) -> None:
    """Delete the checkpoint of a finished run."""
    (folder / NAME).unlink(missing_ok=True)
