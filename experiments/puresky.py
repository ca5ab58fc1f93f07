"""The PureSky maps that experiments are made over: those that a folder holds, by name."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path

from envedit.core.errors import ConfigError, EnveditError, InputError

_NAME = re.compile(r"(?P<name>.+)_puresky_(?P<size>[1-9][0-9]?)k\.(?P<kind>hdr|exr)")
_HOW = "python -m experiments.download_puresky DIR fetches them"


def data(holds: str = "puresky/NAME_puresky_1k.hdr", give: str = "", how: str = _HOW) -> Path:
    """Return the folder that ENVEDIT_DATA names.

    Parameters
    ----------
    holds, how : str
        What is looked for in it and how it is had, for the error.
    give : str, optional
        What may be given instead, for the error.

    Raises
    ------
    ConfigError
        ENVEDIT_DATA is not set.
    """
    if not (root := os.environ.get("ENVEDIT_DATA")):
        raise ConfigError(f"no maps: {give}set ENVEDIT_DATA to a folder with {holds}; {how}")
    return Path(root)


def find(folder: str | Path | None = None, option: str = "") -> dict[str, Path]:
    """List the maps of a folder by name.

    Parameters
    ----------
    folder : path, optional
        With files NAME_puresky_1k.hdr (or .exr, or of another resolution: of several the smallest is taken);
        None: the folder ``puresky`` of ENVEDIT_DATA.
    option : str, optional
        What names the folder on the command line, for the error.

    Raises
    ------
    ConfigError
        No folder is given and ENVEDIT_DATA is not set.
    InputError
        It is no folder, or holds no map.
    """
    if folder is None:
        folder = data(give=f"give {option} DIR, or " if option else "") / "puresky"
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of maps; {_HOW}")
    matches = [match for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))]
    matches.sort(key=lambda m: (m["name"], int(m["size"]), m["kind"] != "hdr"))
    if not matches:
        raise InputError(f"{folder}: no map NAME_puresky_1k.hdr or .exr in it; {_HOW}")
    found: dict[str, Path] = {}
    for match in matches:
        found.setdefault(match["name"], folder / match[0])
    return found


def pick(found: dict[str, Path], names: Iterable[str], option: str = "--maps") -> dict[str, Path]:
    """Pick maps of :func:`find` by the names that ``option`` gave.

    Raises
    ------
    ConfigError
        A name is not among them.
    """
    names = list(dict.fromkeys(names))
    for name in names:
        if name not in found:
            close = difflib.get_close_matches(name, found, 1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(found)}"
            raise ConfigError(f"{option}: no map {name}; {hint}")
    return {name: found[name] for name in names}


def of_script(names: Iterable[str] | None = None) -> dict[str, Path]:
    """Return the maps of ENVEDIT_DATA, all or some, or end the program with one line that says why not."""
    try:
        return chosen(names)
    except EnveditError as error:
        sys.exit(f"envedit: {error}")


def chosen(names: Iterable[str] | None = None) -> dict[str, Path]:
    """Return the maps of ENVEDIT_DATA, all or some.

    Raises
    ------
    ConfigError, InputError
        As :func:`find` and :func:`pick`.
    """
    return pick(find(), names) if names else find()
