"""An edit or a fit from Python, without files: ``envedit.edit(config)``, ``envedit.fit(image)``."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.errors import ConfigError
from envedit.pipeline import Watch, run
from envedit.representations.siren.fit import fit
from envedit.results import Result

__all__ = ["edit", "fit"]


def edit(
    settings: config.Config | str | PathLike,
    *,
    target: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    base: Path | None = None,
    watch: Watch | None = None,
) -> Result:
    """Carry out an edit without writing files: ``envedit.edit(config)``.

    Parameters
    ----------
    settings : config.Config or path
        A configuration, or the TOML file of one.
    target : ndarray (h, w, 3), optional
        A painted picture in linear radiance, in place of the configuration's target: what
        :func:`envedit.targets.initial_rendering.initial` rendered, with something painted over it.
    mask : ndarray (h, w), optional
        Where it was painted, in [0, 1]; by default where it differs from the initial rendering.
    base : Path, optional
        Folder that file names in scene parameters are relative to; by default the configuration's.
    watch : Watch, optional
        Receives progress.

    Returns
    -------
    Result
        ``envmap``, ``render``, ``metrics``, ``history``.

    Raises
    ------
    EnveditError
        As :func:`envedit.pipeline.run`; ConfigError if there is a mask without a target.
    """
    if mask is not None and target is None:
        raise ConfigError("mask: given without a target; it says where that was painted")
    if not isinstance(settings, config.Config):
        base = base or Path(settings).absolute().parent
        settings = config.load(settings)
    mi.set_variant(settings.variant)
    return run(settings, base=base, watch=watch, picture=target, mask=mask)
