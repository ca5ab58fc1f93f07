"""How fine the gain of an edit with layers is, and which pixels count.

Two recordings of T, independent of each other, separate what is seen from noise. Where they show that
detail of the sky is identifiable, as a mirror does, the gain gets finer grids, and pixels that are mostly
noise are down-weighted.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

from envedit import config, renderers
from envedit.core.seeds import Seeds
from envedit.core.types import Progress
from envedit.representations.layers.gain import CYCLES, Octave
from envedit.representations.layers.layers import Layers
from envedit.scene.scene import Scene
from envedit.solve import gain_bandwidth, pixel_confidence
from envedit.targets.target import Target
from envedit.transport import sampling_plan
from envedit.transport.light_transport import LightTransport

SECOND_SPP, SECOND_COLUMNS = 32, 64
"""Most samples a pixel and exact columns of the second recording of T, which measures its noise."""


@dataclass(frozen=True)
class Recordings:
    """What lights are looked for through."""

    transport: LightTransport  # T; the one that the run renders through, where it does
    second: LightTransport | None = None  # another recording of T, where detail is asked about
    # Detail that the picture determines; see :func:`.gain_bandwidth.octaves`
    octaves: list[Octave] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what was found and chosen


def recordings(
    settings: config.Config,
    scene: Scene,
    shape: tuple[int, int],
    layers: Layers,
    target: Target,
    traced: LightTransport | None,
    progress: Progress | None = None,
) -> Recordings:
    """Trace what lights are looked for through: T, and a second recording where detail is asked about.

    Where detail is identifiable, a gain fine enough for it follows the noise of T: a large picture, whose
    pixels "auto" gives few samples each, gets as many as memory allows. On a mirror of 256x256 pixels the map
    gains 1.6 dB over eight maps; without detail, pixels make up for each other. What is painted need not be
    what any light does: detail would follow it, and is not asked about.

    ``shape`` is (H, W) of the maps. ``traced`` is T, where the run renders through it; of no use any more if
    another one is returned. ``progress`` receives the blocks of pixels done, and all.
    """

    def trace(seed, **changed):
        return renderers.trace(
            replace(settings, seed=seed, renderer=replace(settings.renderer, **changed)),
            scene,
            shape,
            progress,
        )

    # A path tracer's samples a pixel are not meant for T.
    transport = traced or trace(settings.seed, spp="auto")
    fits = shape[1] >= 4 * CYCLES  # an octave of detail into the map
    if not fits or target.painted or settings.representation.cycles != "auto":
        return Recordings(transport)
    pixels, few = scene.width * scene.height, min(SECOND_SPP, transport.spp)
    second = trace(
        Seeds(settings.seed).second_recording,
        spp=few,
        max_depth=transport.bounces + 1,
        memory_gb=sampling_plan.gigabytes(pixels, few, min(SECOND_COLUMNS, transport.capacity) + 1),
    )
    octaves = gain_bandwidth.octaves(
        transport,
        second,
        layers.separation.background,
        layers.rows,
        target.picture,
        target.known_weight,
        2 * CYCLES,
    )
    shares = ", ".join(f"{100 * octave.share:.0f} % at {octave.cycles} cycles" for octave in octaves)
    least = f"below {100 * gain_bandwidth.MIRRORED_SHARE:.0f} % at {2 * CYCLES} cycles"
    notes = [f"sky area with identifiable detail: {shares or least}"]
    if octaves and traced and settings.renderer.spp == "auto":
        most = sampling_plan.most_samples(pixels, sampling_plan.allowed(settings.renderer.memory_gb))
        if most > transport.spp:
            notes.append(
                f"{most} paths a pixel instead of {transport.spp}, for less noise in the identifiable detail"
            )
            transport.release()
            transport = trace(settings.seed, spp=most)
    # Columns of both are compared: their paths are in the ratio of the samples.
    second.paths = tuple(max(1, round(n * second.spp / transport.spp)) for n in transport.paths)
    return Recordings(transport, second, octaves, notes)


def trusted(envmap: np.ndarray, recordings: Recordings, target: Target) -> tuple[Target, list[str]]:
    """Weigh a rendered target's pixels by what is known of them under a map; returns the target and notes.

    ``envmap`` (H, W, 3) is the map as far as it is solved: images of lights, and caustics, are where the
    lights now are. ``recordings`` has a second one.
    """
    first, second = (
        one.resolved(envmap).apply(mi.TensorXf(envmap)).numpy()
        for one in (recordings.transport, recordings.second)
    )
    share = recordings.second.spp / recordings.transport.spp
    views = recordings.transport.scene.rows
    weight = pixel_confidence.weights(first, second, share, target.picture, target.noise, views)
    if weight is None:
        return target, []
    noisy = 100 * float((weight < 0.5).mean())
    note = f"{noisy:.3g} % of the pixels are dominated by Monte Carlo noise and down-weighted"
    weight = weight * target.weight
    if not weight.any():  # a mask around nothing but noise: better that than nothing
        return target, []
    return replace(target, weight=(weight / max(float(weight.mean()), 1e-30)).astype(np.float32)), [note]
