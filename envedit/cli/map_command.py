"""What the commands on a map alone share: options, the object of ``--json``, exit codes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from envedit.cli import console
from envedit.cli.console import Console
from envedit.core import interrupts
from envedit.core.errors import MachineError

if TYPE_CHECKING:
    import numpy as np

    from envedit.inputs import InputMap

MAP_HELP = "an OpenEXR or Radiance HDR file, lat-long, 2:1"


def make_parser(
    command: str,
    description: str,
    examples: Sequence[str],
    out: str = "FILE",
    default: str | None = None,
    repair: bool = True,
) -> argparse.ArgumentParser:
    """Make a parser, as :func:`.console.make_parser`, with the options that all commands on a map have.

    ``out`` is what ``--out`` names, "FILE" or "DIR", ``default`` what it names without the option, for the
    help; ``repair``: whether there is the option of :func:`.map_file.read`.
    """
    parser = console.make_parser(command, description, examples)
    where = f" (default: {default}, in the working folder)" if default else ""
    parser.add_argument("--out", metavar=out, help=f"where the result goes{where}")
    if out == "FILE":
        parser.add_argument(
            "--overwrite", action="store_true", help="replace the file of --out, unless it is an input"
        )
    if repair:
        about = "replace texels that are not finite instead of refusing them"
        parser.add_argument("--repair", action="store_true", help=about)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    return parser


def number(low: float, high: float) -> Callable[[str], float]:
    """Return the type of an option that is a number from ``low`` to ``high``."""

    def read_number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # a NaN is in no range
            raise argparse.ArgumentTypeError(f"got {text}, expected a number from {low:g} to {high:g}")
        return value

    return read_number


def run(
    parser: argparse.ArgumentParser,
    argv: list[str] | None,
    action: Callable[[argparse.Namespace, Console], None],
) -> int:
    """Carry out a command, report its errors, with ``--json`` in the object too, and return its exit code.

    The action says what it does by ``console.say`` and puts what programs read into ``console.facts``.
    """
    arguments = parser.parse_args(argv)
    terminal = Console(one_object=arguments.json)

    def carry_out():
        interrupts.import_mitsuba()
        try:
            action(arguments, terminal)
        except MemoryError:
            raise MachineError("not enough memory for this map; make it smaller") from None
        return 0

    return console.exit_code(terminal, carry_out, "interrupted; no file was left half written")


def read(path: str, arguments: argparse.Namespace, console: Console) -> InputMap:
    """Read a map as of :func:`.map_file.read`, and report its warnings."""
    from envedit.maps import map_file

    input_map = map_file.read(path, arguments.repair)
    console.warn(*input_map.warnings)
    return input_map


def write(file: Path, stored: np.ndarray, like: InputMap, console: Console) -> None:
    """Write a map as of :func:`.map_file.write`, and report its warnings."""
    from envedit.maps import map_file

    console.warn(*map_file.write(file, stored, like))
