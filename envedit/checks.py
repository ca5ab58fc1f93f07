"""Checks of configuration values: each returns a value normalised, or says what is wanted instead.

A check is a function ``value -> value`` that raises :class:`WantedError`. A :class:`Table` is a frozen
dataclass whose fields carry their check; it adds the key's name and what came, and raises ``ConfigError``.
Numbers must fit single precision, in which everything is computed.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import field, fields
from numbers import Integral, Real
from os import PathLike, fspath
from typing import Any

from .errors import ConfigError

Ramp = float | tuple[float, float]
"""A constant weight, or the two ends of a geometric ramp."""

MOST_DIM = 16384
"""Texels or pixels along an axis."""

_FLOAT32_TINY, _FLOAT32_MAX = 2.0**-126, (2 - 2.0**-23) * 2.0**127


class WantedError(Exception):
    """A value is refused; the text says what is wanted instead."""


def string(value: Any) -> str:
    """Accept text or a path, as text."""
    if isinstance(value, PathLike):
        value = fspath(value)
    if not isinstance(value, str):
        raise WantedError("a string")
    # A NUL cannot be in a path, a lone surrogate (an argument that is not UTF-8) cannot be written to a file.
    if "\0" in value or any("\ud800" <= c <= "\udfff" for c in value):
        raise WantedError("a string of valid characters, without NUL")
    return str(value)


def boolean(value: Any) -> bool:
    """Accept true or false."""
    if not isinstance(value, bool):
        raise WantedError("true or false")
    return value


def choice(*names: str) -> Callable:
    """Make a check that accepts one of some names."""

    def check(value: Any) -> str:
        if isinstance(value, str) and value in names:
            return value
        close = difflib.get_close_matches(value[:60], names, 1) if isinstance(value, str) else ()
        hint = f"; did you mean {close[0]}?" if close else ""
        raise WantedError(f"one of {', '.join(names)}{hint}")

    return check


def integer(low: int, high: int, even: bool = False) -> Callable:
    """Make a check that accepts a whole number in [low, high]."""

    def check(value: Any) -> int:
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole or not low <= value <= high or (even and value % 2):
            raise WantedError(f"an {'even ' if even else ''}integer from {low} to {high}")
        return int(value)

    return check


def number(low: float, high: float = math.inf, positive: bool = False) -> Callable:
    """Accept a finite number in [low, high] that single precision can hold."""
    text = f"a number above {low:g}" if positive else f"a number of at least {low:g}"
    text = text if math.isinf(high) else f"{text} and at most {high:g}"

    def check(value: Any) -> float:
        if not isinstance(value, Real) or isinstance(value, bool):
            raise WantedError(text)
        try:
            number = float(value)
        except (OverflowError, ValueError):
            raise WantedError("a finite number") from None
        if not math.isfinite(number):
            raise WantedError("a finite number")
        if abs(number) > _FLOAT32_MAX or 0 < abs(number) < _FLOAT32_TINY:
            raise WantedError("a number that single precision can hold")
        if not low <= number <= high or (positive and number == low):
            raise WantedError(text)
        return number

    return check


def or_auto(check: Callable) -> Callable:
    """Make a check that accepts "auto" beside what another check accepts."""

    def check_auto(value: Any) -> Any:
        try:
            return value if isinstance(value, str) and value == "auto" else check(value)
        except WantedError as error:
            raise WantedError(f'{error}, or "auto"') from None

    return check_auto


def weight(value: Any) -> Ramp:
    """Accept a constant weight, or the two ends of a geometric ramp."""
    wanted = "a number of at least 0, or [start, end], both above 0"
    try:
        if isinstance(value, list | tuple):
            start, end = value
            return number(0, positive=True)(start), number(0, positive=True)(end)
        return number(0)(value)
    except (ValueError, WantedError):
        raise WantedError(wanted) from None


def row_range(value: Any) -> str | tuple[int, int]:
    """Accept the rows that an edit may change: a name, or the first and last of them."""
    try:
        if isinstance(value, list | tuple):
            first, last = map(integer(0, MOST_DIM), value)
            if first <= last:
                return first, last
        elif isinstance(value, str):
            return choice("upper", "all")(value)
    except (ValueError, WantedError):
        pass
    raise WantedError('"upper", "all" or [first, last], rows from 0 at the zenith, last included')


def plain(value: Any, depth: int = 8) -> Any:
    """Accept what :func:`.config.quote` can write: strings, numbers, booleans, lists and tables of them."""
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        return string(value)
    if isinstance(value, Integral):
        return integer(-(2**63), 2**63 - 1)(value)
    if isinstance(value, Real):
        return number(-math.inf)(value)
    if depth and isinstance(value, list | tuple):
        return [plain(v, depth - 1) for v in value]
    if depth and isinstance(value, dict):
        return {string(k): plain(v, depth - 1) for k, v in value.items()}
    raise WantedError("strings, finite numbers, true or false, and not too deep lists and tables of them")


def parameter_table(value: Any) -> dict[str, str | float | bool]:
    """Accept a flat table of strings, numbers and booleans."""
    if not isinstance(value, dict) or any(isinstance(v, dict | list | tuple) for v in value.values()):
        raise WantedError("a table of strings, numbers and booleans")
    return plain(value)


# ---- targets and strokes -----------------------------------------------------------------------------------


def target_kind(value: Any) -> str:
    """Accept the way in which a target is given."""
    return choice("envmap", "image", "strokes")(value)


def _numbers(*checks: Callable) -> Callable:
    """Make a check that accepts a list with one value for each of some checks."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != len(checks):
            raise WantedError(f"a list of {len(checks)} numbers")
        return [check(v) for check, v in zip(checks, value, strict=True)]

    return check


_FURTHEST = 1e6
_coordinate = number(-_FURTHEST, _FURTHEST)
_length = number(0, _FURTHEST, positive=True)
_point = _numbers(_coordinate, _coordinate)
_color = _numbers(*3 * [number(0, 1e6)])


def _ellipse(value: Any) -> list[float]:
    fields = (_coordinate, _coordinate, _length, _length, number(-360, 360))
    if not isinstance(value, list | tuple) or len(value) not in (4, 5):
        raise WantedError("[cx, cy, rx, ry] or [cx, cy, rx, ry, degrees]")
    return _numbers(*fields[: len(value)])(value)


def _rectangle(value: Any) -> list[float]:
    wanted = "[x0, y0, x1, y1] with x1 above x0 and y1 above y0"
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise WantedError(wanted)
    x0, y0, x1, y1 = _numbers(*4 * [_coordinate])(value)
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
    """Accept a list of strokes, each with all of its keys spelled out; see :mod:`envedit.strokes`.

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
        raise ConfigError(f"{name}.type: came none, wanted one of {', '.join(STROKES)}")
    kind = _value(f"{name}.type", choice(*STROKES), stroke["type"])
    keys = STROKES[kind] | _ANY_STROKE
    known = ["type", *SHAPES, "width", *keys]
    for unknown in (k for k in stroke if k not in known):
        text = unknown[:60] if isinstance(unknown, str) else ""
        close = difflib.get_close_matches(text, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
        raise ConfigError(f"{name}, type {kind}, has no key {show(unknown)}; {hint}")

    found: dict[str, Any] = {"type": kind}
    shapes = [shape for shape in SHAPES if shape in stroke]
    if len(shapes) > 1:
        raise ConfigError(f"{name}: came {' and '.join(shapes)}, wanted one shape")
    if not shapes and kind not in WHOLE_IMAGE:
        raise ConfigError(f"{name}: came no shape, wanted one of {', '.join(SHAPES)} for type {kind}")
    for shape in shapes:
        check = SHAPES[shape]
        if callable(check):
            found[shape] = _value(f"{name}.{shape}", check, stroke[shape])
        else:
            found[shape] = _points(f"{name}.{shape}", stroke[shape], check)
    if "points" in stroke:
        if "width" not in stroke:
            raise ConfigError(f"{name}.width: came none, wanted the width of the brush, as points are given")
        found["width"] = _value(f"{name}.width", _length, stroke["width"])
    elif "width" in stroke:
        raise ConfigError(f"{name}.width: came {show(stroke['width'])}, wanted none without points")
    for key, (default, check) in keys.items():
        if key not in stroke and default is None:
            raise ConfigError(f"{name}.{key}: came none, wanted a number, as type is {kind}")
        found[key] = _value(f"{name}.{key}", check, stroke.get(key, default))
    return found


def _points(name: str, value: Any, least: int) -> list[list[float]]:
    if not isinstance(value, list | tuple) or len(value) < least:
        raise ConfigError(f"{name}: came {show(value)}, wanted [[x, y], ...], at least {least}")
    return [_value(f"{name}[{i}]", _point, v) for i, v in enumerate(value)]


def _value(name: str, check: Callable, value: Any) -> Any:
    """Check a value inside another; raise ConfigError with its name."""
    try:
        return check(value)
    except WantedError as error:
        raise ConfigError(f"{name}: came {show(value)}, wanted {error}") from None


# ---- tables of checked values ----------------------------------------------------------------------------


def key(default: Any, check: Callable, doc: str) -> Any:
    """Make a field of a :class:`Table`: its default, its check, and one line on its meaning."""
    metadata = {"check": check, "doc": doc}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


class Table:
    """Checks and normalises every field on construction, so also in ``dataclasses.replace``."""

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, checked(f, self._name(f.name), getattr(self, f.name)))
        self._check_together()

    def _name(self, key: str) -> str:
        """Name a key in errors."""
        return f"{type(self).__name__.lower()}.{key}"

    def _check_together(self) -> None:
        """Check what depends on several keys of this table."""


def checked(f: Any, name: str, value: Any) -> Any:
    """Check the value of a field, or of a table inside a table; raise ConfigError with the key's name."""
    if "table" in f.metadata:
        if not isinstance(value, f.metadata["table"]):
            raise ConfigError(f"{name}: came {show(value)}, wanted a table")
        return value
    return _value(name, f.metadata["check"], value)


def show(value: Any) -> str:
    """Show a value in an error: short, on one line, whatever it is."""
    try:
        text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a huge {type(value).__name__}"
    text = {"True": "true", "False": "false"}.get(text, text)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."
