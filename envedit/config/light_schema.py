"""The keys of ``[[input.lights]]``: lights that are moved, changed or added by hand before the edit.

What they do is :mod:`envedit.representations.layers.placed_lights`'s.
"""

from __future__ import annotations

import difflib
from typing import Any

from envedit.config.validators import WantedError, integer, named, number, numbers, show
from envedit.core.errors import ConfigError

MOST_PLACED = 64
"""Entries of ``[[input.lights]]``."""
_BRIGHTEST = 1e6
_FLUX = numbers(*3 * [number(0, _BRIGHTEST)])
_PLACE = {"azimuth": number(-360, 720), "elevation": number(-90, 90)}
OWN = {"light": integer(1, 8), **_PLACE, "flux": _FLUX, "size": number(0.01, 20)}
"""Of a light of the map: its number, those with most flux first; where it goes; factors on flux and size."""
ADDED = {**_PLACE, "flux": _FLUX, "size": number(0.01, 90)}
"""Of a light that is added: where; its flux, radiance times steradian; its radius in degrees."""
SIZE = 0.5
"""Radius in degrees of an added light where none is given."""


def light_list(value: Any) -> tuple[dict, ...]:
    """Accept a list of lights; every entry has all keys that it can have.

    Raises
    ------
    WantedError
        It is no list of tables, or too long.
    ConfigError
        An entry has an unknown key or an unusable value; the message names ``input.lights[2].flux``.
    """
    if not isinstance(value, list | tuple) or not all(isinstance(v, dict) for v in value):
        raise WantedError("a list of tables")
    if len(value) > MOST_PLACED:
        raise WantedError(f"at most {MOST_PLACED} lights")
    found = tuple(_light(f"input.lights[{i}]", v) for i, v in enumerate(value))
    own = [light["light"] for light in found if "light" in light]
    if twice := sorted({n for n in own if own.count(n) > 1}):
        raise ConfigError(f"input.lights: got light {twice[0]} more than once, expected one entry a light")
    return found


def _light(name: str, light: dict) -> dict:
    keys = OWN if "light" in light else ADDED
    for unknown in (k for k in light if k not in keys):
        close = difflib.get_close_matches(str(unknown)[:60], keys, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(OWN)}"
        raise ConfigError(f"{name}: has no key {show(unknown)}; {hint}")
    found = {key: named(f"{name}.{key}", check, light[key]) for key, check in keys.items() if key in light}
    if ("azimuth" in found) != ("elevation" in found):
        raise ConfigError(f"{name}: got one of azimuth and elevation, expected both or none")
    if "light" in light:
        return {"flux": [1.0, 1.0, 1.0], "size": 1.0} | found
    for key in ("azimuth", "flux"):
        if key not in found:
            raise ConfigError(f"{name}.{key}: got none, expected one: a light without `light` is added")
    return {"size": SIZE} | found
