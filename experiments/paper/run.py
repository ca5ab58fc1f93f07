r"""Carry out a table or figure of the paper: every run of it that is missing.

    python -m experiments.paper.run table1|table2|table3|figure4|figure5|figure8|figure9 \
        [--settings paper|ours|both] [--maps DIR] [--only NAME ...] [--rows NAME ...] [--scene statue|FILE] \
        [--angle 60] [--workers N] [--scheduler ADDRESS] [--set table.key=value ...] [--out runs/paper]

It only computes; ``python -m experiments.paper.plot NAME`` draws and prints what is done, at any time.
Runs are found again by their content (``envedit sweep --help``): what is done is skipped, what
was interrupted continues, and tables share the runs they have in common.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from envedit.cli import sweep as options
from envedit.sweep import COMMAND, Outcome, sweep, table

from . import kinds, network, plan

OUT = Path("runs/paper")


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    made = argparse.ArgumentParser(
        prog="python -m experiments.paper.run", description=__doc__.splitlines()[0]
    )
    made.add_argument("name", choices=kinds.KINDS, metavar="NAME", help=", ".join(kinds.KINDS))
    made.add_argument("--settings", choices=("paper", "ours", "both"), default="both")
    made.add_argument("--maps", metavar="DIR", help="folder of NAME_puresky_1k.hdr ($ENVEDIT_DATA/puresky)")
    made.add_argument("--only", nargs="+", metavar="MAP", help='some maps; "all" where one is the default')
    made.add_argument("--rows", nargs="+", metavar="ROW", help="some rows; an unknown one lists them")
    made.add_argument("--scene", default="", help="shipped scene or Mitsuba XML, with a roughness if varied")
    made.add_argument("--angle", type=float, default=60.0, help="turn of the true map to the left, degrees")
    made.add_argument("--target", default="", metavar="MAP", help="figure8: the true map")
    made.add_argument("--edit", default="", help="figure9: an edit of scenes/edits (move_shadow)")
    made.add_argument("--set", action="append", default=[], dest="sets", metavar="table.key=value")
    options.add_options(made)
    made.add_argument("--out", type=Path, default=OUT)
    made.add_argument(
        "--dry-run", action="store_true", help="list the runs and what is done; compute nothing"
    )
    return made


def carry_out(given: argparse.Namespace) -> list[Outcome]:
    """Make the plan, keep it, and carry out what is missing of it.

    Raises
    ------
    ConfigError, InputError
        As :func:`plan.build` and :func:`envedit.sweep.sweep`.
    """
    question = plan.Question(given.scene, given.angle, given.target, given.edit, tuple(given.sets))
    question = plan.resolved(given.name, question, given.maps, given.only)
    settings = ("paper", "ours") if given.settings == "both" else (given.settings,)
    made = plan.build(given.name, question, settings, given.maps, given.only, given.rows, given.out)
    if given.dry_run:
        done = [(cell.folder(given.out) / "done.json").exists() for cell, _ in made]
        return [Outcome(job, "done" if d else "missing") for d, (_, job) in zip(done, made, strict=True)]
    if plan.save(given.out, given.name, question, [cell for cell, _ in made]):
        print(
            f"{given.name}: asked another way before; its plan is replaced, its runs are kept",
            file=sys.stderr,
        )
    outcomes = []
    for store in dict.fromkeys(cell.store for cell, _ in made):
        jobs = [job for cell, job in made if cell.store == store]
        call = COMMAND if store == "edits" else network.command(store)
        outcomes += sweep(
            jobs, given.out / store, given.workers, given.scheduler, given.threads, call, sys.stderr
        )
    return outcomes


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a run is not done, 2, 3 as envedit.run, 130."""
    asked = parser()
    given = asked.parse_args(argv)
    options.check_options(asked, given)

    def tell():
        outcomes = carry_out(given)
        print(table(outcomes))
        print(f"python -m experiments.paper.plot {given.name} --out {given.out}")
        return 1 if any(one.state not in ("done", "skipped", "missing") for one in outcomes) else 0

    return options.exit_code("paper", tell)


if __name__ == "__main__":
    sys.exit(main())
