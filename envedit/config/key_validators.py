"""Checks of single keys, and of anything that TOML has; see :mod:`envedit.config.validators`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from envedit.config.validators import Check, Choice, Integer, Number, Numbers, Schema, String, WantedError

Ramp = float | tuple[float, float]
"""A constant weight, or the two ends of a geometric ramp."""
MOST_DIM = 16384
"""Texels or pixels along an axis."""


@dataclass(frozen=True)
class Kelvin(Check):
    """A colour temperature for which there are chromaticities, or 0."""

    low: float = 2000.0
    high: float = 25000.0
    kind = "number"

    def _take(self, value: Any) -> float:
        try:
            found = Number(0, self.high)(value)
        except WantedError:
            found = -1.0
        if found and not self.low <= found <= self.high:
            raise WantedError(str(self))
        return found

    def __str__(self) -> str:
        return f"0, or kelvin from {self.low:g} to {self.high:g}"

    @property
    def range(self) -> str:
        """Least and most."""
        return f"0, or {self.low:g} to {self.high:g}"

    def _schema(self) -> Schema:
        return {"anyOf": [{"const": 0}, Number(self.low, self.high).schema()]}


@dataclass(frozen=True)
class Weight(Check):
    """A constant weight, or the two ends of a geometric ramp."""

    kind = "number or list"
    range = "at least 0; or [start, end], both above 0"

    def _take(self, value: Any) -> Ramp:
        end = Number(0, positive=True)
        try:
            if isinstance(value, list | tuple):
                first, last = value
                return end(first), end(last)
            return Number(0)(value)
        except (ValueError, WantedError):
            raise WantedError(str(self)) from None

    def __str__(self) -> str:
        return "a number of at least 0, or [start, end], both above 0"

    def _schema(self) -> Schema:
        end = Number(0, positive=True)
        return {"anyOf": [Number(0).schema(), Numbers(end, end).schema()]}


@dataclass(frozen=True)
class RowRange(Check):
    """The rows that an edit may change: a name, or the first and last of them."""

    kind = "string or list"
    range = '"upper", "all" or [first, last]'

    def _take(self, value: Any) -> str | tuple[int, int]:
        row = Integer(0, MOST_DIM)
        try:
            if isinstance(value, list | tuple):
                first, last = map(row, value)
                if first <= last:
                    return first, last
            elif isinstance(value, str):
                return Choice("upper", "all")(value)
        except (ValueError, WantedError):
            pass
        raise WantedError(str(self))

    def __str__(self) -> str:
        return '"upper", "all" or [first, last], rows from 0 at the zenith, last included'

    def _schema(self) -> Schema:
        row = Integer(0, MOST_DIM)
        return {"anyOf": [Choice("upper", "all").schema(), Numbers(row, row).schema()]}


@dataclass(frozen=True)
class View(Check):
    """A view: the id of its sensor, or its index."""

    kind = "string or integer"

    def _take(self, value: Any) -> int | str:
        try:
            check = String() if isinstance(value, str) else Integer(0, MOST_DIM)
            if (found := check(value)) != "":
                return found
        except WantedError:
            pass
        raise WantedError(str(self))

    def __str__(self) -> str:
        return "the id of a sensor, or the index of a view from 0"

    def _schema(self) -> Schema:
        return {"anyOf": [{"type": "string", "minLength": 1}, Integer(0, MOST_DIM).schema()]}


@dataclass(frozen=True)
class ViewList(Check):
    """Sensors of a scene: "all", or a list of ids and of indices from 0, none of them twice."""

    kind = "string or list"
    range = '"all", or ids and indices from 0'

    def _take(self, value: Any) -> str | tuple[int | str, ...]:
        if isinstance(value, str) and value == "all":
            return value
        try:
            if isinstance(value, list | tuple) and value and len({*value}) == len(value):
                return tuple(View()(v) for v in value)
        except (TypeError, WantedError):
            pass
        raise WantedError(str(self))

    def __str__(self) -> str:
        return '"all", or a list of ids of sensors or of indices from 0, each once'

    def _schema(self) -> Schema:
        views: Schema = {"type": "array", "items": View().schema(), "minItems": 1, "uniqueItems": True}
        return {"anyOf": [{"const": "all"}, views]}


@dataclass(frozen=True)
class Parameters(Check):
    """A flat table of strings, numbers and booleans."""

    kind = "table"

    def _take(self, value: Any) -> dict[str, str | float | bool]:
        if not isinstance(value, dict) or any(isinstance(v, dict | list | tuple) for v in value.values()):
            raise WantedError(str(self))
        return plain(value)

    def __str__(self) -> str:
        return "a table of strings, numbers and booleans"

    @property
    def range(self) -> str:
        """What its values are."""
        return "of strings, numbers and booleans"

    def _schema(self) -> Schema:
        return {"type": "object", "additionalProperties": {"type": ["string", "number", "boolean"]}}


def plain(value: Any, depth: int = 8) -> Any:
    """Accept what :func:`.toml.quote` can write: strings, numbers, booleans, lists and tables of them."""
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        return String()(value)
    if isinstance(value, Integral):
        return Integer(-(2**63), 2**63 - 1)(value)
    if isinstance(value, Real):
        return Number(-math.inf)(value)
    if depth and isinstance(value, list | tuple):
        return [plain(v, depth - 1) for v in value]
    if depth and isinstance(value, dict):
        return {String()(k): plain(v, depth - 1) for k, v in value.items()}
    raise WantedError("strings, finite numbers, true or false, and not too deep lists and tables of them")
