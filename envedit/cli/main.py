"""The command ``envedit``: its commands, and how they are called."""

from __future__ import annotations

import argparse
import importlib
import sys

from envedit.cli.streams import steady

COMMANDS = {
    "run": "carry out the edit that a configuration describes",
    "paint": "paint on the rendering in the browser, while the map follows",
    "convert": "write a USD file as a Mitsuba scene",
    "fit": "fit a SIREN to a map, without an edit",
    "lights": "list the lights of a map; write its sky and its lights apart",
    "adjust": "exposure, colour, rotation, blur of a map; a second map as backplate",
    "blend": "a map between two maps: lights move, skies blend",
    "sky": "an analytic sky as a file, of a sun's position or of a place and a time",
    "unclip": "give a map whose sun was clipped its sun back",
    "compare": "how far two maps are apart, as pictures and as light",
    "apply": "give maps the light of an edit: its look",
    "init": "write a commented configuration to start from",
    "sweep": "carry out many configurations, on this machine or a cluster",
    "doctor": "check whether this machine can run envedit",
    "schema": "print every key of the configuration, as JSON Schema or as a page",
    "cache": "show or delete what is kept on disk between runs",
    "weights": "fetch the trained networks of LPIPS and DISTS",
}


@steady()
def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    parser = _parser()
    if not arguments:
        parser.print_help(sys.stderr)
        return 2
    command = parser.parse_args(arguments[:1]).command
    if command not in COMMANDS:
        from envedit.config.validators import meant

        hint = meant(command, COMMANDS, "see envedit --help")
        parser.error(f"got command {command!r}, expected one of {', '.join(COMMANDS)}; {hint}")
    try:
        return importlib.import_module(f"envedit.cli.{command}").main(arguments[1:])
    except KeyboardInterrupt:
        print("envedit: interrupted", file=sys.stderr)
        return 130


def _parser():
    from envedit import __version__
    from envedit.core import shipped

    commands = "\n".join(f"  {name:<8}{about}" for name, about in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="envedit",
        usage="envedit COMMAND ... | --help | --version",
        description="Edit HDR environment maps by inverse rendering.",
        epilog=f"commands:\n{commands}\n\n"
        "examples:\n  envedit run quickstart\n"
        "  envedit init sphere --envmap sky.hdr && envedit run edit.toml\n\n"
        f"shipped configurations: {', '.join(shipped.configurations())}\n"
        f"shipped scenes: {', '.join(shipped.scenes())}\n\n"
        "envedit COMMAND --help lists the options of a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"envedit {__version__}")
    parser.add_argument("command", metavar="COMMAND", help=argparse.SUPPRESS)
    return parser
