"""An edit from Python, without files: ``envedit.edit(config)``."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi

from . import config
from ._callable import make_callable
from .errors import ConfigError
from .pipeline import run


def edit(settings: config.Config | str, *, target=None, mask=None, **named):
    """Carry out an edit without writing files: ``envedit.edit(config)``.

    Parameters
    ----------
    settings : config.Config or path
        A configuration, or the TOML file of one.
    target : ndarray (h, w, 3), optional
        A painted picture in linear radiance, in place of the configuration's target: what
        :func:`envedit.painted.initial` rendered, with something painted over it.
    mask : ndarray (h, w), optional
        Where it was painted, in [0, 1]; by default where it differs from the initial rendering.
    **named
        As :func:`envedit.pipeline.run`.

    Returns
    -------
    pipeline.Result
        ``envmap``, ``render``, ``metrics``, ``history``.

    Raises
    ------
    EnveditError
        As :func:`envedit.pipeline.run`; ConfigError if there is a mask without a target.
    """
    if mask is not None and target is None:
        raise ConfigError("mask: given without a target; it says where that was painted")
    if not isinstance(settings, config.Config):
        named.setdefault("base", Path(settings).absolute().parent)
        settings = config.load(settings)
    mi.set_variant(settings.variant)
    return run(settings, picture=target, mask=mask, **named)


make_callable(__name__, edit)
