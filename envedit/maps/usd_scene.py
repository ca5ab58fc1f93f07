"""A map as USD: a stage with a dome light, and with its sky and its lights apart as another variant.

UsdLux places a lat-long texture as OpenEXR does, pole at +Y, longitude 0 at +Z and pi/2 at +X, falling from
pi at the left edge to -pi at the right (schema of ``DomeLight``): the frame of Mitsuba's emitter. The prims
carry the rotation of that frame in the scene. ``DistantLight`` shines along its -Z; normalized, its intensity
times its colour is the irradiance of a surface that faces it, whatever its angle.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from envedit.config.toml import quote
from envedit.core.rotations import rotation_matrix, rotation_vector

DEFAULT_VARIANT, LIGHTS_VARIANT = "map", "sky_and_lights"
"""The two variants of the set ``lighting``: the whole map; the map without its lights, and these as lamps."""


def text(
    map_file: str,
    sky_file: str,
    lights: Sequence[dict],
    to_world: np.ndarray | None = None,
    scale: float = 1.0,
    below: tuple[str, dict] | None = None,
) -> str:
    """Return a stage (``.usda``) that is lit by a map.

    The files are the map, and the map without its ``lights`` (:func:`.light_list.listed`), by names relative
    to the stage. ``to_world`` (3, 3) rotates from the map's frame (+y up) to the scene's; ``scale`` is what
    the scene multiplies the files' values by. ``below`` is the scene's USD file, relative to the stage, which
    becomes a layer above it, and its ``stage`` as of :class:`.conversion.Converted`, whose domes are switched
    off. None: lights alone.
    """
    # ---- Layer metadata
    rotation = np.eye(3) if to_world is None else np.asarray(to_world, np.float64)
    up = "Z" if abs(rotation[2, 1]) > abs(rotation[1, 1]) else "Y"
    head = ['defaultPrim = "Environment"', "metersPerUnit = 1", f'upAxis = "{up}"']
    off = ""
    if below is not None:
        file, stage = below
        layer = file.replace(os.sep, "/")
        head = [f"subLayers = [@@@{layer}@@@]", f"metersPerUnit = {stage['metersPerUnit']:.9g}"]
        head.append(f'upAxis = "{stage["upAxis"]}"')
        off = "".join(_switched_off(path) for path in stage["domes"])
    metadata = "\n".join(f"    {line}" for line in head)

    # ---- Domes and lamps
    dome, sky = (_dome(file, rotation, scale) for file in (map_file, sky_file))
    lamps = [_distant(number, light) for number, light in enumerate(lights, 1)]
    return f"""#usda 1.0
(
{metadata}
)

{off}def Xform "Environment" (
    variants = {{
        string lighting = "{DEFAULT_VARIANT}"
    }}
    prepend variantSets = "lighting"
)
{{
    variantSet "lighting" = {{
        "{DEFAULT_VARIANT}" {{
{dome}        }}
        "{LIGHTS_VARIANT}" {{
{sky}{"".join(lamps)}        }}
    }}
}}
"""


def _switched_off(path):
    """Write an opinion that a prim is not active, by its path."""
    *parents, name = path.strip("/").split("/")
    lines = []
    for parent in parents:
        lines += [f'over "{parent}"', "{"]
    lines += [f'over "{name}" (', "    active = false", ")", "{", "}"]
    return "\n".join([*lines, *"}" * len(parents), "", ""])


def _dome(file, rotation, scale):
    return _prim(
        'DomeLight "Dome"',
        f"asset inputs:texture:file = @./{file}@",
        'token inputs:texture:format = "latlong"',
        *_brightness(scale, np.ones(3)),
        *_placed(rotation),
    )


def _distant(number, light):
    flux = np.asarray(light["flux"], np.float64)
    intensity = flux.max()
    facing = rotation_matrix(rotation_vector(np.array([0.0, 0.0, 1.0]), np.array(light["direction"])))
    return _prim(
        f'DistantLight "Light_{number}"',
        f"float inputs:angle = {light['angle']:.9g}",
        "bool inputs:normalize = 1",
        *_brightness(intensity, flux / intensity if intensity > 0 else np.ones(3)),
        *_placed(facing),
    )


def _brightness(intensity, colour):
    shown = ", ".join(f"{channel:.9g}" for channel in colour)
    return (
        f"float inputs:intensity = {intensity:.9g}",
        "float inputs:exposure = 0",
        f"color3f inputs:color = ({shown})",
    )


def _placed(rotation):
    """Write a rotation whose columns are where the axes go; USD has vectors as rows: its transpose."""
    rows = [", ".join(quote(float(value) + 0.0) for value in column) for column in rotation.T]
    matrix = ", ".join(f"({row}, 0)" for row in rows)
    return (
        f"matrix4d xformOp:transform = ( {matrix}, (0, 0, 0, 1) )",
        'uniform token[] xformOpOrder = ["xformOp:transform"]',
    )


def _prim(name, *lines):
    indent = " " * 12
    body = "".join(f"{indent}    {line}\n" for line in lines)
    return f"{indent}def {name}\n{indent}{{\n{body}{indent}}}\n"
