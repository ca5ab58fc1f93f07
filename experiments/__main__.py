"""``python -m experiments NAME run|table|sheet``: the experiments on :mod:`experiments.harness`."""

import importlib
import inspect
import sys
from pathlib import Path
from types import ModuleType

from experiments import harness


def modules() -> dict[str, str]:
    """Return the modules of all experiments by name: FOLDER for ``experiment.py``, or FOLDER.MODULE."""
    files = sorted(Path(__file__).parent.glob("*/*.py"))
    found = [(f.parent.name, f.stem) for f in files if "\nEXPERIMENT = " in f.read_text(encoding="utf-8")]
    names = [folder if module == "experiment" else f"{folder}.{module}" for folder, module in found]
    return {name: f"experiments.{'.'.join(one)}" for name, one in sorted(zip(names, found, strict=True))}


def about(module: ModuleType) -> str:
    """Return the first line of what a module says of itself."""
    return inspect.getdoc(module).splitlines()[0]


def main(argv=None) -> int:
    """Run an experiment by name; returns the exit code."""
    given = sys.argv[1:] if argv is None else argv
    known = modules()
    if given[:1] in (["-h"], ["--help"]):
        print("python -m experiments NAME run|table|sheet: compute, print the table, draw the sheets\n")
        width = max(map(len, known))
        for name, module in known.items():
            print(f"  {name:<{width}}  {about(importlib.import_module(module))}")
        return 0
    if not given or given[0] not in known:
        got = f"got {given[0]}" if given else "got no name"
        print(f"python -m experiments NAME ...: {got}, expected one of {', '.join(known)}", file=sys.stderr)
        return 2
    module = importlib.import_module(known[given[0]])
    return harness.main(given[0], about(module), module.EXPERIMENT, given[1:])


if __name__ == "__main__":
    sys.exit(main())
