"""What each constant of behaviour does: four small edits with it halved and doubled."""

from __future__ import annotations

import ast
import contextlib
import importlib
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import envedit
from envedit import config, pipeline
from envedit.config import presets
from experiments.harness import Case, Experiment, calling
from experiments.summary import values

FACTORS = {"halved": 0.5, "doubled": 2.0}
NO_SCALE = {"light_places.PLACES_APART_COSINE", "prior.DEGREES", "normal_equations.ROWS"}
"""A cosine, the length of a series, and what decides only how long something takes."""
SHADOW = {"type": "shadow", "ellipse": [0.75, 0.75, 0.2, 0.1], "softness": 0.03, "amount": 0.8}
EDITS: dict[str, dict] = {
    "sun lower": {
        "input": {"azimuth": 240.0, "elevation": 45.0},
        "target": {"kind": "envmap", "rotate_degrees": 40.0},
        "representation": {"turn": False},
    },
    "sky turned": {"input": {"azimuth": 200.0}, "target": {"kind": "envmap", "rotate_degrees": 75.0}},
    "mirror": {
        "input": {"elevation": 25.0},
        "scene": {"file": "mirror"},
        "target": {"kind": "envmap", "rotate_degrees": 30.0},
        "representation": {"turn": False},
    },
    "shadow painted": {"target": {"kind": "strokes", "strokes": [SHADOW]}},
}
KINDS = "rendering", "map", "paint"
"""Numbers of an edit: PSNR of rendering and map, dB, and percent of the paint."""
BASE = {
    "input": {"envmap": "sunsky", "width": 64},
    "scene": {"file": "sphere", "width": 48},
    "output": {"report": False},
}


@dataclass(frozen=True)
class Constant:
    """A module below ``envedit``, a name there, and its number."""

    module: str
    name: str
    value: float

    @property
    def label(self) -> str:
        return f"{self.module.rpartition('.')[2]}.{self.name}"


def constants() -> list[Constant]:
    """List the constants of the solver that have a docstring, in the order of modules and lines."""
    found = []
    folder = Path(envedit.__file__).parent
    for file in [folder / "preparation.py", *sorted((folder / "solve").glob("*.py"))]:
        module = ".".join(file.relative_to(folder.parent).with_suffix("").parts)
        body = ast.parse(file.read_text()).body
        for node, after in zip(body, body[1:], strict=False):
            if isinstance(node, ast.Assign) and isinstance(after, ast.Expr):
                targets = node.targets[0]
                names = [one.id for one in getattr(targets, "elts", [targets])]
                values = [getattr(importlib.import_module(module), name) for name in names]
                found += [
                    Constant(module, name, value)
                    for name, value in zip(names, values, strict=True)
                    if isinstance(value, int | float) and not isinstance(value, bool)
                ]
    return [one for one in found if one.label not in NO_SCALE]


def scaled(value: float, factor: float) -> float:
    """Return a number times a factor; a count stays a count."""
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def measured(settings: config.Config, folder: Path, module: str = "") -> list[dict]:
    """Make the edits with each constant of a module halved and doubled; without a module, as they are."""
    if not module:
        return [{"constant": "", "edits": _edits()}]
    rows = []
    for one in constants():
        for change, factor in FACTORS.items() if one.module == module else ():
            with _changed(one, scaled(one.value, factor)):
                about = {"constant": one.label, "value": one.value, "change": change}
                rows.append(about | {"edits": _edits()})
    return rows


@contextlib.contextmanager
def _changed(constant: Constant, value: float):
    """Change a constant wherever it has been imported."""
    modules = [module for name, module in sys.modules.items() if name.startswith("envedit.")]
    places = [module for module in modules if getattr(module, constant.name, None) is constant.value]
    for module in places:
        setattr(module, constant.name, value)
    try:
        yield
    finally:
        for module in places:
            setattr(module, constant.name, constant.value)


def _edits():
    numbers = {}
    for edit, tables in EDITS.items():
        try:
            metrics = pipeline.run(config.from_dict(presets.overlaid(BASE, tables))).metrics
        except Exception as error:  # a constant may make an edit impossible
            numbers[edit] = {"failed": f"{type(error).__name__}: {error}"}
            continue
        painted = metrics["painted"]
        numbers[edit] = {
            "rendering": metrics["render"]["psnr"],
            "map": metrics["envmap"]["psnr"] if metrics["envmap"] else None,
            "paint": None if painted is None else 100 * painted["towards"],
        }
    return numbers


def cases(given) -> list[Case]:
    """Return the edits as they are, and those of each module."""
    modules = dict.fromkeys(one.module for one in constants())
    changed = [calling(module, measured, BASE, {}, module=module) for module in modules]
    return [calling("as they are", measured, BASE, {}), *changed]


def combine(rows: list[dict]) -> list[dict]:
    """Return a row a constant: by how much numbers differ from those of the edits as they are."""
    base = next(row["edits"] for row in rows if not row["constant"])
    combined: dict[str, dict] = {}
    for row in rows:
        if row["constant"]:
            unknown = {"constant": row["constant"], "value": row["value"]} | dict.fromkeys(FACTORS)
            found = combined.setdefault(row["constant"], unknown)
            found[row["change"]] = largest_changes(row["edits"], base)
    return [values(row) for row in combined.values()]


def largest_changes(edits: dict, base: dict) -> dict[str, float]:
    """Return the changes of the edits that changed most; NaN where one failed."""
    if any("failed" in numbers for numbers in edits.values()):
        return dict.fromkeys(KINDS, math.nan)
    changes = dict.fromkeys(KINDS, 0.0)
    for edit, numbers in edits.items():
        for kind in KINDS:
            change = numbers[kind] - base[edit].get(kind, math.nan)
            if change == change:
                changes[kind] = max(changes[kind], change, key=abs)
    return changes


CHANGES = "{{{0}[rendering]:+.1f}}, {{{0}[map]:+.1f}}, {{{0}[paint]:+.1f}}"

EXPERIMENT = Experiment(
    cases=cases,
    combine=combine,
    columns={
        "constant": "`{constant}`",
        "value": "{value:.4g}",
        "halved: dB, dB, %": CHANGES.format("halved"),
        "doubled: dB, dB, %": CHANGES.format("doubled"),
    },
)
