"""The command line of sweeps: parse, call, print, exit code."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence

import experiments.sweep
from envedit.errors import EnveditError

from . import COMMAND, read_jobs, sweep, table


def main(argv: list[str] | None = None, command: Sequence[str] = COMMAND) -> int:
    """Run the command line; returns the exit code: 0, 1 if a job is not done, 2, 3 as envedit.run, 130."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.sweep", description=experiments.sweep.__doc__
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("jobs", metavar="JOBS", help="TOML with tables [jobs.NAME], or a folder of NAME.toml")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the jobs' folders")
    parser.add_argument("--workers", type=int, metavar="N", help="jobs at a time (one for every four cores)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of a job (its share of the cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster of this scheduler")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    given = parser.parse_args(argv)
    for option in ("workers", "threads"):
        if (value := getattr(given, option)) is not None and value < 1:
            parser.error(f"--{option}: came {value}, wanted 1 or more")
    if given.workers and given.scheduler:
        parser.error("--workers, --scheduler: came both; a cluster's workers are started beside it")

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)  # a batch system's way to say that time is up
    try:
        options = given.workers, given.scheduler, given.threads, command, given.quiet
        outcomes = sweep(read_jobs(given.jobs), given.out, *options)
    except EnveditError as error:
        print(f"sweep: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("sweep: interrupted; run again to continue", file=sys.stderr)
        return 130
    finally:
        signal.signal(signal.SIGTERM, before)
    missing = [one for one in outcomes if one.state not in ("done", "skipped")]
    if not given.quiet:
        print(table(outcomes))
    elif missing:
        print(table(missing), file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
