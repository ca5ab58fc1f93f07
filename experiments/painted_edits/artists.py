"""Carry out the twelve edits that lighting artists make, painted by functions: four scenes, eight maps.

Four of the maps are kept out of every choice (``experiments.natural.skies.KEPT``).
"""

import itertools
from dataclasses import replace

import numpy as np

import envedit
from envedit import inputs
from envedit.core.color import tonemap
from envedit.targets import initial_rendering
from experiments import puresky
from experiments.harness import Done, Experiment, calling
from experiments.measures import degrees
from experiments.natural.skies import KEPT
from experiments.painted_edits import one_light
from experiments.painted_edits.experiment import PAINT, STATISTICS, explanation
from experiments.painted_edits.painters import PAINTERS, SHADOWS, View
from experiments.summary import Summary

SCENES = ("sphere", "statue", "matpreview", "mesh")
MAPS = (
    "kloofendal_48d_partly_cloudy", "sunflowers", "rustig_koppie", "syferfontein_18d_clear", "aristea_wreck",
    "mud_road", "evening_road_01", "industrial_sunset",
)  # fmt: skip
SHADOWLESS = ("mud_road", "evening_road_01")
"""Maps whose suns cast no shadow that is to be seen."""
WIDTH, MAP_WIDTH = 128, 256
TURNS = {"matpreview": {"rotate_degrees": 60.0}}
"""By how much the maps of a scene are turned: else their suns are behind its camera, and their shadows."""
EXPLAINED = 0.75
"""Share of the paint from which on lights explain it."""
SUN = 0.25
"""Share of the brightest light's flux from which on another light is a sun as well."""
EDIT = "edit"
"""Folder of the edit in that of a case."""


def options(parser):
    rooms = "under the maps of ENVEDIT_DATA/hdri, most of which have several lights, in place of skies"
    parser.add_argument("--rooms", action="store_true", help=rooms)


def cases(args):
    skies = puresky.find() if not args.rooms else {}
    maps = puresky.others() if args.rooms else {name: skies[name] for name in MAPS if name in skies}
    made = []
    for (i, edit), (j, scene), (k, name) in itertools.product(*map(enumerate, (PAINTERS, SCENES, maps))):
        if name in SHADOWLESS and edit in SHADOWS:
            continue
        tables = {
            "input": {"envmap": str(maps[name]), "width": MAP_WIDTH, **TURNS.get(scene, {})},
            "scene": puresky.scene(scene) | {"width": WIDTH},
        }
        about = {"edit": edit, "scene": scene, "map": name, "kept": " (kept out)" if name in KEPT else ""}
        # Scene and map change from one edit to the next.
        about["place"] = (
            i,
            (k - i) % len(maps),
            (j - i) % len(SCENES),
        )
        made.append(calling(f"{edit}-{scene}-{name}".replace(" ", "_"), carry_out, tables, about, edit=edit))
    return made


def carry_out(settings, folder, edit: str) -> dict:
    """Paint, and edit the map; returns {} where there is nothing to paint on."""
    # ---- Paint
    scene = inputs.load_scene(settings.scene)
    envmap, _ = inputs.load_map(settings.input, scene)
    view = View(scene, envmap)
    initial = initial_rendering.initial(scene, envmap, settings)
    paint = PAINTERS[edit](view, initial)
    if paint is None:
        return {}

    # ---- Edit
    result = envedit.edit(settings, target=paint.picture, mask=paint.coverage)
    result.save(folder / EDIT)

    # ---- Measures
    lights = result.lights["after"]
    flux = [sum(light["flux"]) for light in lights]
    off = None
    if paint.sun is not None and lights:
        brightest = np.array(lights[int(np.argmax(flux))]["direction"])
        off = float(degrees(brightest, scene.to_world @ paint.sun))
    explained = one_light.share(settings, view, initial, paint)
    towards = result.metrics["painted"]["towards"]
    return {
        **result.metrics,
        **result.metrics["painted"],
        **result.metrics["natural"],
        "one_light": explained,
        "of_explained": towards if explained >= EXPLAINED else None,
        "explanation": explanation(result.notes),
        "sun_off": off,
        "suns": sum(f >= SUN * max(flux) for f in flux),
    }


def panels(done: Done):
    """Return initial, painted and edited rendering, original and edited map."""
    if not done.metrics:
        return []
    edit = Done(replace(done.case, result="metrics.json"), done.folder / EDIT)  # as `envedit run` leaves it
    maps = [tonemap(one, "gamma") for one in edit.maps[:2]]
    return edit.shown("render_initial", "render_target", "render_edited") + maps


EXPERIMENT = Experiment(
    cases,
    columns={
        "edit": "{edit}",
        "scene": "{scene}",
        "map": "{map}{kept}",
        "sun off, degrees": "{sun_off:.1f}",
        "suns": "{suns}",
        "lights explain": "{one_light:.0%}",
        **PAINT,
    },
    summary=Summary(
        {"edit": "{edit}"},
        STATISTICS
        | {
            "lights explain": "{one_light.mean:.0%}",
            "at least 75 %: explained, reached of these": (
                "{of_explained.count}, {of_explained.above[0.75]}"
            ),
            "sun off, degrees, at most": "{sun_off.max:.1f}",
        },
    ),
    panels=panels,
    sheet=lambda case: f"artists_{case.about['scene']}.jpg",
    options=options,
    place=lambda case: case.about["place"],
)
