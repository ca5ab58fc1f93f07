"""Scenes of the kinds that people have, and what happens with each: the rows of ``docs/scenes.md``."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envedit import config, inputs
from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.scene import scene
from tests.oracles.builders import BALL, SENSOR, sky, write_scene

PATH = '<integrator type="path"/>'
FLOOR = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
    <translate y="-1"/></transform></shape>"""
LAMP = """<shape type="disk"><transform name="to_world"><rotate x="1" angle="90"/><scale value="0.4"/>
    <translate x="-1.2" y="0.8"/></transform><emitter type="area"><rgb name="radiance" value="9, 6, 3"/>
    </emitter></shape>"""
TURN = '<transform name="to_world"><rotate x="0.48" y="0.8" z="0.36" angle="70"/></transform>'
HIDDEN = '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'
IMAGE = '<texture type="bitmap" name="{}"><string name="filename" value="wood.exr"/>{}</texture>'
RAW = '<boolean name="raw" value="true"/>'
BUMPED = f'<bsdf type="bumpmap">{IMAGE.format("arbitrary", RAW)}<bsdf type="diffuse"/></bsdf>'
NORMALS = f'<bsdf type="normalmap">{IMAGE.format("normalmap", RAW)}<bsdf type="diffuse"/></bsdf>'
MASKED = '<bsdf type="mask"><float name="opacity" value="0.6"/><bsdf type="diffuse"/></bsdf>'
BLENDED = """<bsdf type="blendbsdf"><float name="weight" value="0.3"/><bsdf type="diffuse"/>
    <bsdf type="conductor"/></bsdf>"""
PRINCIPLED = f"""<bsdf type="twosided"><bsdf type="principled">{IMAGE.format("base_color", "")}
    <float name="roughness" value="0.4"/></bsdf></bsdf>"""


def shaded(bsdf: str, x: float) -> str:
    place = f'<transform name="to_world"><scale value="0.3"/><translate x="{x}"/></transform>'
    return f'<shape type="sphere">{place}{bsdf}</shape>'


INSTANCES = """<shape type="shapegroup" id="group"><shape type="sphere"><float name="radius" value="0.3"/>
    <bsdf type="plastic"/></shape></shape>"""
INSTANCES += "".join(
    f"""<shape type="instance"><ref id="group"/><transform name="to_world"><translate x="{x}" y="-0.7"/>
    </transform></shape>"""
    for x in (-0.7, 0.7)
)
MATERIALS = [
    shaded(bsdf, x)
    for x, bsdf in zip((-1.4, -0.7, 0, 0.7, 1.4), (BUMPED, NORMALS, MASKED, BLENDED, PRINCIPLED), strict=True)
]
MEDIUM = """<shape type="cube"><bsdf type="null"/><medium name="interior" type="homogeneous"/></shape>"""
VOLUME = '<integrator type="volpath"/>'
CROP = "".join(
    f'<integer name="crop_{key}" value="{value}"/>'
    for key, value in {"width": 8, "height": 8, "offset_x": 4, "offset_y": 2}.items()
)
FOV = '<float name="fov" value="40"/>'
SEEN = SENSOR.replace("<rfilter", '<string name="pixel_format" value="rgba"/><rfilter')
FLAT = SENSOR.replace('"perspective"', '"orthographic"').replace(FOV, "")
FLAT = FLAT.replace("<lookat", '<scale x="2" y="2"/><lookat')
LENS = SENSOR.replace('"perspective"', '"thinlens"').replace(
    "<film", '<float name="aperture_radius" value="0.3"/><float name="focus_distance" value="5"/><film'
)


def light(scale=None, inside="", name="own.exr") -> str:
    given = "" if scale is None else f'<float name="scale" value="{scale}"/>'
    return f'<emitter type="envmap"><string name="filename" value="{name}"/>{given}{inside}</emitter>'


@dataclass(frozen=True)
class Kind:
    """A kind of scene: its parts, and what is said or refused; ``traced``: T is
    compared too."""

    name: str
    parts: tuple[str, ...]
    happens: str = "rendered as Mitsuba does"
    traced: bool = False
    like: tuple[str, ...] | None = None  # parts that plain Mitsuba is given instead


UNKNOWN = '<integrator type="my_own"><float name="strength" value="2"/></integrator>'
SCALED = '<transform name="to_world"><rotate y="1" angle="70"/><scale value="2.5"/></transform>'
UNSCALED = '<transform name="to_world"><rotate y="1" angle="70"/></transform>'

CONSTANT = '<emitter type="constant"><rgb name="radiance" value="0.9, 0.3, 0.1"/></emitter>'
NO_FILM = re.sub("<film.*</film>", "", SENSOR, flags=re.DOTALL)

KINDS = (
    Kind("a map of its own with a scale", (PATH, SENSOR, BALL, light(3))),
    Kind("a lamp (area light) beside the map", (PATH, SENSOR, BALL, FLOOR, LAMP, light(0.5, TURN)),
         "rendered as Mitsuba does; the lamp's light is constant"),
    Kind("as Blender exports: principled, image textures, two-sided, scale; normal maps, bump maps; "
         "blended and masked materials; instances",
         (PATH, SENSOR, *MATERIALS, INSTANCES, FLOOR, light(0.55, TURN))),
    Kind("two sensors", (PATH, SENSOR, SENSOR.replace('"40"', '"20"'), BALL, light()),
         "1 of 2 sensors used"),
    Kind("hidden emitters", (HIDDEN, SEEN, BALL, LAMP, light()),
         "rendered as Mitsuba does; pixels that see no surface are transparent and do not count", True),
    Kind("direct light only", ('<integrator type="direct"/>', SENSOR, BALL, FLOOR, light())),
    Kind("an orthographic camera", (PATH, FLAT, BALL, FLOOR, light())),
    Kind("a thin lens and a cropped film",
         (PATH, LENS.replace("<rfilter", f"{CROP}<rfilter"), INSTANCES, light()), traced=True),
    Kind("an integrator that is not installed", (UNKNOWN, SENSOR, BALL, light()),
         "integrator my_own is not used", like=(PATH, SENSOR, BALL, light())),
    Kind("a map that is scaled in space", (PATH, SENSOR, BALL, light(None, SCALED)),
         "taken as the rotation in it", like=(PATH, SENSOR, BALL, light(None, UNSCALED))),
    Kind("a medium that the integrator leaves out", (PATH, SENSOR, BALL, MEDIUM, light()),
         "medium homogeneous is not rendered"),
    Kind("a medium", (VOLUME, SENSOR, BALL, MEDIUM, light()),
         "refused: participating medium (homogeneous): envedit renders surfaces only"),
    Kind("a radiance meter", (PATH, SENSOR.replace("perspective", "radiancemeter").replace(FOV, ""), BALL,
                              light()), "refused: sensor radiancemeter makes no picture"),
    Kind("a spectral film", (PATH, SENSOR.replace("hdrfilm", "specfilm"), BALL, light()),
         'refused: the sensor needs a <film type="hdrfilm">'),
    Kind("a constant light in place of a map", (PATH, SENSOR, BALL, FLOOR, CONSTANT)),
    Kind("no environment emitter, no map given", (PATH, SENSOR, BALL, LAMP),
         "refused: no environment emitter"),
    Kind("an environment map without a file name", (PATH, SENSOR, BALL, light(name="")),
         "refused: the environment map names no file"),
    Kind("two environment emitters", (PATH, SENSOR, BALL, light(), '<emitter type="constant"/>'),
         "refused: 2 environment emitters"),
)  # fmt: skip


def write(folder: Path, parts, name="scene.xml") -> Path:
    """Write a scene with its map and texture; the map is the same for all, whatever its scale."""
    rng = np.random.default_rng(0)
    if not (folder / "own.exr").exists():
        images.write_exr(folder / "own.exr", sky(rng) + 0.1)
        images.write_exr(folder / "wood.exr", rng.random((4, 4, 3)).astype(np.float32), panorama=False)
    return write_scene(folder, *parts, name=name)


def loaded(path: Path, width=0):
    """Load a file as a run does: scene, radiance of its map, and what the run says."""
    settings = config.from_dict({"input": {"width": 16}, "scene": {"file": str(path)}}, path.parent)
    lit = scene.load(settings.scene.file, width)
    input_map = inputs.read_map(settings.input, lit, settings.input.width)
    return lit, input_map.radiance, inputs.notes(settings.input, lit, input_map)


def happened(kind: Kind) -> str:
    """Return what a run says of a scene, or with what words it is refused."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return "; ".join(loaded(write(Path(folder), kind.parts))[2])
        except EnveditError as error:
            return f"refused: {str(error).replace(folder, '')}"
