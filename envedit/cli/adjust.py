"""``envedit adjust MAP``: exposure, colour, rotation, lights and blur of a map, and a second map."""

from __future__ import annotations

import os

from envedit.cli import doctor, map_command
from envedit.cli.map_command import number
from envedit.core.errors import ConfigError
from envedit.maps.conventions import QUARTERS, turned_for

OPTIONS = {
    "turn": (number(-360, 360), "DEGREES", "turn about the vertical; positive moves the picture to the left"),
    "tilt": (number(-180, 180), "DEGREES", "rotate clockwise about the middle of the map"),
    "horizon": (number(-90, 90), "DEGREES", "raise the middle of the map, and lower its back"),
    "exposure": (number(-100, 100), "STOPS", "brighten by stops"),
    "white-balance": (number(1667, 25000), "KELVIN", "make light of this temperature neutral"),
    "saturation": (number(0, 10), "FACTOR", "0: grey; 1: as it is"),
    "soften": (number(0, 90), "DEGREES", "spread each light over a disc of this radius, with its flux"),
    "max-radiance": (number(1e-30, 1e30), "VALUE", "spread lights until no texel is brighter"),
    "blur": (number(0, 180), "DEGREES", "blur all of the map, standard deviation"),
}
"""Type, unit and help of each adjustment, in the order in which they are made; colours before lights."""


def main(argv: list[str] | None = None) -> int:
    """Adjust a map; returns the exit code."""
    parser = map_command.make_parser(
        "adjust",
        "Adjust a map. Rotations are resampled once and keep the flux of lights.",
        [
            "envedit adjust sky.hdr --exposure 1 --white-balance 5500",
            "envedit adjust sky.hdr --horizon 2 --tilt -1.5 --turn 90",
            "envedit adjust sky.hdr --max-radiance 200 --background plate.hdr --background-blur 3",
            "envedit adjust edited.exr --for unreal --out edited_unreal.hdr",
        ],
        default="MAP_adjusted.exr or .hdr, as the map",
    )
    parser.add_argument("map", metavar="MAP", help=map_command.MAP_HELP)
    for name, (kind, unit, text) in OPTIONS.items():
        parser.add_argument(f"--{name}", type=kind, metavar=unit, help=text)
    parser.add_argument(
        "--for",
        dest="program",
        choices=sorted(QUARTERS),
        help="at last turn the map so that it stands in another program as in a Mitsuba scene",
    )
    parser.add_argument("--background", metavar="OUT", help="write a second map, to be seen and not to light")
    parser.add_argument(
        "--background-blur", type=number(0, 180), metavar="DEGREES", default=0.0, help="blur of that map"
    )
    parser.add_argument(
        "--background-exposure",
        type=number(-100, 100),
        metavar="STOPS",
        default=0.0,
        help="exposure of that map",
    )
    return map_command.run(parser, argv, _adjust)


def _adjust(arguments, console):
    from envedit.maps import map_file
    from envedit.maps.adjusted import Adjustments, adjusted

    # ---- What is asked
    values = {name: getattr(arguments, name) for name in (key.replace("-", "_") for key in OPTIONS)}
    how = Adjustments(**{name: value for name, value in values.items() if value is not None})
    second = Adjustments(exposure=arguments.background_exposure, blur=arguments.background_blur)
    if how == Adjustments() and not arguments.background and not arguments.program:
        names = ", ".join(f"--{name}" for name in (*OPTIONS, "for"))
        raise ConfigError(f"nothing to adjust: give one of {names}")
    if second != Adjustments() and not arguments.background:
        raise ConfigError("--background-blur and --background-exposure need --background OUT")

    # ---- Where it goes
    path = map_file.output_path(arguments.out, "adjusted", [arguments.map], arguments.overwrite)
    files = {"map": path}
    if arguments.background:
        files["background"] = map_file.output_path(
            arguments.background, "background", [arguments.map], arguments.overwrite
        )
        if os.path.realpath(files["background"]) == os.path.realpath(path):
            raise ConfigError(f"--background: got {path}, where the map itself goes: give another name")

    # ---- The maps
    doctor.select()
    input_map = map_command.read(arguments.map, arguments, console)
    radiance, notes = adjusted(map_file.radiance_of(input_map), how)
    width = radiance.shape[1]
    if arguments.program and QUARTERS[arguments.program] * width % 4:
        notes.append(
            f"interpolated between columns for {arguments.program}: 4 does not divide the width, {width}"
        )
    console.say(*notes)
    for name, file in files.items():
        if name == "background":
            radiance, done = adjusted(radiance, second)
            notes += [f"background: {line}" for line in done]
        stored = map_file.as_stored(radiance, input_map)
        if arguments.program:
            stored = turned_for(arguments.program, stored)
        map_command.write(file, stored, input_map, console)
        console.say(str(file))
    console.facts |= {"files": {name: str(file) for name, file in files.items()}, "notes": notes}
