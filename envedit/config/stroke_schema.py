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
_ELLIPSE = _COORDINATE, _COORDINATE, _LENGTH, _LENGTH, Number(-360, 360)
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


class Ellipse(Check):
    """Centre, radii and, if it is turned, degrees."""

    words = "[cx, cy, rx, ry] or [cx, cy, rx, ry, degrees]"

    def __call__(self, value: Any) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) not in (4, 5):
            raise WantedError(str(self))
        return Numbers(*_ELLIPSE[: len(value)])(value)

    def schema(self) -> Schema:
        return Numbers(*_ELLIPSE).schema() | {"minItems": 4}


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


SHAPES: dict[str, Check] = {
    "points": Points(_POINT, "x, y", 1),
    "polygon": Points(_POINT, "x, y", 3),
    "ellipse": Ellipse(),
    "rectangle": Rectangle(),
}
"""Where a stroke is."""

STROKES: dict[str, dict[str, tuple[Any, Check]]] = {
    "shadow": {"amount": (0.6, Number(0, 1)), "color": ([1.0, 1.0, 1.0], Color())},
    "light": {"amount": (0.5, Number(0, 1e6)), "color": ([1.0, 1.0, 1.0], Color())},
    "erase-shadow": {},
    "temperature": {"kelvin": (None, Number(2000, 25000))},
    "contrast": {"amount": (1.5, Number(0, 100))},
    "blur": {"radius": (None, _LENGTH)},
    "hold": {},
}
"""What a stroke does, and the keys that belong to it: default (None: it must be given) and check."""

WHOLE_IMAGE = ("temperature", "contrast", "blur")
"""What may be done to the whole image, without a shape."""

ANY_STROKE: dict[str, tuple[Any, Check]] = {
    "units": ("fraction", Choice("fraction", "pixels")),
    "softness": (0.0, Number(0, _FURTHEST)),
    "opacity": (1.0, Number(0, 1)),
}
"""Keys of every stroke, likewise."""

MEANINGS = {
    "type": "what it does to the rendering",
    "points": "middle line of a brush: [x, y], to the right and downwards from the upper left corner",
    "width": "of the brush; only with points, and needed there",
    "polygon": "corners of a region",
    "ellipse": "[cx, cy, rx, ry] or [cx, cy, rx, ry, degrees]: centre, radii and turn of a region",
    "rectangle": "[x0, y0, x1, y1]: corners of a region",
    "view": "view that it is painted on: index or id",
    "amount": "shadow: share of the light taken; light: radiance added; contrast: factor",
    "color": 'factors on linear radiance, or a display colour, "#rrggbb"',
    "kelvin": "temperature: of the light in place of 6500 K",
    "radius": "blur: standard deviation of the Gaussian",
    "units": "of all lengths: shares of the picture's width and height, or pixels",
    "softness": "width over which the border fades",
    "opacity": "share of the change that is painted",
}
"""What each key is, for the reference."""


class StrokeList(Tables):
    """A list of strokes, each with all of its keys spelled out; see :mod:`envedit.targets.strokes`."""

    name = "target.strokes"

    def _entry(self, name: str, stroke: dict[str, Any]) -> dict[str, Any]:
        if "type" not in stroke:
            raise ConfigError(f"{name}.type: got none, expected one of {', '.join(STROKES)}")
        kind = named(f"{name}.type", Choice(*STROKES), stroke["type"])
        own = STROKES[kind] | ANY_STROKE
        checks = {key: check for key, (_, check) in own.items()}
        checks = {"type": Choice(kind), **SHAPES, "width": _LENGTH, "view": VIEW, **checks}
        defaults = {key: default for key, (default, _) in own.items() if default is not None}
        found = self._checked(name, defaults | stroke, checks)

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

    def schema(self) -> Schema:
        checks: dict[str, list[Check]] = {"type": [Choice(*STROKES)], **{k: [c] for k, c in SHAPES.items()}}
        checks |= {"width": [_LENGTH], "view": [VIEW]}
        defaults: dict[str, list[str]] = {}
        for kind, keys in (*STROKES.items(), ("every type", ANY_STROKE)):
            for key, (default, check) in keys.items():
                checks.setdefault(key, []).append(check)
                value = "needed" if default is None else json.dumps(default)
                defaults.setdefault(key, []).append(f"{kind}: {value}")

        properties: Schema = {}
        for key, options in checks.items():
            each = [check.schema() for check in dict.fromkeys(options)]
            default = f" (default of {', '.join(defaults[key])})" if key in defaults else ""
            about = {"description": MEANINGS[key] + default}
            properties[key] = (each[0] if len(each) == 1 else {"anyOf": each}) | about
        return self._schema_of({"properties": properties, "required": ["type"]})
