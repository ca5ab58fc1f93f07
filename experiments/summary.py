"""Statistics over the rows of an experiment, declared as columns.

.. code-block:: python

   Summary(
       {"scene": "{scene}"},
       {
           "runs": "{runs}",
           "rendering, dB (worst)": "{render.mean:.1f} ({render.min:.1f})",
           "over 5 %": "{outside.above[0.05]}",
       },
   )

A row of this table is a scene: all rows of the experiment that agree in what the first dictionary writes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

SCALES = (1e9, "G"), (1e6, "M"), (1e3, "k"), (1, ""), (1e-3, "m"), (1e-6, "u")
"""Factors of a number, and their prefixes."""


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])


class Value(float):
    """A number that is written as a dash where it is not known (NaN), and by ``.0%`` as ``12 %``.

    Further forms: ``.3g%`` is a share in percent with three digits, ``si B`` a number with three digits, a
    prefix and a unit (12.3 MB, 45.6 ms; seconds from 100 on are whole).
    """

    def __format__(self, form: str) -> str:
        """Write the number."""
        if self != self:
            return "-"
        if form.startswith("si"):
            return self._with_prefix(form[2:].strip())
        if form.endswith("g%"):
            return f"{100 * float(self):{form[:-1]}} %"
        return super().__format__(form).replace("%", " %")

    def _with_prefix(self, unit):
        if unit == "s" and self >= 100:
            return f"{self:.0f} s"
        factor, prefix = next((scale for scale in SCALES if self >= scale[0]), (1, ""))
        digits = max(0, 3 - len(str(int(self / factor))))
        return f"{self / factor:.{digits}f} {prefix}{unit}".rstrip()

    def __getitem__(self, key):
        """Return an unknown part of something unknown, such as the PSNR of a map that there is not."""
        return Value("nan")


def values(row: dict) -> dict:
    """Return a row, such as of ``metrics.json``, whose numbers, and None, are :class:`Value`.

    Columns write parts of it as ``{render[psnr]:.1f}``. Texts and lists stay; counts are :class:`Count`.
    """
    return {key: _value(value) for key, value in row.items()}


def _value(content):
    if isinstance(content, dict):
        return values(content)
    if content is None or isinstance(content, float):
        return Value("nan" if content is None else content)
    if type(content) is int:
        return Count(content)
    return content


class Count(int):
    """A whole number, which has the forms of :class:`Value` as well."""

    def __format__(self, form: str) -> str:
        """Write the number."""
        return format(Value(self), form) if form.startswith("si") else super().__format__(form)


@dataclass(frozen=True)
class Counts:
    """How many numbers are on one side of a limit; ``[limit]`` in a format string."""

    count: Callable[[float], int]

    def __getitem__(self, limit) -> int:
        return int(self.count(float(limit)))


class Numbers:
    """One measure over several rows: ``count``, ``mean``, ``median``, ``min``, ``max``, ``sum``, ``rms``.

    ``geometric`` is the mean of positive numbers, ``worst`` the number with the largest magnitude.
    None and NaN are left out. ``above[0.05]`` and ``below[0]`` count the numbers on either side of a limit;
    ``[key]`` is a part of each, where they are dicts.
    """

    def __init__(self, measured: Sequence):
        self.parts = measured
        measured = [value for value in measured if not isinstance(value, dict)]
        known = np.array([value for value in measured if value is not None and value == value], float)
        self.count = len(known)
        if not self.count:
            known = np.array([np.nan])
        self.mean = Value(known.mean())
        self.median = Value(np.median(known))
        self.min = Value(known.min())
        self.max = Value(known.max())
        self.sum = Value(known.sum())
        self.rms = Value(np.sqrt(np.square(known).mean()))
        self.geometric = Value(np.exp(np.log(known[known > 0]).mean())) if (known > 0).any() else Value("nan")
        self.worst = Value(known[np.abs(known).argmax()])
        self.above = Counts(lambda limit: (known > limit).sum())
        self.below = Counts(lambda limit: (known < limit).sum())

    def __getitem__(self, key) -> Numbers:
        """Return the numbers of one part."""
        return Numbers([part[key] for part in self.parts if isinstance(part, dict)])


class _Statistics(dict):
    """The numbers of some rows by their keys, as a format string looks them up."""

    def __init__(self, rows):
        super().__init__(runs=len(rows))
        self.rows = rows

    def __missing__(self, key):
        return Numbers([row.get(key) for row in self.rows])


@dataclass(frozen=True)
class Summary:
    """A table of statistics: ``summary`` of an :class:`experiments.harness.Experiment`.

    Attributes
    ----------
    by : dict
        Heading -> format string of a row: rows that agree in all of them are one row of the table.
    columns : dict
        Heading -> format string of :class:`Numbers` by the rows' keys, and of ``runs``, the number of rows.
    """

    by: dict[str, str]
    columns: dict[str, str]

    def __call__(self, rows: list[dict]) -> str:
        """Return the table of some rows, as Markdown."""
        groups: dict[tuple, list[dict]] = {}
        for row in rows:
            groups.setdefault(tuple(form.format_map(row) for form in self.by.values()), []).append(row)
        lines = []
        for names, some in groups.items():
            statistics = _Statistics(some)
            lines.append([*names, *(form.format_map(statistics) for form in self.columns.values())])
        return markdown([*self.by, *self.columns], lines)
