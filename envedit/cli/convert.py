"""``envedit convert FILE.usd SCENE.xml``: write a USD file as a Mitsuba scene."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from envedit.cli.console import Console
from envedit.cli.streams import steady


@steady
def main(argv: list[str] | None = None) -> int:
    """Convert a file; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="envedit convert",
        description="Write a USD file as a Mitsuba scene, with its meshes in a folder NAME_files beside it.\n"
        "`envedit run` and `envedit paint` read USD files themselves. Needs the extra usd.",
        epilog="examples:\n  envedit convert shot.usd scene.xml\n"
        "  envedit convert shot.usdz scene.xml --camera /World/Camera --time 24",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", help="a .usd, .usda, .usdc or .usdz file")
    parser.add_argument("scene", metavar="SCENE", help="the Mitsuba XML file to write; it may not exist")
    parser.add_argument("--camera", metavar="PATH", default="", help="which camera (default: the only one)")
    parser.add_argument(
        "--time", metavar="CODE", type=float, help="time code (default: the first of the stage)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")
    arguments = parser.parse_args(argv)
    console = Console(one_object=arguments.json)
    code = _convert(arguments, console)
    console.close(code)
    return code


def _convert(arguments, console):
    from envedit.core.errors import ConfigError, EnveditError
    from envedit.scene.usd import conversion

    try:
        if not conversion.is_usd(arguments.file):
            raise ConfigError(f"FILE: got {arguments.file}, expected a .usd, .usda, .usdc or .usdz file")
        if not arguments.scene.lower().endswith(".xml"):
            raise ConfigError(f"SCENE: got {arguments.scene}, expected a name that ends in .xml")
        converted = conversion.convert(
            arguments.file, Path(arguments.scene).absolute(), arguments.camera, arguments.time
        )
    except EnveditError as error:
        console.error(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        console.error("interrupted; nothing was written")
        return 130
    for note in converted.notes:
        console.warn(note)
    console.facts["files"] = {converted.xml.name: str(converted.xml)}
    console.say(f"{arguments.scene}: written; now, for example: envedit paint {arguments.scene}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
