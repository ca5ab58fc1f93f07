"""Checks of single keys, and of anything that TOML has; see :mod:`envedit.config.validators`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from envedit.config.validators import (
    Check,
    Choice,
    Either,
    Integer,
    Number,
    Pair,
    Schema,
    String,
    WantedError,
)

Ramp = float | tuple[float, float]
"""A constant weight, or the two ends of a geometric ramp."""
MOST_DIM = 16384
"""Texels or pixels along an axis."""


@dataclass(frozen=True)
class Kelvin(Either):
    """A colour temperature for which there are chromaticities, or 0."""

    kind = "number"
    range = "0, or 2000 to 25000"
    words = "0, or kelvin from 2000 to 25000"
    checks = Number(0, 0), Number(2000, 25000)


@dataclass(frozen=True)
class Weight(Either):
    """A constant weight, or the two ends of a geometric ramp."""

    kind = "number or list"
    range = "at least 0; or [start, end], both above 0"
    words = "a number of at least 0, or [start, end], both above 0"
    checks = Number(0), Pair(Number(0, positive=True))


@dataclass(frozen=True)
class RowRange(Either):
    """The rows that an edit may change: a name, or the first and last of them."""

    kind = "string or list"
    range = '"upper", "all" or [first, last]'
    words = '"upper", "all" or [first, last], rows from 0 at the zenith, last included'
    checks = Choice("upper", "all"), Pair(Integer(0, MOST_DIM))

    def _take(self, value: Any) -> str | tuple[int, int]:
        rows = super()._take(value)
        if isinstance(rows, tuple) and rows[0] > rows[1]:
            raise WantedError(self.words)
        return rows


@dataclass(frozen=True)
class View(Either):
    """A view: the id of its sensor, or its index."""

    kind = "string or integer"
    words = "the id of a sensor, or the index of a view from 0"
    checks = String(least=1), Integer(0, MOST_DIM)


@dataclass(frozen=True)
class ViewList(Check):
    """Sensors of a scene: "all", or a list of ids and of indices from 0, none of them twice."""

    kind = "string or list"
    range = '"all", or ids and indices from 0'
    words = '"all", or a list of ids of sensors or of indices from 0, each once'

    def _take(self, value: Any) -> str | tuple[int | str, ...]:
        if isinstance(value, str) and value == "all":
            return value
        try:
            if isinstance(value, list | tuple) and value and len({*value}) == len(value):
                return tuple(View()(v) for v in value)
        except (TypeError, WantedError):
            pass
        raise WantedError(str(self))

    def _schema(self) -> Schema:
        views: Schema = {"type": "array", "items": View().schema(), "minItems": 1, "uniqueItems": True}
        return {"anyOf": [{"const": "all"}, views]}


@dataclass(frozen=True)
class Parameters(Check):
    """A flat table of strings, numbers and booleans."""

    kind = "table"
    range = "of strings, numbers and booleans"
    words = f"a table {range}"

    def _take(self, value: Any) -> dict[str, str | float | bool]:
        if not isinstance(value, dict):
            raise WantedError(str(self))
        return {String()(name): self._scalar(scalar) for name, scalar in value.items()}

    def _scalar(self, value: Any) -> str | float | bool:
        if isinstance(value, bool):
            return value
        if isinstance(value, str):
            return String()(value)
        if isinstance(value, Integral):
            return Integer(-(2**63), 2**63 - 1)(value)
        if isinstance(value, Real):
            return Number(-math.inf)(value)
        raise WantedError(str(self))

    def _schema(self) -> Schema:
        return {"type": "object", "additionalProperties": {"type": ["string", "number", "boolean"]}}
