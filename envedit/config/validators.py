"""Checks of configuration values: objects that say what they accept, and normalise a value or refuse it.

A check is called with a value and returns it normalised, or raises :class:`WantedError`. ``str(check)`` is
what an error says it expected, ``check.schema()`` the same as JSON Schema. Numbers must fit single precision,
in which everything is computed.

>>> Integer(1, 8)(3), str(Integer(1, 8)), Integer(1, 8).schema()
(3, 'an integer from 1 to 8', {'type': 'integer', 'minimum': 1, 'maximum': 8})
"""

from __future__ import annotations

import contextlib
import difflib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from os import PathLike, fspath
from typing import Any

from envedit.core import extensions
from envedit.core.errors import ConfigError

Schema = dict[str, Any]
Ramp = float | tuple[float, float]
"""A constant weight, or the two ends of a geometric ramp."""
MOST_DIM = 16384
"""Texels or pixels along an axis."""

_FLOAT32_TINY, _FLOAT32_MAX = 2.0**-126, (2 - 2.0**-23) * 2.0**127


class WantedError(Exception):
    """A value is refused; the text says what is wanted instead."""


class Check(ABC):
    """What a key may be."""

    words: str = ""  # what is accepted, as the end of a sentence

    @abstractmethod
    def __call__(self, value: Any) -> Any:
        """Return a value normalised; WantedError if it is refused."""

    @abstractmethod
    def schema(self) -> Schema:
        """Return what is accepted as JSON Schema; where that cannot say all, it accepts more."""

    def __str__(self) -> str:
        """Say what is accepted, as the end of a sentence."""
        return self.words


# ---- words -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class String(Check):
    """Text or a path, as text of at least so many characters."""

    least: int = 0
    words = "a string"

    def __call__(self, value: Any) -> str:
        if isinstance(value, PathLike):
            value = fspath(value)
        if not isinstance(value, str) or len(value) < self.least:
            raise WantedError(str(self))
        # A NUL cannot be in a path, a lone surrogate (an argument that is not UTF-8) cannot be written.
        if "\0" in value or any("\ud800" <= c <= "\udfff" for c in value):
            raise WantedError("a string of valid characters, without NUL")
        return str(value)

    def schema(self) -> Schema:
        return {"type": "string"} | ({"minLength": self.least} if self.least else {})


class Boolean(Check):
    """True or false."""

    words = "true or false"

    def __call__(self, value: Any) -> bool:
        if not isinstance(value, bool):
            raise WantedError(str(self))
        return value

    def schema(self) -> Schema:
        return {"type": "boolean"}


class Choice(Check):
    """One of some names, or of those that installed packages add to a group of entry points."""

    def __init__(self, *names: str, group: str = "") -> None:
        self.names = names
        self.group = group

    @property
    def _added(self) -> tuple[str, ...]:
        return extensions.names(self.group) if self.group else ()

    def __call__(self, value: Any) -> str:
        if isinstance(value, str) and (value in self.names or value in self._added):
            return value
        hint = meant(value, self.names, "")
        raise WantedError(f"{self}; {hint}" if hint else str(self))

    def __str__(self) -> str:
        return f"one of {', '.join([*self.names, *self._added])}"

    def schema(self) -> Schema:
        return {"enum": [*self.names, *self._added]}


# ---- numbers -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Integer(Check):
    """A whole number in [low, high]."""

    low: int
    high: int
    even: bool = False

    def __call__(self, value: Any) -> int:
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole or not self.low <= value <= self.high or (self.even and value % 2):
            raise WantedError(str(self))
        return int(value)

    def __str__(self) -> str:
        return f"an {'even ' if self.even else ''}integer from {self.low} to {self.high}"

    def schema(self) -> Schema:
        limits: Schema = {"type": "integer", "minimum": self.low, "maximum": self.high}
        return limits | ({"multipleOf": 2} if self.even else {})


@dataclass(frozen=True)
class Number(Check):
    """A finite number in [low, high], or (low, high], that single precision can hold."""

    low: float
    high: float = math.inf
    positive: bool = False

    def __call__(self, value: Any) -> float:
        if not isinstance(value, Real) or isinstance(value, bool):
            raise WantedError(str(self))
        try:
            number = float(value)
        except (OverflowError, ValueError):
            raise WantedError("a finite number") from None
        if not math.isfinite(number):
            raise WantedError("a finite number")
        if abs(number) > _FLOAT32_MAX or 0 < abs(number) < _FLOAT32_TINY:
            raise WantedError("a number that single precision can hold")
        if not self.low <= number <= self.high or (self.positive and number == self.low):
            raise WantedError(str(self))
        return number

    def __str__(self) -> str:
        text = f"a number {'above' if self.positive else 'of at least'} {self.low:g}"
        return text if math.isinf(self.high) else f"{text} and at most {self.high:g}"

    def schema(self) -> Schema:
        limits: Schema = {"type": "number"}
        if not math.isinf(self.low):
            limits["exclusiveMinimum" if self.positive else "minimum"] = self.low
        return limits | ({} if math.isinf(self.high) else {"maximum": self.high})


class Numbers(Check):
    """A list with one value for each of some checks."""

    def __init__(self, *checks: Check) -> None:
        self.checks = checks

    def __call__(self, value: Any) -> Any:
        if not isinstance(value, list | tuple) or len(value) != len(self.checks):
            raise WantedError(str(self))
        return [check(v) for check, v in zip(self.checks, value, strict=True)]

    def __str__(self) -> str:
        return f"a list of {len(self.checks)} numbers"

    def schema(self) -> Schema:
        items = [check.schema() for check in self.checks]
        return {"type": "array", "items": items, "minItems": len(items), "maxItems": len(items)}


class Pair(Numbers):
    """Two values of one check, as a tuple."""

    def __init__(self, check: Check) -> None:
        super().__init__(check, check)

    def __call__(self, value: Any) -> tuple[float, ...]:
        return tuple(super().__call__(value))


# ---- what other checks accept ------------------------------------------------------------------------------


class ListOf(Check):
    """A list of what another check accepts, as a tuple; ``most`` of None: any number of it."""

    def __init__(
        self,
        check: Check,
        least: int = 0,
        most: int | None = None,
        unique: bool = False,
        words: str = "a list",
    ) -> None:
        self.check = check
        self.least = least
        self.most = most
        self.unique = unique
        self.words = words

    def __call__(self, value: Any) -> tuple[Any, ...]:
        most = math.inf if self.most is None else self.most
        if not isinstance(value, list | tuple) or not self.least <= len(value) <= most:
            raise WantedError(self.words)
        values = []
        for i, entry in enumerate(value):
            try:
                values.append(self.check(entry))
            except WantedError as error:
                raise WantedError(f"{error} at entry {i}") from None
        if self.unique and len({*values}) < len(values):
            raise WantedError(self.words)
        return tuple(values)

    def schema(self) -> Schema:
        values: Schema = {"type": "array", "items": self.check.schema(), "uniqueItems": self.unique}
        values |= {"minItems": self.least} if self.least else {}
        return values if self.most is None else values | {"maxItems": self.most}


class Either(Check):
    """What one of several checks accepts, in words of its own."""

    def __init__(self, words: str, *checks: Check) -> None:
        self.words = words
        self.checks = checks

    def __call__(self, value: Any) -> Any:
        for check in self.checks:
            with contextlib.suppress(WantedError):
                return check(value)
        raise WantedError(self.words)

    def schema(self) -> Schema:
        return {"anyOf": [check.schema() for check in self.checks]}


class OrAuto(Either):
    """The word "auto" beside what another check accepts."""

    def __init__(self, check: Check) -> None:
        super().__init__(f'{check}, or "auto"', check, Choice("auto"))


class OneOrMore(Either):
    """A value, or a list of values, as a tuple."""

    def __init__(self, check: Check) -> None:
        super().__init__(f"{check}, or a list of them", check, ListOf(check))


# ---- single keys -------------------------------------------------------------------------------------------

KELVIN = Either("0, or kelvin from 2000 to 25000", Number(0, 0), Number(2000, 25000))
"""A colour temperature for which there are chromaticities, or 0."""
WEIGHT = Either(
    "a number of at least 0, or [start, end], both above 0", Number(0), Pair(Number(0, positive=True))
)
"""A constant weight, or the two ends of a geometric ramp."""
VIEW = Either("the id of a sensor, or the index of a view from 0", String(least=1), Integer(0, MOST_DIM))
"""A view: the id of its sensor, or its index."""
VIEWS = Either(
    '"all", or a list of ids of sensors or of indices from 0, each once',
    Choice("all"),
    ListOf(VIEW, least=1, unique=True),
)
"""Sensors of a scene."""


class RowRange(Either):
    """The rows that an edit may change: a name, or the first and last of them."""

    def __init__(self) -> None:
        super().__init__(
            '"upper", "all" or [first, last], rows from 0 at the zenith, last included',
            Choice("upper", "all"),
            Pair(Integer(0, MOST_DIM)),
        )

    def __call__(self, value: Any) -> str | tuple[int, int]:
        rows = super().__call__(value)
        if isinstance(rows, tuple) and rows[0] > rows[1]:
            raise WantedError(self.words)
        return rows


class Parameters(Check):
    """A flat table of strings, numbers and booleans."""

    words = "a table of strings, numbers and booleans"
    scalar = Either(words, Boolean(), String(), Integer(-(2**63), 2**63 - 1), Number(-math.inf))

    def __call__(self, value: Any) -> dict[str, str | float | bool]:
        if not isinstance(value, dict):
            raise WantedError(self.words)
        return {String()(name): self.scalar(scalar) for name, scalar in value.items()}

    def schema(self) -> Schema:
        return {"type": "object", "additionalProperties": {"type": ["string", "number", "boolean"]}}


# ---- words for errors --------------------------------------------------------------------------------------


def named(name: str, check: Check, value: Any) -> Any:
    """Check a value inside another; raise ConfigError with its name."""
    try:
        return check(value)
    except WantedError as error:
        raise ConfigError(f"{name}: got {show(value)}, expected {error}") from None


def show(value: Any) -> str:
    """Show a value in an error: short, on one line, whatever it is."""
    try:
        text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits
        text = f"a huge {type(value).__name__}"
    text = {"True": "true", "False": "false"}.get(text, text)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


def meant(key: Any, known: Iterable[str], otherwise: str | None = None) -> str:
    """Say which of some names is meant, or ``otherwise``, by default which there are."""
    names = list(known)
    close = difflib.get_close_matches(key[:60] if isinstance(key, str) else "", names, 1)
    if close:
        return f"did you mean {close[0]}?"
    return f"known: {', '.join(names)}" if otherwise is None else otherwise
