"""The keys of ``[[input.regions]]``: regions of the map that are kept, scaled or filled.

What they do is :mod:`envedit.images.map_regions`'s.
"""

from __future__ import annotations

from typing import Any

from envedit.config.validators import Check, Choice, Number, Numbers, Points, Tables
from envedit.core.errors import ConfigError

MOST_REGIONS, MOST_POINTS = 64, 500
"""Regions of a map, and points of each."""
ACTIONS = ("keep", "scale", "fill")
_POINT = Numbers(Number(-360, 720), Number(-90, 90))
_DIRECTIONS = "azimuth, elevation"

KEYS: dict[str, tuple[Check, str]] = {
    "action": (
        Choice(*ACTIONS),
        "keep: an edit changes nothing there; scale: radiance is multiplied; fill: replaced by what is "
        "around it",
    ),
    "points": (
        Points(_POINT, _DIRECTIONS, 1, MOST_POINTS),
        "middle line of a brush, directions [azimuth, elevation] of the map in degrees",
    ),
    "radius": (Number(0, 180, positive=True), "of the brush, degrees; only with points, and needed there"),
    "polygon": (
        Points(_POINT, _DIRECTIONS, 3, MOST_POINTS),
        "corners of a region, joined by straight lines in the lat-long image; across its edge azimuths go on "
        "below 0 or above 360",
    ),
    "softness": (
        Number(0, 180),
        "degrees outside the border over which the change fades, at least a texel",
    ),
    "factor": (Numbers(*3 * [Number(0, 1e6)]), "scale: factors on red, green and blue; needed"),
}
"""Of a region, what happens there and where it is: check and meaning of each key."""


class RegionList(Tables):
    """A list of regions."""

    name = "input.regions"
    most = MOST_REGIONS
    keys = KEYS
    rules = {
        "required": ["action"],
        "oneOf": [{"required": ["points"]}, {"required": ["polygon"]}],
        "dependencies": {"points": ["radius"], "radius": ["points"]},
    }

    def _entry(self, name: str, region: dict[str, Any]) -> dict[str, Any]:
        found = self._checked(name, region)
        if "action" not in found:
            raise ConfigError(f"{name}.action: got none, expected one of {', '.join(ACTIONS)}")
        if ("points" in found) == ("polygon" in found):
            given = "both" if "points" in found else "neither"
            raise ConfigError(f"{name}: got {given} of points and polygon, expected one of them")
        self._require(name, "radius", found, needed="points" in found, where="with points")
        scales = found["action"] == "scale"
        self._require(name, "factor", found, needed=scales, where='where action is "scale"')
        return {"softness": 0.0} | found
