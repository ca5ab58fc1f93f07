"""The pixel test of every program: by its own formula, a bright texel is looked up where it was."""

import math

import numpy as np

from envedit.core import latlong
from envedit.maps.conventions import QUARTERS, turned_for

# A direction (x, y, z) of the scene in a program's axes, and the column over the width that it looks up.
LOOK_UP = {
    "blender": (lambda x, y, z: (x, -z, y), lambda x, y, z: 0.5 - math.atan2(y, x) / (2 * math.pi)),
    "houdini": (lambda x, y, z: (x, y, z), lambda x, y, z: (math.pi - math.atan2(x, z)) / (2 * math.pi)),
    "three": (lambda x, y, z: (x, y, z), lambda x, y, z: 0.5 + math.atan2(z, x) / (2 * math.pi)),
    "unity": (lambda x, y, z: (-x, y, z), lambda x, y, z: 0.5 - math.atan2(z, x) / (2 * math.pi)),
    "unreal": (lambda x, y, z: (x, z, y), lambda x, y, z: 0.5 + math.atan2(x, -y) / (2 * math.pi)),
    "usd": (lambda x, y, z: (x, y, z), lambda x, y, z: (math.pi - math.atan2(x, z)) / (2 * math.pi)),
}


def test_a_bright_texel_is_found_where_it_stands_in_the_scene(rng):
    height, width = 16, 32
    assert set(LOOK_UP) == set(QUARTERS)
    for program, (axes, column_of) in LOOK_UP.items():
        for row, column in ((4, 0), (7, 13), (9, 30)):
            envmap = np.zeros((height, width, 3), np.float32)
            envmap[row, column] = [1, 2, 3]
            turned = turned_for(program, envmap)
            there = axes(*latlong.directions(height, width)[row, column])
            looked_up = math.floor(column_of(*there) * width) % width
            assert turned[row, looked_up].tolist() == [1, 2, 3] and turned.sum() == 6, program
    envmap = rng.random((9, 18, 3), dtype=np.float32)
    np.testing.assert_allclose(turned_for("three", envmap).sum(axis=1), envmap.sum(axis=1), rtol=1e-5)
