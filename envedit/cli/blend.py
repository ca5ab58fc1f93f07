"""``envedit blend A B``: a map between two maps, with one sun and not two halves."""

from __future__ import annotations

from envedit.cli import doctor, map_command
from envedit.core.errors import counted


def main(argv: list[str] | None = None) -> int:
    """Blend two maps; returns the exit code."""
    parser = map_command.make_parser(
        "blend",
        "Blend two maps: lights move on great circles and change flux, skies blend in log radiance.\n"
        "The result has the size, format and colour space of the first map; the second is resampled to it.",
        [
            "envedit blend noon.hdr dusk.hdr --amount 0.5",
            "envedit blend a.exr b.exr --amount 0.25 --out c.exr",
        ],
        default="A_blended.exr or .hdr, as the first map",
    )
    parser.add_argument("first", metavar="A", help=map_command.MAP_HELP)
    parser.add_argument("second", metavar="B", help="another")
    parser.add_argument(
        "--amount",
        type=map_command.number(0, 1),
        required=True,
        metavar="T",
        help="0: the first map; 1: the second",
    )
    return map_command.run(parser, argv, _blend)


def _blend(arguments, console):
    from envedit.core import latlong
    from envedit.maps import map_file
    from envedit.maps.blended import blend

    sources = [arguments.first, arguments.second]
    path = map_file.output_path(arguments.out, "blended", sources, arguments.overwrite)
    doctor.select()
    first = map_command.read(arguments.first, arguments, console)
    second = map_command.read(arguments.second, arguments, console)
    alike = first.chromaticities == second.chromaticities and first.size == second.size
    if first.size != second.size and arguments.amount != 0:
        console.warn(f"{arguments.second}: resampled from {second.size[0]} to {first.size[0]} texels across")
    lights: list[dict] = []
    if arguments.amount == 0:
        values = first.stored
    elif arguments.amount == 1 and alike:
        values = second.stored
    else:
        other = map_file.radiance_of(second)
        del second  # 0.4 GB of a map of 8192 x 4096 texels, where it is in another colour space
        if other.shape != first.stored.shape:
            other = latlong.resize(other, *first.stored.shape[:2])
        radiance, lights = blend(map_file.radiance_of(first), other, arguments.amount)
        values = map_file.as_stored(radiance, first)
    map_command.write(path, values, first, console)
    console.facts |= {"files": {"map": str(path)}, "amount": arguments.amount, "lights": lights}
    console.say(f"{counted(len(lights), 'light', 'lights')}; {path}" if lights else str(path))
