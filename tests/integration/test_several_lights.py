"""Maps with several lights: only those that have changed move, go out or are added."""

import numpy as np
import pytest

import envedit
from envedit.core import latlong

pytestmark = pytest.mark.usefixtures("own_core")

HEIGHT, WIDTH = 64, 128
LAMPS = {"ceiling": (200, 55), "desk": (165, 8), "corner": (320, 25)}


def direction(azimuth, elevation):
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)])


def room(lamps):
    """Grey walls that are darker towards the floor, and lamps of a radius of 4 degrees."""
    d = latlong.directions(HEIGHT, WIDTH)
    envmap = np.repeat(0.15 + 0.05 * d[..., 1:2], 3, axis=2)
    for place in lamps.values():
        envmap[d @ direction(*place) > np.cos(np.radians(4))] = [200, 160, 110]
    return envmap.astype(np.float32)


@pytest.mark.parametrize(
    ("lamps", "removed", "added"),
    [
        ({name: place for name, place in LAMPS.items() if name != "corner"}, 1, 0),
        (LAMPS | {"new": (20, 40)}, 0, 1),
    ],
    ids=["off", "added"],
)
@pytest.mark.slow
def test_only_the_lamp_that_has_changed_changes(lamps, removed, added):
    settings = {
        "input": {"width": WIDTH},
        "scene": {"file": "sphere", "width": 48, "parameters": {"roughness": 0.3}},
        "target": {"spp": 128},
        "output": {"spp": 64},
        "renderer": {"spp": 128},
        "representation": {"turn": False},
    }
    found = envedit.edit(settings, envmap=room(LAMPS), target_map=room(lamps)).lights
    after = {light["id"]: light for light in found["after"]}
    stayed = [one for one in found["before"] if not one["removed"] and after[one["id"]]["moved_degrees"] < 3]
    assert len(stayed) == len(LAMPS) - removed
    assert sum(light["removed"] for light in found["before"]) == removed
    assert sum(light["added"] for light in found["after"]) == added
    toward = [direction(light["azimuth"], light["elevation"]) for light in after.values()]
    for place in [lamps["new"]] if added else []:
        assert max(one @ direction(*place) for one in toward) > np.cos(np.radians(3))
