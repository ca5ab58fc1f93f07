"""How experiments are carried out: ``python -m experiments NAME run|table|sheet``.

An experiment is its cases, what is measured of each, the columns of its table and the panels of its sheets.
A case is a job of :mod:`envedit.sweep`: its folder ``OUT/<hash>`` belongs to one configuration, with the
content of the files it names, and to one version of the program. What is done is skipped, what was
interrupted continues, and results of another configuration or version are never taken for it.

.. code-block:: python

   EXPERIMENT = Experiment(
       cases=lambda given: [
           Case(name, {"input": {"envmap": str(file)}, "target": {"rotate_degrees": 60}}, {"map": name})
           for name, file in puresky.find().items()
       ],
       measure=lambda done: {"psnr": done.metrics["render"]["psnr"]},
       columns={"map": "{map}", "rendering, dB": "{psnr:.1f}"},
   )

What a run does not measure is a function, called in a process of its own (:func:`calling`).
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import hashlib
import inspect
import itertools
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR

from envedit import config, sweep
from envedit.cli import sweep as options
from envedit.core import latlong
from envedit.core.atomic_files import make_folder, write_atomically
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError, InputError
from envedit.core.extras import required
from envedit.images import images
from experiments import call
from experiments.summary import markdown, values

NOTHING = "no case is done by this version of the program; run computes them"
SHOWING = {b"harness", b"summary"}
"""Modules that decide what is shown of a case, and not its numbers."""
GAP = 3
"""Pixels between the rows of a sheet."""


@dataclass(frozen=True)
class Case:
    """One run of an experiment."""

    name: str  # unique in the experiment; what ``--only`` looks at
    tables: dict  # configuration
    about: dict = field(default_factory=dict)  # what the columns and groups show of it
    command: Sequence[str] = sweep.COMMAND  # what carries it out
    version: str = ""  # whatever else decides what comes out, such as the code of another command
    result: str = "metrics.json"  # the file with its numbers

    def job(self, overrides: Iterable[str] = ()) -> sweep.Job:
        """Return its job under overrides ``table.key=value``."""
        how = {"version": self.version, "command": self.command, "overrides": overrides}
        return sweep.job(self.name, self.tables, **how)


def calling(
    name: str,
    function: Callable[..., dict | list[dict]],
    tables: dict,
    about: dict | None = None,
    **arguments,
) -> Case:
    """Make a case that calls a function in place of ``envedit run``.

    The function, of a module, is (settings, folder, **arguments) -> the metrics of the case; arguments are
    those of JSON. The code of its folder, and of what this imports from ``experiments``, is part of the
    version.
    """
    folder = Path(inspect.getfile(function)).parent
    imported = set(re.findall(rb"^from experiments\.(\w+)", code_of(folder), re.M)) - SHOWING
    places = [folder, *(Path(__file__).parent / one.decode() for one in sorted(imported))]
    code = hashlib.sha256(b"".join(map(code_of, places))).hexdigest()
    where = f"{function.__module__}:{function.__name__}"
    given = json.dumps(arguments, sort_keys=True)
    command = "{python}", str(Path(call.__file__).absolute()), where, "{folder}", "{threads}", given
    return Case(name, tables, about or {}, command, f"{code} {where} {given}", call.RESULT)


@functools.cache
def code_of(folder: Path) -> bytes:
    """Return the Python files of a folder, one after the other; or the module of this name."""
    files = sorted(folder.glob("*.py")) or [folder.with_suffix(".py")]
    return b"\0".join(file.read_bytes() for file in files)


@dataclass(frozen=True)
class Done:
    """A case that is done, and the folder of its results."""

    case: Case
    folder: Path

    @cached_property
    def metrics(self) -> Any:
        """Numbers of its result, a dict or rows of them; InputError if the file cannot be read."""
        path = self.folder / self.case.result
        try:
            return json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read ({error}); remove its folder and run again") from None

    def picture(self, name: str) -> np.ndarray:
        """Read ``NAME.exr``, linear radiance (H, W, 3)."""
        return images.read(str(self.folder / f"{name}.exr"))[0]

    def shown(self, *names: str) -> list[np.ndarray]:
        """Read ``NAME.exr`` of several names as display values."""
        return [tonemap(self.picture(name), "gamma") for name in names]

    @cached_property
    def maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Original, edited and true map; None for a target without one."""
        layers = OpenEXR.File(str(self.folder / "edited_layers.exr"), separate_channels=True).channels()
        original = np.stack([layers[f"initial.{c}"].pixels for c in "RGB"], axis=2)
        edited = self.picture("edited")
        settings = config.load(self.folder / "config.toml")
        asked = settings.target
        if asked.kind != "envmap":
            return original, edited, None
        if not asked.file:
            return original, edited, latlong.rotate(original, asked.degrees)
        true, _ = images.load_envmap(asked.file, original.shape[1], settings.input.repair)
        return original, edited, true

    @property
    def rows(self) -> slice:
        """Rows of the map that were edited."""
        first, last = self.metrics["active_rows"]
        return slice(first, last + 1)


def edit_panels(done: Done) -> list[np.ndarray]:
    """Return original, true and edited map, target and edited rendering as display values."""
    original, edited, true = done.maps
    maps = [original, np.zeros_like(original) if true is None else true, edited]
    return [tonemap(one, "gamma") for one in maps] + done.shown("render_target", "render_edited")


@dataclass(frozen=True)
class Experiment:
    """What is run, measured and shown."""

    cases: Callable[[argparse.Namespace], list[Case]]  # of the parsed command line
    # A row of numbers, or several, or an empty one, which is left out; columns also know the case's ``about``
    measure: Callable[[Done], dict | list[dict]] = lambda done: done.metrics
    # Heading -> format string, or callable of the row that returns the text; or this of each group. Without
    # columns the summary is all
    columns: dict[str, Any] = field(default_factory=dict)
    # Row -> heading of the part of the table that it belongs to; "" for one table
    group: Callable[[dict], str] = lambda row: ""
    # All rows -> a sentence for each thing that must hold and does not: exit code 1 if there are any
    failures: Callable[[list[dict]], list[str]] | None = None
    summary: Callable[[list[dict]], str] | None = None  # all rows -> Markdown that precedes the table
    combine: Callable[[list[dict]], list[dict]] = lambda rows: rows  # all rows -> rows of the table
    # A row of the sheet: pictures of display values, of any size; no pictures: no row
    panels: Callable[[Done], list[np.ndarray]] = edit_panels
    sheet: Callable[[Case], str] = lambda case: "sheet.jpg"  # name of its file; without ending: a PNG
    options: Callable[[argparse.ArgumentParser], None] = lambda parser: None  # adds the experiment's own
    # Kind of a case and its rank there, as one tuple; adds --count N: so many cases, of each kind in turn
    place: Callable[[Case], tuple] | None = None
    draw: Callable[[list[Done], Path], list[Path]] | None = None  # in place of panels: folder -> files
    alone: bool = False  # times are measured: a case at a time, unless the command line says otherwise


# ---- running -----------------------------------------------------------------------------------------------


def chosen(experiment: Experiment, given: argparse.Namespace) -> list[Case]:
    """Return the cases that the command line asks for: those of ``--only``, and of these ``--count``."""
    cases = experiment.cases(given)
    if given.only:
        cases = [case for case in cases if any(text in case.name for text in given.only)]
    if experiment.place and given.count is not None:
        kinds: dict[Any, list[Case]] = {}
        for case in sorted(cases, key=experiment.place):
            kinds.setdefault(experiment.place(case)[0], []).append(case)
        rounds = itertools.zip_longest(*kinds.values())
        cases = [case for some in rounds for case in some if case is not None][: given.count]
    return cases


def done_of(cases: Iterable[tuple[Case, sweep.Job]], out: Path) -> list[Done]:
    """Return the cases that are done, in their order."""
    return [Done(case, job.folder(out)) for case, job in cases if (job.folder(out) / sweep.DONE).exists()]


def carry_out(cases, out: Path, given, stream=None) -> list[sweep.Outcome]:
    """Run what is not done of cases with their jobs, in this order; with ``--dry-run`` only say what is."""
    if given.dry_run:
        states = ["done" if (job.folder(out) / sweep.DONE).exists() else "missing" for _, job in cases]
        return [sweep.Outcome(job, state) for (_, job), state in zip(cases, states, strict=True)]
    jobs = [job for _, job in cases]
    return sweep.sweep(jobs, out, given.workers, given.scheduler, given.threads, stream=stream)


# ---- tables and sheets -------------------------------------------------------------------------------------


def rows_of(experiment: Experiment, done: Iterable[Done]) -> list[dict]:
    """Return what is known of each case, a row or several; numbers are as of :func:`.values`."""
    rows = []
    for one in done:
        measured = experiment.measure(one)
        of_case = measured if isinstance(measured, list) else [measured]
        rows += [one.case.about | values(row) for row in of_case if row]
    return rows


def table(experiment: Experiment, rows: list[dict]) -> str:
    """Return the summary and a table for each group."""
    if not rows:
        return NOTHING
    parts = [experiment.summary(rows)] if experiment.summary else []
    rows = experiment.combine(rows) if experiment.columns else []
    for heading in dict.fromkeys(map(experiment.group, rows)):
        some = [row for row in rows if experiment.group(row) == heading]
        columns = experiment.columns.get(heading, experiment.columns)
        forms = [form.format_map if isinstance(form, str) else form for form in columns.values()]
        lines = [[form(row) for form in forms] for row in some]
        parts += [f"{heading}:"] * bool(heading) + [markdown(list(columns), lines)]
    return "\n\n".join(parts)


def montage(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Put pictures of display values side by side in rows, (H, W, 3) uint8.

    Smaller ones are enlarged by whole factors.
    """
    height = max(len(picture) for row in rows for picture in row)
    strips = []
    for row in rows:
        factors = [max(1, height // len(picture)) for picture in row]
        tiles = [np.kron(p[..., :3], np.ones((f, f, 1))) for p, f in zip(row, factors, strict=True)]
        tiles = [np.pad(t, ((0, height - len(t) + GAP), (0, GAP), (0, 0))) for t in tiles]
        strips.append(np.concatenate(tiles, axis=1))
    width = max(strip.shape[1] for strip in strips)
    padded = [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0))) for strip in strips]
    return (np.clip(np.concatenate(padded), 0, 1) * 255 + 0.5).astype(np.uint8)


def sheets(experiment: Experiment, done: Sequence[Done], folder: Path) -> list[Path]:
    """Draw every sheet of which a case is done; returns the files."""
    files = []
    for name in dict.fromkeys(experiment.sheet(one.case) for one in done):
        rows = [experiment.panels(one) for one in done if experiment.sheet(one.case) == name]
        picture = montage([row for row in rows if row])
        files.append(folder / (name if name.endswith(".jpg") else f"{name}.png"))
        if name.endswith(".jpg"):
            mi.Bitmap(picture).write(str(files[-1]), quality=88)
        else:
            write_atomically(files[-1], images.png(picture))
    return files


@contextlib.contextmanager
def figure(file: Path, rows: int, columns: int, size: tuple[float, float], **subplots):
    """Give the panels of a figure to draw in, as ``matplotlib.pyplot.subplots``, and write it.

    ``size`` is width and height in inches. MachineError if matplotlib is missing.
    """
    drawing = required("matplotlib.figure", "report", "a figure")
    drawn = drawing.Figure(figsize=size, layout="constrained", dpi=110)
    panels = drawn.subplots(rows, columns, **subplots)
    for panel in np.ravel(panels):
        panel.grid(alpha=0.3)
    yield panels
    drawn.savefig(file)


# ---- command line ------------------------------------------------------------------------------------------


def main(name: str, about: str, experiment: Experiment, argv: Sequence[str] | None = None) -> int:
    """Run the command line of an experiment of a name, which its help says about; returns the exit code.

    0; 1 if a case is not done; 2, 3 as ``envedit run``; 130 interrupted.
    """
    parser = argparse.ArgumentParser(prog=f"python -m experiments {name}", description=about)
    parser.add_argument(
        "action",
        choices=("run", "table", "sheet"),
        help="compute what is missing and print the table; print the table; draw the contact sheets",
    )
    out = Path("runs") / name
    parser.add_argument("--out", type=Path, default=out, metavar="DIR", help="of the runs (%(default)s)")
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="names of cases, or parts")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="table.key=value")
    parser.add_argument("--dry-run", action="store_true", help="list the cases; compute nothing")
    options.add_options(parser)
    parser.add_argument("--to", type=Path, metavar="DIR", help="of the sheets (that of the runs)")
    if experiment.place:
        parser.add_argument("--count", type=int, metavar="N", help="so many cases, evenly from all kinds")
    experiment.options(parser)
    given = parser.parse_args(argv)
    options.check_options(parser, given)
    if experiment.alone and not given.scheduler:
        given.workers = given.workers or 1
    return options.exit_code(name, lambda: _act(name, experiment, given))


def _act(name, experiment, given):
    mi.set_variant(config.Config().variant)
    out = given.out.absolute()
    cases = [(case, case.job(given.sets)) for case in chosen(experiment, given)]
    if not cases:
        got = f"--only {' '.join(given.only)}: " if given.only else ""
        raise ConfigError(f"{got}no case of {name} is left; give other options")
    missing = []
    if given.action == "run":
        outcomes = carry_out(cases, out, given, sys.stderr)
        missing = [one for one in outcomes if one.state not in ("done", "skipped")]
        if given.dry_run:
            print(sweep.table(outcomes))
            return 0
        if missing:
            print(sweep.table(missing), file=sys.stderr)
    done = done_of(cases, out)
    if given.action == "sheet":
        draw = experiment.draw
        if not draw and experiment.panels is edit_panels and cases[0][0].result == call.RESULT:
            raise ConfigError(f"there is no sheet of {name}; give run or table")
        if not done:
            raise InputError(f"{out}: {NOTHING}")
        to = make_folder(given.to or out)
        print("\n".join(map(str, draw(done, to) if draw else sheets(experiment, done, to))))
        return 0
    rows = rows_of(experiment, done)
    print(table(experiment, rows))
    wrong = experiment.failures(rows) if experiment.failures else []
    for line in wrong:
        print(f"FAILED: {line}", file=sys.stderr)
    return 1 if missing or wrong else 0
