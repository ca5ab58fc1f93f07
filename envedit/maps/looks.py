"""Looks: what an edit did to the light of a map, apart from the map (``look.toml``).

A look has lights by role, and what was done to the sky. The key light is the one with most flux; the rim is
the strongest one behind, more than :data:`RIM_DEGREES` of azimuth from the key; the fill is the strongest of
the others. Fluxes are in stops over the irradiance of the horizontal plane by the sky, the map without its
lights: a look means the same for a map of any exposure. The sky's change is a smooth gain, a saturation and a
white balance, of what lights do not do to it.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from envedit.config.toml import parsed, quote
from envedit.config.validators import Check, Number, Numbers, named
from envedit.core import atomic_files, latlong
from envedit.core.color import LUMINANCE, luminance
from envedit.core.errors import ConfigError, InputError
from envedit.core.types import FilePath
from envedit.export import light_list
from envedit.representations.layers import below_horizon
from envedit.representations.layers.aureoles import ground_irradiance
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.placed_lights import angles, direction

ROLES = ("key", "fill", "rim")
RIM_DEGREES = 120.0
"""Azimuth from the key light beyond which a light is a rim. Not measured."""
LEAST_SHARE = 1 / 8
"""Least flux of fill and rim over the key's: edges of clouds are below it. Not measured."""
RIDGE = 1e-3
"""Weight of the squared coefficients beside the mean squared misfit: keeps a gain that the sky does not
determine at 0, and takes less than 1 % from a coefficient of an even one."""
FAINTEST = 1e-3
"""Radiance over the sky's mean that is added before logarithms: black ground has no gain. Not measured."""
MOST_STOPS = 16.0
"""Most stops that a gain, a white balance or a flux may have. Derived: e^12 of the gain is 17 stops."""
MOST_COEFFICIENT = 100.0
"""Largest coefficient of a gain. Derived: of an even gain of MOST_STOPS it is 57."""
_CHANNEL = 1e-2  # least channel over its luminance in logarithms
_VARIES = 1e-4  # least variance of log chroma from which its slope is known


@dataclass(frozen=True)
class RoleLight:
    """A light of a look."""

    # azimuth, elevation: degrees in the map; of fill and rim, over the key's
    azimuth: float
    elevation: float
    flux: float  # stops over the sky's irradiance
    radius: float  # degrees within which 97 % of its flux lie; 0: at most :func:`.smallest`, as a sun
    tint: tuple[float, float, float]  # its colour, of luminance 1


@dataclass(frozen=True)
class Look:
    """What an edit did to the light."""

    turn: float = 0.0  # degrees by which the whole map was turned (:func:`.latlong.rotate`); 0: it stood
    # (9,), coefficients of :func:`harmonics`: stops of the sky's luminance
    gain: np.ndarray = field(default_factory=lambda: np.zeros(9))
    saturation: float = 1.0  # exponent of the sky's chroma, as of :mod:`.saturation`
    # stops of the sky's red, green and blue beside those of its luminance
    white_balance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lights: dict[str, RoleLight] = field(default_factory=dict)  # by role; without a key light there is none

    def toward(self, role: str) -> np.ndarray:
        """Return the direction (3,) of a light in the map."""
        light, key = self.lights[role], self.lights["key"]
        if role == "key":
            return direction(light.azimuth, light.elevation)
        elevation = min(max(key.elevation + light.elevation, -90.0), 90.0)
        return direction(key.azimuth + light.azimuth, elevation)


# ---- Measuring ---------------------------------------------------------------------------------------------


def harmonics(d: np.ndarray) -> np.ndarray:
    """Evaluate the real spherical harmonics up to order 2 at directions.

    Y_0, then y, z, x, then xz, xy, yz, 3 y^2 - 1 and x^2 - z^2, orthonormal on the sphere, with the values of
    the mirrored direction below the horizon. ``d`` (..., 3) are unit vectors, +y up; returns (..., 9).
    """
    x, y, z = d[..., 0], np.abs(d[..., 1]), d[..., 2]
    first = 0.5 * math.sqrt(3 / math.pi)
    second = 0.5 * math.sqrt(15 / math.pi)
    bands = [np.full_like(x, 0.5 / math.sqrt(math.pi)), first * y, first * z, first * x]
    bands += [second * x * z, second * x * y, second * y * z]
    bands += [0.25 * math.sqrt(5 / math.pi) * (3 * y**2 - 1), 0.5 * second * (x**2 - z**2)]
    return np.stack(bands, axis=-1)


def layers_of(envmap: np.ndarray, aureole: np.ndarray | None = None) -> Layers:
    """Separate a map (H, W, 3) as looks are measured and applied; ``aureole`` is the glow of added lights."""
    kind: Any = below_horizon.kind_of(envmap)
    return Layers.of(envmap, horizon=kind, aureoles=False if aureole is None else aureole)


def sky_irradiance(layers: Layers, sky: np.ndarray) -> float:
    """Return the luminance of the irradiance of level ground by a sky (rows, W, 3) without lights."""
    return float(luminance(ground_irradiance(sky[: layers.shape[0]], layers.rows)))


def smallest(width: int) -> float:
    """Return the radius in degrees up to which a light of a map so wide may be a sun: two texels."""
    return 2 * 360 / width


def roles(layers: Layers) -> dict[str, int]:
    """Return the index of the light of each role in a map."""
    own = layers.lights.own
    flux = layers.lights.flux[:own] @ LUMINANCE
    if not own or not flux.max() > 0:
        return {}
    key, *others = np.argsort(-flux, kind="stable").tolist()
    indices = {"key": key}
    for i in (i for i in others if flux[i] >= LEAST_SHARE * flux[key]):
        apart = angles(layers.lights.centres[i])[0] - angles(layers.lights.centres[key])[0]
        behind = abs((apart + 180) % 360 - 180) > RIM_DEGREES
        indices.setdefault("rim" if behind else "fill", i)
    return indices


def radius(layers: Layers, i: int) -> float:
    """Return the radius in degrees of a light of the map, at least :func:`smallest`."""
    most = light_list.radii(layers.separation.lights[i], (layers.rows[1], layers.whole[1]))[1]
    return max(most, smallest(layers.whole[1]))


def lights_of(layers: Layers) -> dict[str, RoleLight]:
    """Describe the lights of a map by their roles."""
    sky = sky_irradiance(layers, layers.base)
    described: dict[str, RoleLight] = {}
    indices = roles(layers) if sky > 0 else {}
    places = {role: angles(layers.lights.centres[i]) for role, i in indices.items()}
    for role, i in indices.items():
        azimuth, elevation = places[role]
        if role != "key":
            azimuth = (azimuth - places["key"][0] + 180) % 360 - 180
            elevation -= places["key"][1]
        flux = layers.lights.flux[i]
        light = float(flux @ LUMINANCE)
        size = radius(layers, i)
        described[role] = RoleLight(
            azimuth,
            elevation,
            float(np.clip(np.log2(light / sky), -MOST_STOPS, MOST_STOPS)),
            min(size, 90.0) if size > smallest(layers.whole[1]) else 0.0,
            tuple((flux / light).tolist()),
        )
    return described


def sky_change(before: np.ndarray, after: np.ndarray, weight: np.ndarray, total: int) -> tuple:
    """Measure the gain, the saturation and the white balance of :class:`Look` between two skies.

    ``before`` and ``after`` (rows, W, 3) are linear radiance of the first rows of a map of ``total`` rows,
    without its lights; ``weight`` (rows, W) is how much each texel counts.
    """
    rows, columns = weight.shape
    weight = (weight / max(weight.sum(), 1e-300)).ravel()
    skies = [np.float64(sky).reshape(-1, 3) for sky in (before, after)]
    light = [sky @ LUMINANCE for sky in skies]
    mean = float(weight @ light[0])
    if not (mean > 0 and weight @ light[1] > 0):
        return np.zeros(9), 1.0, (0.0, 0.0, 0.0)

    # ---- Gain: weighted least squares of the change of log luminance
    change = np.log2((light[1] + FAINTEST * mean) / (light[0] + FAINTEST * mean))
    basis = harmonics(latlong.directions(total, columns)[:rows].reshape(-1, 3))
    normal = (basis * weight[:, None]).T @ basis + RIDGE / (4 * np.pi) * np.eye(9)
    moment = basis.T @ (weight * np.clip(change, -MOST_STOPS, MOST_STOPS))
    gain = np.clip(np.linalg.solve(normal, moment), -MOST_COEFFICIENT, MOST_COEFFICIENT)

    # ---- Saturation and white balance: log chroma after = balance + saturation * log chroma before
    chroma = [
        np.log2(np.maximum(sky / np.maximum(luminances, 1e-30)[:, None], _CHANNEL))
        for sky, luminances in zip(skies, light, strict=True)
    ]
    mean_before, mean_after = (weight @ log_chroma for log_chroma in chroma)
    apart = chroma[0] - mean_before
    variance = float(weight @ np.square(apart).sum(axis=1))
    saturation = 1.0
    if variance > _VARIES:
        covariance = float(weight @ (apart * (chroma[1] - mean_after)).sum(axis=1))
        saturation = min(max(covariance / variance, 0.0), 4.0)
    balance = np.clip(mean_after - saturation * mean_before, -MOST_STOPS, MOST_STOPS)
    return gain, saturation, tuple(balance.tolist())


# ---- Files -------------------------------------------------------------------------------------------------

_STOPS = Number(-MOST_STOPS, MOST_STOPS)
_NUMBERS: dict[str, Check] = {
    "turn": Number(-360, 360),
    "saturation": Number(0, 4),
    "white_balance": Numbers(*3 * [_STOPS]),
    "gain": Numbers(*9 * [Number(-MOST_COEFFICIENT, MOST_COEFFICIENT)]),
}
_LIGHT: dict[str, Check] = {
    "azimuth": Number(-360, 360),
    "elevation": Number(-180, 180),
    "flux": _STOPS,
    "radius": Number(0, 90),
    "tint": Numbers(*3 * [Number(0, 1000)]),
}
"""What each key may be."""


def to_toml(look: Look) -> str:
    """Write a look as TOML."""
    lines = [
        "# What an edit did to the light. To do it to other maps: envedit apply look.toml MAP ...",
        f"turn = {_short(look.turn)}  # degrees by which the sky was turned",
        f"saturation = {_short(look.saturation)}",
        f"white_balance = {_short(look.white_balance)}  # stops of red, green, blue",
        f"gain = {_short(look.gain)}  # stops, spherical harmonics to order 2",
    ]
    for role, light in look.lights.items():
        lines += ["", f"[{role}]"]
        lines += [f"{name} = {_short(getattr(light, name))}" for name in _LIGHT]
    return "\n".join(lines) + "\n"


def _short(value):
    values = [float(f"{number:.6g}") + 0.0 for number in np.ravel(value)]
    return quote(values if np.ndim(value) else values[0])


def write(path: FilePath, look: Look) -> None:
    """Write a look to a file."""
    atomic_files.write_atomically(path, to_toml(look).encode())


def read(path: FilePath) -> Look:
    """Read a look.

    ConfigError names the file and the key that is missing, unknown or out of range; InputError if the file
    cannot be read.
    """
    try:
        with atomic_files.opened(path) as file:
            return parse(file.read().decode(), os.fsdecode(path))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not TOML: {error}") from None


def parse(text: str, path: str) -> Look:
    """Read a look from the text of a file; ConfigError as of :func:`read`."""
    table = parsed(text, path)
    lights = {role: table.pop(role) for role in ROLES if role in table}
    values = _numbers(path, "", table, _NUMBERS)
    if lights and "key" not in lights:
        raise ConfigError(f"{path}: {next(iter(lights))}: needs a key light beside it: add the table [key]")
    described = {}
    for role, keys in lights.items():
        if not isinstance(keys, dict):
            raise ConfigError(f"{path}: {role}: got {keys!r}, expected a table [{role}]")
        light = RoleLight(**_numbers(path, f"{role}.", keys, _LIGHT))
        if not np.asarray(light.tint) @ LUMINANCE > 0:
            raise ConfigError(f"{path}: {role}.tint: got black, expected a colour")
        described[role] = light
    if "key" in described and abs(described["key"].elevation) > 90:
        raise ConfigError(f"{path}: key.elevation: got {described['key'].elevation:g}, expected -90 to 90")
    gain = np.array(values.pop("gain"))
    return Look(gain=gain, lights=described, **values)


def _numbers(path, prefix, table, expected):
    """Check that a table has the expected keys, with such numbers."""
    for name in table:
        if name not in expected:
            raise ConfigError(f"{path}: {prefix}{name}: unknown key, expected {', '.join(expected)}")
    for name in expected:
        if name not in table:
            raise ConfigError(f"{path}: {prefix}{name}: missing")
    values = {name: named(f"{path}: {prefix}{name}", expected[name], table[name]) for name in expected}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
