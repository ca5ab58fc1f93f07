"""``envedit sweep JOBS``: many runs, on this machine or on a Dask cluster."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence

from envedit import sweep as sweeps
from envedit.cli.streams import steady
from envedit.core.errors import EnveditError, unwrapped


@steady
def main(argv: list[str] | None = None, command: Sequence[str] = ()) -> int:
    """Carry out jobs; returns the exit code: 0, 1 if a job is not done, 2, 3 as ``envedit run``, 130."""
    parser = argparse.ArgumentParser(
        prog="envedit sweep",
        description="Carry out many configurations; skip those that are done, continue interrupted ones.\n"
        "JOBS is a TOML file with a table [jobs.NAME] for each job, laid over [common], or a folder of\n"
        "configurations NAME.toml. The folder of a job is DIR/HASH; DIR/sweep.tsv lists names and folders.",
        epilog="examples:\n  envedit sweep jobs.toml --out runs/sweep --workers 2\n"
        "  envedit sweep jobs.toml --out /shared/runs --scheduler tcp://HOST:8786\n\n"
        "A scheduler and its workers are Dask's (pip install 'envedit[cluster]'):\n"
        "  dask scheduler                              # prints its address, tcp://HOST:8786\n"
        "  dask worker tcp://HOST:8786 --nthreads 1    # on each node; a thread is a job at a time",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("jobs", metavar="JOBS", help="TOML with tables [jobs.NAME], or a folder of NAME.toml")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the jobs' folders")
    add_options(parser)
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    given = parser.parse_args(argv)
    check_options(parser, given)

    def carry_out():
        stream = None if given.quiet else sys.stderr
        outcomes = sweeps.sweep(
            sweeps.read_jobs(given.jobs),
            given.out,
            workers=given.workers,
            scheduler=given.scheduler,
            threads=given.threads,
            command=command,
            stream=stream,
        )
        missing = [one for one in outcomes if one.state not in ("done", "skipped")]
        if not given.quiet:
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


def check_options(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """End with a usage error where the options of :func:`add_options` make no sense."""
    for option in ("workers", "threads"):
        if (value := getattr(given, option)) is not None and value < 1:
            parser.error(f"--{option}: got {value}, expected 1 or more")
    if given.workers and given.scheduler:
        parser.error("--workers, --scheduler: got both, expected one; start the cluster's workers with dask")


def exit_code(name: str, action: Callable[[], int]) -> int:
    """Return the exit code of an action, or of a user's error (2, 3) or an interruption (130) that ended it.

    These are reported on stderr. SIGTERM, a batch system's way to say that time is up, counts as Ctrl-C.
    """

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        with unwrapped():
            return action()
    except EnveditError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print(f"{name}: interrupted; run again to continue", file=sys.stderr)
        return 130
    finally:
        signal.signal(signal.SIGTERM, before)
