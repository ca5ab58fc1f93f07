"""What each table and figure consists of: one job for every row, map and roughness.

The plan of a table is kept beside its runs, ``OUT/NAME.json``, so that whoever draws it knows what belongs to
it, done or not. Runs lie under the hash of all that decides what comes out of them, so that tables share
them: the same edit is never made twice.
"""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from envedit import config
from envedit.config import presets
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import ConfigError, InputError
from envedit.scene import scene
from envedit.sweep import Job, job
from experiments import puresky

from . import skies
from .kinds import KINDS
from .methods import FITS, ONLY_OURS

EDITS = Path(__file__).parents[2] / "scenes" / "edits"
SUNSKY = "sunsky"


@dataclass(frozen=True)
class Cell:
    """One run of a table.

    Attributes
    ----------
    settings : str
        "paper" or "ours".
    row, map : str
        Method and map.
    roughness : float or None
        Of the scene's object, where it is varied.
    store : str
        Folder of the run's folder, by what is carried out: "edits", "fits", "stock", "stock-scaled".
    key : str
        Name of the run's folder.
    """

    settings: str
    row: str
    map: str
    roughness: float | None
    store: str
    key: str

    @property
    def place(self) -> tuple:
        """Where it stands in the table."""
        return self.settings, self.row, self.map, self.roughness

    def folder(self, out) -> Path:
        """Return the run's folder."""
        return Path(out) / self.store / self.key


@dataclass(frozen=True)
class Question:
    """What all runs of a table have in common; runs under another question are not averaged with them."""

    scene: str = ""
    angle: float = 60.0
    target: str = ""
    edit: str = ""
    sets: tuple[str, ...] = ()


def build(
    name: str,
    question: Question,
    settings=("paper", "ours"),
    maps=None,
    only=None,
    rows=None,
    out=".",
) -> list[tuple[Cell, Job]]:
    """List the runs of a table or figure.

    Parameters
    ----------
    name : str
        A key of :data:`KINDS`.
    question : Question
        Scene ("": the table's own), turn of the true map in degrees, and overrides ``table.key=value``, which
        beat what a row sets. Of Figure 8 the name of the true map, of Figure 9 the edit.
    settings : sequence of str
        "paper", "ours" or both.
    maps : path, optional
        Folder of maps; see :func:`experiments.puresky.find`.
    only : sequence of str, optional
        Names of maps; see :func:`skies.choose`.
    rows : sequence of str, optional
        Some of the table's rows.
    out : path
        Folder of the runs; the true map of Figure 8 is written to ``maps`` in it.

    Raises
    ------
    ConfigError, InputError
        An unknown name, a scene without a roughness, an override that is not usable, no maps.
    """
    kind = KINDS[name]
    for row in rows or ():
        if row not in kind.rows:
            raise ConfigError(f"--rows: {name} has no row {row}; it has {', '.join(kind.rows)}")
    if question.scene and not kind.scene:
        raise ConfigError(f"--scene: came {question.scene}, but {name} has none to choose")
    question, chosen = resolved(name, question, maps, only), _maps(name, kind, maps, only)
    lit = question.scene or kind.scene
    if None not in kind.roughness:
        _check_roughness(lit)
    target = _target(name, question, maps, Path(out) / "maps")
    made = []
    # Maps last: what shares a fit is then many jobs apart, and finds it on disk also with several workers.
    for setting in settings:
        for roughness in kind.roughness:
            for row in kind.rows:
                if (rows and row not in rows) or (setting == "paper" and row in ONLY_OURS):
                    continue
                for sky, file in chosen.items():
                    tables = kind.methods[row].under(setting)
                    tables = presets.overlaid(tables, _shared(name, question, file, lit, roughness, target))
                    if row == "lum-l1-dists" and not _names(question, "perceptual", "vgg"):
                        continue
                    varied = "" if roughness is None else f", roughness {roughness:g}"
                    one = job(f"{name}, {setting}: {row}, {sky}{varied}", _set(tables, question.sets))
                    store = row if row.startswith("stock") else "fits" if kind.methods is FITS else "edits"
                    made.append((Cell(setting, row, sky, roughness, store, one.key), one))
    if not made:
        raise ConfigError(
            f"{name}: nothing to run: no row of --rows {' '.join(rows or kind.rows)} has settings "
            f"{' or '.join(settings)} (layers are ours; lum-l1-dists needs perceptual.vgg)"
        )
    return made


def resolved(name: str, question: Question, maps=None, only=None) -> Question:
    """Name the true map of Figure 8 where the question does not, so that plans know it; see :func:`build`."""
    if name == "figure8" and not question.target:
        chosen = _maps(name, KINDS[name], maps, only)
        if skies.OTHER in _known(maps) and skies.OTHER not in chosen:
            return replace(question, target=skies.OTHER)
    return question


def _known(folder):
    return puresky.find(folder, "--maps")


def _maps(name, kind, folder, only):
    if name == "figure9" and (only is None or list(only) == [SUNSKY]):
        return {SUNSKY: SUNSKY}
    return skies.choose(_known(folder), only, kind.several)


def _target(name, question, folder, to):
    """Return the target's table: the map turned, or, in Figure 8, another one, turned, where there is one."""
    if other := question.target:
        if name != "figure8":
            raise ConfigError(f"--target: came {other}, but {name} turns its map: give --angle")
        file = puresky.pick(_known(folder), [other], "--target")[other]
        return {"file": str(skies.turned(file, question.angle, to))}
    return {"rotate_degrees": question.angle}


def _shared(name, question, file, lit, roughness, target):
    """Return what a row does not decide."""
    tables = {"input": {"envmap": str(file)}}
    if KINDS[name].methods is FITS:
        return tables
    tables["output"] = {"report": False, "full": False}
    tables["renderer"] = {"cache": False}  # every run pays for its transport, whichever comes first
    if name == "figure9":
        return presets.overlaid(read_edit(question.edit or "move_shadow"), tables)
    tables |= {"scene": {"file": lit}, "target": target}
    if roughness is not None:
        tables["scene"] |= {"parameters": {"roughness": roughness}}
    return tables


def read_edit(name: str) -> dict:
    """Read a shipped edit's tables, without its output.

    Raises
    ------
    ConfigError
        There is no such edit.
    """
    known = sorted(path.stem for path in EDITS.glob("*.toml"))
    if name not in known:
        raise ConfigError(f"--edit: no edit {name}; there are {', '.join(known)}")
    tables = tomllib.loads((EDITS / f"{name}.toml").read_text(encoding="utf-8"))
    tables.pop("output", None)
    return tables


def _set(tables, overrides):
    """Lay ``table.key=value`` over a configuration's tables."""
    for text in overrides:
        keys, value = config.parse_override(text)
        for key in reversed(keys):
            value = {key: value}
        if keys == ("target", "file"):
            tables = presets.overlaid(tables, {"target": {"rotate_degrees": 0.0}})
        tables = presets.overlaid(tables, value)
    return tables


def _names(question, table, key):
    """Tell whether an override gives a key a value."""
    given = _set({}, question.sets).get(table, {})
    return isinstance(given, dict) and bool(given.get(key))


def _check_roughness(name):
    """Refuse a scene whose roughness cannot be set."""
    path = scene.find(name)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"scene {path}: cannot be read ({error})") from None
    if not re.search(r"""<default\s+name\s*=\s*["']roughness["']""", text):
        raise ConfigError(f'scene {name}: no <default name="roughness" .../> in it, which is to be varied')


# ---- on disk -----------------------------------------------------------------------------------------------


def save(out, name: str, question: Question, cells: list[Cell]) -> bool:
    """Add cells to the plan of a table; a plan under another question is replaced.

    Returns
    -------
    bool
        True if a plan was replaced: its runs are still there, and come back with its question.

    Raises
    ------
    InputError
        The folder cannot be made or written to, or holds something else under that name.
    """
    path, replaced, known = Path(out) / f"{name}.json", False, {}
    if (old := load(out, name)) is not None:
        if old[0] == question:
            known = {cell.place: cell for cell in old[1]}
        else:
            replaced = True
    known |= {cell.place: cell for cell in cells}
    text = {"question": asdict(question), "cells": [asdict(cell) for cell in known.values()]}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}): give another --out") from None
    write_atomically(path, (json.dumps(text, indent=1) + "\n").encode())
    return replaced


def load(out, name: str) -> tuple[Question, list[Cell]] | None:
    """Read the plan of a table; None where there is none.

    Raises
    ------
    InputError
        The file is not a plan.
    """
    path = Path(out) / f"{name}.json"
    try:
        found = json.loads(path.read_bytes())
        question = found["question"] | {"sets": tuple(found["question"]["sets"])}
        return Question(**question), [Cell(**cell) for cell in found["cells"]]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a plan of experiments.paper ({error}); remove it") from None
