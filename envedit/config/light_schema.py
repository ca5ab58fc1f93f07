"""The keys of ``[[input.lights]]``: lights that are moved, changed or added by hand before the edit.

What they do is :mod:`envedit.representations.layers.placed_lights`'s.
"""

from __future__ import annotations

from typing import Any

from envedit.config.validators import Boolean, Check, Choice, Integer, Number, Numbers, String, Tables
from envedit.core.errors import ConfigError

MOST_PLACED = 64
"""Entries of ``[[input.lights]]``."""
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
SIZE = 0.5
"""Radius in degrees of an added light where none is given."""
_OWN_SIZE = Number(0.01, 20)  # a factor, of a light of the map

KEYS: dict[str, tuple[Check, str]] = {
    "light": (
        Integer(1, 8),
        "number of a light of the map, those with most flux first; without it a light is added",
    ),
    "azimuth": (
        Number(-360, 720),
        "where it goes, degrees along the columns; needed for a light that is added",
    ),
    "elevation": (Number(-90, 90), "likewise, degrees above the horizon"),
    "flux": (
        Numbers(*3 * [Number(0, 1e6)]),
        "of the map's light: factors on its; of an added one: radiance times steradian; needed",
    ),
    "size": (
        Number(0.01, 90),
        "of the map's light: factor on its size, to 20; of an added one: radius in degrees, or half "
        "of its longer side",
    ),
    "shape": (
        Choice(*SHAPES),
        "of an added light; ring: the hole has half the radius; gradient: a rectangle that falls from "
        "its upper side to black at its lower one; strip: with round ends; image: a rectangle with a picture",
    ),
    "image": (
        String(),
        "file of a light of shape image, and needed there: its colours are the picture's times flux",
    ),
    "aspect": (
        Number(0.01, 1),
        "of an added light: its shorter side over its longer one; without it 1, of a strip 0.1, of an "
        "image the picture's",
    ),
    "rotation": (
        Number(-360, 360),
        "likewise: degrees by which its longer side is turned to the left from the horizontal",
    ),
    "softness": (
        Number(0, 1),
        "likewise, but not of a Gaussian: 0 has a sharp border, 1 fades from the middle",
    ),
    "name": (String(), "what it is called in the page of `envedit paint`"),
    "role": (Choice("key", "fill", "rim"), "what it does in the picture, a label like the name"),
    "muted": (Boolean(), "whether it is switched off"),
    "locked": (Boolean(), "whether an edit of layers leaves it, with its glow, as it is here"),
}
"""Of a light: check and meaning of each key."""
OF_ADDED = ("shape", "image", "aspect", "rotation", "softness")
"""Keys that a light of the map does not have."""


class LightList(Tables):
    """A list of lights, with flux and size spelled out."""

    name = "input.lights"
    most = MOST_PLACED
    keys = KEYS
    rules = {"dependencies": {"azimuth": ["elevation"], "elevation": ["azimuth"]}}

    def __call__(self, value: Any) -> tuple[dict[str, Any], ...]:
        found = super().__call__(value)
        own = [light["light"] for light in found if "light" in light]
        if twice := sorted({n for n in own if own.count(n) > 1}):
            raise ConfigError(
                f"input.lights: got light {twice[0]} more than once, expected one entry a light"
            )
        return found

    def _entry(self, name: str, light: dict[str, Any]) -> dict[str, Any]:
        own = {"size": _OWN_SIZE, **dict.fromkeys(OF_ADDED)} if "light" in light else {}
        found = self._checked(name, light, **own)
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
