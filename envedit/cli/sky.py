"""``envedit sky``: an analytic sky as a file, of a sun's position or of a place and a time."""

from __future__ import annotations

from envedit.cli import doctor, map_command
from envedit.cli.map_command import number
from envedit.core.errors import ConfigError

MIDDLE = 180.0
"""Azimuth of the middle of a map."""


def main(argv: list[str] | None = None) -> int:
    """Write an analytic sky; returns the exit code."""
    parser = map_command.make_parser(
        "sky",
        "Write an analytic sky (Hosek and Wilkie 2012, 2013), a sun of 0.54 degrees included.\n"
        "North is at the left edge of the map, east at a quarter of it, south in the middle.",
        [
            "envedit sky --elevation 30 --turbidity 4",
            "envedit sky --place 47.37 8.54 --date 2026-06-21T13:30+02:00 --out noon.exr --width 4096",
        ],
        default="sky.exr",
        repair=False,
    )
    parser.add_argument("--elevation", type=number(0, 90), metavar="DEGREES", help="of the sun")
    parser.add_argument(
        "--azimuth",
        type=number(-360, 360),
        metavar="DEGREES",
        help="of the sun, from north by east (default: 180, the middle of the map)",
    )
    parser.add_argument(
        "--place", type=float, nargs=2, metavar=("LATITUDE", "LONGITUDE"), help="degrees, north and east"
    )
    parser.add_argument("--date", metavar="TIME", help="ISO 8601 with an offset from UTC; with --place")
    parser.add_argument(
        "--turbidity", type=number(1, 10), metavar="T", default=3.0, help="haze: 1 clear to 10 (default: 3)"
    )
    parser.add_argument(
        "--width", type=int, metavar="TEXELS", default=2048, help="even, 6 to 16384 (default: 2048)"
    )
    return map_command.run(parser, argv, _sky)


def _sky(arguments, console):
    from envedit import api
    from envedit.config.validators import MOST_DIM, Integer, named
    from envedit.maps import map_file

    width = named("--width", Integer(6, MOST_DIM, even=True), arguments.width)
    azimuth, elevation = _sun(arguments)
    path = map_file.output_path(arguments.out, "sky", [], arguments.overwrite)
    doctor.select()
    sky = api.sunsky(width, azimuth, elevation, arguments.turbidity)
    map_file.write(path, sky)
    console.facts |= {"files": {"map": str(path)}, "azimuth": azimuth, "elevation": elevation}
    console.say(f"sun at azimuth {azimuth:.2f}, elevation {elevation:.2f} degrees; {path}")


def _sun(arguments):
    """Return azimuth and elevation of the sun that is asked for, degrees."""
    from envedit.maps import sun_position

    by_angle = arguments.elevation is not None or arguments.azimuth is not None
    by_time = arguments.place is not None or arguments.date is not None
    if by_angle == by_time or (by_angle and arguments.elevation is None):
        raise ConfigError("which sun? give --elevation (and --azimuth), or --place and --date")
    if by_angle:
        return MIDDLE if arguments.azimuth is None else arguments.azimuth % 360, arguments.elevation
    if arguments.place is None or arguments.date is None:
        raise ConfigError("--place and --date are needed together: where, and when")
    latitude, longitude = arguments.place
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise ConfigError(
            f"--place: got {latitude:g} {longitude:g}, expected a latitude from -90 to 90 and a longitude "
            "from -360 to 360, degrees"
        )
    moment = sun_position.moment(arguments.date)
    azimuth, elevation = sun_position.sun_position(latitude, longitude, moment)
    if elevation < 0:
        raise ConfigError(
            f"the sun is {-elevation:.1f} degrees below the horizon there and then: "
            "the analytic sky has no night"
        )
    return azimuth, elevation
