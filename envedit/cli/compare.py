"""``envedit compare A B``: how far two maps are apart, as pictures and as light."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from envedit.cli import doctor, map_command

RESULTS = ("compare.json", "difference.png")
"""What the command leaves in its folder."""


def main(argv: list[str] | None = None) -> int:
    """Compare two maps; returns the exit code."""
    parser = map_command.make_parser(
        "compare",
        "Compare map B with map A, the reference: PSNR, SSIM and LPIPS of display values, irradiance in\n"
        "stops, lights side by side. Leaves compare.json and difference.png. B is resampled to A's size.",
        ["envedit compare sky.hdr sky_adjusted.hdr", "envedit compare a.exr b.exr --json --out compared"],
        out="DIR",
        default="A_B_compared",
    )
    parser.add_argument("first", metavar="A", help=f"the reference, {map_command.MAP_HELP}")
    parser.add_argument("second", metavar="B", help="another")
    return map_command.run(parser, argv, _compare)


def _compare(arguments, console):
    from envedit.core import latlong
    from envedit.core.atomic_files import write_atomically
    from envedit.images.images import png
    from envedit.maps import compared
    from envedit.report import output_folder, plain_files, preview

    # ---- The maps and what is measured of them
    doctor.select()
    first = map_command.read(arguments.first, arguments, console)
    second = map_command.read(arguments.second, arguments, console)
    other = second.radiance
    if first.size != second.size:
        other = latlong.resize(other, *first.stored.shape[:2])
        console.warn(f"{arguments.second}: resampled from {second.size[0]} to {first.size[0]} texels across")
    identical = bool(np.array_equal(first.radiance, other))
    lights = compared.lights(first.radiance, other)
    reference = compared.reduced(first.radiance)
    small = compared.reduced(other)
    measured = compared.pictures(reference, small) | {"identical": identical, "lights": lights}
    difference, scale = preview.difference_image(small, reference, "stops")
    measured |= {"first": arguments.first, "second": arguments.second, "difference_stops": scale}

    # ---- The files
    stems = [Path(name).stem for name in (arguments.first, arguments.second)]
    folder = Path(arguments.out or f"{stems[0]}_{stems[1]}_compared")
    about = f"log2 of luminance of {stems[1]} over {stems[0]}; red: brighter; full colour: {scale:g} stops"
    with output_folder.results_in(folder, RESULTS, [arguments.first, arguments.second]):
        write_atomically(folder / "difference.png", png(difference, {"Description": about}))
        plain_files.write_json(folder / "compare.json", measured)
    files = {name: str(folder / name) for name in RESULTS}
    console.facts |= {"folder": str(folder), "files": files, **measured}
    console.say(*_lines(measured))
    console.say(f"difference.png: full colour is {scale:g} stops; results in {folder}")


def _lines(measured):
    """Return what is measured as lines of text."""
    lpips = "LPIPS -" if measured["lpips"] is None else f"LPIPS {measured['lpips']:.4f}"
    score = f"PSNR {measured['psnr']:.2f} dB, SSIM {measured['ssim']:.4f}, {lpips}"
    lines = ["the maps are identical"] if measured["identical"] else [score]
    parts = [f"{axis} {_stops(entry['stops'])}" for axis, entry in measured["irradiance"].items()]
    lines.append(f"irradiance of B over A, stops (+y: horizontal): {', '.join(parts)}")
    before = {light["id"]: light for light in measured["lights"]["before"]}
    for light in measured["lights"]["after"]:
        own = before.pop(light["id"], None)
        if own is None:
            lines.append(f"light {light['id']}: only in B, at {_place(light)}")
        else:
            change = (
                f"moved {light['moved_degrees']:.1f} degrees, flux {_stops(light['stops_of_flux'])} stops"
            )
            lines.append(f"light {light['id']}: {_place(own)} in A, {_place(light)} in B; {change}")
    lines += [f"light {light['id']}: only in A, at {_place(light)}" for light in before.values()]
    return lines


def _place(light):
    return f"azimuth {light['azimuth']:.1f}, elevation {light['elevation']:.1f}"


def _stops(value):
    return "-" if value is None else f"{round(value, 2) + 0.0:+.2f}"  # no minus of what rounds to 0
