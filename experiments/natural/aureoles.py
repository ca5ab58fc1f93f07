"""How the glow of a sun goes with its flux: over photographed skies, each with a sun of its own."""

import numpy as np

from envedit.core.color import luminance
from envedit.images import images
from envedit.representations.layers import aureoles
from envedit.representations.layers.layers import Layers
from experiments import puresky
from experiments.harness import Experiment

WIDTH = 512
DEGREES = (2, 5, 10, 20, 40)
POWER_DEGREES = 10
"""Angle from the sun at which the power of the flux is fitted."""


def measure_glow(settings, folder, file: str) -> dict:
    """Return flux over the sky's irradiance and glow of the strongest light with one; {} without."""
    image = images.load_envmap(file, WIDTH)[0]
    made = Layers.of(image[: WIDTH // 4], (0, WIDTH // 2))
    glows = made.lights.glows[: made.lights.own]
    if all(glow is None for glow in glows):
        return {}
    strongest = max(
        (k for k, glow in enumerate(glows) if glow is not None), key=lambda k: luminance(made.lights.flux[k])
    )
    sky = luminance(aureoles.ground_irradiance(made.base, made.rows))
    flux = luminance(made.lights.flux[strongest]) / sky
    return {"flux": float(flux), "glow": luminance(glows[strongest])[list(DEGREES)].tolist()}


def summary(rows) -> str:
    """Return the power of the flux that the glow goes with."""
    if len(rows) < 3:
        return f"{len(rows)} suns are measured"
    glow = np.log([row["glow"][DEGREES.index(POWER_DEGREES)] for row in rows])
    power = np.polyfit(np.log([row["flux"] for row in rows]), glow, 1)[0]
    return f"The glow at {POWER_DEGREES} degrees goes with flux^{power:.2f}."


EXPERIMENT = Experiment(
    lambda given: puresky.cases(measure_glow),
    columns={"map": "{map}", "flux over sky": "{flux:.2f}"}
    | {f"glow at {degrees}°": f"{{glow[{k}]:.1f}}" for k, degrees in enumerate(DEGREES)},
    summary=summary,
    combine=lambda rows: sorted(rows, key=lambda row: row["flux"]),
)
