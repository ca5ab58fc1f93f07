"""``envedit convert MAP --for PROGRAM``: a map turned as another program expects it."""

from __future__ import annotations

from envedit.cli import map_command
from envedit.cli.streams import steady
from envedit.maps.conventions import QUARTERS, turned_for


@steady
def main(argv: list[str] | None = None) -> int:
    """Write a map for another program; returns the exit code."""
    parser = map_command.make_parser(
        "convert",
        "Turn a map so that it stands in another program as in a Mitsuba scene, each with y up or as its\n"
        "importers turn a scene that has y up. The texels are moved, not resampled.",
        [
            "envedit convert sky.exr --for unreal --out sky_unreal.hdr",
            "envedit convert edited.exr --for blender",
        ],
        default="MAP_PROGRAM",
    )
    parser.add_argument("map", metavar="MAP", help=map_command.MAP_HELP)
    parser.add_argument(
        "--for", dest="program", required=True, choices=sorted(QUARTERS), help="the program to turn it for"
    )
    arguments = parser.parse_args(argv)
    return map_command.run(arguments, lambda console: _convert(arguments, console))


def _convert(arguments, console):
    from envedit.maps import map_file

    program = arguments.program
    path = map_file.output_path(arguments.out, program, [arguments.map], arguments.overwrite)
    input_map = map_command.read(arguments.map, arguments, console)
    for warning in map_file.write(path, turned_for(program, input_map.stored), input_map):
        console.warn(warning)
    console.facts |= {"file": str(path), "turned_degrees": 90 * QUARTERS[program]}
    console.say(f"{path}: {arguments.map} turned by {90 * QUARTERS[program]} degrees for {program}")
