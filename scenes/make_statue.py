"""Build the statue of the shipped scenes: a fluted trefoil knot on a fluted pedestal, 2 units tall.

Run ``python scenes/make_statue.py [FILE]`` to write ``statue.ply`` beside this script; it is committed, so
only a change of shape needs it. The surface is two closed grids wrapped onto parametric surfaces, a tube
(torus) and a surface of revolution (sphere), so that every edge lies in exactly two triangles by
construction. It is as non-convex as shadows and interreflection want: the strands pass over one another.
"""

import sys
from pathlib import Path

import numpy as np

ALONG, AROUND = 480, 36  # tube: vertices along the knot and around it
RINGS, TURN = 40, 160  # pedestal: rings between its poles and vertices of a ring
FLUTES, FLUTE_TWIST = 6, 5  # ridges of the tube, and by how many ridges the section turns over the whole knot
PEDESTAL_HEIGHT, TOTAL_HEIGHT = 0.42, 2.0


def knot() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices ``(V, 3)`` and triangles ``(F, 3)`` of the trefoil tube, standing in the xy plane.

    The centre line is the trefoil (sin t + 2 sin 2t, cos t - 2 cos 2t, -1.15 sin 3t); its curvature never
    vanishes, so that the Frenet frame is defined everywhere and closes by itself.
    """
    t = 2 * np.pi * np.arange(ALONG)[:, None] / ALONG
    s1, s2, s3, c1, c2, c3 = (f(k * t) for f in (np.sin, np.cos) for k in (1, 2, 3))
    centre = np.hstack([s1 + 2 * s2, c1 - 2 * c2, -1.15 * s3])
    first = np.hstack([c1 + 4 * c2, -s1 + 4 * s2, -3.45 * c3])
    second = np.hstack([-s1 - 8 * s2, -c1 + 8 * c2, 10.35 * s3])
    binormal = np.cross(first, second)
    binormal /= np.linalg.norm(binormal, axis=1, keepdims=True)
    tangent = first / np.linalg.norm(first, axis=1, keepdims=True)
    normal = np.cross(binormal, tangent)

    phi = 2 * np.pi * np.arange(AROUND)[None, :] / AROUND
    # The section closes on itself because a whole number of ridges passes.
    radius = 0.62 + 0.1 * np.cos(3 * t) + 0.055 * np.cos(FLUTES * phi + FLUTE_TWIST * t)
    offset = np.cos(phi)[..., None] * normal[:, None] + np.sin(phi)[..., None] * binormal[:, None]
    points = centre[:, None] + radius[..., None] * offset
    i, j = np.meshgrid(np.arange(ALONG), np.arange(AROUND), indexing="ij")
    return points.reshape(-1, 3), _quads(i, j, ALONG, AROUND)


def pedestal() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of the pedestal, from y = 0 to y = 1 and about 1 in radius."""
    s = np.linspace(-np.pi / 2, np.pi / 2, RINGS + 2)[1:-1, None]
    theta = 2 * np.pi * np.arange(TURN)[None, :] / TURN
    # A superellipse of exponent 6: nearly a drum, with edges round enough for smooth normals.
    radius = np.abs(np.cos(s)) ** (2 / 6)
    height = 0.5 + 0.5 * np.sign(np.sin(s)) * np.abs(np.sin(s)) ** (2 / 6)
    radius = radius * (1 + 0.12 * (1 - height) ** 3)
    fluted = radius * (1 + 0.018 * np.cos(20 * theta) * np.cos(s) ** 2)
    y = np.broadcast_to(height, fluted.shape)
    rings = np.stack([fluted * np.cos(theta), y, fluted * np.sin(theta)], axis=-1).reshape(-1, 3)
    points = np.vstack([rings, [[0, 0, 0], [0, 1, 0]]])
    i, j = np.meshgrid(np.arange(RINGS - 1), np.arange(TURN), indexing="ij")
    sides = _quads(i, j, RINGS, TURN)[:, ::-1]
    ring, after = np.arange(TURN), (np.arange(TURN) + 1) % TURN
    bottom, top, last = RINGS * TURN, RINGS * TURN + 1, (RINGS - 1) * TURN
    caps = [np.stack([np.full(TURN, bottom), ring, after], 1)]
    caps += [np.stack([np.full(TURN, top), last + after, last + ring], 1)]
    return points, np.vstack([sides, *caps])


def build() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices ``(V, 3)`` float32 and triangles ``(F, 3)`` int32, counter-clockwise from outside."""
    tube, tube_faces = knot()
    drum, drum_faces = pedestal()
    # One lobe of the trefoil points down and sinks a little into the pedestal.
    tube[:, 0] -= (tube[:, 0].min() + tube[:, 0].max()) / 2
    low, high = tube[:, 1].min(), tube[:, 1].max()
    sink = 0.06
    scale = (TOTAL_HEIGHT - PEDESTAL_HEIGHT + sink) / (high - low)
    tube = tube * scale
    tube[:, 1] += TOTAL_HEIGHT - high * scale
    drum = drum * [0.52, PEDESTAL_HEIGHT, 0.52]
    vertices = np.vstack([tube, drum]).astype(np.float32)
    return vertices, np.vstack([tube_faces, drum_faces + len(tube)]).astype(np.int32)


def write_ply(path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a binary PLY with smooth normals.

    Mitsuba would compute the normals itself, but with atomics: other last bits, and so another rendering,
    in every process.
    """
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment made by scenes/make_statue.py\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property float nx\nproperty float ny\nproperty float nz\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    table = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    table["n"], table["v"] = 3, faces
    points = np.hstack([vertices, normals(vertices, faces)]).astype("<f4")
    Path(path).write_bytes(header.encode() + points.tobytes() + table.tobytes())


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals ``(V, 3)``: those of the triangles around a vertex, weighted by their area."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    axes = [np.bincount(faces.ravel(), np.repeat(normal[:, k], 3), len(vertices)) for k in range(3)]
    total = np.stack(axes, axis=1)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def _quads(i, j, rows: int, columns: int) -> np.ndarray:
    """Split the quads at (i, j) of a grid that wraps around in both directions into triangles."""
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c = (i + 1) % rows * columns + (j + 1) % columns
    d = (i + 1) % rows * columns + j
    return np.stack([a, c, d, a, b, c], axis=-1).reshape(-1, 3)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("statue.ply")
    write_ply(target, *build())
    print(f"{target}: {target.stat().st_size} bytes")
