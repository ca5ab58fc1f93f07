"""Maps with several lights: only those that have changed move, go out or are added."""

import numpy as np
import pytest

import envedit
from envedit.core import latlong
from tests.oracles.maps import angle, toward

pytestmark = pytest.mark.usefixtures("own_core")

HEIGHT, WIDTH = 64, 128
LAMPS = {"ceiling": (55, 200), "desk": (8, 165), "corner": (25, 320)}
"""Name -> elevation and azimuth in degrees."""


def room(lamps):
    """Grey walls that are darker towards the floor, and lamps of a radius of 4 degrees."""
    d = latlong.directions(HEIGHT, WIDTH)
    envmap = np.repeat(0.15 + 0.05 * d[..., 1:2], 3, axis=2)
    for place in lamps.values():
        envmap[angle(d, toward(*place)) < 4] = [200, 160, 110]
    return envmap.astype(np.float32)


@pytest.mark.parametrize(
    ("lamps", "removed", "added"),
    [
        ({name: place for name, place in LAMPS.items() if name != "corner"}, 1, 0),
        (LAMPS | {"new": (40, 20)}, 0, 1),
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
        "representation": {"turn": False, "cycles": 6},
    }
    found = envedit.edit(settings, envmap=room(LAMPS), target_map=room(lamps)).lights
    after = {light["id"]: light for light in found["after"]}
    stayed = [one for one in found["before"] if not one["removed"] and after[one["id"]]["moved_degrees"] < 3]
    assert len(stayed) == len(LAMPS) - removed
    assert sum(light["removed"] for light in found["before"]) == removed
    assert sum(light["added"] for light in found["after"]) == added
    found = [toward(light["elevation"], light["azimuth"]) for light in after.values()]
    for place in [lamps["new"]] if added else []:
        assert min(angle(one, toward(*place)) for one in found) < 3
