"""Compare what may be shown where a sun was: a table, and a picture of the old place.

Every light of a map is turned about the vertical, nothing is rendered, and the map is compared with the map
turned as a whole. ``envedit/representations/layers/behind_glow.py`` is "elevation, contrast"; the others take
parts of it, or a membrane through what surrounds the brighter part of the glow.
"""

import itertools
from dataclasses import replace

import numpy as np

from envedit import inputs
from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import luminance
from envedit.core.rotations import rotation_vector
from envedit.images import images
from envedit.losses import metrics, naturalness
from envedit.representations.layers import behind_glow as product
from envedit.representations.layers import below_horizon, layers, separation
from experiments import puresky
from experiments.harness import Experiment, calling, markdown

TURNS = 71, 143
"""Columns of 256."""
HELD = "snow_field", "industrial_sunset", "kloofendal_48d_partly_cloudy"
"""Nothing was chosen by these."""
WAYS = "glow divided out", "contrast", "elevation", "elevation, contrast", "elevation, no texture", "membrane"
OLD = 0.3
"""The old place: where the glow was so much of the light, and is gone."""
BRIGHT = 1.5
"""Glow from which on the membrane fills in."""


def under(made: layers.Layers, way: str) -> layers.Layers:
    """Return layers that show what they do under one of the :data:`WAYS`."""
    behind, background = made.behind, made.separation.background
    logs = np.log(background + behind.faint)
    low, none = product._blurred(logs, product.BLUR_DEGREES, made.rows), np.zeros_like(logs)
    filled = separation.filled(background, made.separation.glow.max(axis=2) > BRIGHT)
    offset, slope = {
        "glow divided out": (none, none),
        "contrast": (-behind.slope * low, behind.slope),
        "elevation": (behind.offset + behind.slope * low, none),
        "elevation, contrast": (behind.offset, behind.slope),
        "elevation, no texture": (behind.offset + (behind.slope + 1) * low, none - 1),
        "membrane": (np.log(filled + behind.faint) - logs, none),
    }[way]
    made = replace(made, behind=replace(behind, offset=offset, slope=slope))
    if made.mirrored and way in WAYS[:2]:
        gone, near = np.ones((*made.below.shape, 1)), np.zeros((*made.below.shape, 1))
        made.below.reveal(np.zeros((*made.below.shape, 3)), gone, near)
    return made


def turned(made: layers.Layers, params: dict, columns: int, width: int) -> dict:
    """Return the parameters with every light of the map turned about the vertical."""
    angle = 2 * np.pi * columns / width
    about = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turn = np.zeros(params["turn"].shape)
    for i, light in enumerate(made.separation.lights):
        turn[i] = rotation_vector(light.direction, about @ light.direction)
    return params | {"turn": tensor(turn / layers.SCALES["turn"])}


NUMBERS = "map, dB", "log radiance, up", "below", "seam", "high frequencies"


def measured(edited, original, true, old) -> list[float]:
    """Return :data:`NUMBERS`: map PSNR over the unedited one's, RMS of log radiance at the old place."""
    errors = [metrics.compare(one, true)["psnr"] for one in (edited, original)]
    off = np.square(np.log((edited + 1e-3) / (true + 1e-3)))
    rows = old.shape[0]
    low = old[: len(true) - rows][::-1]
    natural = naturalness.natural(edited, original, true)
    return [
        errors[0] - errors[1],
        float(np.sqrt(off[:rows][old].mean())),
        float(np.sqrt(off[rows:][low].mean())),
        natural["seam"],
        natural["high_frequency"],
    ]


def compare(settings, folder) -> dict:
    """Turn the lights of a map every way; returns ``numbers`` by way and turn, none without a light.

    ``places.exr``, display values: the true map, the original, and each way, beside each other.
    """
    original, _ = inputs.load_map(settings.input)
    height, width, _ = original.shape
    tiles, found = [], {}
    for way in WAYS:
        made = layers.Layers.of(original, horizon=below_horizon.kind_of(original))
        params = made.start()
        if made.behind is None:
            return {"numbers": {}}
        made = under(made, way)
        found[way] = []
        for columns in TURNS:
            params = turned(made, params, columns, width)
            edited = made.decode(params).numpy()
            true = latlong.rotate(original, 360 * columns / width)
            if metrics.sun_offset(edited, true) > width / 8:
                raise ArithmeticError("the light went elsewhere than the map")
            glow = made.separation.glow @ [0.2126, 0.7152, 0.0722]
            old = 1 - np.roll(glow, -columns, axis=1) / glow > OLD
            found[way].append(measured(edited, original, true, old))
        tiles.append(edited)
    centre = latlong.texel_position(made.separation.lights[0].direction, height, width)[1]
    white = 4 * float(np.median(luminance(true)))
    shown = [np.roll(m, width // 2 - round(float(centre)), axis=1) for m in (true, original, *tiles)]
    cut = slice(width // 4, 3 * width // 4)
    shown = [np.clip(m[:, cut] / white, 0, 1) ** (1 / 2.2) for m in shown]
    images.write_exr(folder / "places.exr", np.concatenate(shown, axis=1).astype(np.float32))
    return {"numbers": found}


def cases(given):
    return [
        calling(
            name,
            "experiments.layers.old_sun:compare",
            {"input": {"envmap": str(file), "width": 256}},
            {"map": name, "held": "held out" if name in HELD else "others"},
        )
        for name, file in puresky.find().items()
    ]


def measure(done) -> list[dict]:
    found = done.metrics["numbers"].items()
    return [{"way": way, "numbers": numbers} for way, turns in found for numbers in turns]


def summary(rows) -> str:
    """Return means of every way, over the maps that nothing was chosen by and over the others."""
    lines = []
    for way, held in itertools.product(WAYS, ("others", "held out")):
        some = [row["numbers"] for row in rows if (row["way"], row["held"]) == (way, held)]
        if some:
            lines.append([way, f"{held}, {len(some)}", *(f"{v:.2f}" for v in np.mean(some, axis=0))])
    return markdown(["where the sun was", "maps", *NUMBERS], lines)


EXPERIMENT = Experiment(
    "layers.old_sun",
    "Compare what may be shown where a sun was.",
    cases,
    measure,
    {"map": "{map}", "where the sun was": "{way}"}
    | {name: f"{{numbers[{i}]:.2f}}" for i, name in enumerate(NUMBERS)},
    summary=summary,
    panels=lambda done: [done.picture("places")] if done.metrics["numbers"] else [],
    sheet=lambda case: "old_sun.jpg",
)
