"""The keys of lists of tables: ``[[input.lights]]``, ``[[input.regions]]``, ``[[target.strokes]]``.

What they do is :mod:`envedit.representations.layers.placed_lights`'s, :mod:`envedit.images.map_regions`'s and
:mod:`envedit.targets.strokes`'s.
"""

from __future__ import annotations

import json
import re
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.config.validators import (
    VIEW,
    Boolean,
    Check,
    Choice,
    Either,
    Integer,
    ListOf,
    Number,
    Numbers,
    Schema,
    String,
    WantedError,
    meant,
    named,
    show,
)
from envedit.core.color import srgb_to_linear
from envedit.core.errors import ConfigError


class Tables(Check):
    """A list of tables.

    Calling it raises ConfigError, which names ``input.lights[2].flux``, where an entry has an unknown key or
    an unusable value; WantedError if it is no list of tables, or too long.
    """

    words = "a list of tables"
    name: str  # of the key, "input.lights"
    most: int | None = None  # entries; None: any number
    keys: dict[str, tuple[Check, str]]  # of an entry: check and meaning
    rules: Schema  # what depends on several keys of an entry, as JSON Schema

    def __call__(self, value: Any) -> tuple[dict[str, Any], ...]:
        if not isinstance(value, list | tuple) or not all(isinstance(v, dict) for v in value):
            raise WantedError(str(self))
        if self.most is not None and len(value) > self.most:
            raise WantedError(f"at most {self.most} {self.name.split('.')[1]}")
        return tuple(self._entry(f"{self.name}[{i}]", v) for i, v in enumerate(value))

    @abstractmethod
    def _entry(self, name: str, table: dict[str, Any]) -> dict[str, Any]: ...

    def _checked(self, name: str, table: dict[str, Any], **others: Check | None) -> dict[str, Any]:
        """Return the values of an entry, in the order of :attr:`keys`.

        ``others`` are checks in place of those of the keys; None: the entry cannot have the key.
        """
        checks = {key: others.get(key, check) for key, (check, _) in self.keys.items()}
        known = {key: check for key, check in checks.items() if check}
        for key in table:
            if key not in known:
                raise ConfigError(f"{name}: has no key {show(key)}; {meant(key, known)}")
        return {k: named(f"{name}.{k}", check, table[k]) for k, check in known.items() if k in table}

    def _require(self, name: str, key: str, found: dict[str, Any], needed: bool, where: str) -> None:
        """Raise ConfigError where a key of an entry is missing, or is given without a meaning."""
        if needed and key not in found:
            raise ConfigError(f"{name}.{key}: got none, expected one {where}")
        if not needed and key in found:
            raise ConfigError(f"{name}.{key}: got {show(found[key])}, expected none but {where}")

    def schema(self) -> Schema:
        keys = {key: {**check.schema(), "description": about} for key, (check, about) in self.keys.items()}
        entry = {"type": "object", "properties": keys, **self.rules, "additionalProperties": False}
        return {"type": "array", "items": entry} | ({} if self.most is None else {"maxItems": self.most})


def _points(point: Check, names: str, least: int, most: int | None = None) -> Check:
    """Return the check of a list of points, each a list of two numbers of these names."""
    count = f"at least {least}" if most is None else f"{least} to {most}"
    return ListOf(point, least, most, words=f"[[{names}], ...], {count}")


# ---- Lights: moved, changed or added by hand before the edit -----------------------------------------------

MOST_PLACED = 64
"""Entries of ``[[input.lights]]``."""
LIGHT_SHAPES = {
    "gaussian": 1.0,
    "disc": 1.0,
    "rectangle": 1.0,
    "ring": 1.0,
    "gradient": 1.0,
    "strip": 0.1,
    "image": None,
}
"""Shapes of a light that is added, each with its ``aspect`` where none is given; None: its own."""
LIGHT_SIZE = 0.5
"""Radius in degrees of an added light where none is given."""
_OWN_SIZE = Number(0.01, 20)  # a factor, of a light of the map

LIGHT_KEYS: dict[str, tuple[Check, str]] = {
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
        Choice(*LIGHT_SHAPES),
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
    keys = LIGHT_KEYS
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
        return {"size": LIGHT_SIZE} | found


# ---- Regions of the map: kept, scaled or filled ------------------------------------------------------------

MOST_REGIONS, MOST_POINTS = 64, 500
"""Regions of a map, and points of each."""
ACTIONS = ("keep", "scale", "fill")
_DIRECTION = Numbers(Number(-360, 720), Number(-90, 90))
_ANGLES = "azimuth, elevation"

REGION_KEYS: dict[str, tuple[Check, str]] = {
    "action": (
        Choice(*ACTIONS),
        "keep: an edit changes nothing there; scale: radiance is multiplied; fill: replaced by what is "
        "around it",
    ),
    "points": (
        _points(_DIRECTION, _ANGLES, 1, MOST_POINTS),
        "middle line of a brush, directions [azimuth, elevation] of the map in degrees",
    ),
    "radius": (Number(0, 180, positive=True), "of the brush, degrees; only with points, and needed there"),
    "polygon": (
        _points(_DIRECTION, _ANGLES, 3, MOST_POINTS),
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
    keys = REGION_KEYS
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


# ---- Strokes: painted on the rendering ---------------------------------------------------------------------

_FURTHEST = 1e6
_COORDINATE = Number(-_FURTHEST, _FURTHEST)
_LENGTH = Number(0, _FURTHEST, positive=True)
_POINT = Numbers(_COORDINATE, _COORDINATE)
_RADII = _LENGTH, _LENGTH
_ELLIPSE = Either(
    "[cx, cy, rx, ry] or [cx, cy, rx, ry, degrees]",
    Numbers(*_POINT.checks, *_RADII),
    Numbers(*_POINT.checks, *_RADII, Number(-360, 360)),
)
_LINEAR = Numbers(*3 * [Number(0, 1e6)])


@dataclass(frozen=True)
class Color(Check):
    """[r, g, b], factors on linear radiance, or the sRGB colour "#rrggbb", which becomes them."""

    words = '[r, g, b], or a colour such as "#ffd9a6"'

    def __call__(self, value: Any) -> list[float]:
        if isinstance(value, str):
            if not re.fullmatch("#[0-9a-fA-F]{6}", value):
                raise WantedError(str(self))
            codes = np.frombuffer(bytes.fromhex(value[1:]), np.uint8)
            return [float(round(c, 4)) for c in srgb_to_linear(codes / 255)]
        return _LINEAR(value)

    def schema(self) -> Schema:
        return {"anyOf": [_LINEAR.schema(), {"type": "string", "pattern": "^#[0-9a-fA-F]{6}$"}]}


class Rectangle(Numbers):
    """Upper left and lower right corner."""

    def __init__(self) -> None:
        super().__init__(*4 * [_COORDINATE])

    def __call__(self, value: Any) -> list[float]:
        x0, y0, x1, y1 = corners = super().__call__(value)
        if x1 <= x0 or y1 <= y0:
            raise WantedError(str(self))
        return corners

    def __str__(self) -> str:
        return "[x0, y0, x1, y1] with x1 above x0 and y1 above y0"


STROKE_SHAPES = ("points", "polygon", "ellipse", "rectangle")
"""Keys that say where a stroke is."""
WHOLE_IMAGE = ("temperature", "contrast", "blur")
"""What may be done to the whole image, without a shape."""
STROKES: dict[str, dict[str, Any]] = {
    "shadow": {"amount": 0.6, "color": [1.0, 1.0, 1.0]},
    "light": {"amount": 0.5, "color": [1.0, 1.0, 1.0]},
    "erase-shadow": {},
    "temperature": {"kelvin": None},
    "contrast": {"amount": 1.5},
    "blur": {"radius": None},
    "hold": {},
}
"""What a stroke does, and the keys that belong to it with their defaults; None: it must be given."""
ANY_STROKE = {"units": "fraction", "softness": 0.0, "opacity": 1.0}
"""Keys of every stroke, likewise."""
_AMOUNTS = {"shadow": Number(0, 1), "light": Number(0, 1e6), "contrast": Number(0, 100)}

STROKE_KEYS: dict[str, tuple[Check, str]] = {
    "type": (Choice(*STROKES), "what it does to the rendering"),
    "points": (
        _points(_POINT, "x, y", 1),
        "middle line of a brush: [x, y], to the right and downwards from the upper left corner",
    ),
    "polygon": (_points(_POINT, "x, y", 3), "corners of a region"),
    "ellipse": (
        _ELLIPSE,
        "[cx, cy, rx, ry] or [cx, cy, rx, ry, degrees]: centre, radii and turn of a region",
    ),
    "rectangle": (Rectangle(), "[x0, y0, x1, y1]: corners of a region"),
    "width": (_LENGTH, "of the brush; only with points, and needed there"),
    "view": (VIEW, "view that it is painted on: index or id"),
    "amount": (
        Either("a number of at least 0", *_AMOUNTS.values()),
        "shadow: share of the light taken; light: radiance added; contrast: factor",
    ),
    "color": (Color(), 'factors on linear radiance, or a display colour, "#rrggbb"'),
    "kelvin": (Number(2000, 25000), "temperature: of the light in place of 6500 K"),
    "radius": (_LENGTH, "blur: standard deviation of the Gaussian"),
    "units": (
        Choice("fraction", "pixels"),
        "of all lengths: shares of the picture's width and height, or pixels",
    ),
    "softness": (Number(0, _FURTHEST), "width over which the border fades"),
    "opacity": (Number(0, 1), "share of the change that is painted"),
}
"""Of a stroke: check and meaning of each key."""


def _with_defaults() -> dict[str, tuple[Check, str]]:
    """Return the keys, their meaning with the defaults that each type has."""
    defaults: dict[str, list[str]] = {}
    for kind, keys in (*STROKES.items(), ("every type", ANY_STROKE)):
        for key, default in keys.items():
            value = "needed" if default is None else json.dumps(default)
            defaults.setdefault(key, []).append(f"{kind}: {value}")
    more = {key: f" (default of {', '.join(each)})" for key, each in defaults.items()}
    return {key: (check, about + more.get(key, "")) for key, (check, about) in STROKE_KEYS.items()}


class StrokeList(Tables):
    """A list of strokes, each with all of its keys spelled out; see :mod:`envedit.targets.strokes`."""

    name = "target.strokes"
    keys = _with_defaults()
    rules = {"required": ["type"]}

    def _entry(self, name: str, stroke: dict[str, Any]) -> dict[str, Any]:
        if "type" not in stroke:
            raise ConfigError(f"{name}.type: got none, expected one of {', '.join(STROKES)}")
        kind = named(f"{name}.type", Choice(*STROKES), stroke["type"])
        own = STROKES[kind] | ANY_STROKE
        of_types = {key for keys in STROKES.values() for key in keys}
        others = dict.fromkeys(of_types - own.keys()) | {"amount": _AMOUNTS.get(kind)}
        defaults = {key: default for key, default in own.items() if default is not None}
        found = self._checked(name, defaults | stroke, **others)

        # ---- One shape, and what it and the type need
        shapes = [shape for shape in STROKE_SHAPES if shape in found]
        if len(shapes) > 1:
            raise ConfigError(f"{name}: got {' and '.join(shapes)}, expected one shape")
        if not shapes and kind not in WHOLE_IMAGE:
            raise ConfigError(
                f"{name}: got no shape, expected one of {', '.join(STROKE_SHAPES)} for type {kind}"
            )
        self._require(name, "width", found, needed="points" in found, where="with points")
        for key in own.keys() - found.keys():
            raise ConfigError(f"{name}.{key}: got none, expected a number, as type is {kind}")
        return found
