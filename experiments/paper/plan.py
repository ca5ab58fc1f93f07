"""What each table and figure consists of: one case for every row, map and roughness.

Runs lie under the hash of all that decides what comes out of them, so that tables share them: the same edit
is never made twice.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

from envedit.config import presets
from envedit.core.errors import ConfigError, InputError
from envedit.scene import scene
from envedit.sweep import Job
from experiments import puresky
from experiments.harness import Case, overridden

from . import network, skies
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
    key : str
        Name of the run's folder.
    fitted : bool
        Whether it is a fit of Figures 4 and 5, not an edit.
    """

    settings: str
    row: str
    map: str
    roughness: float | None
    key: str
    fitted: bool = False

    def folder(self, out) -> Path:
        """Return the run's folder."""
        return Path(out) / self.key


def cell(case: Case, job: Job) -> Cell:
    """Return a case's place in the table."""
    return Cell(**case.about, key=job.key)


@dataclass(frozen=True)
class Question:
    """What all runs of a table have in common; the command line gives it."""

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
) -> list[Case]:
    """List the runs of a table or figure, without the question's overrides, which :meth:`.Case.job` takes.

    Parameters
    ----------
    name : str
        A key of :data:`KINDS`.
    question : Question
        Scene ("": the table's own), turn of the true map in degrees, and overrides ``table.key=value``, of
        which only those that name weights count here. Of Figure 8 the name of the true map, of Figure 9 the
        edit.
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
                    about = {"settings": setting, "row": row, "map": sky, "roughness": roughness}
                    fit = {}
                    if kind.methods is FITS:
                        recipe = row if row.startswith("stock") else "fits"
                        command, about["fitted"] = network.command(recipe), True
                        fit = {"command": command, "version": network.version(recipe)}
                    made.append(Case(f"{name}, {setting}: {row}, {sky}{varied}", tables, about, **fit))
    if not made:
        raise ConfigError(
            f"{name}: nothing to run: no row of --rows {' '.join(rows or kind.rows)} has settings "
            f"{' or '.join(settings)} (layers are ours; lum-l1-dists needs perceptual.vgg)"
        )
    return made


def resolved(name: str, question: Question, maps=None, only=None) -> Question:
    """Name the true map of Figure 8 where the question does not, where there is one."""
    if name == "figure8" and not question.target:
        chosen = _maps(name, KINDS[name], maps, only)
        if skies.OTHER in _known(maps) and skies.OTHER not in chosen:
            return replace(question, target=skies.OTHER)
    return question


def _known(folder):
    return puresky.find(folder, "--folder")


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


def _names(question, table, key):
    """Tell whether an override gives a key a value."""
    given = overridden({}, question.sets).get(table, {})
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
