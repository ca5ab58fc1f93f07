"""Edit towards the same light given as a map, a linear picture, and an 8-bit picture of plain Mitsuba."""

import itertools
from dataclasses import replace

import mitsuba as mi

import envedit
from envedit import config, inputs
from envedit.images import images
from experiments import puresky
from experiments.harness import Done, Experiment, calling
from experiments.measures import psnr
from experiments.natural.experiment import place
from experiments.plain_mitsuba import loaded, relit
from experiments.summary import Summary

SCENES = ("sphere", "statue", "matpreview")
TURNS = {
    "kloofendal_48d_partly_cloudy": 60,
    "mud_road": 140,
    "rustig_koppie": 220,
    "industrial_sunset": 300,
}
"""Maps, and how far they are turned, degrees."""
PAIRS = (
    ("kloofendal_48d_partly_cloudy", "sunflowers"),
    ("mud_road", "kloofendal_48d_partly_cloudy"),
    ("sunflowers", "overcast_soil"),
    ("industrial_sunset", "wasteland_clouds"),
    ("rustig_koppie", "aristea_wreck"),
    ("syferfontein_18d_clear", "evening_road_01"),
    ("evening_road_01", "rustig_koppie"),
    ("overcast_soil", "syferfontein_18d_clear"),
)
"""Map and target."""
WIDTH, MAP_WIDTH = 128, 256
PNG_SPP, PNG_SEED = 512, 4711
"""Samples a pixel, and seed, of the PNG."""
WAYS = {"by_map": "map", "by_picture": "linear picture", "by_png": "PNG"}
"""How the target is given, by the name of its files."""


def cases(given):
    maps = puresky.find()
    targets = [(name, f"turned by {turn}", {"rotate_degrees": float(turn)}) for name, turn in TURNS.items()]
    targets += [(name, other, {"file": str(maps[other])}) for name, other in PAIRS if other in maps]
    found = []
    for scene, (name, label, target) in itertools.product(SCENES, targets):
        if name not in maps:
            continue
        tables = {
            "input": {"envmap": str(maps[name]), "width": MAP_WIDTH},
            "scene": puresky.scene(scene) | {"width": WIDTH},
            "target": target,
        }
        kind = "turned" if "rotate_degrees" in target else "another map"
        about = {"scene": scene, "map": name, "target": label, "kind": kind}
        title = f"{scene}-{name}-{label}".replace(" ", "_")
        found.append(calling(title, three_ways, tables, about))
    return found


def three_ways(settings, folder) -> dict:
    """Edit towards a map, its picture, and a PNG of it; returns PSNR of maps and renderings, by way."""
    # ---- The map, and the pictures that it makes
    results = {"by_map": envedit.edit(settings)}
    original, true = (results["by_map"].maps[name] for name in ("initial", "target"))
    picture = folder / "picture.exr"
    images.write_exr(picture, results["by_map"].renders["target"])
    png = folder / "picture.png"
    write_png(settings, folder, true, png)

    # ---- The pictures as targets
    for way, file in (("by_picture", picture), ("by_png", png)):
        target = config.Target(file=str(file))
        results[way] = envedit.edit(replace(settings, target=target))

    # ---- Measures, on display values of the maps
    for name, shown in (("original", original), ("true", true)):
        images.write_exr(folder / f"{name}.exr", shown)
    found = {"unedited": psnr(original, true)}
    for way, result in results.items():
        images.write_exr(folder / f"{way}.exr", result.maps["edited"])
        images.write_exr(folder / f"render_{way}.exr", result.renders["edited"])
        found[way] = {
            "psnr": psnr(result.maps["edited"], true),
            "render": result.metrics["render"]["psnr"],
            "turn": result.metrics["turn_degrees"],
            "seconds": result.metrics["timing"]["total_s"],
            "target": next((n for n in result.notes if n.startswith("a picture of the scene")), ""),
        }
    return found


def write_png(settings, folder, true, file) -> None:
    """Render the scene of plain Mitsuba under a map, as 8 bits of sRGB.

    The map is in the units of the radiance that reaches the scene.
    """
    file_of_scene = relit(settings.scene, true, folder / "true.xml")
    scene, _ = loaded(file_of_scene, inputs.load_scene(settings.scene))
    rendering = mi.Bitmap(mi.render(scene, spp=PNG_SPP, seed=PNG_SEED))
    shown = rendering.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    shown.write(str(file))


def measure(done: Done) -> dict:
    """Return the numbers of a case, with how much better each way is than the map, and than no edit."""
    found = dict(done.metrics)
    for way in WAYS:
        psnr_of_way = found[way]["psnr"]
        over, gain = psnr_of_way - found["by_map"]["psnr"], psnr_of_way - found["unedited"]
        found[way] = found[way] | {"over": over, "gain": gain}
    return found


def summary(rows) -> str:
    """Return means of maps, differences to the target as map, and how many are worse than unedited."""
    return STATISTICS([row[way] | {"target": name} for way, name in WAYS.items() for row in rows])


STATISTICS = Summary(
    {"target": "{target}"},
    {
        "runs": "{runs}",
        "map, dB": "{psnr.mean:.1f}",
        "over the map as target": "{over.mean:.1f}",
        "least": "{over.min:.1f}",
        "rendering, dB": "{render.mean:.1f}",
        "worse than unedited": "{gain.below[0]}",
    },
)


def panels(done: Done):
    """Return original and true map, the edited ones, and the renderings."""
    return done.shown("original", "true", *WAYS, *(f"render_{way}" for way in WAYS))


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "scene": "{scene}",
        "map": "{map}",
        "target": "{target}",
        "unedited, dB": "{unedited:.1f}",
        **{f"by {name}, dB": f"{{{way}[psnr]:.1f}}" for way, name in WAYS.items()},
        "picture over map": "{by_picture[over]:+.1f}",
        "PNG over map": "{by_png[over]:+.1f}",
        "turns, degrees": ", ".join(f"{{{way}[turn]:.1f}}" for way in WAYS),
    },
    summary=summary,
    panels=panels,
    sheet=lambda case: f"{case.about['scene']}.jpg",
    place=lambda case: place(case, ("kind", "scene")),
)
