"""UsdPreviewSurface, and what its likes of MaterialX have in common with it, as Mitsuba's ``principled``."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np
from pxr import Gf, UsdGeom, UsdShade

from envedit.scene.usd.description import Description, add, add_matrix, column_matrix, put

PREVIEW, OPEN_PBR = "UsdPreviewSurface", "ND_open_pbr_surface_surfaceshader"
STANDARD = "ND_standard_surface_surfaceshader"
PARAMETERS = ("base_color", "metallic", "roughness", "eta", "specular", "spec_trans", "clearcoat",
              "clearcoat_gloss", "opacity")  # fmt: skip
"""Parameters of ``principled``, and what is none: ``specular``, a scale of the reflection, and opacity."""
INPUTS = {
    PREVIEW: ("diffuseColor", "metallic", "roughness", "ior", "specular", "", "clearcoat",
              "clearcoatRoughness", "opacity"),
    OPEN_PBR: ("base_color", "base_metalness", "specular_roughness", "specular_ior", "specular_weight",
               "transmission_weight", "coat_weight", "coat_roughness", "geometry_opacity"),
    STANDARD: ("base_color", "metalness", "specular_roughness", "specular_IOR", "specular", "transmission",
               "coat", "coat_roughness", "opacity"),
}  # fmt: skip
"""By surface shader: the inputs that give :data:`PARAMETERS`; Blender writes ``specular``, 0.5 for 1."""
FALLBACKS: dict[str, tuple[Any, ...]] = {
    PREVIEW: ((0.18, 0.18, 0.18), 0.0, 0.5, 1.5, 0.5, 0.0, 0.0, 0.01, 1.0),
    OPEN_PBR: ((0.8, 0.8, 0.8), 0.0, 0.3, 1.5, 1.0, 0.0, 0.0, 0.0, 1.0),
    STANDARD: ((0.8, 0.8, 0.8), 0.0, 0.2, 1.5, 1.0, 0.0, 0.0, 0.1, (1.0, 1.0, 1.0)),
}
"""Values of inputs that the file does not have."""
UNUSED = ("emissiveColor", "emission", "emission_luminance", "displacement", "normal", "geometry_normal",
          "useSpecularWorkflow", "opacityThreshold", "subsurface", "subsurface_weight")  # fmt: skip
"""Inputs that are not used, which is noted where they are not 0."""
_SMALLEST_ETA = 1.001  # Mitsuba divides by eta - 1
_WRAPS = {"repeat": "repeat", "mirror": "mirror", "clamp": "clamp", "black": "clamp", "useMetadata": "clamp"}


@dataclass
class Texture:
    """A ``UsdUVTexture`` that gives a parameter: its file, and how it is looked up."""

    file: str
    raw: bool
    wrap: str = "clamp"
    to_uv: np.ndarray | None = None


@dataclass
class Surface:
    """Parameters of ``principled`` by name: numbers, colours (3,) or textures; and the primvar of uv."""

    values: dict[str, Any] = field(default_factory=dict)
    uv_name: str = ""


def read(scene: Description, material: Any) -> Surface:
    """Read the surface of a material.

    Of a material with two surfaces the one of USD counts, and the transmission of MaterialX's, which the
    former does not have.
    """
    surface = Surface()
    outputs = [material.GetSurfaceOutput(), material.GetSurfaceOutput("mtlx")]
    shaders = [_source(output)[0] for output in outputs if output]
    known = [shader for shader in shaders if shader and shader.GetIdAttr().Get() in INPUTS]
    if not known:
        scene.leave_out("a material without a known surface: rendered grey", material.GetPath())
    for shader in known:
        kind = shader.GetIdAttr().Get()
        for name, key, fallback in zip(PARAMETERS, INPUTS[kind], FALLBACKS[kind], strict=True):
            if key and name not in surface.values:
                surface.values[name] = _parameter(scene, surface, shader, key, fallback)
        for key in UNUSED if shader is known[0] else ():
            port = shader.GetInput(key)
            if port and (_source(port)[0] or (not key.endswith("normal") and np.any(port.Get(scene.time)))):
                scene.leave_out(f"{key} of a material", material.GetPath())
    if known:
        _take_specular(scene, surface, material, 0.5 if known[0].GetIdAttr().Get() == PREVIEW else 1.0)
    return surface


def _take_specular(scene, surface, material, neutral):
    """Put the scale of the reflection into the index of refraction: F = ((eta - 1) / (eta + 1))^2."""
    specular = surface.values.pop("specular")
    eta = surface.values["eta"]
    if not isinstance(eta, float) or not isinstance(specular, float):
        scene.leave_out("texture of a reflectance", material.GetPath())
        surface.values["eta"] = eta if isinstance(eta, float) else 1.5
    elif specular != neutral:
        root = min(abs(eta - 1) / (eta + 1) * math.sqrt(max(specular, 0.0) / neutral), 0.99)
        surface.values["eta"] = (1 + root) / (1 - root)


def _source(port):
    """Return shader and name of the output that a port is connected to, through groups; or (None, "")."""
    for attribute in UsdShade.Utils.GetValueProducingAttributes(port):
        prim = attribute.GetPrim()
        if UsdShade.Utils.GetType(attribute.GetName()) == UsdShade.AttributeType.Output:
            return UsdShade.Shader(prim), attribute.GetName().removeprefix("outputs:")
    return None, ""


def _value(port, time, fallback):
    """Return the value of an input that no shader gives."""
    for attribute in UsdShade.Utils.GetValueProducingAttributes(port) if port else ():
        value = attribute.Get(time)
        if value is not None:
            return value
    return fallback


def _parameter(scene, surface, shader, key, fallback):
    """Return a number, a colour (3,) or a :class:`Texture`."""
    port = shader.GetInput(key)
    source, output = _source(port) if port else (None, "")
    if source and source.GetIdAttr().Get() == "UsdUVTexture":
        return _texture(scene, surface, source, output, len(np.atleast_1d(fallback)))
    if source and source.GetIdAttr().Get() == "UsdPrimvarReader_float3":
        scene.leave_out("colours of vertices", shader.GetPath())
    elif source:
        scene.leave_out(f"shader {source.GetIdAttr().Get()}", source.GetPath())
    value = fallback if source else _value(port, scene.time, fallback)
    array = np.array(value, np.float64)
    if not np.isfinite(array).all():
        raise scene.error(shader.GetPath(), f"{key} is {value}, expected finite numbers")
    return float(array) if array.ndim == 0 else array


# ---- Textures ----------------------------------------------------------------------------------------------


def _texture(scene, surface, shader, output, channels):
    """Read a ``UsdUVTexture``; one channel of it, or one that is scaled, is written into a copy."""
    path = shader.GetPath()
    asset = _value(shader.GetInput("file"), scene.time, None)
    if asset is None or not asset.path:
        raise scene.error(path, "the texture names no file")
    file = scene.texture_file(path, asset)
    space = _value(shader.GetInput("sourceColorSpace"), scene.time, "auto")
    raw = space == "raw" or (space == "auto" and channels == 1)
    wrap = _value(shader.GetInput("wrapS"), scene.time, "useMetadata")
    texture = Texture(file, raw, _WRAPS.get(wrap, "repeat"))

    # ---- Texture coordinates
    coordinates = shader.GetInput("st")
    source, _ = _source(coordinates) if coordinates else (None, "")
    if source and source.GetIdAttr().Get() == "UsdTransform2d":
        texture.to_uv = _uv_transform(scene, source)
        inner = source.GetInput("in")
        source, _ = _source(inner) if inner else (None, "")
    name = str(_value(source.GetInput("varname"), scene.time, "")) if source else ""
    if surface.uv_name and name and name != surface.uv_name:
        scene.leave_out(f"second set of texture coordinates, {name}", path)
    surface.uv_name = surface.uv_name or name

    # ---- Channels, scale and bias
    scale = np.array(_value(shader.GetInput("scale"), scene.time, (1, 1, 1, 1)), np.float32)
    bias = np.array(_value(shader.GetInput("bias"), scene.time, (0, 0, 0, 0)), np.float32)
    if (scale == 1).all() and (bias == 0).all() and output in ("rgb", ""):
        return texture
    picked = list(range(3)) if output == "rgb" else ["rgba".index(output)]
    bitmap = mi.Bitmap(str(scene.folder / file))
    bitmap.set_srgb_gamma(bitmap.srgb_gamma() and not raw)
    values = np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.Float32, False))
    values = np.clip(values[..., picked] * scale[picked] + bias[picked], 0, 1)
    short = hashlib.sha256(f"{file} {output} {scale} {bias} {raw}".encode()).hexdigest()[:12]
    copy, texture.file = scene.new_file(f"texture_{short}.exr")
    mi.Bitmap(np.repeat(values, 3, axis=2) if len(picked) == 1 else values).write(str(copy))
    texture.raw = True
    return texture


def _uv_transform(scene, shader):
    """Return ``UsdTransform2d`` for coordinates whose v goes down, (4, 4): scale, then rotate, then move."""
    turn = Gf.Rotation(Gf.Vec3d(0, 0, 1), float(_value(shader.GetInput("rotation"), scene.time, 0.0)))
    rotation = column_matrix(Gf.Matrix4d(turn, Gf.Vec3d(0)))
    scale = np.diag([*_value(shader.GetInput("scale"), scene.time, (1.0, 1.0)), 1.0, 1.0])
    move = np.eye(4)
    move[:2, 3] = _value(shader.GetInput("translation"), scene.time, (0.0, 0.0))
    flip = np.diag([1.0, -1, 1, 1])
    flip[1, 3] = 1
    return flip @ move @ rotation @ scale @ flip


# ---- Into Mitsuba ------------------------------------------------------------------------------------------


def of_colour(scene: Description, prim: Any) -> Surface:
    """Return the surface of a prim without a material: its ``displayColor``."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
    colours = primvar.ComputeFlattened(scene.time) if primvar and primvar.HasValue() else None
    if colours and len(colours) > 1:
        scene.leave_out("colours of vertices", prim.GetPath())
    mean = np.array(colours, np.float64).mean(axis=0) if colours else np.full(3, 0.18)
    return Surface({"base_color": np.clip(np.nan_to_num(mean), 0, 1)})


def add_bsdf(scene: Description, surface: Surface, name: str) -> None:
    """Add a material to the scene, two-sided unless light passes through it.

    One without reflection is ``diffuse``: the base of ``principled`` is not Lambert's.
    """
    values = dict(surface.values)
    opacity = values.pop("opacity", 1.0)
    if isinstance(opacity, np.ndarray):
        opacity = float(opacity.mean())
    outer = scene.root
    if isinstance(opacity, Texture) or opacity < 1:
        outer = add(outer, "bsdf", "mask")
        _add_value(outer, "opacity", opacity if isinstance(opacity, Texture) else max(opacity, 0.0))
    lobes = {
        key
        for key in ("spec_trans", "metallic", "clearcoat")
        if isinstance(value := values.get(key, 0.0), Texture) or value > 0
    }
    if "spec_trans" not in lobes:
        outer = add(outer, "bsdf", "twosided")
        values.pop("spec_trans", None)
    if values.get("eta", 1.0) <= _SMALLEST_ETA and not lobes:
        bsdf = add(outer, "bsdf", "diffuse")
        values = {"reflectance": values["base_color"]}
    else:
        bsdf = add(outer, "bsdf", "principled")
    scene.root[-1].set("id", name)

    # ---- Mitsuba's parameters
    if isinstance(values.get("clearcoat_gloss"), float):
        values["clearcoat_gloss"] = 1 - values["clearcoat_gloss"]
    if "eta" in values:
        values["eta"] = max(values["eta"], _SMALLEST_ETA)
    if values.get("clearcoat") == 0:
        del values["clearcoat"], values["clearcoat_gloss"]
    for key, value in values.items():
        if not isinstance(value, Texture) and key != "eta":
            value = np.clip(value, 0, 1)
        _add_value(bsdf, key, value)


def _add_value(bsdf, name, value):
    if not isinstance(value, Texture):
        put(bsdf, **{name: value if isinstance(value, np.ndarray) else float(value)})
        return
    node = add(bsdf, "texture", "bitmap", name, filename=value.file, raw=value.raw, wrap_mode=value.wrap)
    if value.to_uv is not None:
        add_matrix(node, "to_uv", value.to_uv)
