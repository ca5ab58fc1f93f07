"""Where an edit with layers starts: how fine its gain is, which pixels count, where lights are looked for.

Two recordings of T, independent of each other, tell what is seen from what is noise. Where they show that
the picture tells detail of the sky, as a mirror does, the gain gets finer grids, and pixels that are mostly
noise count less. Then lights are searched for, in the picture or in what was painted on it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

from . import changes, config, renderers, resolution, scene, search, trust
from .gain import CYCLES
from .layers import Layers
from .target import Target
from .transport import LightTransport

AGAIN_SEED, AGAIN_SPP = 500_009, 32
"""Added to the run's seed for the second recording of T, which tells its noise; its samples a pixel."""


@dataclass(frozen=True)
class Starts:
    """What :func:`find` found.

    Attributes
    ----------
    starts : list of (dict, list of str)
        Parameters, and notes on them; one is to be taken (:meth:`.job.Job.best`).
    wanted : Target
        The target; its pixels may be weighed.
    notes : list of str
        What was chosen, whichever start is taken.
    """

    starts: list[tuple[dict, list[str]]]
    wanted: Target
    notes: list[str] = field(default_factory=list)


def recordings(
    settings: config.Config, lit: scene.Scene, shape, wanted: Target, traced: LightTransport | None
) -> list[LightTransport]:
    """Trace what :func:`find` looks through: T, and a second recording where detail is asked about.

    Parameters
    ----------
    settings : config.Config
        Of the run.
    lit : scene.Scene
        The scene.
    shape : (int, int)
        Rows and columns of the maps.
    wanted : Target
        What the picture should be. What is painted need not be what any light does: detail would follow it.
    traced : LightTransport, optional
        T, where the run renders through it.
    """
    # A path tracer's samples a pixel are not meant for T.
    automatic = replace(settings, renderer=replace(settings.renderer, spp="auto"))
    found = [traced or renderers.trace(automatic, lit, shape)]
    if wanted.coverage is None and settings.representation.cycles == "auto":
        few = replace(settings.renderer, spp=min(AGAIN_SPP, found[0].spp), refresh=0)
        seed = (settings.seed + AGAIN_SEED) % 2**32
        again = renderers.trace(replace(settings, seed=seed, renderer=few), lit, shape)
        # Its columns are only compared with the first's: the fewest paths do.
        again.paths = (again.paths[0],) * len(again.paths)
        found.append(again)
    return found


def find(
    layers: Layers, params: dict, recordings: list[LightTransport], wanted: Target, original: np.ndarray
) -> Starts:
    """Find where to start; ``layers`` may get finer grids.

    Parameters
    ----------
    layers, params : Layers, dict
        The representation and its parameters, of :meth:`.Layers.encode`.
    recordings : list of LightTransport
        Of :func:`recordings`; their bright columns may change.
    wanted : Target
        What the picture should be.
    original : ndarray (H, W, 3)
        The map.
    """
    transport = recordings[0]
    if len(recordings) == 1:
        return Starts(_searched(layers, params, transport, wanted, original), wanted)
    asked = layers.separation.background, layers.rows, wanted.picture, wanted.weight
    told = resolution.octaves(*recordings, *asked, 2 * CYCLES)
    shares = ", ".join(f"{100 * octave.share:.0f} % of {octave.cycles} cycles" for octave in told)
    notes = [f"detail that the picture tells beyond {CYCLES} cycles: {shares or 'not enough'}"]
    params = layers.refine(params, told)
    starts = _searched(layers, params, transport, wanted, original)
    if told:  # a mirror: images of a light, and caustics, are where the light is now found to be
        first = layers.rows[0]
        began = original.copy()
        began[first : first + layers.shape[0]] = layers.decode(starts[0][0]).numpy()
        weight, said = _trusted(began, recordings, wanted)
        if weight is not None:
            notes.append(said)
            wanted = replace(wanted, weight=weight)
            starts = _searched(layers, params, transport, wanted, original)
    return Starts(starts, wanted, notes)


def _trusted(envmap, recordings, wanted):
    """Weigh a rendered target's pixels by what is known of them; returns weights, or None, and a note."""
    pictures = []
    for recording in recordings:
        recording.resolve(envmap)
        pictures.append(recording.apply(mi.TensorXf(envmap)).numpy())
    share = recordings[1].spp / recordings[0].spp
    weight = trust.weights(*pictures, share, wanted.picture, wanted.noise)
    if weight is None:
        return None, ""
    noisy = 100 * float((weight < 0.5).mean())
    said = f"{noisy:.2g} % of the pixels are mostly noise of caustics or of a light's images: they count less"
    weight = weight if wanted.weight is None else weight * wanted.weight
    if not weight.any():  # a mask around nothing but noise: better that than nothing
        return None, ""
    return (weight / max(float(weight.mean()), 1e-30)).astype(np.float32), said


def _searched(layers, params, transport, wanted, original):
    """List the starts of the searches, (parameters, notes)."""
    asked = wanted.picture, wanted.weight, original
    if wanted.coverage is None:
        return [search.start(layers, params, transport, *asked)]
    begin = layers, params, transport, wanted.initial, *asked
    daring = (False, True) if (wanted.coverage < 1).any() else (False,)
    found = [changes.start(*begin, bold=bold) for bold in daring]
    if layers.separation.lights:
        found.append(changes.softened(layers, params))
    return [one for i, one in enumerate(found) if not any(_same(one, other) for other in found[:i])]


def _same(one, other):
    """Say whether two starts place the lights alike, in turn and flux, to a thousandth of their units."""
    return all(np.allclose(*(p[name].numpy() for p, _ in (one, other)), 0, 1e-3) for name in ("turn", "flux"))
