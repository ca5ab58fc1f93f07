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
from experiments.harness import Experiment
from experiments.measures import degrees
from experiments.summary import Summary
from experiments.unclip import clipping

CLEAR = ("autumn_field", "kloofendal_48d_partly_cloudy", "sunflowers")
LOW = ("industrial_sunset", "wasteland_clouds")


def measure_sun(settings, folder, file: str) -> dict:
    """Return log2 of aureole over flux (1/sr), of flux over sky, of the analytic one, and of their ratio."""
    radiance = clipping.load(file)
    true = clipping.truth(radiance)
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
    analytic = float(np.log2(luminance(sun) / luminance(sky)))
    return {"aureole": aureole, "ratio": ratio, "analytic": analytic, "offset": ratio - analytic}


def cases(args):
    return [case for case in puresky.cases(measure_sun) if case.name in CLEAR + LOW]


def constants(suns: list[dict]) -> tuple[np.ndarray, float, tuple[float, float]]:
    """Return AUREOLE, HAZE_STOPS and SKY_OFFSET of some suns."""
    clear = [sun for sun in suns if sun["map"] in CLEAR]
    low = [sun for sun in suns if sun["map"] in LOW]
    aureole = np.mean([sun["aureole"] for sun in clear], axis=0)
    haze = float(np.mean([sun["aureole"] - aureole for sun in low]))
    clear_offset, low_offset = (float(np.mean([sun["offset"] for sun in some])) for some in (clear, low))
    return aureole, haze, (clear_offset, low_offset)


def errors(suns: list[dict], sun: dict) -> list[dict]:
    """Return the errors of both estimates and of their mean by the constants of the other suns, stops.

    A row for each ring that may be the first outside the clipped region.
    """
    aureole, haze, offsets = constants([one for one in suns if one is not sun])
    low = sun["map"] in LOW
    rows = []
    for ring, radius in enumerate(RING_DEGREES[: len(aureole)]):
        near = radius <= unclip.NEAR_DEGREES
        by_aureole = sun["aureole"][ring] - aureole[ring] - haze * low
        by_sky = offsets[low] - sun["offset"]
        precision = np.array([unclip.AUREOLE_STOPS[not near], unclip.SKY_STOPS]) ** -2.0
        rows.append(
            {
                "suns": "low" if low else "clear, near" if near else "clear, far",
                "aureole": by_aureole,
                "sky": by_sky,
                "both": np.average([by_aureole, by_sky], weights=precision),
            }
        )
    return rows


def summary(suns: list[dict]) -> str:
    """Return the constants, and the errors of each map by those without it."""
    if len(suns) < len(CLEAR + LOW):
        return f"{len(suns)} of {len(CLEAR + LOW)} suns are measured"
    aureole, haze, offsets = constants(suns)
    rounded = f"AUREOLE {np.round(aureole, 2).tolist()}, HAZE_STOPS {haze:.1f}"
    rounded += f", SKY_OFFSET {np.round(offsets, 2).tolist()}"
    return f"{rounded}\n\n{ERRORS([row for sun in suns for row in errors(suns, sun)])}"


ERRORS = Summary(
    {"RMS of the errors, stops": "{suns}"},
    {"by the aureole": "{aureole.rms:.2f}", "by the sky": "{sky.rms:.2f}", "both": "{both.rms:.2f}"},
)

EXPERIMENT = Experiment(
    cases,
    columns={"map": "{map}", "flux over sky, stops": "{ratio:+.1f}", "analytic": "{analytic:+.1f}"},
    summary=summary,
)
