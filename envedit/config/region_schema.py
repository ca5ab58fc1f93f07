"""The keys of ``[[input.regions]]``: regions of the map that are kept, scaled or filled.

What they do is :mod:`envedit.images.map_regions`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from envedit.config.validators import Check, Choice, Number, Numbers, Schema, WantedError, meant, named, show
from envedit.core.errors import ConfigError

MOST_REGIONS, MOST_POINTS = 64, 500
"""Regions of a map, and points of each."""
ACTIONS = ("keep", "scale", "fill")
_POINT = Numbers(Number(-360, 720), Number(-90, 90))
_FACTOR = Number(0, 1e6)


@dataclass(frozen=True)
class Places(Check):
    """Directions of the map, [azimuth, elevation] in degrees, of which there are at least so many."""

    least: int
    kind = "list"

    def _take(self, value: Any) -> list[list[float]]:
        if not isinstance(value, list | tuple) or not self.least <= len(value) <= MOST_POINTS:
            raise WantedError(str(self))
        try:
            return [_POINT(place) for place in value]
        except WantedError:
            raise WantedError(f"{self}; azimuth from -360 to 720, elevation from -90 to 90 degrees") from None

    def __str__(self) -> str:
        return f"[[azimuth, elevation], ...], {self.least} to {MOST_POINTS}"

    @property
    def range(self) -> str:
        """Their form and number."""
        return str(self)

    def _schema(self) -> Schema:
        items = _POINT.schema()
        return {"type": "array", "items": items, "minItems": self.least, "maxItems": MOST_POINTS}


KEYS: dict[str, Check] = {
    "action": Choice(*ACTIONS),
    "points": Places(1),
    "radius": Number(0, 180, positive=True),
    "polygon": Places(3),
    "softness": Number(0, 180),
    "factor": Numbers(*3 * [_FACTOR]),
}
"""Of a region: what happens there, and where it is."""
MEANINGS = {
    "action": "keep: an edit changes nothing there; scale: radiance is multiplied; fill: replaced by what is "
    "around it",
    "points": "middle line of a brush, directions of the map in degrees",
    "radius": "of the brush, degrees; only with points, and needed there",
    "polygon": "corners of a region, joined by straight lines in the lat-long image; across its edge "
    "azimuths go on below 0 or above 360",
    "softness": "degrees outside the border over which the change fades, at least a texel",
    "factor": "scale: factors on red, green and blue; needed",
}
"""What each key is, for the reference."""


@dataclass(frozen=True)
class RegionList(Check):
    """A list of regions.

    Calling it raises ConfigError, which names ``input.regions[2].radius``, where an entry has an unknown key
    or an unusable value; WantedError if it is no list of tables, or too long.
    """

    kind = "list of tables"

    def _take(self, value: Any) -> tuple[dict[str, Any], ...]:
        if not isinstance(value, list | tuple) or not all(isinstance(v, dict) for v in value):
            raise WantedError(str(self))
        if len(value) > MOST_REGIONS:
            raise WantedError(f"at most {MOST_REGIONS} regions")
        return tuple(_region(f"input.regions[{i}]", v) for i, v in enumerate(value))

    def __str__(self) -> str:
        return "a list of tables"

    @property
    def range(self) -> str:
        """How many."""
        return f"at most {MOST_REGIONS}"

    def _schema(self) -> Schema:
        keys = {key: {**check.schema(), "description": MEANINGS[key]} for key, check in KEYS.items()}
        region: Schema = {"type": "object", "properties": keys, "additionalProperties": False}
        region |= {"required": ["action"], "oneOf": [{"required": ["points"]}, {"required": ["polygon"]}]}
        region["dependencies"] = {"points": ["radius"], "radius": ["points"]}
        return {"type": "array", "items": region, "maxItems": MOST_REGIONS}


def _region(name: str, region: dict[str, Any]) -> dict[str, Any]:
    for unknown in (key for key in region if key not in KEYS):
        raise ConfigError(f"{name}: has no key {show(unknown)}; {meant(unknown, KEYS)}")
    found = {key: named(f"{name}.{key}", check, region[key]) for key, check in KEYS.items() if key in region}
    if "action" not in found:
        raise ConfigError(f"{name}.action: got none, expected one of {', '.join(ACTIONS)}")
    if ("points" in found) == ("polygon" in found):
        given = "both" if "points" in found else "neither"
        raise ConfigError(f"{name}: got {given} of points and polygon, expected one of them")
    _require(name, "radius", found, needed="points" in found, where="with points")
    _require(name, "factor", found, needed=found["action"] == "scale", where='where action is "scale"')
    return {"softness": 0.0} | found


def _require(name, key, found, needed, where):
    """Raise ConfigError where a key is missing, or is given without a meaning."""
    if needed and key not in found:
        raise ConfigError(f"{name}.{key}: got none, expected one {where}")
    if not needed and key in found:
        raise ConfigError(f"{name}.{key}: got {show(found[key])}, expected none but {where}")
