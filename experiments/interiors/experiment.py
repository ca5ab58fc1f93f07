"""Edit maps with several lights, rooms, a studio, a street at night: which moved, and which stayed."""

import json
import math

import numpy as np

from envedit.core import latlong
from envedit.representations.layers.placed_lights import direction
from experiments import puresky
from experiments.harness import Case, Done, Experiment, edit_panels

WIDTH = 256
LAMPS = {"ceiling": (200, 55), "desk": (165, 8), "corner": (320, 25)}
"""Azimuth and elevation of the room's lamps, degrees."""
ROOMS = {
    "as it is": LAMPS,
    "desk lamp moved": LAMPS | {"desk": (240, 8)},
    "corner lamp off": {name: place for name, place in LAMPS.items() if name != "corner"},
    "one lamp more": LAMPS | {"new": (20, 40)},
}
LAMP_DEGREES, LAMP_RADIANCE = 3.0, 300.0
STAYED, FAINT = 3.0, 0.25
"""Degrees up to which a light is where a lamp is, and share of a lamp's flux below which it is none."""
WARM = {
    "type": "light",
    "ellipse": [0.38, 0.32, 0.1, 0.08],
    "amount": 0.3,
    "color": "#ffd9a6",
    "softness": 0.05,
}
DARK = {"type": "shadow", "ellipse": [0.68, 0.82, 0.15, 0.06], "amount": 0.4, "softness": 0.05}
PAINT = [WARM, DARK]
"""A warm light on the sphere, and a shadow on the ground."""


def room(lamps: dict[str, tuple[float, float]]) -> np.ndarray:
    """Return a room of matte walls, with a window and lamps: linear radiance (WIDTH / 2, WIDTH, 3)."""
    d = latlong.directions(WIDTH // 2, WIDTH)
    box = np.array([2.0, 1.2, 3.0])
    hit = d * (box / np.maximum(np.abs(d), 1e-9)).min(axis=-1, keepdims=True)
    wall = np.abs(hit / box).argmax(axis=-1)
    paint = np.array([[0.5, 0.4, 0.3], [0.6, 0.6, 0.55], [0.35, 0.4, 0.5]])
    tiles = np.floor(2 * hit).sum(axis=-1, keepdims=True) % 2
    envmap = 0.3 * paint[wall] * np.where((wall == 1)[..., None], 0.5 + 0.3 * tiles, 1)
    window = (wall == 0) & (hit[..., 0] > 0) & (np.abs(hit[..., 2]) < 0.8) & (np.abs(hit[..., 1] - 0.2) < 0.5)
    envmap[window] = [6.0, 7.0, 9.0]
    for place in lamps.values():
        lamp = d @ direction(*place) > math.cos(math.radians(LAMP_DEGREES))
        envmap[lamp] = LAMP_RADIANCE * np.array([1.0, 0.8, 0.55])
    return envmap.astype(np.float32)


def cases(args):
    maps = puresky.others()
    rooms = {name: puresky.written(args.out, name, room(lamps)) for name, lamps in ROOMS.items()}
    made = []
    for name, file in (maps | {"room": rooms["as it is"]}).items():
        targets = {"60": {"rotate_degrees": 60}, "painted": {"kind": "strokes", "strokes": PAINT}}
        if name == "room":
            targets |= {other: {"file": rooms[other]} for other in list(ROOMS)[1:]}
        for label, target in targets.items():
            tables = {
                "input": {"envmap": str(file), "width": WIDTH},
                "scene": {"file": "sphere", "width": 128, "parameters": {"roughness": 0.3}},
                "target": target,
            }
            if "file" in target:
                tables["representation"] = {"turn": False}
            made.append(Case(f"{name}-{label}".replace(" ", "_"), tables, {"map": name, "label": label}))
    return made


def lamps_found(about: dict, after: list[dict]) -> str:
    """Say how many lamps of the true room have a light of the edited map, and how many lights are not one."""
    if about["map"] != "room" or about["label"] == "painted":
        return "-"
    turned = 60 if about["label"] == "60" else 0
    lamps = [direction(a - turned, e) for a, e in ROOMS.get(about["label"], LAMPS).values()]
    most = max(sum(one["flux"]) for one in after)
    lights = [direction(one["azimuth"], one["elevation"]) for one in after if sum(one["flux"]) > FAINT * most]
    near = np.array(lights) @ np.array(lamps).T > math.cos(math.radians(STAYED))
    return f"{near.any(axis=0).sum()} of {len(lamps)}, {(~near.any(axis=1)).sum()} beside them"


def measure(done: Done) -> dict:
    lights = json.loads((done.folder / "lights.json").read_bytes())
    stayed = [one for one in lights["after"] if not one["added"]]
    turn = done.metrics["turn_degrees"]
    return {
        "initial_envmap": None,  # of a painted target there is none
        **done.metrics,
        "lights": len(lights["before"]),
        "moved": 0 if turn else sum(one["moved_degrees"] > STAYED for one in stayed),
        "gone": sum(one["removed"] for one in lights["before"]),
        "new": sum(one["added"] for one in lights["after"]),
        "lamps": lamps_found(done.case.about, lights["after"]),
    }


def panels(done: Done):
    """Return original, true and edited map; what was asked for, and the edited rendering."""
    shown = edit_panels(done)
    if done.maps[2] is None:  # painted: what it was painted on
        shown[1:2] = done.shown("render_initial")
    return shown


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "map": "{map}",
        "target": "{label}",
        "rendering (unedited), dB": "{render[psnr]:.1f} ({initial[psnr]:.1f})",
        "map (unedited), dB": "{envmap[psnr]:.1f} ({initial_envmap[psnr]:.1f})",
        "of the paint (feasible)": "{painted[towards]:.0%} ({painted[reachable]:.0%})",
        "turn, degrees": "{turn_degrees:.1f}",
        "lights": "{lights}",
        "moved, gone, new": "{moved}, {gone}, {new}",
        "lamps where they are in truth": "{lamps}",
        "colours outside": "{natural[colours_outside]:.0%}",
        "seam": "{natural[seam]:.1f}",
    },
    panels=panels,
)
