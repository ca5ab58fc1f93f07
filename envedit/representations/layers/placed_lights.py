"""Lights of a map that are moved, changed or added by hand, before any edit: ``[[input.lights]]``.

Lights of the map move as :mod:`.layers` moves them, with their glow. A light that is added is a lobe: its
radiance falls off as a Gaussian of the angle, and its sum over the texels' solid angles is its flux.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.rotations import rotation_vector
from envedit.representations.layers import below_horizon
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK
from envedit.representations.layers.unseen import unseen_kept

ADDED_LEAST_TEXELS = 0.6
"""Least standard deviation of an added light in texels: a narrower one would vanish between them. Not
measured."""


class PlacedLights:
    """A map whose lights can be placed anew.

    Parameters
    ----------
    envmap : ndarray (H, W, 3) float32
        Linear radiance, finite and not negative.
    horizon : str
        What rows below the horizon do, as of :class:`.Layers`, or "auto".

    Attributes
    ----------
    layers : Layers
        The separated map.
    lights : list of Light
        Its lights, those with most flux first: ``light = 1`` is the first.
    """

    def __init__(self, envmap: np.ndarray, horizon: str = "auto"):
        self.envmap = envmap
        kind: Any = below_horizon.kind_of(envmap) if horizon == "auto" else horizon
        self.layers = Layers.of(envmap, horizon=kind)
        self._still = self.layers.start()
        self.lights = self.layers.separation.lights

    def params(self, placed: Sequence[dict]) -> dict:
        """Return the layers' parameters of entries of :func:`.light_schema.LightList`; others are left out.

        An entry of a light that the map does not have does nothing.
        """
        values = {name: self._still[name].numpy().copy() for name in ("turn", "flux", "size")}
        scales = self.layers.scales
        for light in placed:
            i = light.get("light", 0) - 1
            if not 0 <= i < len(self.lights):
                continue
            flux = np.maximum(flux_of(light), 1e-30)
            values["flux"][i] = np.maximum(np.log(flux), DARK) / scales["flux"]
            values["size"][i] = np.log(light["size"]) / scales["size"]
            if "azimuth" in light:
                end = direction(light["azimuth"], light["elevation"])
                turn = rotation_vector(self.layers.lights.centres[i], end)
                values["turn"][i] = turn / scales["turn"]
        return self._still | {name: tensor(value) for name, value in values.items()}

    def place(self, placed: Sequence[dict]) -> np.ndarray:
        """Return the map with its lights placed, (H, W, 3) float32.

        Raises
        ------
        InputError
            A texel becomes brighter than :data:`.radiance.BRIGHTEST`.
        """
        envmap = self.envmap
        if any("light" in light for light in placed):
            params = self.params(placed)
            lights = {name: value for name, value in params.items() if not name.startswith("gain.")}
            envmap = unseen_kept(envmap, self.layers.decode(lights).numpy())
        envmap = add(envmap, [light for light in placed if "light" not in light])
        require_radiance(envmap, "input.lights", brightest=BRIGHTEST)
        return envmap

    def locked(self, placed: Sequence[dict]) -> np.ndarray | None:
        """Return what locked lights add to the placed map, (H, W, 3) float32; None where none is locked."""
        others = without_locked(placed)
        return None if others is None else np.maximum(self.place(placed) - self.place(others), 0)


def flux_of(light: dict) -> np.ndarray:
    """Return the flux of an entry (3,), 0 of a muted one; in its units."""
    return np.zeros(3) if light.get("muted") else np.array(light["flux"], np.float64)


def without_locked(placed: Sequence[dict]) -> tuple[dict, ...] | None:
    """Return the entries with locked lights muted; None where none is locked."""
    if not any(light.get("locked") for light in placed):
        return None
    return tuple(light | {"muted": True} if light.get("locked") else light for light in placed)


def missing(placed: Sequence[dict], count: int) -> list[int]:
    """List the numbers of placed lights that a map of ``count`` lights does not have."""
    return sorted(light["light"] for light in placed if light.get("light", 0) > count)


def add(envmap: np.ndarray, added: Sequence[dict]) -> np.ndarray:
    """Add lights to a map (H, W, 3) of any resolution.

    A light's radiance is flux g / sum(g omega), with g = exp(-angle^2 / (2 size^2)) and omega the solid
    angles by which Mitsuba looks texels up.
    """
    if not added:
        return envmap
    height, width, _ = envmap.shape
    radiance = envmap.astype(np.float64)
    omega = latlong.lookup_solid_angles(height, width)[:, None]
    toward = latlong.directions(height, width)
    for light in added:
        size = max(np.radians(light["size"]), ADDED_LEAST_TEXELS * np.pi / max(height - 1, 1))
        cosine = toward @ direction(light["azimuth"], light["elevation"])
        angle = np.arccos(np.clip(cosine, -1, 1))
        lobe = np.where(angle < 5 * size, np.exp(-0.5 * (angle / size) ** 2), 0.0)
        total = float((lobe * omega).sum())
        if total > 0:
            radiance += (lobe / total)[..., None] * flux_of(light)
    with np.errstate(over="ignore"):
        return radiance.astype(np.float32)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector (3,) of degrees: azimuth 0 is -z and 90 is +x, the elevation's 90 is +y."""
    azimuth, elevation = np.radians([azimuth, elevation])
    across = np.cos(elevation)
    return np.array([across * np.sin(azimuth), np.sin(elevation), -across * np.cos(azimuth)])


def angles(toward: np.ndarray) -> tuple[float, float]:
    """Return azimuth in [0, 360) and elevation in degrees of a direction (3,)."""
    x, y, z = (float(v) for v in toward)
    return float(np.degrees(np.arctan2(x, -z)) % 360), float(np.degrees(np.arctan2(y, np.hypot(x, z))))
