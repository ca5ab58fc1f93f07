"""``envedit unclip MAP``: give a map whose sun was clipped its sun back."""

from __future__ import annotations

import numpy as np

from envedit.cli import doctor, map_command
from envedit.cli.map_command import number
from envedit.core.errors import ConfigError

FACTS = ("kind", "reason", "azimuth", "elevation", "radius", "level")
"""Of what is clipped, for ``--json``."""


def main(argv: list[str] | None = None) -> int:
    """Write the map with its sun, if one was clipped; returns the exit code."""
    parser = map_command.make_parser(
        "unclip",
        "Give a map whose sun was clipped its sun back: a disc of the sun's size behind the aureole, with\n"
        "a flux estimated from aureole, sky and elevation. Where nothing is clipped no file is written; of\n"
        "a lamp or cloud neither, but with --flux or --ratio.",
        [
            "envedit unclip sky.hdr",
            "envedit unclip panorama.jpg --out sky.exr --ratio 4",
            "envedit unclip sky.exr --flux 12 --json",
        ],
        default="MAP_unclipped, .exr or .hdr as the map",
    )
    parser.add_argument("map", metavar="MAP", help=map_command.MAP_HELP + "; or a PNG or JPEG")
    override = parser.add_mutually_exclusive_group()
    override.add_argument(
        "--flux",
        type=number(0, 1e30),
        nargs="+",
        metavar="E",
        help="the sun's irradiance on a surface that faces it, in the map's units: luminance, or R G B",
    )
    override.add_argument(
        "--ratio", type=number(1e-6, 1e6), help="the sun's horizontal irradiance over the sky's, luminance"
    )
    return map_command.run(parser, argv, _unclip)


def _unclip(arguments, console):
    from envedit.maps import map_file
    from envedit.representations.layers import clipped_light, unclip

    if arguments.flux is not None and (len(arguments.flux) not in (1, 3) or not any(arguments.flux)):
        raise ConfigError(f"--flux: got {arguments.flux}, expected 1 or 3 numbers above 0")
    path = map_file.output_path(arguments.out, "unclipped", [arguments.map], arguments.overwrite)
    doctor.select()
    input_map = map_command.read(arguments.map, arguments, console)
    radiance = input_map.radiance
    light = clipped_light.find(radiance)
    console.facts |= {"light": None, "added": False, "file": None}
    if light is None:
        console.say("nothing is clipped above the horizon: no sun was added")
        return

    # ---- What is clipped, and what flux it gets
    place = f"azimuth {light.azimuth:.1f}, elevation {light.elevation:.1f} degrees"
    console.facts["light"] = {name: getattr(light, name) for name in FACTS}
    console.say(f"clipped at {light.level:.4g}, {place}: {light.kind}, as {light.reason}")
    flux, stops = _flux(arguments, light)
    forced = stops == 0
    if not forced and light.kind != "sun":
        console.say("no sun was added; --flux or --ratio put one there")
        return
    if not forced and not unclip.is_clipped(light, flux):
        console.say("the sun has the flux that is expected: none was added")
        return

    # ---- The map with it
    edited = unclip.restored(radiance, light, flux)
    map_command.write(path, input_map.as_stored(edited), input_map, console)
    horizontal = float(unclip.luminance(flux)) * max(float(light.direction[1]), 0)
    sky = float(unclip.luminance(light.sky_irradiance))
    ratio = horizontal / max(sky, 1e-300)
    console.facts |= {"added": True, "file": str(path), "flux": flux.tolist(), "stops": stops, "ratio": ratio}
    spread = f" (standard deviation {stops:.1f} stops)" if stops else ""
    if stops and unclip.doubt(light):
        console.warn(f"{arguments.map}: {unclip.doubt(light)}")
    values = " ".join(f"{value:.4g}" for value in flux)
    console.say(f"sun of flux {values}{spread}, horizontally {ratio:.2g} times the sky; {path}")


def _flux(arguments, light):
    """Return the flux (3,) as asked or estimated, and its standard deviation in stops, 0 as asked."""
    from envedit.representations.layers import unclip

    if arguments.flux is not None and len(arguments.flux) == 3:
        return np.array(arguments.flux, np.float64), 0.0
    if arguments.flux is not None:
        return unclip.coloured(light, arguments.flux[0]), 0.0
    if arguments.ratio is not None:
        return unclip.coloured(light, unclip.flux_of_ratio(light, arguments.ratio)), 0.0
    estimate = unclip.estimate(light)
    return estimate.flux, estimate.stops
