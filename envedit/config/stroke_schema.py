"""The keys of strokes: which there are, their defaults and ranges, and the check of a list of strokes.

What a stroke does is :mod:`envedit.targets.strokes`'s.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from envedit.config.validators import (
    VIEW,
    Check,
    Choice,
    Either,
    Number,
    Numbers,
    Points,
    Schema,
    Tables,
    WantedError,
    named,
)
from envedit.core.color import srgb_to_linear
from envedit.core.errors import ConfigError

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
_CORNERS = Numbers(*4 * [_COORDINATE])
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


class Rectangle(Check):
    """Upper left and lower right corner."""

    words = "[x0, y0, x1, y1] with x1 above x0 and y1 above y0"

    def __call__(self, value: Any) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != 4:
            raise WantedError(str(self))
        x0, y0, x1, y1 = _CORNERS(value)
        if x1 <= x0 or y1 <= y0:
            raise WantedError(str(self))
        return [x0, y0, x1, y1]

    def schema(self) -> Schema:
        return _CORNERS.schema()


SHAPES = ("points", "polygon", "ellipse", "rectangle")
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

KEYS: dict[str, tuple[Check, str]] = {
    "type": (Choice(*STROKES), "what it does to the rendering"),
    "points": (
        Points(_POINT, "x, y", 1),
        "middle line of a brush: [x, y], to the right and downwards from the upper left corner",
    ),
    "polygon": (Points(_POINT, "x, y", 3), "corners of a region"),
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
    return {key: (check, about + more.get(key, "")) for key, (check, about) in KEYS.items()}


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
        shapes = [shape for shape in SHAPES if shape in found]
        if len(shapes) > 1:
            raise ConfigError(f"{name}: got {' and '.join(shapes)}, expected one shape")
        if not shapes and kind not in WHOLE_IMAGE:
            raise ConfigError(f"{name}: got no shape, expected one of {', '.join(SHAPES)} for type {kind}")
        self._require(name, "width", found, needed="points" in found, where="with points")
        for key in own.keys() - found.keys():
            raise ConfigError(f"{name}.{key}: got none, expected a number, as type is {kind}")
        return found
