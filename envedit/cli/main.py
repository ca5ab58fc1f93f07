"""The command ``envedit``: run, fit, doctor, cache, init."""

from __future__ import annotations

import argparse
import importlib
import sys

COMMANDS = {
    "run": "carry out the edit that a configuration describes",
    "fit": "fit a SIREN to a map",
    "init": "write a commented configuration to start from",
    "doctor": "say whether this machine can run envedit",
    "cache": "show or empty what is kept between runs",
}


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    from envedit import __version__
    from envedit.core import shipped

    commands = "\n".join(f"  {name:<8}{about}" for name, about in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="envedit",
        usage="envedit COMMAND ... | --version",
        description="Edit HDR environment maps by inverse rendering.",
        epilog=f"commands:\n{commands}\n\n"
        "examples:\n  envedit run quickstart\n"
        "  envedit init sphere --envmap sky.hdr && envedit run edit.toml\n\n"
        f"shipped configurations: {', '.join(shipped.configurations())}\n"
        f"shipped scenes: {', '.join(shipped.scenes())}\n\n"
        "envedit COMMAND --help says more.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"envedit {__version__}")
    parser.add_argument("command", metavar="COMMAND", choices=tuple(COMMANDS), help=argparse.SUPPRESS)
    given = sys.argv[1:] if argv is None else argv
    chosen = parser.parse_args(given[:1]).command
    return importlib.import_module(f"envedit.cli.{chosen}").main(given[1:])


if __name__ == "__main__":
    sys.exit(main())
