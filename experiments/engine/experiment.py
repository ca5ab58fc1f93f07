"""Measure the engine beside the machine's own floors, Mitsuba's ``prb`` and PyTorch.

``--quick`` measures tiny sizes without data; what must hold of any size is in :mod:`.tables`.
"""

import itertools
import os
import sys

from envedit.core import shipped
from experiments import puresky
from experiments.harness import Experiment, calling, rows_of

from . import tables, timing

SUNNY = "kloofendal_48d_partly_cloudy"
ANALYTIC = {"envmap": "sunsky", "azimuth": 130, "elevation": 45}
"""In its place where there is no data."""
SUNS = {80: 0.62, 45: 0.40, 10: 0.70}
"""Elevation in degrees of the sun of one texel, and its place across the map."""
CURVE = (16, 64, 256)
"""Samples a pixel of T and of prb."""
RANGES = {"pixels": (64, 128, 256, 512), "texels": (128, 256, 512), "spp": (16, 32, 64, 128, 256)}


def options(parser):
    parser.add_argument("--quick", action="store_true", help="check the programs at tiny sizes, without data")
    parser.add_argument("--torch", metavar="PYTHON", help="an interpreter with PyTorch, to compare with")


def data(quick: bool) -> tuple[dict, dict]:
    """Return the real maps by name, and the parameters of the scene ``mesh`` by its name."""
    if quick or "ENVEDIT_DATA" not in os.environ:
        if not quick:
            print("ENVEDIT_DATA is not set: no fits, no scene mesh; an analytic sky", file=sys.stderr)
        return {}, {}
    mesh = puresky.data().absolute() / "meshes" / "bunny_watertight.ply"
    if not mesh.is_file():
        print(f"no file {mesh}: no scene mesh", file=sys.stderr)
    return puresky.find(), {"mesh": {"mesh": str(mesh), "up": "z"}} if mesh.is_file() else {}


def cases(given):
    quick = given.quick
    found = []
    maps, meshes = data(quick)
    sky = {"envmap": str(maps[SUNNY])} if SUNNY in maps else ANALYTIC

    def add(name, function, settings, about=None, **arguments):
        about = {"case": name, "section": name.partition("-")[0], "quick": quick} | (about or {})
        called = {"measuring": function, "quick": quick} | arguments
        found.append(calling(name, timing.measured, settings, about, **called))

    def lit(pixels, texels, spp="auto", scene="sphere"):
        shown = {"file": scene, "width": pixels, "parameters": meshes.get(scene, {})}
        return {"input": sky | {"width": texels}, "scene": shown, "renderer": {"spp": spp}}

    add("floors", "floors:measure", {})
    for preset in ("standard",) if quick else ("paper", "standard", "draft"):
        size = {"hidden": 16, "depth": 2} if quick else {}
        settings = {"preset": preset, "representation": {"kind": "siren"} | size}
        add(f"siren-{preset}", "network:measure", settings, torch=given.torch)
    for scene in ("sphere", *meshes):
        size = (32, 32, 64) if quick else (256, 256)
        about = {"scene": scene, "map": SUNNY if SUNNY in maps else "analytic sun and sky"}
        add(f"transport-{scene}", "transport:measure", lit(*size, scene=scene), about, disk=True)

    size, spp = ((24, 32), 2048) if quick else ((128, 256), 4096)
    scenes = ["sphere"] if quick else [s for s in shipped.scenes() if s != "mesh"] + [*meshes]
    for scene, sun in itertools.product(scenes, [45] if quick else SUNS):
        about = {"scene": scene, "sun": f"{sun} degrees"}
        compared = {"sun": [sun, SUNS[sun]], "reference_spp": spp}
        add(f"quality-{scene}-{sun}", "transport:measure", lit(*size, scene=scene), about, **compared)
    for samples in (16, 64) if quick else CURVE:
        settings = lit(*size, samples, "sphere" if quick else "matte")
        compared = {"sun": [45, SUNS[45]], "reference_spp": spp, "prb_spp": samples}
        add(f"curve-{samples}", "transport:measure", settings, **compared)

    base = {"pixels": 16, "texels": 32, "spp": 16} if quick else {"pixels": 128, "texels": 256, "spp": "auto"}
    ranges = {"pixels": (16, 32), "texels": (16, 32), "spp": (16, 32)} if quick else RANGES
    for variable, values in ranges.items():
        for value in values:
            settings = lit(**base | {variable: value})
            about = {"variable": variable, "scene": "sphere"}
            add(f"scaling-{variable}-{value}", "transport:measure", settings, about)
    tiny = {"fit": {"epochs": 60}, "representation": {"kind": "siren", "hidden": 32}}
    for name, file in {"sunsky": "sunsky"}.items() if quick else maps.items():
        settings = {"representation": {"kind": "siren"}} | (tiny if quick else {})
        settings["input"] = {"envmap": str(file), "width": 32 if quick else 256}
        add(f"fits-{name}", "fits:measure", settings, {"map": name})
    return found


EXPERIMENT = Experiment(
    cases,
    tables.measure,
    tables.COLUMNS,
    group=lambda row: row["table"],
    failures=tables.failures,
    summary=tables.summary,
    options=options,
    draw=lambda done, to: tables.draw(rows_of(EXPERIMENT, done), to),
    alone=True,
)
