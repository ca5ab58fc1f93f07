"""The keys of strokes: which there are, their defaults and ranges, and the check of a list of strokes.

What a stroke does is :mod:`envedit.targets.strokes`'s.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from envedit.config.validators import WantedError, choice, named, number, numbers, show, view
from envedit.core.color import srgb_to_linear
from envedit.core.errors import ConfigError

_FURTHEST = 1e6
_coordinate = number(-_FURTHEST, _FURTHEST)
_length = number(0, _FURTHEST, positive=True)
_point = numbers(_coordinate, _coordinate)
_linear_color = numbers(*3 * [number(0, 1e6)])


def _color(value: Any) -> list[float]:
    """Accept [r, g, b], factors on linear radiance, or the sRGB colour "#rrggbb", which becomes them."""
    if isinstance(value, str):
        if not re.fullmatch("#[0-9a-fA-F]{6}", value):
            raise WantedError('[r, g, b], or a colour such as "#ffd9a6"')
        return [
            float(round(c, 4))
            for c in srgb_to_linear(np.frombuffer(bytes.fromhex(value[1:]), np.uint8) / 255)
        ]
    return _linear_color(value)


def _ellipse(value: Any) -> list[float]:
    fields = (_coordinate, _coordinate, _length, _length, number(-360, 360))
    if not isinstance(value, list | tuple) or len(value) not in (4, 5):
        raise WantedError("[cx, cy, rx, ry] or [cx, cy, rx, ry, degrees]")
    return numbers(*fields[: len(value)])(value)


def _rectangle(value: Any) -> list[float]:
    wanted = "[x0, y0, x1, y1] with x1 above x0 and y1 above y0"
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise WantedError(wanted)
    x0, y0, x1, y1 = numbers(*4 * [_coordinate])(value)
    if x1 <= x0 or y1 <= y0:
        raise WantedError(wanted)
    return [x0, y0, x1, y1]


SHAPES: dict[str, int | Callable] = {"points": 1, "polygon": 3, "ellipse": _ellipse, "rectangle": _rectangle}
"""Where a stroke is: the least number of points, or the check of the list."""

STROKES: dict[str, dict[str, tuple[Any, Callable]]] = {
    "shadow": {"amount": (0.6, number(0, 1)), "color": ([1.0, 1.0, 1.0], _color)},
    "light": {"amount": (0.5, number(0, 1e6)), "color": ([1.0, 1.0, 1.0], _color)},
    "erase-shadow": {},
    "temperature": {"kelvin": (None, number(2000, 25000))},
    "contrast": {"amount": (1.5, number(0, 100))},
    "blur": {"radius": (None, _length)},
    "hold": {},
}
"""What a stroke does, and the keys that belong to it: default (None: it must be given) and check."""

WHOLE_IMAGE = ("temperature", "contrast", "blur")
"""What may be done to the whole image, without a shape."""

_ANY_STROKE: dict[str, tuple[Any, Callable]] = {
    "units": ("fraction", choice("fraction", "pixels")),
    "softness": (0.0, number(0, _FURTHEST)),
    "opacity": (1.0, number(0, 1)),
}


def stroke_list(value: Any) -> tuple[dict, ...]:
    """Accept a list of strokes, each with all of its keys spelled out; see :mod:`envedit.targets.strokes`.

    Raises
    ------
    WantedError
        It is no list of tables.
    ConfigError
        A stroke has an unknown key or an unusable value; the message names ``target.strokes[2].width``.
    """
    if not isinstance(value, list | tuple) or not all(isinstance(v, dict) for v in value):
        raise WantedError("a list of tables")
    return tuple(_stroke(f"target.strokes[{i}]", v) for i, v in enumerate(value))


def _stroke(name: str, stroke: dict) -> dict:
    if "type" not in stroke:
        raise ConfigError(f"{name}.type: got none, expected one of {', '.join(STROKES)}")
    kind = named(f"{name}.type", choice(*STROKES), stroke["type"])
    keys = STROKES[kind] | _ANY_STROKE
    known = ["type", *SHAPES, "width", "view", *keys]
    for unknown in (k for k in stroke if k not in known):
        text = unknown[:60] if isinstance(unknown, str) else ""
        close = difflib.get_close_matches(text, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
        raise ConfigError(f"{name}, type {kind}, has no key {show(unknown)}; {hint}")

    found: dict[str, Any] = {"type": kind}
    shapes = [shape for shape in SHAPES if shape in stroke]
    if len(shapes) > 1:
        raise ConfigError(f"{name}: got {' and '.join(shapes)}, expected one shape")
    if not shapes and kind not in WHOLE_IMAGE:
        raise ConfigError(f"{name}: got no shape, expected one of {', '.join(SHAPES)} for type {kind}")
    for shape in shapes:
        check = SHAPES[shape]
        if callable(check):
            found[shape] = named(f"{name}.{shape}", check, stroke[shape])
        else:
            found[shape] = _points(f"{name}.{shape}", stroke[shape], check)
    if "points" in stroke:
        if "width" not in stroke:
            raise ConfigError(f"{name}.width: got none, expected the width of the brush, as points are given")
        found["width"] = named(f"{name}.width", _length, stroke["width"])
    elif "width" in stroke:
        raise ConfigError(f"{name}.width: got {show(stroke['width'])}, expected none without points")
    if "view" in stroke:
        found["view"] = named(f"{name}.view", view, stroke["view"])
    for key, (default, check) in keys.items():
        if key not in stroke and default is None:
            raise ConfigError(f"{name}.{key}: got none, expected a number, as type is {kind}")
        found[key] = named(f"{name}.{key}", check, stroke.get(key, default))
    return found


def _points(name: str, value: Any, least: int) -> list[list[float]]:
    if not isinstance(value, list | tuple) or len(value) < least:
        raise ConfigError(f"{name}: got {show(value)}, expected [[x, y], ...], at least {least}")
    return [named(f"{name}[{i}]", _point, v) for i, v in enumerate(value)]
