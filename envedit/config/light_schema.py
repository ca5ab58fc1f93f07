"""The keys of ``[[input.lights]]``: lights that are moved, changed or added by hand before the edit.

What they do is :mod:`envedit.representations.layers.placed_lights`'s.
"""

from __future__ import annotations

from typing import Any

from envedit.config.validators import (
    Boolean,
    Check,
    Choice,
    Integer,
    Number,
    Numbers,
    Schema,
    String,
    Tables,
)
from envedit.core.errors import ConfigError

MOST_PLACED = 64
"""Entries of ``[[input.lights]]``."""
_BRIGHTEST = 1e6
_FLUX = Numbers(*3 * [Number(0, _BRIGHTEST)])
_PLACE: dict[str, Check] = {"azimuth": Number(-360, 720), "elevation": Number(-90, 90)}
ROLES = ("key", "fill", "rim")
_LISTED: dict[str, Check] = {
    "name": String(),
    "role": Choice(*ROLES),
    "muted": Boolean(),
    "locked": Boolean(),
}
OWN: dict[str, Check] = {
    "light": Integer(1, 8),
    **_PLACE,
    "flux": _FLUX,
    "size": Number(0.01, 20),
    **_LISTED,
}
"""Of a light of the map: its number, those with most flux first; where it goes; factors on flux and size."""
SHAPES = {
    "gaussian": 1.0,
    "disc": 1.0,
    "rectangle": 1.0,
    "ring": 1.0,
    "gradient": 1.0,
    "strip": 0.1,
    "image": None,
}
"""Shapes of a light that is added, each with its ``aspect`` where none is given; None: its own."""
ADDED: dict[str, Check] = {
    **_PLACE,
    "flux": _FLUX,
    "size": Number(0.01, 90),
    "shape": Choice(*SHAPES),
    "image": String(),
    "aspect": Number(0.01, 1),
    "rotation": Number(-360, 360),
    "softness": Number(0, 1),
    **_LISTED,
}
"""Of a light that is added: where; its flux, radiance times steradian; its radius in degrees; its shape."""
MEANINGS = {
    "light": "number of a light of the map, those with most flux first; without it a light is added",
    "azimuth": "where it goes, degrees along the columns; needed for a light that is added",
    "elevation": "likewise, degrees above the horizon",
    "flux": "of the map's light: factors on its; of an added one: radiance times steradian; needed",
    "size": "of the map's light: factor on its size, to 20; of an added one: radius in degrees, or half "
    "of its longer side",
    "shape": "of an added light; ring: the hole has half the radius; gradient: a rectangle that falls from "
    "its upper side to black at its lower one; strip: with round ends; image: a rectangle with a picture",
    "image": "file of a light of shape image, and needed there: its colours are the picture's times flux",
    "aspect": "of an added light: its shorter side over its longer one; without it 1, of a strip 0.1, of an "
    "image the picture's",
    "rotation": "likewise: degrees by which its longer side is turned to the left from the horizontal",
    "softness": "likewise, but not of a Gaussian: 0 has a sharp border, 1 fades from the middle",
    "name": "what it is called in the page of `envedit paint`",
    "role": "what it does in the picture, a label like the name",
    "muted": "whether it is switched off",
    "locked": "whether an edit of layers leaves it, with its glow, as it is here",
}
"""What each key is, for the reference."""
SIZE = 0.5
"""Radius in degrees of an added light where none is given."""


class LightList(Tables):
    """A list of lights; every entry has all keys that it can have."""

    name = "input.lights"
    most = MOST_PLACED

    def __call__(self, value: Any) -> tuple[dict[str, Any], ...]:
        found = super().__call__(value)
        own = [light["light"] for light in found if "light" in light]
        if twice := sorted({n for n in own if own.count(n) > 1}):
            raise ConfigError(
                f"input.lights: got light {twice[0]} more than once, expected one entry a light"
            )
        return found

    def _entry(self, name: str, light: dict[str, Any]) -> dict[str, Any]:
        keys = OWN if "light" in light else {"light": OWN["light"]} | ADDED
        found = self._checked(name, light, keys)
        if ("azimuth" in found) != ("elevation" in found):
            raise ConfigError(f"{name}: got one of azimuth and elevation, expected both or none")
        if "light" in light:
            return {"flux": [1.0, 1.0, 1.0], "size": 1.0} | found
        if (found.get("shape") == "image") != bool(found.get("image")):
            raise ConfigError(f'{name}: got one of shape = "image" and image = FILE, expected both or none')
        for key in ("azimuth", "flux"):
            if key not in found:
                raise ConfigError(f"{name}.{key}: got none, expected one: a light without `light` is added")
        return {"size": SIZE} | found

    def schema(self) -> Schema:
        keys = {key: {**(OWN | ADDED)[key].schema(), "description": MEANINGS[key]} for key in MEANINGS}
        both = {"azimuth": ["elevation"], "elevation": ["azimuth"]}
        return self._schema_of({"properties": keys, "dependencies": both})
