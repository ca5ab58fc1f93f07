r"""Draw and print what is done of a table or figure; computes nothing that ``experiments.paper.run`` does.

    python -m experiments.paper.plot table1|table2|table3|figure4|figure5|figure8|figure9 \
        [--out runs/paper] [--to DIR] [--no-pictures]

The table is printed, and kept as ``NAME.md`` beside the pictures, ``NAME-SETTINGS*.png``, which need
matplotlib (envedit[report]).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import mitsuba as mi

from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError, InputError

from . import kinds, plan, tables
from .run import OUT


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 2 or 3 as envedit.run."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.plot", description=__doc__.splitlines()[0]
    )
    parser.add_argument("name", choices=kinds.KINDS, metavar="NAME", help=", ".join(kinds.KINDS))
    parser.add_argument("--out", type=Path, default=OUT, help="where the runs lie")
    parser.add_argument("--to", type=Path, help="folder of table and pictures (that of the runs)")
    parser.add_argument("--no-pictures", action="store_true", help="only the table")
    given = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    to = given.to or given.out
    try:
        if (found := plan.load(given.out, given.name)) is None:
            command = f"python -m experiments.paper.run {given.name} --out {given.out}"
            raise InputError(f"{given.out}: no plan of {given.name} in it; {command} makes it")
        text = tables.text(given.name, given.out, found[1])
        print(text)
        try:
            to.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{to}: cannot be made ({error.strerror}): give another --to") from None
        write_atomically(to / f"{given.name}.md", f"{text}\n".encode())
        if given.no_pictures:
            return 0
        try:
            from . import sheets
        except ImportError:
            print("no pictures: matplotlib is missing: pip install 'envedit[report]'", file=sys.stderr)
            return 0
        for file in sheets.draw(given.name, given.out, found[1], to):
            print(file)
    except EnveditError as error:
        print(f"paper: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
