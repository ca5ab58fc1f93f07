"""How the glow of a sun goes with its flux: over photographed skies, each with a sun of its own."""

import numpy as np

from envedit.core.color import luminance
from envedit.images import images
from envedit.representations.layers import aureoles
from envedit.representations.layers.layers import Layers
from experiments import puresky
from experiments.harness import Experiment, calling, done_of, markdown

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
    flux = luminance(made.lights.flux[strongest]) / aureoles.ground_irradiance(made.base, made.rows)
    return {"flux": float(flux), "glow": luminance(glows[strongest])[list(DEGREES)].tolist()}


def cases(args):
    return [
        calling(name, "experiments.natural.aureoles:measure_glow", {}, file=str(file))
        for name, file in puresky.find().items()
    ]


def tabulate(cases, out, args) -> str:
    """Return glows by flux, and the power of the flux that the glow goes with."""
    suns = {done.case.name: done.metrics for done in done_of(cases, out) if done.metrics}
    if len(suns) < 3:
        return f"{len(suns)} suns are measured"
    suns = dict(sorted(suns.items(), key=lambda one: one[1]["flux"]))
    head = ["map", "flux over sky", *(f"glow at {degrees}°" for degrees in DEGREES)]
    rows = [[name, f"{sun['flux']:.2f}", *(f"{g:.1f}" for g in sun["glow"])] for name, sun in suns.items()]
    glow = np.log([sun["glow"][DEGREES.index(POWER_DEGREES)] for sun in suns.values()])
    flux = np.log([sun["flux"] for sun in suns.values()])
    power = np.polyfit(flux, glow, 1)[0]
    return f"{markdown(head, rows)}\n\nThe glow at {POWER_DEGREES} degrees goes with flux^{power:.2f}."


EXPERIMENT = Experiment(
    "natural.aureoles",
    "Measure how the glow of a sun goes with its flux.",
    cases=cases,
    tabulate=tabulate,
)
