"""What commands write to the terminal, and the exit codes of errors."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from envedit.core.errors import EnveditError, unwrapped

if TYPE_CHECKING:
    from envedit.cli.progress import Progress


def make_parser(
    command: str, description: str, examples: Sequence[str], more: str = ""
) -> argparse.ArgumentParser:
    """Make the parser of a command; its help ends with examples, command lines, and ``more``."""
    lines = "\n".join(f"  {example}" for example in examples)
    return argparse.ArgumentParser(
        prog=f"envedit {command}",
        description=description,
        epilog=f"examples:\n{lines}\n\n{more}".rstrip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_overrides(parser: argparse.ArgumentParser, example: str) -> None:
    """Add ``--set``, the option ``overrides``: keys of the configuration with other values."""
    parser.add_argument(
        "--set",
        metavar="table.key=value",
        action="append",
        default=[],
        dest="overrides",
        help=f"change one key of the configuration, such as {example}; may be repeated",
    )


class Console:
    """What a run writes: lines to stdout, progress, warnings and errors to stderr, the object of ``--json``.

    ``facts`` is what the object of ``--json`` will have beside the exit code.
    """

    def __init__(
        self, quiet: bool = False, one_object: bool = False, json_lines: bool = False, name: str = "envedit"
    ):
        self._name = name  # what the lines on stderr begin with
        self._quiet = quiet
        self._one_object = one_object
        self._json_lines = json_lines
        self.facts: dict[str, Any] = {}

    def say(self, *lines: str) -> None:
        """Write lines of text, unless there will be an object."""
        for line in () if self._quiet or self._one_object else lines:
            print(line)

    def warn(self, *texts: str) -> None:
        """Report warnings."""
        for text in texts:
            self.facts.setdefault("warnings", []).append(text)
            self._report("warning", text, f"{self._name}: warning: {text}")

    def error(self, text: str) -> None:
        """Report an error."""
        self.facts["error"] = text
        self._report("error", text, f"{self._name}: {text}")

    def _report(self, kind, text, line):
        if self._json_lines:
            from envedit.cli.progress import tell

            tell(kind, text=text)
        else:
            print(line, file=sys.stderr)

    def progress(self) -> Progress:
        """Return what shows progress."""
        from envedit.cli.progress import Progress

        return Progress(self._quiet, self._json_lines)

    def close(self, code: int) -> None:
        """Write the object, if one is asked for."""
        if self._one_object:
            print(json.dumps({"ok": code == 0, "exit_code": code, **self.facts}))


def exit_code(console: Console, action: Callable[[], int], interrupted: str = "interrupted") -> int:
    """Return the exit code of an action, or of a user's error or of Ctrl-C, which are reported."""
    try:
        with unwrapped():
            code = action()
    except EnveditError as error:
        console.error(str(error))
        code = error.exit_code
    except KeyboardInterrupt:
        console.error(interrupted)
        code = 130
    console.close(code)
    return code
