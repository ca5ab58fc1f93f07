"""The command line of sweeps: parse, call, print, exit code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import experiments.sweep

from . import COMMAND, options, read_jobs, sweep, table


def main(argv: list[str] | None = None, command: Sequence[str] = COMMAND) -> int:
    """Run the command line; returns the exit code: 0, 1 if a job is not done, 2, 3 as envedit.run, 130."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.sweep", description=experiments.sweep.__doc__
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("jobs", metavar="JOBS", help="TOML with tables [jobs.NAME], or a folder of NAME.toml")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the jobs' folders")
    options.add(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    given = parser.parse_args(argv)
    options.check(parser, given)

    def carry_out():
        where = given.workers, given.scheduler, given.threads, command, given.quiet
        outcomes = sweep(read_jobs(given.jobs), given.out, *where)
        missing = [one for one in outcomes if one.state not in ("done", "skipped")]
        if not given.quiet:
            print(table(outcomes))
        elif missing:
            print(table(missing), file=sys.stderr)
        return 1 if missing else 0

    return options.exit_code("sweep", carry_out)


if __name__ == "__main__":
    sys.exit(main())
