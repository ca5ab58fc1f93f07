"""The lights of a map at the resolution of its file.

They are looked for on the small copy of :mod:`.separation` and taken out of the file's texels in bands.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from envedit.representations.layers.separation import Light, separate, survey_of

ROWS = 128
"""Rows that are worked on at a time: a band of a map 8192 texels wide is 25 MB in double precision."""


def lights_of(radiance: np.ndarray) -> list[Light]:
    """Separate the lights of a map (H, W, 3), linear radiance in Rec. 709, from its sky.

    Those with most flux come first; texels and radiance are at the resolution of the map.
    """
    survey = survey_of(radiance)
    if survey is None:
        return []
    height, width = radiance.shape[:2]

    # ---- Texels of each light, of the bands that hold any
    rows = np.flatnonzero((survey.label >= 0).any(axis=1)) * ((height - 1) / (survey.rows[1] - 1))
    margin = height / survey.rows[1] + 1
    parts: list[list[Light]] = [[] for _ in survey.centres]
    for first in range(0, height, ROWS):
        if not ((rows > first - margin) & (rows < first + ROWS + margin)).any():
            continue
        band = separate(radiance[first : first + ROWS], (first, height), survey=survey)
        for light in band.lights:
            index = next(i for i, centre in enumerate(survey.centres) if centre is light.direction)
            parts[index].append(replace(light, texels=light.texels + first * width))

    # ---- Those that leave anything at this resolution
    return [
        replace(
            part[0],
            texels=np.concatenate([light.texels for light in part]),
            radiance=np.concatenate([light.radiance for light in part]),
            hidden=np.concatenate([light.hidden for light in part]),
        )
        for part in parts
        if part
    ]


def take_out(radiance: np.ndarray, lights: list[Light]) -> None:
    """Take lights out of a map (H, W, 3) float32 in place; what is left is the sky, not negative."""
    for light in lights:
        texels = np.divmod(light.texels, radiance.shape[1])  # of a map in any memory layout
        radiance[texels] = np.maximum(radiance[texels] - light.radiance + light.hidden, 0)


def without(radiance: np.ndarray, lights: list[Light]) -> np.ndarray:
    """Return a map (H, W, 3) float32 without some of its lights; not negative."""
    sky = radiance.copy()
    take_out(sky, lights)
    return sky
