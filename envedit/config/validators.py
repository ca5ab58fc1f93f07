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
from typing import Any, ClassVar

from envedit.core.errors import ConfigError

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


def numbers(*checks: Callable) -> Callable:
    """Make a check that accepts a list with one value for each of some checks."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != len(checks):
            raise WantedError(f"a list of {len(checks)} numbers")
        return [check(v) for check, v in zip(checks, value, strict=True)]

    return check


def kelvin(value: Any) -> float:
    """Accept a colour temperature for which there are chromaticities, or 0."""
    try:
        found = number(0, 25000)(value)
    except WantedError:
        found = -1.0
    if found and not 2000 <= found <= 25000:
        raise WantedError("0, or kelvin from 2000 to 25000")
    return found


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


def view_list(value: Any) -> str | tuple[int | str, ...]:
    """Accept sensors of a scene: "all", or a list of ids and of indices from 0, none of them twice."""
    if isinstance(value, str) and value == "all":
        return value
    try:
        if isinstance(value, list | tuple) and value and len({*value}) == len(value):
            return tuple(view(v) for v in value)
    except (TypeError, WantedError):
        pass
    raise WantedError('"all", or a list of ids of sensors or of indices from 0, each once')


def view(value: Any) -> int | str:
    """Accept a view: the id of its sensor, or its index."""
    try:
        if (found := string(value) if isinstance(value, str) else integer(0, MOST_DIM)(value)) != "":
            return found
    except WantedError:
        pass
    raise WantedError("the id of a sensor, or the index of a view from 0")


def one_or_more(check: Callable) -> Callable:
    """Make a check that accepts a value, or a list of values, as a tuple."""

    def check_each(value: Any) -> Any:
        try:
            return tuple(check(v) for v in value) if isinstance(value, list | tuple) else check(value)
        except WantedError as error:
            raise WantedError(f"{error}, or a list of them") from None

    return check_each


def plain(value: Any, depth: int = 8) -> Any:
    """Accept what :func:`.schema.quote` can write: strings, numbers, booleans, lists and tables of them."""
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


def named(name: str, check: Callable, value: Any) -> Any:
    """Check a value inside another; raise ConfigError with its name."""
    try:
        return check(value)
    except WantedError as error:
        raise ConfigError(f"{name}: got {show(value)}, expected {error}") from None


# ---- tables of checked values ----------------------------------------------------------------------------


def key(default: Any, check: Callable, doc: str) -> Any:
    """Make a field of a :class:`Table`: its default, its check, and one line on its meaning."""
    metadata = {"check": check, "doc": doc}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


class Table:
    """Checks and normalises every field on construction, so also in ``dataclasses.replace``.

    Attributes
    ----------
    given : frozenset of str
        Names of the fields that were passed to the constructor; the others have their defaults, in whose
        place a preset may put its own (:meth:`with_defaults`).
    """

    given: ClassVar[frozenset[str]] = frozenset()

    def __new__(cls, *values: Any, **named: Any) -> Table:
        """Note which fields are given."""
        table = super().__new__(cls)
        by_position = (f.name for f, _ in zip(fields(cls), values, strict=False))  # type: ignore[arg-type]
        object.__setattr__(table, "given", frozenset([*by_position, *named]))
        return table

    def with_defaults(self, values: dict[str, Any]) -> Table:
        """Return the table with other defaults; what was given stays."""
        own = {name: getattr(self, name) for name in self.given}
        table = type(self)(**(values | own))
        object.__setattr__(table, "given", self.given)
        return table

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]  # every table is a dataclass
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
            raise ConfigError(f"{name}: got {show(value)}, expected a table")
        return value
    return named(name, f.metadata["check"], value)


def show(value: Any) -> str:
    """Show a value in an error: short, on one line, whatever it is."""
    try:
        text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a huge {type(value).__name__}"
    text = {"True": "true", "False": "false"}.get(text, text)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."
