"""Edit towards photographs of unknown cameras, and towards the same pictures given linear."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

import envedit
from envedit import config
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.images import images
from envedit.targets.photo import Camera
from experiments import puresky
from experiments.harness import Done, Experiment, calling
from experiments.light_estimation import protocol
from experiments.measures import brightest, irradiance_error, peak_error
from experiments.photograph.adam import edited_by_adam
from experiments.photograph.cameras import CAMERAS, Model, photograph
from experiments.photograph.insertion import Plate
from experiments.summary import Summary

SCENES = ("sphere", "statue", "pair")
FARTHER = 5
"""The target's map is so many names farther on in the alphabet."""
SUN_DEGREES = 5.0
"""Around the brightest texel: what comes from there is the sun's."""
SUNLIT = 0.5
"""Share of the ground's irradiance that is the sun's, from which on a shadow or a highlight shows it: 0.69 to
0.92 in five of the thirteen maps, at most 0.09 in the others."""
WORSE = "sun", "irradiance", "insertion RMSE"
"""Measures that are compared with the unedited map's: exposure and white balance leave them."""
PREVIEW_SPP = 64
SEED = 260_000
"""Of the photographs; that of a case adds its number."""


@dataclass(frozen=True)
class Way:
    """How the light of the other map is given."""

    label: str  # in the tables
    camera: Model | None  # None: by the rendering itself
    every: int = 0  # one in so many pairs of map and scene is of the part; 0: a pair takes one camera in turn


WAYS = {
    "linear": Way("linear", None, every=6),
    **{
        str(k): Way(f"{model.curve}, {model.stops:+g} stops, {model.kelvin:g} K", model)
        for k, model in enumerate(CAMERAS)
    },
    "known": Way("filmic, +1 stops, 5500 K, both given", CAMERAS[2], every=9),
    "adam": Way("Adam on path, sRGB", CAMERAS[0], every=9),
}
"""By name. "known": exposure and white balance are given; "adam": Mitsuba's path tracer and Adam."""


def options(parser):
    parser.add_argument("--maps", nargs="+", metavar="NAME", help="only these maps are edited")
    parser.add_argument(
        "--part", action="store_true", help="one camera a map and scene in turn, a few of the other ways"
    )


def cases(given):
    maps = puresky.find()
    names = sorted(maps)
    made = []
    for i, name in enumerate(names):
        other = names[(i + FARTHER) % len(names)]
        for k, (scene, way) in enumerate(itertools.product(SCENES, WAYS)):
            if given.maps and name not in given.maps:
                continue
            if given.part and not _in_part(i, SCENES.index(scene), way):
                continue
            tables = {
                "preset": "draft",
                "input": {"envmap": str(maps[name])},
                "scene": {"file": scene},
                "output": {"spp": PREVIEW_SPP},
            }
            about = {"scene": scene, "map": name, "other": other, "way": way}
            title = f"{scene}-{name}-{other}-{way}"
            seed = SEED + 100 * i + k
            made.append(calling(title, edited, tables, about, other=str(maps[other]), way=way, seed=seed))
    return sorted(made, key=lambda case: WAYS[case.about["way"]].every > 0)


def _in_part(i, j, way):
    """Say whether a way of the i-th map and j-th scene belongs to the part: each pair takes one camera."""
    if every := WAYS[way].every:
        return (i + j) % every == 0
    return int(way) == (len(SCENES) * i + j) % len(CAMERAS)


def edited(settings, folder, other, way, seed) -> dict:
    """Edit towards a picture of the other map's light; returns what is measured."""
    # ---- The picture
    true, _ = images.load_envmap(other, settings.input.width, False)
    unedited, _ = images.load_envmap(settings.input.envmap, settings.input.width, False)
    camera = Camera("srgb")
    summary = ""
    curve = "srgb"
    model = WAYS[way].camera
    if model is None:
        file = folder / "picture.exr"
        scene = envedit.load_scene(settings.scene.file, width=settings.scene.width)
        images.write_exr(file, scene.render(true, 256, seed), panorama=False)
        target = config.Target(kind="rendering", file=str(file))
    else:
        file = folder / "photograph.jpg"
        camera = photograph(model, settings.scene, true, seed, file)
        target = config.Target(kind="photo", file=str(file))
        if way == "known":
            target = replace(target, exposure=camera.stops, white_balance=model.kelvin)

    # ---- The edit
    if way == "adam":
        found, seconds = edited_by_adam(settings, unedited, file)
        psnr = None
    else:
        result = envedit.edit(replace(settings, target=target))
        found = result.envmap
        seconds = result.metrics["timing"]["total_s"]
        psnr = result.metrics["render"]["psnr"]
        images.write_exr(folder / "render.exr", result.render)
        if result.photo:
            summary = result.photo.summary
            curve = result.photo.camera.curve
    images.write_exr(folder / "edited.exr", found)
    images.write_exr(folder / "true.exr", true)

    # ---- Measures
    plate = Plate(settings.scene, true, camera, folder)
    about = {"psnr": psnr, "seconds": seconds, "found": summary, "curve": camera.curve}
    return {
        "edited": about | measured(found, true) | plate.inserted(found, curve),
        "unedited": measured(unedited, true) | plate.inserted(unedited, curve),
        "sunlit": sunlit(true),
    }


def sunlit(envmap) -> float:
    """Return the share of the ground's irradiance that comes from within :data:`SUN_DEGREES` of the sun."""
    towards = latlong.directions(*envmap.shape[:2])
    light = luminance(np.float64(envmap)) * latlong.lookup_solid_angles(*envmap.shape[:2])[:, None]
    sun = brightest(envmap)
    on_ground = light * np.maximum(towards[..., 1], 0)
    return float(on_ground[towards @ sun > np.cos(np.radians(SUN_DEGREES))].sum() / on_ground.sum())


def measured(envmap, true) -> dict:
    """Compare a map with the true one: the sun, irradiance, and the three spheres."""
    stops = irradiance_error(envmap, true)
    found = {
        "sun": peak_error(envmap, true),
        "brightness": float(stops.mean()),
        "irradiance": float(np.abs(stops - stops.mean()).mean()),
    }
    expected = protocol.pictures(true)
    for name, picture in protocol.pictures(envmap).items():
        errors = protocol.compared(picture, expected[name])
        found[f"{name} si-RMSE"] = errors["si_rmse"]
        found[f"{name} angle"] = errors["angle"]
    return found


def measure(done: Done) -> list[dict]:
    way = WAYS[done.case.about["way"]]
    edited, unedited = done.metrics["edited"], done.metrics["unedited"]
    sun = edited["sun"] if done.metrics["sunlit"] > SUNLIT else None
    worse = [name for name in WORSE if edited[name] > unedited[name]]
    rows = [{"kind": way.label, "shown sun": sun, "worse": ", ".join(worse), **edited}]
    if not way.every:
        sun = unedited["sun"] if sun is not None else None
        rows.append({"kind": "unedited", "shown sun": sun, "worse": "", "found": "", **unedited})
        rows.append(rows[0] | {"kind": "all cameras"})
    return rows


SUMMARY = Summary(
    {"": "{kind}"},
    {
        "runs": "{runs}",
        "sun, degrees: mean (median)": "{sun.mean:.1f} ({sun.median:.1f})",
        "shown sun within 3 degrees": "{shown sun.below[3]} of {shown sun.count}",
        "brightness, stops": "{brightness.mean:+.2f}",
        "irradiance, stops": "{irradiance.mean:.2f}",
        **{
            f"{name}: si-RMSE, angle": f"{{{name} si-RMSE.mean:.3f}}, {{{name} angle.mean:.1f}}"
            for name in protocol.SPHERES
        },
        "insertion: RMSE, SSIM": "{insertion RMSE.mean:.4f}, {insertion SSIM.mean:.4f}",
        "seconds": "{seconds.mean:.0f}",
    },
)


def panels(done: Done):
    """Return the rendering where there is one, edited and true map."""
    names = ("render", "edited", "true")
    return done.shown(*(name for name in names if (done.folder / f"{name}.exr").exists()))


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "scene": "{scene}",
        "map": "{map} towards {other}",
        "camera": "{kind}",
        "found": "{found}",
        "sun, degrees": "{sun:.1f}",
        "brightness, stops": "{brightness:+.2f}",
        "irradiance, stops": "{irradiance:.2f}",
        "insertion RMSE": "{insertion RMSE:.4f}",
        "worse than unedited": "{worse}",
    },
    summary=SUMMARY,
    panels=panels,
    options=options,
)
