"""The formula of the layers, at texels of any resolution.

    E = sat_k(E_0' * prod((1 + f_l G_l) / (1 + G_l^0)) * exp(w r)) * exp(g) + sum(C_l)

E_0' is the original without the cores C_l of its lights, and with what they hid where they have gone
(``separation.py``). The first factor is how the glow of the lights has changed (``aureoles.py``), exp(w r)
what is seen where a glow has gone (``behind_glow.py``), k the saturation of the sky's colours
(``saturation.py``) and g its smooth gain (``gain.py``). Where the first factor p is above 1, it is
1 + (p - 1) min(1, exp(lum r)): a glow adds to a cloud no more than to the sky that is seen at its elevation.
In rows below the horizon that follow those above, one factor stands for the first two (``below_horizon.py``).

:class:`.Layers` composes the working map, :mod:`.full_resolution` the map of the input's file: they differ in
where these fields come from, and in how the cores are rendered, which are added to what :func:`compose`
returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from envedit.core.arrays import settled
from envedit.representations.layers.gain import brightened
from envedit.representations.layers.lights import Lights
from envedit.representations.layers.saturation import saturated


@dataclass(frozen=True)
class Glows:
    """The glows of lights, and what they hide, at the texels of a map."""

    lights: Lights  # the lights of the map
    # turn, log_flux: (count, 3), where they are placed, as of :meth:`.Lights.core`
    turn: mi.TensorXf
    log_flux: mi.TensorXf
    before: mi.Color3f  # product of 1 + G over the unmoved lights (:meth:`.Lights.glow_before`)
    # offset, slope: of :class:`.BehindGlow`
    offset: mi.Color3f
    slope: mi.Color3f
    faint: mi.Float  # likewise


@dataclass(frozen=True)
class Fields:
    """What an edit does at the texels of a map; None: nothing."""

    glows: Glows | None = None  # how the glows of lights change
    # Log factor, by what lights do, of rows that follow those above the horizon
    log_followed: mi.Color3f | None = None
    follows: mi.Bool | None = None  # texels of such rows; None: all where there are no :attr:`glows`
    log_saturation: mi.Float | None = None  # logarithm of k
    log_gain: mi.Color3f | None = None  # the gain g
    # Share of the saturation and of the gain that acts on a texel, 0 to 1; None: all
    share: mi.Float | None = None
    kept: mi.Float | None = None  # how far a texel stays as it is, 0 to 1; None: nowhere
    log_glow: mi.Color3f | None = None  # further log factor of the glows, for derivatives by it


class Composed(NamedTuple):
    """A map without the cores of its lights: ``sky``, and ``relit`` before its saturation and its gain.

    ``gone`` (Float, None without glows) is the share of a texel's radiance that was a glow's and is gone.
    """

    sky: mi.Color3f
    relit: mi.Color3f
    gone: mi.Float | None


def compose(base: mi.Color3f, directions: mi.Vector3f | None, fields: Fields) -> Composed:
    """Compose texels (n,) of a map, but for the cores of its lights, differentiably.

    ``base`` is linear radiance of the original without the cores, ``directions`` are unit vectors through the
    texels; None where there are no glows. Where no field changes a texel, the sky is ``base``, bit for bit.
    """
    # ---- Lights: their glow, and what it had hidden
    factor, gone = None, None
    if fields.glows is not None:
        glows = fields.glows
        glow = glows.lights.glow(glows.turn, glows.log_flux, directions)
        glow = glow if fields.log_glow is None else glow * dr.exp(fields.log_glow)
        factor = settled(glow / glows.before, 1)  # exactly 1 where nothing moved
        gone = dr.maximum(mi.luminance(1 - factor), 0)
        hidden = glows.offset + glows.slope * dr.log(base / glows.before + glows.faint)
        added = (factor - 1) * dr.exp(dr.minimum(mi.luminance(hidden), 0))
        factor = dr.select(factor > 1, 1 + added, factor)
        factor = factor * dr.exp(gone * hidden)
    if fields.log_followed is not None:
        followed = dr.exp(fields.log_followed)
        factor = followed if factor is None else dr.select(fields.follows, followed, factor)
    relit = base if factor is None else base * factor

    # ---- Saturation
    sky = relit
    if fields.log_saturation is not None:
        sky = saturated(sky, dr.exp(_shared(fields.log_saturation, fields.share)))

    # ---- Gain
    if fields.log_gain is not None:
        sky = brightened(sky, dr.exp(_shared(fields.log_gain, fields.share)))

    # ---- What is kept
    if fields.kept is not None:
        open_share = 1 - fields.kept
        sky = fields.kept * base + open_share * sky
        relit = fields.kept * base + open_share * relit
        gone = None if gone is None else open_share * gone
    return Composed(sky, relit, gone)


def _shared(log, share):
    return log if share is None else log * share
