"""``python -m experiments NAME run|table|sheet``: the experiments on :mod:`experiments.harness`."""

import importlib
import sys
from pathlib import Path

from experiments import harness


def main(argv=None) -> int:
    """Run an experiment by name; returns the exit code."""
    given = sys.argv[1:] if argv is None else argv
    names = sorted(path.parent.name for path in Path(__file__).parent.glob("*/experiment.py"))
    if not given or given[0] not in names:
        got = f"got {given[0]}" if given else "got no name"
        print(f"python -m experiments NAME ...: {got}, expected one of {', '.join(names)}", file=sys.stderr)
        return 0 if given[:1] in (["-h"], ["--help"]) else 2
    return harness.main(importlib.import_module(f"experiments.{given[0]}.experiment").EXPERIMENT, given[1:])


if __name__ == "__main__":
    sys.exit(main())
