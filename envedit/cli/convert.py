"""``envedit convert FILE.usd SCENE.xml``: write a USD file as a Mitsuba scene."""

from __future__ import annotations

from pathlib import Path

from envedit.cli import console, map_command


def main(argv: list[str] | None = None) -> int:
    """Convert a file; returns the exit code."""
    parser = console.make_parser(
        "convert",
        "Write a USD file as a Mitsuba scene, with its meshes in a folder NAME_files beside it.\n"
        "`envedit run` and `envedit paint` read USD files themselves. Needs the extra usd.",
        [
            "envedit convert shot.usd scene.xml",
            "envedit convert shot.usdz scene.xml --camera /World/Camera --time 24",
        ],
    )
    parser.add_argument("file", metavar="FILE", help="a .usd, .usda, .usdc or .usdz file")
    parser.add_argument("scene", metavar="SCENE", help="the Mitsuba XML file to write; it may not exist")
    parser.add_argument("--camera", metavar="PATH", default="", help="which camera (default: the only one)")
    parser.add_argument(
        "--time", metavar="CODE", type=float, help="time code (default: the first of the stage)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")
    return map_command.run(parser, argv, _convert)


def _convert(arguments, output):
    from envedit.core.errors import ConfigError
    from envedit.scene.usd import conversion

    if not conversion.is_usd(arguments.file):
        raise ConfigError(f"FILE: got {arguments.file}, expected a .usd, .usda, .usdc or .usdz file")
    if not arguments.scene.lower().endswith(".xml"):
        raise ConfigError(f"SCENE: got {arguments.scene}, expected a name that ends in .xml")
    converted = conversion.convert(
        arguments.file, Path(arguments.scene).absolute(), arguments.camera, arguments.time
    )
    output.warn(*converted.notes)
    output.facts["files"] = {converted.xml.name: str(converted.xml)}
    output.say(f"{arguments.scene}: written; now, for example: envedit paint {arguments.scene}")
