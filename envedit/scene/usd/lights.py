"""UsdLux lights as Mitsuba emitters.

A light emits radiance L = intensity 2^exposure color, divided by its size where ``normalize`` is set: the
area in the stage of an area light, pi sin^2(angle / 2) of a distant one. Source: "Clarification of UsdLux
Quantities and Behavior" (OpenUSD proposals, 2024).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pxr import UsdGeom, UsdLux

from envedit.core import rotations
from envedit.images import images
from envedit.scene.usd.description import Description, add

NEUTRAL = {"diffuse": 1.0, "specular": 1.0, "shaping:focus": 0.0, "shaping:ies:file": None}
"""Inputs of lights that are not used, and their values that say nothing."""
DOMES = ("DomeLight", "DomeLight_1")
"""Types of the lights whose texture is the map that is edited."""
_WHITE_KELVIN = 6500.0  # which is white, as the source says; the function of usd-core is 4 % off
_WIDEST_SUN = 5.0  # degrees across, above which the missing penumbra is named
_EMITS_ALONG_MINUS_Z = np.diag([-1.0, 1, -1, 1])  # from Mitsuba's +z to USD's -z
_Y_TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a quarter turn about x
_ROUNDING = 1e-3
_LEVEL = 0.5  # cosine of the angle between pole and up axis, above which a sky stands upright


def add_light(scene: Description, prim: Any, to_world: np.ndarray) -> None:
    """Add the emitter of a light; ``to_world`` (4, 4) is its place in the stage."""
    for key, neutral in NEUTRAL.items():
        if _value(scene, prim, f"inputs:{key}", neutral) != neutral:
            scene.leave_out(f"{key} of a light", prim.GetPath())
    if prim.GetRelationship("light:filters").GetTargets():
        scene.leave_out("filters of a light", prim.GetPath())
    radiance = _radiance(scene, prim)
    LIGHTS[prim.GetTypeName()](scene, prim, to_world, radiance)


def _value(scene, prim, key, default):
    """Return the value of an attribute, or a default where it has none."""
    value = prim.GetAttribute(key).Get(scene.time) if prim.GetAttribute(key) else None
    return default if value is None else value


def _radiance(scene, prim):
    """Return intensity 2^exposure color, (3,), before it is normalised."""
    color = np.array(_value(scene, prim, "inputs:color", (1, 1, 1)), np.float64)
    if _value(scene, prim, "inputs:enableColorTemperature", False):
        kelvin = _value(scene, prim, "inputs:colorTemperature", 6500.0)
        white = np.array(UsdLux.BlackbodyTemperatureAsRgb(_WHITE_KELVIN))
        color = color * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin)) / white
    with np.errstate(over="ignore"):
        exposure = np.exp2(np.float64(_value(scene, prim, "inputs:exposure", 0.0)))
        color = color * _value(scene, prim, "inputs:intensity", 1.0) * exposure
    if not (np.isfinite(color).all() and (color >= 0).all()):
        raise scene.error(prim.GetPath(), f"the light has radiance {color}, expected numbers of at least 0")
    return color


def _per_size(scene, prim, radiance, size):
    """Divide a radiance by a size where the light is normalised."""
    if not _value(scene, prim, "inputs:normalize", False):
        return radiance
    if not size > 0:
        raise scene.error(prim.GetPath(), "the light is normalised and has no area; give it a size")
    return radiance / size


def _rotation(scene, prim, to_world):
    """Return the rotation (3, 3) in a transform."""
    rotation = rotations.rotation_in(to_world[:3, :3], _ROUNDING)
    if rotation is None:
        raise scene.error(
            prim.GetPath(), "the light's transform stretches, shears or mirrors; expected a rotation"
        )
    left, _, right = np.linalg.svd(rotation)
    return left @ right


# ---- Lights at infinity ------------------------------------------------------------------------------------


def _add_dome(scene, prim, to_world, radiance):
    """Add the map that is edited; in the dome's frame it stands as in Mitsuba's (docs/pipelines.md)."""
    path = prim.GetPath()
    if scene.root.find("./emitter[@id='dome']") is not None:
        raise scene.error(path, "a second dome light; expected one: deactivate the others")
    rotation = _rotation(scene, prim, to_world)
    if prim.GetTypeName() == "DomeLight_1":
        pole = _value(scene, prim, "poleAxis", "scene")
        if (UsdGeom.GetStageUpAxis(scene.stage) if pole == "scene" else pole) == "Z":
            rotation = rotation @ _Y_TO_Z
    up = "XYZ".index(UsdGeom.GetStageUpAxis(scene.stage))
    if rotation[up, 1] < _LEVEL:
        scene.leave_out("the pole of a dome light is not up: its sky lies on its side", path)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    if prim.GetRelationship("portals").GetTargets():
        scene.leave_out("portals of a dome light", path)

    # ---- One radiance from everywhere
    texture = prim.GetAttribute("inputs:texture:file").Get(scene.time)
    if texture is None or not texture.path:
        add(scene.root, "emitter", "constant", radiance=radiance).set("id", "dome")
        return

    # ---- A map; what a scale cannot say of its colour is written into a copy
    layout = _value(scene, prim, "inputs:texture:format", "automatic")
    if layout not in ("automatic", "latlong"):
        raise scene.error(path, f"got a dome texture of format {layout}, expected latlong")
    file = scene.texture_file(path, texture)
    scale = float(radiance.mean())
    if np.ptp(radiance) > 1e-6 * scale:
        scene.leave_out("colour of a dome light: multiplied into a copy of its map", path)
        stored, info = images.load_envmap(str(scene.folder / file), convert=False)
        copy, name = scene.new_file("dome.exr")
        marks = {"source": str(path)}
        coloured = stored * radiance.astype(np.float32)
        images.write_exr(copy, coloured, marks, chromaticities=info["chromaticities"])
        file = name
        scale = 1.0
    if not scale > 0:
        raise scene.error(path, "the dome light is black; expected an intensity above 0")
    add(scene.root, "emitter", "envmap", filename=file, scale=scale, to_world=matrix).set("id", "dome")


def _add_distant(scene, prim, to_world, radiance):
    """Add a directional light with the irradiance that the disc of the light gives a surface facing it."""
    angle = _value(scene, prim, "inputs:angle", 0.53)
    half = math.radians(min(max(angle, 0.0), 360.0)) / 2
    size = 1.0
    if half > 0:
        size = math.pi * (math.sin(half) ** 2 if half <= math.pi / 2 else 2 - math.sin(half) ** 2)
    if angle > _WIDEST_SUN:
        what = f"angle of a distant light, {angle:g} degrees: its shadows are hard"
        scene.leave_out(what, prim.GetPath())
    irradiance = _per_size(scene, prim, radiance, size) * size
    add(scene.root, "emitter", "directional", irradiance=irradiance, direction=-to_world[:3, 2])


# ---- Lights with a place -----------------------------------------------------------------------------------


def _add_flat(scene, prim, to_world, radiance):
    """Add a rectangle or a disk that emits along -z."""
    rectangle = prim.GetTypeName() == "RectLight"
    if rectangle:
        half = (_value(scene, prim, "inputs:width", 1.0) / 2, _value(scene, prim, "inputs:height", 1.0) / 2)
        if (texture := _value(scene, prim, "inputs:texture:file", None)) and texture.path:
            scene.leave_out("texture of a rect light", prim.GetPath())
    else:
        half = (_value(scene, prim, "inputs:radius", 0.5),) * 2
    matrix = to_world @ _EMITS_ALONG_MINUS_Z @ np.diag([*half, 1.0, 1.0])
    area = np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1])) * (4 if rectangle else math.pi)
    if not area > 0:
        raise scene.error(prim.GetPath(), "the light has no area; give it a size")
    if _value(scene, prim, "inputs:shaping:cone:angle", 180.0) < 90:
        scene.leave_out("cone of an area light", prim.GetPath())
    shape = add(scene.root, "shape", "rectangle" if rectangle else "disk", to_world=matrix)
    _add_area_emitter(shape, _per_size(scene, prim, radiance, area))


def _add_sphere(scene, prim, to_world, radiance):
    """Add a sphere; a point where it has no radius; a spot light where it has a cone."""
    scales = np.linalg.norm(to_world[:3, :3], axis=0)
    if np.ptp(scales) > _ROUNDING * scales.max():
        scene.leave_out("stretch of a sphere light", prim.GetPath())
    own = _value(scene, prim, "inputs:radius", 0.5)
    cone = _value(scene, prim, "inputs:shaping:cone:angle", 180.0)
    as_point = own == 0 or bool(_value(scene, prim, "treatAsPoint", False)) or cone < 90
    radius = float((own or 1.0) * np.cbrt(np.prod(scales)))
    radiance = _per_size(scene, prim, radiance, 4 * math.pi * radius**2)
    center = to_world[:3, 3]
    if 90 <= cone < 180:
        scene.leave_out("cone of a light that is 90 degrees or more", prim.GetPath())
    if not as_point:
        _add_area_emitter(add(scene.root, "shape", "sphere", radius=radius, center=center), radiance)
        return
    intensity = radiance * math.pi * radius**2  # of its disc from afar
    if cone < 90:
        soft = min(max(_value(scene, prim, "inputs:shaping:cone:softness", 0.0), 0.0), 1.0)
        matrix = np.eye(4)
        matrix[:3, :3] = _rotation(scene, prim, to_world)
        matrix[:3, 3] = center
        angles: dict[str, Any] = {"cutoff_angle": float(cone), "beam_width": float(cone * (1 - soft))}
        matrix = matrix @ _EMITS_ALONG_MINUS_Z
        add(scene.root, "emitter", "spot", intensity=intensity, **angles, to_world=matrix)
        return
    add(scene.root, "emitter", "point", intensity=intensity, position=center)


def _add_area_emitter(shape, radiance):
    """Let a shape emit, and reflect nothing."""
    add(shape, "bsdf", "diffuse", reflectance=np.zeros(3))
    add(shape, "emitter", "area", radiance=radiance)


LIGHTS = {
    **dict.fromkeys(DOMES, _add_dome),
    "DistantLight": _add_distant,
    "SphereLight": _add_sphere,
    "RectLight": _add_flat,
    "DiskLight": _add_flat,
}
"""Types of the lights that are read."""
