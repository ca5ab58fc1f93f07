"""What the command lines of sweeps share: options, what ends them, exit codes."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable

from envedit.core.errors import EnveditError


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where jobs run."""
    parser.add_argument("--workers", type=int, metavar="N", help="jobs at a time (one for every four cores)")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of a job (its share of the cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster of this scheduler")


def check(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """End with a usage error where the options of :func:`add` make no sense."""
    for option in ("workers", "threads"):
        if (value := getattr(given, option)) is not None and value < 1:
            parser.error(f"--{option}: came {value}, wanted 1 or more")
    if given.workers and given.scheduler:
        parser.error("--workers, --scheduler: came both; a cluster's workers are started beside it")


def exit_code(name: str, action: Callable[[], int]) -> int:
    """Return the exit code of an action, or of a user's error (2, 3) or an interruption (130) that ended it.

    These are told on stderr. SIGTERM, a batch system's way to say that time is up, counts as Ctrl-C.
    """

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        return action()
    except EnveditError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print(f"{name}: interrupted; run again to continue", file=sys.stderr)
        return 130
    finally:
        signal.signal(signal.SIGTERM, before)
