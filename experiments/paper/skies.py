"""The PureSky maps that the tables are made over: those that a folder holds."""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from pathlib import Path

from envedit import image, latlong
from envedit.errors import ConfigError, InputError

DEFAULT = "kloofendal_48d_partly_cloudy"
"""The map of a table that the paper made with one; it does not name its own."""
OTHER = "autumn_field"
"""The true map of Figure 8, turned: "a different environment map in a different light orientation"."""

_NAME = re.compile(r"(?P<name>.+)_puresky_(?P<size>[1-9][0-9]?)k\.(?P<kind>hdr|exr)")
_HOW = "python -m experiments.download_puresky DIR fetches them"


def find(folder=None) -> dict[str, Path]:
    """List the maps of a folder by name.

    Parameters
    ----------
    folder : path, optional
        With files NAME_puresky_1k.hdr (or .exr, or of another resolution: of several the smallest is taken);
        None: the folder ``puresky`` of ENVEDIT_DATA.

    Raises
    ------
    ConfigError
        No folder is given and ENVEDIT_DATA is not set.
    InputError
        It is no folder, or holds no map.
    """
    if folder is None:
        if not (root := os.environ.get("ENVEDIT_DATA")):
            raise ConfigError(f"--maps: give a folder with NAME_puresky_1k.hdr, or set ENVEDIT_DATA; {_HOW}")
        folder = Path(root) / "puresky"
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


def choose(found: dict[str, Path], names, several: bool) -> dict[str, Path]:
    """Pick maps by name.

    Parameters
    ----------
    found : dict
        As of :func:`find`.
    names : sequence of str or None
        Which; ``["all"]``: every one; None: every one where ``several``, else :data:`DEFAULT`, or the first
        where that is not there.
    several : bool
        Whether the paper averages over maps there.

    Raises
    ------
    ConfigError
        A name is not among them.
    """
    if names is None:
        names = ["all"] if several else [DEFAULT if DEFAULT in found else next(iter(found))]
    if list(names) == ["all"]:
        return found
    for name in names:
        if name not in found:
            close = difflib.get_close_matches(name, found, 1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(found)}"
            raise ConfigError(f"--only: no map {name}; {hint}")
    return {name: found[name] for name in dict.fromkeys(names)}


def turned(file: Path, degrees: float, folder) -> Path:
    """Write a map that is turned about the vertical, unless that was done before.

    All PureSky maps have their sun in the middle: another map alone is not another orientation of the light.

    Parameters
    ----------
    file : path
        The map; its own resolution is kept.
    degrees : float
        To the left.
    folder : path
        Where to; made where it is not there.

    Returns
    -------
    Path
        ``NAME-turned-DEGREES-CONTENT.exr``.

    Raises
    ------
    InputError
        The map cannot be read, or the file cannot be written.
    """
    content = hashlib.sha256(file.read_bytes()).hexdigest()[:8]
    path = Path(folder).absolute() / f"{file.stem}-turned-{degrees:g}-{content}.exr"
    if not path.exists():
        original, _ = image.load_envmap(str(file))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{path.parent}: cannot be made ({error.strerror}): give another --out"
            ) from None
        image.write_exr(path, latlong.rotate(original, degrees))
    return path
