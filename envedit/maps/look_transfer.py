"""Looks of edits, and looks applied to maps: lights placed, the sky graded, at the resolution of the file.

A map's own lights move and change as an edit moves them, with their glow; one that the map does not have is
added, round and with a soft glow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE
from envedit.core.errors import NumericalError
from envedit.core.rotations import rotated, rotation_between, rotation_vector
from envedit.core.rows import Rows
from envedit.export import full_resolution
from envedit.maps import looks
from envedit.maps.looks import Look
from envedit.representations.layers import lights as layer_lights
from envedit.representations.layers.aureoles import glow_strength
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.placed_lights import angles
from envedit.representations.layers.separation import GLOW_DEGREES
from envedit.representations.layers.unseen import unseen_kept

WORKING_WIDTH = 256
"""Columns of the map on which a look is fitted to a map, as of ``[input] width``."""
MOST_GLOW = 1.0
"""Most by which a map's own light and its glow are made stronger in a channel; what it lacks beyond is added
as a light with a soft glow. Not measured: in proportion, the glow of a hazy sun whitens all its sky."""
AUREOLE = 4.0
AUREOLE_DEGREES = 12.0
"""Glow of an added key light: AUREOLE exp(-angle / AUREOLE_DEGREES) of the sky's radiance. The slope is that
of clear suns; the height is less, for skies with clouds. Not measured beside others."""
ADDED_DEGREES = 0.1
"""Standard deviation of an added light that may be a sun: 97 % of its flux are within the sun's radius."""
_GAUSSIAN_97 = math.sqrt(-2 * math.log(0.03))  # radius within which 97 % of a Gaussian's flux lie
_ROUNDS = 16  # of fitting fluxes to the sky that they light
_ENOUGH = 1e-3  # relative change of that sky at which it ends


@dataclass(frozen=True)
class Placed:
    """A light as it is to be: direction (3,), flux (3,), logarithm of its size over what it was."""

    direction: np.ndarray
    flux: np.ndarray
    log_size: float


@dataclass(frozen=True)
class Change:
    """What is done to one map."""

    lights: dict[int, Placed]  # by the light's index in the map's layers; spare ones come last
    gain: np.ndarray  # (9,), as of :class:`.Look`
    log_saturation: float  # logarithm of the exponent of chroma
    white_balance: np.ndarray  # (3,), stops


def apply(envmap: np.ndarray, look: Look, amount: float = 1.0, start: Look | None = None) -> np.ndarray:
    """Return a map in the light of a look.

    ``envmap`` (H, W, 3) float32 is linear radiance, finite and not negative. At an ``amount`` of 1 all of
    ``look`` is done, at 0 ``start``, or nothing; between, lights move on great circles, fluxes and gains
    change in proportion. NumericalError if the map leaves single precision.
    """
    if amount == 0 and start is None:
        return envmap
    # ---- The turn of the whole map, by whole columns
    width = min(envmap.shape[1], WORKING_WIDTH)
    first = _working(envmap, width)
    degrees = _between(_turn(first, start), _turn(first, look), amount)
    columns = round(degrees / 360 * envmap.shape[1])
    if columns:
        envmap = np.roll(envmap, -columns, axis=1)
        first = _working(envmap, width)

    # ---- The edit of the working map
    layers = _layers(first, look)
    begun = no_change(layers) if start is None else change_of(layers, start)
    params = parameters(layers, blended(begun, change_of(layers, look), amount))

    # ---- The same at the resolution of the file
    if width == envmap.shape[1]:
        result = unseen_kept(envmap, layers.decode(params).numpy())
        if not np.isfinite(result).all():
            raise NumericalError("the map in the light of the look is not finite: scale it down")
        return result
    return full_resolution.carry(layers, params, first, first, envmap, Rows.of(len(first)))


def of_edit(initial: np.ndarray, edited: np.ndarray, turn: float = 0.0) -> Look:
    """Measure the look of an edit from the map (H, W, 3) float32 before and after, linear radiance.

    The lights are those of the edited map; the sky's change is that from the map before with these lights.
    ``turn`` is by how many degrees the whole map was turned before it was edited.
    """
    after = looks.layers_of(edited)
    irradiance = looks.sky_irradiance(after, after.base)
    look = Look(turn=turn, lights=looks.lights_of(after))
    before = _layers(latlong.rotate(initial, turn), look)
    relit = replace(no_change(before), lights=_lights(before, look, irradiance))
    sky, core = (part.numpy() for part in before.parts(parameters(before, relit)))
    rows = min(before.shape[0], after.shape[0])
    in_core = core[:rows].any(axis=2) | after.separation.core[:rows].any(axis=2)
    total = before.rows[1]
    weight = np.where(in_core, 0.0, latlong.solid_angles(total, sky.shape[1])[:rows, None])
    gain, saturation, white_balance = looks.sky_change(sky[:rows], after.base[:rows], weight, total)
    return replace(look, gain=gain, saturation=saturation, white_balance=white_balance)


def _working(envmap, width):
    if width == envmap.shape[1]:
        return envmap
    return latlong.resize(envmap, round(envmap.shape[0] * width / envmap.shape[1]), width)


def _layers(envmap, look):
    """Separate a map; lights that a look adds to it have a soft glow."""
    layers = looks.layers_of(envmap)
    if "key" not in look.lights:
        return layers
    return looks.layers_of(envmap, _aureole(layers, look.lights["key"]))


def _aureole(layers, key):
    """Return the glow of spare lights: :data:`AUREOLE` at the flux that a key light has beside this sky.

    What the map's own key light has of it, within 5 degrees, comes with that.
    """
    flux = 2.0**key.flux * looks.sky_irradiance(layers, layers.base)
    own = layers.lights.glows[looks.roles(layers).get("key", -1)]
    height = AUREOLE if own is None else max(AUREOLE - own[5] @ LUMINANCE, 0.0)
    strength = glow_strength(flux / layers.lights.flux[-1])
    table = height * np.exp(-GLOW_DEGREES / AUREOLE_DEGREES)[:, None] / np.maximum(strength, 1e-30)
    table[-1] = 0
    return table


def _turn(working, look):
    """Return the degrees by which a look turns a map: until the key lights' azimuths are the same."""
    if look is None or look.turn == 0:
        return 0.0
    layers = looks.layers_of(working)
    key = looks.roles(layers).get("key")
    if key is None or "key" not in look.lights:
        return look.turn
    own = angles(layers.lights.centres[key])[0]
    return (own - look.lights["key"].azimuth + 180) % 360 - 180


def _between(start, end, amount):
    """Interpolate angles in degrees the shorter way round."""
    return start + amount * ((end - start + 180) % 360 - 180)


# ---- From a look to a change of one map --------------------------------------------------------------------


def no_change(layers: Layers) -> Change:
    """Return the change of a map that changes nothing."""
    own = layers.lights
    stay = {i: Placed(own.centres[i], own.flux[i], 0.0) for i in range(own.own)}
    return Change(stay, np.zeros(9), 0.0, np.zeros(3))


def change_of(layers: Layers, look: Look) -> Change:
    """Fit a look to a map: the fluxes are those that it asks for beside the sky that they make.

    Without a key light in the look the map's lights are put out.
    """
    graded = replace(
        no_change(layers),
        gain=look.gain,
        log_saturation=math.log(max(look.saturation, 1e-3)),
        white_balance=np.asarray(look.white_balance),
    )
    irradiance = 0.0
    change = replace(graded, lights=_lights(layers, look, irradiance))
    for _ in range(_ROUNDS if look.lights else 0):
        sky = layers.parts(parameters(layers, change))[0].numpy()
        fresh = looks.sky_irradiance(layers, sky)
        if abs(fresh - irradiance) <= _ENOUGH * fresh:
            break
        irradiance = fresh
        change = replace(graded, lights=_lights(layers, look, irradiance))
    return change


def _lights(layers, look, irradiance):
    """Place the lights of a look in a map whose sky has an irradiance."""
    placed = no_change(layers).lights
    if not look.lights:
        return {i: replace(light, flux=np.zeros(3)) for i, light in placed.items()}
    own = layers.lights
    roles = looks.roles(layers)
    spare = iter(range(own.own, own.count))
    width = layers.whole[1]
    for role, light in look.lights.items():
        toward = look.toward(role)
        flux = irradiance * 2.0**light.flux * np.asarray(light.tint)
        if role in roles:
            # ---- The map's own light, as far as its glow allows
            i = roles[role]
            log_size = math.log(max(light.radius, looks.smallest(width)) / looks.radius(layers, i))
            placed[i] = Placed(toward, np.minimum(flux, MOST_GLOW * own.flux[i]), log_size)
            flux = flux - placed[i].flux
        if flux.max() > 0 and (i := next(spare, None)) is not None:
            size = max(light.radius / _GAUSSIAN_97, ADDED_DEGREES)
            placed[i] = Placed(toward, flux, math.log(size / layer_lights.LOBE_DEGREES))
    return placed


def blended(start: Change, end: Change, amount: float) -> Change:
    """Return the change between two of the same map; a light that only one has fades."""
    lights = {}
    for i in start.lights.keys() | end.lights.keys():
        first = start.lights.get(i) or _dark(i, start.lights, end.lights)
        second = end.lights.get(i) or _dark(i, end.lights, start.lights)
        way = rotation_between(first.direction, second.direction)
        toward = rotated(first.direction, amount * way) if way.any() else second.direction
        both = (first.flux > 0) & (second.flux > 0)
        log_first, log_second = np.log(np.where(both, [first.flux, second.flux], 1))
        geometric = np.exp(_mix(log_first, log_second, amount))
        flux = np.where(both, geometric, _mix(first.flux, second.flux, amount))
        lights[i] = Placed(toward, flux, _mix(first.log_size, second.log_size, amount))
    return Change(
        lights,
        _mix(start.gain, end.gain, amount),
        _mix(start.log_saturation, end.log_saturation, amount),
        _mix(start.white_balance, end.white_balance, amount),
    )


def _dark(i, own, others):
    """Return a light that only ``others`` have, without flux: where the one of ``own`` is that it adds to."""
    light = others[i]
    same = [j for j in own if j in others and others[j].direction is light.direction]
    return replace(light, direction=own[same[0]].direction if same else light.direction, flux=np.zeros(3))


def _mix(start, end, amount):
    return (1 - amount) * start + amount * end


# ---- From a change to the parameters of layers -------------------------------------------------------------


def parameters(layers: Layers, change: Change) -> dict:
    """Return the layers' parameters of a change."""
    still = layers.start()
    values = {name: still[name].numpy().copy() for name in ("turn", "flux", "size")}
    scales = layers.scales
    own = layers.lights
    for i, light in change.lights.items():
        ratio = np.maximum(light.flux, 1e-30) / np.maximum(own.flux[i], 1e-30)
        log_flux = np.where(light.flux > 0, np.log(ratio), layer_lights.DARK)
        log_flux[light.flux == own.flux[i]] = 0
        values["flux"][i] = np.maximum(log_flux, layer_lights.DARK) / scales["flux"]
        values["size"][i] = light.log_size / scales["size"]
        if not np.allclose(light.direction, own.centres[i], atol=1e-9):
            turn = rotation_vector(own.centres[i], light.direction)
            values["turn"][i] = turn / scales["turn"]
    params = still | {name: tensor(value) for name, value in values.items()}
    if change.log_saturation:
        params["saturation"] = tensor(np.full((1, 1), change.log_saturation / scales["saturation"]))
    if change.gain.any() or change.white_balance.any():
        level = len(layers.gain.sizes) - 1
        params[f"gain.{level}"] = tensor(_nodes(layers, change, level))
    else:
        params = {name: value for name, value in params.items() if not name.startswith("gain.")}
    return params


def _nodes(layers, change, level):
    """Return the nodes of a grid of the gain whose splines make the gain of a change."""
    rows, columns = layers.gain.sizes[level]
    stops = looks.harmonics(layers.gain.directions(level)) @ change.gain
    stops = stops[:, None] + change.white_balance
    field = (math.log(2) * stops).reshape(rows, columns, 3)
    # A spline has at a node 3/4 of it and 1/8 of each neighbour: a first correction of that blur.
    inner = np.pad(field, ((1, 1), (0, 0), (0, 0)), mode="edge")
    blurred = 0.75 * field + 0.125 * (inner[:-2] + inner[2:])
    blurred = 0.75 * blurred + 0.125 * (np.roll(blurred, 1, axis=1) + np.roll(blurred, -1, axis=1))
    nodes = 2 * field - blurred
    for row in layers.gain.poles:
        nodes[row] = nodes[row].mean(axis=0)
    return (nodes / layers.gain.scales()[f"gain.{level}"]).astype(np.float32)
