"""Normals of meshes whose files have none: the exact sum, in every run; those of a file stay."""

import numpy as np
import pytest

from envedit.scene import scene
from tests.oracles.builders import LIGHT, SENSOR, write_scene

COUNT = 40


@pytest.fixture
def loaded(tmp_path):
    """Make what loads a mesh, with or without normals of its own; it returns vertices, faces, normals."""

    def load(positions, faces, own=None):
        lines = [f"v {x} {y} {z}" for x, y, z in positions]
        lines += [] if own is None else [f"vn {x} {y} {z}" for x, y, z in own]
        corner = "{0}" if own is None else "{0}//{0}"
        lines += ["f " + " ".join(corner.format(i + 1) for i in face) for face in faces]
        (tmp_path / "mesh.obj").write_text("\n".join(lines))
        mesh = '<shape type="obj" id="mesh"><string name="filename" value="mesh.obj"/></shape>'
        params = scene.load(write_scene(tmp_path, SENSOR, mesh, LIGHT)).params
        names = "vertex_positions", "faces", "vertex_normals"
        return [params[f"mesh.{name}"].numpy().reshape(-1, 3) for name in names]

    return load


def fan(rng):
    """A bent fan of triangles around its first vertex, where rounding of a sum in single precision shows."""
    angle = 2 * np.pi * np.arange(COUNT) / COUNT
    around = np.stack([np.cos(angle), np.sin(angle), rng.normal(0, 0.3, COUNT)], 1)
    positions = np.round(np.concatenate([[[0, 0, 1]], around]), 4)
    return positions, [(0, 1 + i, 1 + (i + 1) % COUNT) for i in range(COUNT)]


def test_they_are_the_sum_over_faces_weighted_by_angles(loaded, rng):
    positions, faces, found = loaded(*fan(rng))
    positions = positions.astype(np.float64)
    total = np.zeros(positions.shape)
    for face in faces:
        for i in range(3):
            corner, ahead, back = (positions[face[(i + k) % 3]] for k in range(3))
            a, b = ahead - corner, back - corner
            normal = np.cross(a, b)
            angle = np.arctan2(np.linalg.norm(normal), a @ b)
            total[face[i]] += angle * normal / np.linalg.norm(normal)
    expected = total / np.linalg.norm(total, axis=1, keepdims=True)
    assert np.abs(found - expected).max() <= 2**-24  # half a unit in the last place of 1


def test_those_of_a_file_stay(loaded, rng):
    positions, faces = fan(rng)
    own = rng.normal(size=positions.shape)
    own = np.round(own / np.linalg.norm(own, axis=1, keepdims=True), 6)
    there, _, found = loaded(positions, faces, own)
    at = np.abs(there[:, None] - positions).sum(axis=2).argmin(axis=1)
    np.testing.assert_allclose(found, own[at], atol=1e-6)


@pytest.mark.slow
def test_a_face_without_area_counts_for_nothing(loaded):
    _, _, found = loaded([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0)], [(0, 1, 2), (0, 1, 3)])
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[:3], [[0, 0, 1]] * 3)
