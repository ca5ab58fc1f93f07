"""Several pictures of one map in one OpenEXR file, as layers that viewers list by name."""

from __future__ import annotations

import os

import numpy as np

from envedit.core.primaries import Chromaticities
from envedit.core.types import FilePath
from envedit.images import exr
from envedit.images.headers import finite

DEFAULT = "edited"
"""The layer that is written as plain R, G, B: what a program shows that knows of no layers."""


def write(
    path: FilePath, layers: dict[str, np.ndarray], chromaticities: Chromaticities | None = None
) -> None:
    """Write layers as one float32 OpenEXR file, whole or not at all.

    The layer ``edited``, or else the first, becomes the channels ``R``, ``G``, ``B``; any other NAME becomes
    ``NAME.R``, ``NAME.G``, ``NAME.B``, and one of two dimensions ``NAME.Y``. One part, marked as lat-long
    with ``chromaticities``; None: Rec. 709.

    Layers (H, W, 3) or (H, W) are linear radiance, or anything else with a value a texel, all of one size;
    the one that becomes R, G, B has three channels. NumericalError for a value that is not finite in float32
    names the layer and the first texel; InputError if the file cannot be written.
    """
    name = os.fsdecode(path)
    default = DEFAULT if DEFAULT in layers else next(iter(layers))
    planes = {}
    size = np.shape(layers[default])[:2]
    for layer, values in layers.items():
        values = np.asarray(values)
        colour = values.ndim == 3 and values.shape[2] == 3
        if not (colour or values.ndim == 2 and layer != default) or values.shape[:2] != size or 0 in size:
            raise ValueError(
                f"{name}: layer '{layer}' has shape {values.shape}, expected {size} with 3 channels"
            )
        values = finite(name, values, f"texels of layer '{layer}'")
        prefix = "" if layer == default else f"{layer}."
        for i, channel in enumerate("RGB" if colour else "Y"):
            planes[prefix + channel] = values[..., i] if colour else values
    exr.write(name, planes, chromaticities)
