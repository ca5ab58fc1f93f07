"""``envedit lights MAP``: the lights of a map as a list, and the map as sky and lights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from envedit.cli import map_command
from envedit.core.errors import counted

RESULTS = ("lights.json", "sky.exr", "lights.exr")
"""What the command leaves in its folder."""


def main(argv: list[str] | None = None) -> int:
    """Write the lights of a map; returns the exit code."""
    parser = map_command.make_parser(
        "lights",
        "List the lights of a map: direction, solid angle, flux, irradiance, stops over the sky.\n"
        "Leaves lights.json, sky.exr (the map without its lights) and lights.exr (its lights alone),\n"
        "whose sum in float32 is the map, bit for bit.",
        ["envedit lights sky.hdr", "envedit lights sky.exr --out lamps --json"],
        out="DIR",
        default="MAP_lights",
    )
    parser.add_argument("map", metavar="MAP", help=map_command.MAP_HELP)
    return map_command.run(parser, argv, _lights)


def _lights(arguments, console):
    from envedit.images import images
    from envedit.maps import map_lights
    from envedit.report import output_folder, plain_files
    from envedit.representations.layers import file_lights

    # ---- The lights, in Rec. 709 and in the colours of the file
    input_map = map_command.read(arguments.map, arguments, console)
    shape = input_map.stored.shape[:2]
    separated = file_lights.lights_of(input_map.radiance)
    listed = map_lights.listed(separated, shape, file_lights.without(input_map.radiance, separated))
    texels = [input_map.stored.reshape(-1, 3)[light.texels][None] for light in separated]
    cores = [
        replace(input_map, stored=stored).as_stored(light.radiance[None].astype(np.float32))[0]
        for stored, light in zip(texels, separated, strict=True)
    ]
    sky, alone = map_lights.split(input_map.stored, cores, separated)

    # ---- The files
    folder = Path(arguments.out or f"{Path(arguments.map).stem}_lights")
    numbered = [{"id": i + 1, **light} for i, light in enumerate(listed)]
    up = np.array([[0.0, 1.0, 0.0]])
    about = {"map": arguments.map, "width": shape[1], "height": shape[0], "lights": numbered}
    about["sky_irradiance"] = map_lights.irradiance(replace(input_map, stored=sky).radiance, up)[0].tolist()
    with output_folder.results_in(folder, RESULTS, [arguments.map]):
        marks = {"source": arguments.map}
        images.write_exr(folder / "sky.exr", sky, marks, chromaticities=input_map.chromaticities)
        images.write_exr(folder / "lights.exr", alone, marks, chromaticities=input_map.chromaticities)
        plain_files.write_json(folder / "lights.json", about)
    files = {name: str(folder / name) for name in RESULTS}
    console.facts |= {"folder": str(folder), "files": files, **about}
    console.say(*_table(numbered))
    console.say(f"{counted(len(numbered), 'light', 'lights')}; results in {folder}")


def _table(lights):
    """Return the lines of the list, a light each."""
    lines = [
        "light  azimuth  elevation  solid angle, sr  flux (R, G, B)                     stops over the sky"
    ]
    for light in lights:
        flux = ", ".join(f"{value:.4g}" for value in light["flux"])
        stops = "-" if light["stops"] is None else f"{light['stops']:+.2f}"
        place = f"{light['azimuth']:7.1f}  {light['elevation']:9.1f}  {light['solid_angle']:15.3g}"
        lines.append(f"{light['id']:5d}  {place}  {flux:<33}  {stops}")
    return lines if lights else []
