"""``envedit sweep JOBS``: many runs, on this machine or on a Dask cluster."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable

from envedit import sweep as sweeps
from envedit.cli import console


def main(argv: list[str] | None = None) -> int:
    """Carry out jobs; returns the exit code: 0, 1 if a job is not done, 2, 3 as ``envedit run``, 130."""
    parser = console.make_parser(
        "sweep",
        "Carry out many configurations; skip those that are done, continue interrupted ones.\n"
        "JOBS is a TOML file with a table [jobs.NAME] for each job, laid over [common], or a folder of\n"
        "configurations NAME.toml. The folder of a job is DIR/HASH; DIR/sweep.tsv lists names and folders.",
        [
            "envedit sweep jobs.toml --out runs/sweep --workers 2",
            "envedit sweep jobs.toml --out /shared/runs --scheduler tcp://HOST:8786",
        ],
        "A scheduler and its workers are Dask's (pip install '.[cluster]' in a checkout):\n"
        "  dask scheduler                              # prints its address, tcp://HOST:8786\n"
        "  dask worker tcp://HOST:8786 --nthreads 1    # on each node; a thread is a job at a time",
    )
    parser.add_argument("jobs", metavar="JOBS", help="TOML with tables [jobs.NAME], or a folder of NAME.toml")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the jobs' folders")
    add_options(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    arguments = parser.parse_args(argv)
    check_options(parser, arguments)

    def carry_out():
        stream = None if arguments.quiet else sys.stderr
        outcomes = sweeps.sweep(
            sweeps.read_jobs(arguments.jobs),
            arguments.out,
            workers=arguments.workers,
            scheduler=arguments.scheduler,
            threads=arguments.threads,
            stream=stream,
        )
        missing = [outcome for outcome in outcomes if outcome.state not in ("done", "skipped")]
        if not arguments.quiet:
            print(sweeps.table(outcomes))
        elif missing:
            print(sweeps.table(missing), file=sys.stderr)
        return 1 if missing else 0

    return exit_code("envedit sweep", carry_out)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where jobs run."""
    parser.add_argument("--workers", type=int, metavar="N", help="jobs at a time (one for every four cores)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of a job (its share of the cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster of this scheduler")


def check_options(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """End with a usage error where the options of :func:`add_options` make no sense."""
    for option in ("workers", "threads"):
        if (value := getattr(arguments, option)) is not None and value < 1:
            parser.error(f"--{option}: got {value}, expected 1 or more")
    if arguments.workers and arguments.scheduler:
        parser.error("--workers, --scheduler: got both, expected one; start the cluster's workers with dask")


def exit_code(name: str, action: Callable[[], int]) -> int:
    """Return the exit code as :func:`.console.exit_code`; a batch system's SIGTERM counts as Ctrl-C."""

    def interrupt(number, frame):
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        return console.exit_code(console.Console(name=name), action, "interrupted; run again to continue")
    finally:
        signal.signal(signal.SIGTERM, previous)
