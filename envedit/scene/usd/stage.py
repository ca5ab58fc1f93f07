"""A USD stage is read in a process of its own, and written as a Mitsuba scene.

USD takes what a file declares, and its references may multiply: a file of a kilobyte can have more prims than
any memory holds. This process has bounds on time, memory and the size of files, and is all that fails.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Tf, Usd, UsdGeom, UsdShade

from envedit.core.errors import ConfigError, EnveditError, InputError
from envedit.scene import scene_files
from envedit.scene.usd import cameras, lights, materials, meshes
from envedit.scene.usd.description import Description, add, add_matrix, column_matrix

MEMORY = 2**33
"""Address space in bytes; three meshes of 252,000 triangles take 0.5 GB in all."""
FILE_BYTES = 2**32
"""Size of a file that may be written."""
MOST_PRIMS = 2**20
"""Prims that are visited, instances as often as they occur."""
MOST_SHAPES = 10_000
"""Meshes and instances; Mitsuba's parser takes 20 s for as many, and four times as long for twice as many."""
_DEEPEST = 200  # prims inside one another, with those of instancers
_PURPOSES = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
_SILENT = ("Xform", "Scope", "Material", "Shader", "NodeGraph", "GeomSubset", "RenderSettings",
           "RenderProduct", "RenderVar", "Skeleton", "SkelAnimation",
           "BlendShape", "PhysicsScene")  # fmt: skip
"""Types of prims that are no thing in the scene, or are read with another."""


@dataclass(frozen=True)
class Shape:
    """A mesh, or faces of it, with a material: what instances share.

    ``key`` has the path of its prim, the number of the part, the path of its material, and whether its
    transform mirrors.
    """

    key: tuple[str, int, str, bool]
    prim: Any
    material: Any
    faces: np.ndarray | None = None


def main(request: dict, seconds: int) -> None:
    """Convert a file, and write a line of JSON: its notes and files, or an error.

    ``request`` has ``file``, ``xml`` (the file to write), ``camera`` (as of :func:`.cameras.choose`) and
    ``time`` (a time code, or None for the first); ``seconds`` bounds the time of the processor.
    """
    say = scene_files.begin()
    scene_files.limit("RLIMIT_CPU", seconds)
    scene_files.limit("RLIMIT_AS", scene_files.address_space() + MEMORY)
    scene_files.limit("RLIMIT_FSIZE", FILE_BYTES)
    say("begun")
    try:
        answer = convert(**request)
    except EnveditError as error:
        answer = {"error": str(error), "usage": isinstance(error, ConfigError)}
    except (MemoryError, RecursionError):
        answer = {"error": f"{request['file']}: declares more than can be read", "usage": False}
    except Exception as error:  # a damaged file has many
        answer = {"error": f"{request['file']}: cannot be read ({type(error).__name__})", "usage": False}
    say(answer)


def convert(file: str, xml: str, camera: str = "", time: float | None = None) -> dict[str, Any]:
    """Write a USD file as a Mitsuba scene; arguments and errors as of :func:`.conversion.convert`.

    Returns ``notes``: what is not used; ``sources``: absolute paths of the layers and textures; ``stage``:
    its ``upAxis`` and ``metersPerUnit``, and the paths of its ``domes``.
    """
    try:
        stage = Usd.Stage.Open(file)
    except Tf.ErrorException as error:
        reason = " ".join(error.args[0].commentary.split())
        raise InputError(f"{file}: cannot be read as USD ({reason}); is this the right file?") from None
    code = stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else None
    moment = code if time is None else time
    when = Usd.TimeCode.EarliestTime() if moment is None else Usd.TimeCode(moment)
    path = Path(xml)
    scene = Description(file, path.parent, f"{path.stem}_files", stage, when)
    if stage.GetCompositionErrors():
        scene.leave_out("a layer, reference or payload that cannot be read", "/")

    # ---- What is in it
    add(scene.root, "integrator", "path")
    walk = _Walk(scene)
    walk.visit(stage.GetPseudoRoot(), np.eye(4), UsdGeom.Tokens.default_, 0)
    for prim, matrix in cameras.choose(file, walk.cameras, camera):
        cameras.add_camera(scene, prim, matrix)
    if not walk.shapes:
        raise InputError(f"{file}: no surface to light: no visible mesh of purpose default or render")
    for prim, matrix in walk.lights:
        lights.add_light(scene, prim, matrix)
    if not walk.lights:
        scene.leave_out("no light in the stage: give a map", "/")
    _add_shapes(scene, walk.shapes)

    # ---- The file, and what it came from
    ET.indent(scene.root)
    path.write_bytes(ET.tostring(scene.root, encoding="utf-8", xml_declaration=True))
    layers = [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath]
    layers = [Ar.SplitPackageRelativePathOuter(layer)[0] or layer for layer in layers]
    sources = {*map(os.path.abspath, layers), *scene.textures}
    domes = [str(prim.GetPath()) for prim, _ in walk.lights if prim.GetTypeName() in lights.DOMES]
    about = {
        "upAxis": str(UsdGeom.GetStageUpAxis(stage)),
        "metersPerUnit": float(UsdGeom.GetStageMetersPerUnit(stage)),
        "domes": domes,
    }
    return {"notes": scene.notes(), "sources": sorted(sources), "stage": about}


class _Walk:
    """Cameras, lights and shapes of a stage, with their transforms; instances are followed."""

    def __init__(self, scene: Description) -> None:
        self.scene = scene
        self.cameras: list[tuple[Any, np.ndarray]] = []
        self.lights: list[tuple[Any, np.ndarray]] = []
        self.shapes: dict[tuple, tuple[Shape, list[np.ndarray]]] = {}
        self._prims = 0
        self._count = 0

    def visit(self, prim: Any, to_world: np.ndarray, purpose: str, depth: int) -> None:
        """Visit a prim and those inside it.

        ``to_world`` (4, 4) is of its parent, ``purpose`` that it has without an own one, ``depth`` the number
        of prims around it. InputError if there are more prims or shapes than can be read.
        """
        self._prims += 1
        if self._prims > MOST_PRIMS or depth > _DEEPEST:
            raise InputError(f"{self.scene.file}: declares more prims than can be read, at {prim.GetPath()}")
        imageable = UsdGeom.Imageable(prim)
        if imageable and imageable.GetVisibilityAttr().Get(self.scene.time) == UsdGeom.Tokens.invisible:
            return
        if imageable and imageable.GetPurposeAttr().HasAuthoredValue():
            purpose = imageable.GetPurposeAttr().Get()
        if (xformable := UsdGeom.Xformable(prim)) and prim.GetTypeName():
            own = column_matrix(xformable.GetLocalTransformation(self.scene.time))
            to_world = own if xformable.GetResetXformStack() else to_world @ own
            if not np.isfinite(to_world).all():
                raise self.scene.error(prim.GetPath(), "the transform is not finite")
        kind = prim.GetTypeName()
        if kind == "PointInstancer":
            self._visit_instances(prim, to_world, purpose, depth)
            return
        if purpose in _PURPOSES:
            self._take(prim, kind, to_world)
        for child in prim.GetFilteredChildren(Usd.TraverseInstanceProxies()):
            self.visit(child, to_world, purpose, depth + 1)

    def _take(self, prim, kind, to_world):
        """Keep what a prim itself is."""
        if kind == "Camera":
            self.cameras.append((prim, to_world))
        elif kind in lights.LIGHTS:
            self.lights.append((prim, to_world))
        elif kind in (*meshes.SHAPES, "Mesh"):
            self._take_shapes(prim, kind, to_world)
        elif kind and kind not in _SILENT:
            if kind == "SkelRoot":
                kind = "skeleton: the mesh is rendered as it is bound"
            self.scene.leave_out(str(kind), prim.GetPath())

    def _take_shapes(self, prim, kind, to_world):
        """Keep a mesh, in parts where subsets have materials of their own."""
        if kind == "Mesh" and not UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get(self.scene.time):
            self.scene.leave_out("a mesh without faces", prim.GetPath())
            return
        if "MeshLightAPI" in prim.GetAppliedSchemas():
            self.scene.leave_out("light of a mesh", prim.GetPath())
        shared = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
        path = str(shared.GetPath())
        mirrored = bool(np.linalg.det(to_world[:3, :3]) < 0)
        parts = [(prim, None)]
        if kind == "Mesh" and UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            parts = self._parts(prim)
        for number, (bound, faces) in enumerate(parts):
            material = UsdShade.MaterialBindingAPI(bound).ComputeBoundMaterial()[0]
            name = ""
            if material:
                source = material.GetPrim()
                source = source.GetPrimInPrototype() if source.IsInstanceProxy() else source
                name = str(source.GetPath())
            shape = Shape((path, number, name, mirrored), prim, material, faces)
            self.shapes.setdefault(shape.key, (shape, []))[1].append(to_world)
            self._count += 1
            if self._count > MOST_SHAPES:
                raise InputError(f"{self.scene.file}: declares more than {MOST_SHAPES} meshes and instances")

    def _parts(self, prim):
        """Return prims to which materials are bound, and their faces: each face in one."""
        counts = UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get(self.scene.time) or ()
        left = np.ones(len(counts), bool)
        parts = []
        for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            faces = np.array(subset.GetIndicesAttr().Get(self.scene.time) or (), np.int64)
            if faces.size and not (faces.min() >= 0 and faces.max() < len(left)):
                raise self.scene.error(subset.GetPath(), "the subset names faces that the mesh does not have")
            faces = np.unique(faces[left[faces]])
            left[faces] = False
            parts.append((subset.GetPrim(), faces))
        parts.append((prim, np.flatnonzero(left)))
        return [(bound, faces) for bound, faces in parts if len(faces)]

    def _visit_instances(self, prim, to_world, purpose, depth):
        """Visit the prototypes of a point instancer in every place."""
        instancer = UsdGeom.PointInstancer(prim)
        when = self.scene.time
        prototypes = [self.scene.stage.GetPrimAtPath(p) for p in instancer.GetPrototypesRel().GetTargets()]
        indices = instancer.GetProtoIndicesAttr().Get(when) or ()
        if len(indices) > MOST_SHAPES:
            raise InputError(f"{self.scene.file}: {prim.GetPath()} declares {len(indices)} instances")
        how = UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
        places = instancer.ComputeInstanceTransformsAtTime(when, when, *how)
        mask = instancer.ComputeMaskAtTime(when) or [True] * len(indices)
        if len(places) != len(indices):
            raise self.scene.error(prim.GetPath(), "positions and indices do not fit together")
        for index, place, shown in zip(indices, places, mask, strict=True):
            if shown and 0 <= index < len(prototypes) and prototypes[index]:
                matrix = to_world @ column_matrix(place)
                self.visit(prototypes[index], matrix, purpose, depth + 1)


def _add_shapes(scene, shapes):
    """Write meshes, each with its material; one with several places becomes a group with instances."""
    surfaces: dict[str, materials.Surface] = {}
    for number, (shape, places) in enumerate(shapes.values()):
        path, _, name, mirrored = shape.key
        if not name:
            name = f"{path}.displayColor".replace(".", "_")
            surface = materials.of_colour(scene, shape.prim)
        else:
            surface = surfaces.get(name) or materials.read(scene, shape.material)
        if name not in surfaces:
            surfaces[name] = surface
            materials.add_bsdf(scene, surface, name)
        parent = scene.root
        if len(places) > 1:
            parent = add(scene.root, "shape", "shapegroup")
            parent.set("id", f"group_{number}")
        stretched = not all(_is_uniform(place) for place in places)
        element = _add_geometry(scene, parent, shape, surface, number, mirrored, stretched)
        add(element, "ref").set("id", name)
        if len(places) == 1:
            add_matrix(element, "to_world", places[0])
            continue
        for place in places:
            instance = add(scene.root, "shape", "instance", to_world=place)
            add(instance, "ref").set("id", f"group_{number}")


def _is_uniform(place):
    """Whether a matrix (4, 4) turns, moves and scales by one factor only."""
    product = place[:3, :3] @ place[:3, :3].T
    return np.allclose(product, product[0, 0] * np.eye(3), rtol=1e-4, atol=1e-4 * abs(product[0, 0]))


def _add_geometry(scene, parent, shape, surface, number, mirrored, stretched):
    """Add the geometry of a shape without its place; ``stretched``: that scales axes by different factors."""
    prim = shape.prim
    kind = prim.GetTypeName()
    radius = UsdGeom.Sphere(prim).GetRadiusAttr().Get(scene.time) or 1.0 if kind == "Sphere" else 1.0
    if kind == "Mesh" or (kind == "Sphere" and stretched):  # Mitsuba's sphere stays round
        if kind == "Mesh":
            mesh = meshes.triangles(scene, prim, surface.uv_name, shape.faces)
        else:
            mesh = meshes.sphere(float(radius))
        file, name = scene.new_file(f"mesh_{number}.ply")
        meshes.write_ply(file, mesh, mirrored)
        return add(parent, "shape", "ply", filename=name, face_normals="normals" not in mesh)
    if kind == "Cube":
        half = (UsdGeom.Cube(prim).GetSizeAttr().Get(scene.time) or 2.0) / 2
        return add(parent, "shape", "cube", to_world=np.diag([half, half, half, 1.0]))
    return add(parent, "shape", "sphere", radius=float(radius))
