"""Neighbouring rows of a map, such as those that an edit may change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

BAND_ROWS = 256
"""Rows of a map that are worked on at a time, where all of it in double precision would take gigabytes."""


def bands(height: int, rows: int = BAND_ROWS) -> Iterator[slice]:
    """Yield all rows of a map, some at a time."""
    for first in range(0, height, rows):
        yield slice(first, min(first + rows, height))


@dataclass(frozen=True)
class Rows:
    """Rows ``first`` to ``last`` of a map of ``total``: ``envmap[rows.slice]`` has ``count``.

    ValueError if the map does not have them.
    """

    first: int
    count: int
    total: int

    def __post_init__(self) -> None:
        if not 0 <= self.first < self.stop <= self.total:
            raise ValueError(f"rows {self.first} to {self.last} are no rows of a map of {self.total}")

    @classmethod
    def of(cls, total: int, first: int = 0, last: int = -1) -> Rows:
        """Return rows ``first`` to ``last``, both included, counted from the end where negative."""
        return cls(first, (last if last >= 0 else total + last) - first + 1, total)

    @property
    def last(self) -> int:
        """The last of the rows."""
        return self.stop - 1

    @property
    def stop(self) -> int:
        """The row after the last."""
        return self.first + self.count

    @property
    def slice(self) -> slice:
        """The rows as an index of the map."""
        return slice(self.first, self.stop)

    @property
    def all(self) -> bool:
        """Whether they are the whole map."""
        return self.count == self.total

    @property
    def place(self) -> tuple[int, int]:
        """First row and rows of the map: where an image of these rows lies, as representations take it."""
        return self.first, self.total
