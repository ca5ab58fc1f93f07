"""Carry out a case that is a function: ``call.py MODULE:FUNCTION FOLDER THREADS ARGUMENTS``.

Called by :mod:`envedit.sweep` for cases of :func:`experiments.harness.calling`. The function gets the case's
configuration, its folder and the arguments, a JSON object; what it returns is ``result.json`` there, with
null for numbers that are not finite.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[1])  # of the package, which need not be installed

from envedit import config
from envedit.cli import doctor
from envedit.cli.sweep import exit_code
from envedit.core.atomic_files import write_atomically
from envedit.report.plain_files import plain
from envedit.sweep.process import CONFIG

RESULT = "result.json"


def main(argv: list[str]) -> int:
    """Call a function and write what it returns; returns the exit code."""
    name, folder, threads, arguments = argv
    module, _, function = name.partition(":")

    def act():
        settings = config.load(Path(folder) / CONFIG)
        doctor.ensure(settings.variant)
        mi.set_variant(settings.variant)
        dr.set_thread_count(int(threads))
        called = getattr(importlib.import_module(module), function)
        found = called(settings, Path(folder), **json.loads(arguments))
        write_atomically(Path(folder) / RESULT, json.dumps(plain(found, "", []), indent=1).encode())
        return 0

    return exit_code(name, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
