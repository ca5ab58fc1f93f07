"""``python -m envedit.run CONFIG.toml``; see :mod:`envedit.cli.run`."""

from __future__ import annotations

import sys

from envedit.cli import main as commands


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    return commands.main(["run", *arguments])


if __name__ == "__main__":
    raise SystemExit(main())
