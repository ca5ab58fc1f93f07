"""Measure the constants by which the flux of a clipped sun is estimated, and their errors.

Over the suns of the maps that choices are made by: the aureole over the flux at the angles of the rings; sky
and flux over the analytic model's. What is predicted for a map is of constants without this map.
"""

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.representations.layers import unclip
from envedit.representations.layers.clipped_light import RING_DEGREES
from experiments import puresky
from experiments.harness import Experiment, calling, markdown
from experiments.measures import degrees
from experiments.unclip import clipping

CLEAR = ("autumn_field", "kloofendal_48d_partly_cloudy", "sunflowers")
LOW = ("industrial_sunset", "wasteland_clouds")


def measure_sun(settings, folder, file: str, map_name: str) -> dict:
    """Return log2 of aureole over flux (1/sr), of flux over sky, and of that over the analytic model's."""
    radiance = clipping.load(file)
    true = clipping.truth(radiance, map_name)
    directions = latlong.directions(*radiance.shape[:2])
    angle = degrees(directions, true.direction)
    lum = luminance(radiance)
    aureole = []
    for radius in RING_DEGREES[: len(unclip.AUREOLE)]:
        ring = (angle > radius * 2**-0.25) & (angle < radius * 2**0.25) & (directions[..., 1] > 0)
        aureole.append(float(np.log2(np.median(lum[ring]) / true.flux)))
    elevation = float(np.degrees(np.arcsin(true.direction[1])))
    sun, sky = unclip.analytic_fluxes(elevation)
    ratio = float(np.log2(true.flux / true.sky))
    return {
        "elevation": elevation,
        "aureole": aureole,
        "ratio": ratio,
        "offset": ratio - float(np.log2(luminance(sun) / luminance(sky))),
    }


def cases(args):
    maps = {name: str(file) for name, file in puresky.find().items() if name in CLEAR + LOW}
    return [
        calling(name, measure_sun, {}, {"map": name}, file=file, map_name=name) for name, file in maps.items()
    ]


def summary(rows) -> str:
    """Return the constants, and the errors of each map by those without it, by first ring."""
    suns = {row["map"]: row for row in rows}
    if len(suns) < len(CLEAR + LOW):
        return f"{len(suns)} of {len(CLEAR + LOW)} suns are measured"
    aureole, haze, offsets = _constants(suns, "")
    tables = [np.round(values, 2).tolist() for values in (aureole, offsets)]
    lines = [f"AUREOLE {tables[0]}, HAZE_STOPS {haze:.1f}, SKY_OFFSET {tables[1]}"]

    # ---- Every map by the constants of the others
    errors = {name: _errors(suns, name) for name in suns}
    rows = []
    for ring, radius in enumerate(RING_DEGREES[: len(unclip.AUREOLE)]):
        some = [errors[name][:, ring] for name in CLEAR + LOW]
        rows.append([f"{radius:.1f}", *(" ".join(f"{e:+.1f}" for e in one) for one in some)])
    head = ["first ring, degrees", *(f"{name}: aureole, sky, both" for name in CLEAR + LOW)]
    lines.append(markdown(head, rows))
    near = RING_DEGREES[: len(unclip.AUREOLE)] <= unclip.NEAR_DEGREES
    for label, names, rings in (
        ("clear, near", CLEAR, near),
        ("clear, far", CLEAR, ~near),
        ("low", LOW, near | ~near),
    ):
        spread = np.sqrt(np.mean([np.square(errors[name][:, rings]).mean(axis=1) for name in names], axis=0))
        lines.append(
            f"{label}: RMS of aureole {spread[0]:.2f}, sky {spread[1]:.2f}, both {spread[2]:.2f} stops"
        )
    return "\n\n".join(lines)


def _constants(suns, left_out):
    """Return AUREOLE, HAZE_STOPS and SKY_OFFSET without a map."""
    clear = [suns[name] for name in CLEAR if name != left_out]
    low = [suns[name] for name in LOW if name != left_out]
    aureole = np.mean([one["aureole"] for one in clear], axis=0)
    haze = float(np.mean([np.mean(one["aureole"] - aureole) for one in low]))
    return aureole, haze, [float(np.mean([one["offset"] for one in some])) for some in (clear, low)]


def _errors(suns, name):
    """Return the errors (3, rings) of both estimates and their mean for a map, in stops."""
    aureole, haze, offsets = _constants(suns, name)
    sun = suns[name]
    low = name in LOW
    by_aureole = np.array(sun["aureole"]) - aureole - haze * low
    by_sky = np.full_like(by_aureole, offsets[low] - sun["offset"])
    near = RING_DEGREES[: len(aureole)] <= unclip.NEAR_DEGREES
    precision = (
        np.stack([np.where(near, *unclip.AUREOLE_STOPS), np.full(len(aureole), unclip.SKY_STOPS)]) ** -2.0
    )
    both = (precision * [by_aureole, by_sky]).sum(axis=0) / precision.sum(axis=0)
    return np.stack([by_aureole, by_sky, both])


EXPERIMENT = Experiment(cases, summary=summary)
