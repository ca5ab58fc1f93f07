"""USD meshes as triangles in PLY files, and simple shapes as Mitsuba's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import UsdGeom

from envedit.scene.usd.description import Description

SHAPES = ("Cube", "Sphere")
"""Types of shapes that are read beside meshes."""
SPHERE_ROWS = 64
"""Rows of triangles of a sphere that is stretched, half as many as columns."""
FIRST_UV = ("st", "UVMap", "map1")
"""Primvars that are tried where a material names no set of texture coordinates; then any of two numbers."""


def triangles(scene: Description, prim: Any, uv_name: str, faces: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return a mesh as triangles; polygons are cut into fans.

    ``uv_name`` is the primvar of the texture coordinates; "": one of :data:`FIRST_UV`. ``faces`` (n,) says
    which faces; None: all. Returned are ``vertices`` (n, 3), ``normals`` (n, 3) and ``uv`` (n, 2) float32,
    the last two where the mesh has them, and ``faces`` (m, 3) int32. Mitsuba's rows of a texture go down: v
    is 1 - USD's. InputError if the mesh's arrays do not fit together.
    """
    mesh = UsdGeom.Mesh(prim)
    points: np.ndarray = _array(mesh.GetPointsAttr(), scene.time, np.float32).reshape(-1, 3)
    counts = _array(mesh.GetFaceVertexCountsAttr(), scene.time, np.int64)
    indices = _array(mesh.GetFaceVertexIndicesAttr(), scene.time, np.int64)
    inside = not indices.size or (indices.min() >= 0 and indices.max() < len(points))
    if not inside or (counts < 0).any() or counts.sum() != len(indices) or not np.isfinite(points).all():
        raise scene.error(prim.GetPath(), "the mesh's points, counts and indices do not fit together")

    # ---- Corners of the triangles, as indices into those of the polygons
    starts = np.cumsum(counts) - counts
    kept = np.arange(len(counts)) if faces is None else faces
    holes = _array(mesh.GetHoleIndicesAttr(), scene.time, np.int64)
    kept = kept[~np.isin(kept, holes)]
    each = np.maximum(counts[kept] - 2, 0)
    face = np.repeat(kept, each)
    step = np.arange(len(face)) - np.repeat(np.cumsum(each) - each, each)
    first = starts[face]
    corners = np.stack([first, first + step + 1, first + step + 2], axis=1)
    if mesh.GetOrientationAttr().Get(scene.time) == UsdGeom.Tokens.leftHanded:
        corners = corners[:, ::-1]

    # ---- Values at the corners
    columns = [points[indices[corners]]]
    normals = _normals(scene, mesh, points, counts, indices)
    uv = _texture_coordinates(scene, prim, uv_name)
    for values, size in ((normals, 3), (uv, 2)):
        if values is not None:
            array, interpolation = values
            where = {"vertex": indices[corners], "varying": indices[corners], "faceVarying": corners}
            where |= {"uniform": np.repeat(face[:, None], 3, axis=1), "constant": np.zeros_like(corners)}
            index = where[interpolation]
            if index.size and index.max() >= len(array):
                raise scene.error(prim.GetPath(), "the mesh has fewer normals or coordinates than corners")
            columns.append(array.reshape(-1, size)[index])

    # ---- Vertices: corners of one point with the same values share one
    rows = np.concatenate(columns, axis=2, dtype=np.float32).reshape(-1, sum(c.shape[2] for c in columns))
    rows = np.nan_to_num(rows, posinf=0, neginf=0)
    rows += np.float32(0)  # no negative zero, so that equal rows are equal bytes
    keys = np.ascontiguousarray(rows).view(f"V{rows.shape[1] * 4}").ravel()
    _, picked, inverse = np.unique(keys, return_index=True, return_inverse=True)
    vertices = rows[picked]
    mesh_arrays = {"vertices": vertices[:, :3], "faces": inverse.reshape(-1, 3).astype(np.int32)}
    if normals is not None:
        mesh_arrays["normals"] = vertices[:, 3:6]
    if uv is not None:
        mesh_arrays["uv"] = np.stack([vertices[:, -2], 1 - vertices[:, -1]], axis=1)
    return mesh_arrays


def _array(attribute, time, kind):
    """Return an array-valued attribute, empty where it has no value."""
    value = attribute.Get(time)
    return np.array(() if value is None else value, kind)


def _normals(scene, mesh, points, counts, indices):
    """Return normals and their interpolation; None where faces are flat.

    Those of a subdivision surface are not used, as USD says: its control cage is shown smooth.
    """
    if mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none:
        scene.leave_out("subdivision of a mesh: its control cage is rendered, smooth", mesh.GetPath())
        return _smooth_normals(points, counts, indices), "vertex"
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        return np.array(primvar.ComputeFlattened(scene.time), np.float32), str(primvar.GetInterpolation())
    values = mesh.GetNormalsAttr().Get(scene.time)
    if values:
        return np.array(values, np.float32), str(mesh.GetNormalsInterpolation())
    return None


def _smooth_normals(points, counts, indices):
    """Return the mean of the normals of the faces around each point, (n, 3), weighted by area."""
    corner = np.arange(len(indices))
    start = np.repeat(np.cumsum(counts) - counts, counts)
    following = start + (corner - start + 1) % np.maximum(np.repeat(counts, counts), 1)
    of_edge = np.cross(points[indices], points[indices[following]])
    face = np.repeat(np.arange(len(counts)), counts)
    of_face = np.stack([np.bincount(face, of_edge[:, k], len(counts)) for k in range(3)], axis=1)
    of_corner = of_face[face]
    summed = np.stack([np.bincount(indices, of_corner[:, k], len(points)) for k in range(3)], axis=1)
    return (summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _texture_coordinates(scene, prim, name):
    """Return texture coordinates and their interpolation; None where there are none."""
    primvars = UsdGeom.PrimvarsAPI(prim)
    if name:
        candidates = [primvars.FindPrimvarWithInheritance(name)]
    else:
        others = [primvar.GetPrimvarName() for primvar in primvars.GetPrimvarsWithValues()]
        candidates = [primvars.GetPrimvar(uv_name) for uv_name in (*FIRST_UV, *others)]
    for primvar in candidates:
        if primvar and primvar.HasValue() and str(primvar.GetTypeName()).endswith("2f[]"):
            values = np.array(primvar.ComputeFlattened(scene.time), np.float32)
            return values, str(primvar.GetInterpolation())
    return None


def sphere(radius: float) -> dict[str, np.ndarray]:
    """Return a sphere as triangles, as of :func:`triangles`; its poles are on Z."""
    rows, columns = SPHERE_ROWS, 2 * SPHERE_ROWS
    v = np.repeat(np.linspace(0, 1, rows + 1), columns + 1)
    u = np.tile(np.linspace(0, 1, columns + 1), rows + 1)
    polar = np.pi * v
    azimuth = 2 * np.pi * u
    around = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    normals = np.stack(around, axis=1).astype(np.float32)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = first + columns + 1
    halves = (first, below, below + 1), (first, below + 1, first + 1)
    faces = np.concatenate([np.stack(corners, axis=1) for corners in halves])
    return {
        "vertices": np.float32(radius) * normals,
        "normals": normals,
        "uv": np.stack([u, v], axis=1).astype(np.float32),
        "faces": faces.astype(np.int32),
    }


def write_ply(path: Path, mesh: dict[str, np.ndarray], mirrored: bool) -> None:
    """Write triangles, as of :func:`triangles`, as a PLY file.

    If its transform is ``mirrored`` corners go the other way round, so that the outside stays outside.
    """
    names = [("vertices", "xyz"), ("normals", ("nx", "ny", "nz")), ("uv", "uv")]
    properties = [name for key, keys in names if key in mesh for name in keys]
    table = np.concatenate([mesh[key] for key, _ in names if key in mesh], axis=1).astype("<f4")
    faces = mesh["faces"][:, ::-1] if mirrored else mesh["faces"]
    listed = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    listed["count"], listed["corners"] = 3, faces
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    head += [f"property float {name}" for name in properties]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(head).encode())
        file.write(table.tobytes())
        file.write(listed.tobytes())
