"""Which PureSky maps a table is made over, and a turned one."""

from __future__ import annotations

import hashlib
from pathlib import Path

from envedit.core import latlong
from envedit.core.errors import InputError
from envedit.images import images
from experiments import puresky

DEFAULT = "kloofendal_48d_partly_cloudy"
"""The map of a table that the paper made with one; it does not name its own."""
OTHER = "autumn_field"
"""The true map of Figure 8, turned: "a different environment map in a different light orientation"."""


def choose(found: dict[str, Path], names, several: bool) -> dict[str, Path]:
    """Pick maps by name.

    Parameters
    ----------
    found : dict
        As of :func:`experiments.puresky.find`.
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
    return puresky.pick(found, names, "--maps")


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
        original, _ = images.load_envmap(str(file))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{path.parent}: cannot be made ({error.strerror}): give another --out"
            ) from None
        images.write_exr(path, latlong.rotate(original, degrees))
    return path
