"""Lights of a map that are moved, changed or added by hand, before any edit: ``[[input.lights]]``.

Lights of the map move as :mod:`.layers` moves them, with their glow. A light that is added has a shape
(:func:`profile`), and its sum over the texels' solid angles is its flux.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from envedit.config.list_schema import LIGHT_SHAPES
from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.color import LUMINANCE
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.resampling import smooth_step
from envedit.core.rotations import rotation_vector
from envedit.images import map_regions
from envedit.representations.layers import below_horizon, light_images
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK, log_flux_of
from envedit.representations.layers.unseen import unseen_kept

ADDED_LEAST_TEXELS = 0.6
"""Least standard deviation of an added light in texels: a narrower one would vanish between them. Not
measured."""
GAUSSIAN_REACH = 5.0
"""Standard deviations at which a Gaussian light ends, at 4e-6 of its peak."""
ROWS = 128
"""Rows of a map that are worked on at a time: some 100 MB of a map 8192 texels wide."""


class ByHand(NamedTuple):
    """A map that was changed by hand, before it is rotated."""

    envmap: np.ndarray  # (H, W, 3) float32
    locked: np.ndarray | None = None  # (H, W, 3), what of it is of locked lights; None: none is locked
    kept: np.ndarray | None = None  # (H, W), how far it is kept, 0 to 1; None: nowhere


class PlacedLights:
    """A map whose lights can be placed anew.

    ``envmap`` (H, W, 3) float32 is linear radiance, finite and not negative; ``horizon`` what rows below the
    horizon do, as of :class:`.Layers`, or "auto". ``layers`` is the separated map, ``lights`` are its lights,
    those with most flux first: ``light = 1`` is the first.
    """

    def __init__(self, envmap: np.ndarray, horizon: str = "auto"):
        self.envmap = envmap
        self.layers = Layers.of(envmap, horizon=below_horizon.treatment(horizon, "all", envmap))
        self._still = self.layers.start()
        self.lights = self.layers.separation.lights

    def params(self, placed: Sequence[dict]) -> dict:
        """Return the layers' parameters of entries of :func:`.list_schema.LightList`; others are left out.

        An entry of a light that the map does not have does nothing.
        """
        values = {name: self._still[name].numpy().copy() for name in ("turn", "flux", "size")}
        scales = self.layers.scales
        for light in placed:
            i = light.get("light", 0) - 1
            if not 0 <= i < len(self.lights):
                continue
            values["flux"][i] = log_flux_of(flux_of(light)) / scales["flux"]
            values["size"][i] = np.log(light["size"]) / scales["size"]
            if "azimuth" in light:
                end = direction(light["azimuth"], light["elevation"])
                turn = rotation_vector(self.layers.lights.centres[i], end)
                values["turn"][i] = turn / scales["turn"]
        return self._still | {name: tensor(value) for name, value in values.items()}

    def place(self, placed: Sequence[dict]) -> np.ndarray:
        """Return the map with its lights placed, (H, W, 3) float32.

        InputError where a texel becomes brighter than :data:`.radiance.BRIGHTEST`.
        """
        envmap = self.envmap
        if any("light" in light for light in placed):
            envmap = unseen_kept(envmap, self._moved(placed))
        envmap = add(envmap, [light for light in placed if "light" not in light])
        require_radiance(envmap, "input.lights", brightest=BRIGHTEST)
        return envmap

    def _moved(self, placed):
        """Return the map with its own lights as entries place them."""
        params = self.params(placed)
        lights = {name: value for name, value in params.items() if not name.startswith("gain.")}
        sky, core = (part.numpy() for part in self.layers.parts(lights))

        # ---- Points of lights that have grown lie apart in rows too, and are as wide as that there
        scales = self.layers.scales
        turn, log_flux, log_size = (lights[name].numpy() * scales[name] for name in ("turn", "flux", "size"))
        grown = [i for i, (size,) in enumerate(log_size) if size > 0]
        if grown:
            others = log_flux.copy()
            others[grown] = DARK
            _, core = self.layers.parts(lights | {"flux": tensor(others / scales["flux"])})
            core = core.numpy()
        for i in grown:
            size = float(log_size[i, 0])
            core += self.layers.cores_of(i, [(turn[i], log_flux[i], size)], half_row=float(np.exp(size)))[0]
        return sky + core

    def locking(self, placed: Sequence[dict], kept: np.ndarray | None) -> tuple[dict, ...]:
        """Return the entries, with those lights locked that stand where the map is kept, (H, W).

        A light of the map without an entry gets one.
        """
        if kept is None:
            return tuple(placed)
        named = {light["light"] for light in placed if "light" in light}
        own = [{"light": i + 1, "flux": [1.0] * 3, "size": 1.0} for i in range(len(self.lights))]
        unnamed = [light for light in own if light["light"] not in named and self._stands_in(kept, light)]
        given = [light | {"locked": True} if self._stands_in(kept, light) else light for light in placed]
        return (*given, *(light | {"locked": True} for light in unnamed))

    def _stands_in(self, kept, light):
        """Return whether the light of an entry stands where the map is kept; it may not have that light."""
        if "azimuth" in light:
            toward = direction(light["azimuth"], light["elevation"])
        elif light["light"] <= len(self.lights):
            toward = self.lights[light["light"] - 1].direction
        else:
            return False
        row, column = (round(float(v)) for v in latlong.texel_position(toward, *kept.shape))
        return kept[row, column % kept.shape[1]] >= map_regions.KEPT_SHARE

    def by_hand(self, placed: Sequence[dict], regions: Sequence[dict]) -> ByHand:
        """Place lights, then change regions; a light in a region that is kept is locked.

        Errors are those of :meth:`place` and :func:`.map_regions.changed`.
        """
        kept = map_regions.kept(regions, *self.envmap.shape[:2])
        placed = self.locking(placed, kept)
        envmap = map_regions.changed(self.place(placed), regions)
        others = without_locked(placed)
        if others is None:
            return ByHand(envmap, None, kept)
        dark = map_regions.changed(self.place(others), regions)
        return ByHand(envmap, np.maximum(envmap - dark, 0), kept)


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

    A light's radiance is flux g / sum(Y(g) omega), with g its :func:`profile`, Y luminance and omega the
    solid angles by which Mitsuba looks texels up. InputError if an image of one cannot be used.
    """
    if not added:
        return envmap
    height, width, _ = envmap.shape
    radiance = envmap.astype(np.float32)
    omega = latlong.lookup_solid_angles(height, width)[:, None]
    texel = max(np.pi / max(height - 1, 1), 2 * np.pi / width)
    elevations = 90 - np.linspace(0, 180, height)
    for light in added:
        reach = GAUSSIAN_REACH * light["size"] + np.degrees(3 * texel)  # the widest of all shapes
        near = np.flatnonzero(np.abs(elevations - light["elevation"]) < reach)
        bands = [slice(row, min(row + ROWS, near[-1] + 1)) for row in range(near[0], near[-1] + 1, ROWS)]
        shapes = [profile(light, latlong.directions(height, width, band), texel) for band in bands]
        parts = [(shape @ LUMINANCE) * omega[band] for shape, band in zip(shapes, bands, strict=True)]
        total = float(sum(part.sum() for part in parts))
        for shape, band in zip(shapes, bands, strict=True):
            with np.errstate(over="ignore"):
                radiance[band] += (shape * (flux_of(light) / total)).astype(np.float32)
    return radiance


def profile(light: dict, toward: np.ndarray, texel: float) -> np.ndarray:
    """Return the radiance of an added light, its luminance 1 at its brightest, in directions (..., 3).

    Shapes lie in the azimuthal equidistant projection around the light's direction, x to larger azimuths and
    y up, both turned by ``rotation``: a disc of 90 degrees is a half dome. With a = ``size`` half of the
    longer side, b = ``aspect`` a half of the shorter one, and d(x, y) the distance inwards from a border,

        g = 3 t^2 - 2 t^3,    t = clip(1/2 + d / max(2 softness c, texel), 0, 1),

    where c is the largest d. A "rectangle" is the product of such g across both pairs of sides, a "gradient"
    the rectangle times a ramp along y, a "gaussian" exp(-(x/a)^2 / 2 - (y/b)^2 / 2), an "image" the rectangle
    of the image's sides times the image (:func:`.light_images.sampled`).

    Returns (..., 3). ``light`` is without the key ``light``, as of :func:`.list_schema.LightList`;
    ``toward`` are unit vectors in the frame of the map, and ``texel`` is the spacing of the texels in
    radians: the least width of a border, and about the least of a light.
    """
    shape = light.get("shape", "gaussian")
    wide, high = light_images.shares(light["image"]) if shape == "image" else (1.0, 1.0)
    aspect = light.get("aspect", LIGHT_SHAPES[shape] or min(wide, high))

    # ---- Coordinates in radians along the sides
    azimuth, rotation = np.radians([light["azimuth"], light.get("rotation", 0)])
    centre = direction(light["azimuth"], light["elevation"])
    east = np.array([np.cos(azimuth), 0.0, np.sin(azimuth)])
    up = np.cross(east, centre)
    across = toward @ (np.cos(rotation) * east + np.sin(rotation) * up)
    along = toward @ (np.cos(rotation) * up - np.sin(rotation) * east)
    sine = np.hypot(across, along)
    stretch = np.arctan2(sine, toward @ centre) / np.maximum(sine, 1e-12)
    x, y = stretch * across, stretch * along
    sides = (1.0, aspect) if wide >= high else (aspect, 1.0)
    a, b = (np.radians(light["size"]) * part for part in sides)

    # ---- The Gaussian has no border
    if shape == "gaussian":
        least = ADDED_LEAST_TEXELS * texel
        radius = np.hypot(x / max(a, least), y / max(b, least))
        return _grey(np.where(radius < GAUSSIAN_REACH, np.exp(-0.5 * radius**2), 0.0))

    # ---- The others have one as wide as asked for, and no narrower than a texel
    a, b = max(a, texel / 2), max(b, texel / 2)
    middle = b / 4 if shape == "ring" else min(a, b)

    def inside(distance):
        return smooth_step(0.5 + distance / max(2 * light.get("softness", 0) * middle, texel))

    if shape in ("disc", "ring"):
        radius = np.hypot(x / a, y / b)
        slope = np.hypot(x / a**2, y / b**2)
        unit = np.where(radius > 0, radius / np.maximum(slope, 1e-12), b)  # of the radius, in radians
        hole = (radius - 0.5) * unit if shape == "ring" else np.inf
        return _grey(inside(np.minimum((1 - radius) * unit, hole)))
    if shape == "strip":
        return _grey(inside(b - np.hypot(np.maximum(np.abs(x) - (a - b), 0), y)))
    rectangle = _grey(inside(a - np.abs(x)) * inside(b - np.abs(y)))
    if shape == "image":
        u, v = 0.5 + 0.5 * x / a, 0.5 - 0.5 * y / b
        return rectangle * light_images.sampled(light["image"], u, v, texel / (2 * max(a, b)))
    return rectangle * _grey(np.clip(0.5 + 0.5 * y / b, 0, 1)) if shape == "gradient" else rectangle


def _grey(values):
    """Give values (...) three channels that are the same."""
    return np.repeat(values[..., None], 3, axis=-1)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector (3,) of degrees: azimuth 0 is -z and 90 is +x, the elevation's 90 is +y."""
    azimuth, elevation = np.radians([azimuth, elevation])
    across = np.cos(elevation)
    return np.array([across * np.sin(azimuth), np.sin(elevation), -across * np.cos(azimuth)])


def angles(toward: np.ndarray) -> tuple[float, float]:
    """Return azimuth in [0, 360) and elevation in degrees of a direction (3,)."""
    x, y, z = (float(v) for v in toward)
    return float(np.degrees(np.arctan2(x, -z)) % 360), float(np.degrees(np.arctan2(y, np.hypot(x, z))))
