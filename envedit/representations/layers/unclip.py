"""The flux of a clipped sun, estimated, and a disc with it put in its place.

Two estimates of the flux F (irradiance on a surface that faces the sun, luminance) are averaged:

- the **aureole**: log2 F = log2 L(a) - A(a) - 6.1 h(m), with L(a) the luminance at the first angle a outside
  the clipped region and A(a) what clear suns have there (:data:`AUREOLE`);
- the **sky**: log2 F = log2 E_sky + log2 (F / E_sky of the analytic sky at this elevation) + c(m).

h(m) runs from 0 to 1 with the air mass m (Kasten and Young 1989) as haze takes the light of low suns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.core.errors import ConfigError
from envedit.images import analytic_sky
from envedit.representations.layers.clipped_light import (
    CLEAR_CONTRAST,
    CORE_DEGREES,
    PLATEAU,
    RING_DEGREES,
    ClippedLight,
    find,
)

AUREOLE = np.array([3.96, 2.51, 1.22, 0.43, -0.28, -0.96, -1.56, -2.02, -2.52, -2.83, -3.19, -3.73, -4.47])
"""log2 of a clear sun's aureole over its flux, 1/sr, at the first of :data:`.RING_DEGREES`: mean of three.
Measured by ``python -m experiments unclip.constants run``, as all that is called measured here."""
HAZE_STOPS = 6.1
"""Stops by which the flux of a low sun is less than the aureole says: mean of two, measured."""
SKY_OFFSET = (-0.33, -6.27)
"""Stops by which flux over sky is more than in the analytic model, of clear and of low suns, measured."""
HAZE_AIR_MASS = (3.0, 7.0)
"""Air masses of a clear sun at 18 degrees and of a hazy one at 7.5, between which haze sets in linearly. Not
measured: there is no map between."""
TURBIDITY = 3.0
"""Of the analytic model: a clear day."""
NEAR_DEGREES = 2.0
"""Up to here the aureole has the sun's colour and is mostly the lens' glare, by which flux is
known better."""
AUREOLE_STOPS = (0.85, 1.13)
"""Standard deviation of the first estimate, with the first ring near and far: RMS over clear suns, each by
the constants of the others, measured."""
SKY_STOPS = 1.2
"""Standard deviation of the second estimate, likewise."""
FLUX_STOPS = (0.8, 1.1, 2.0)
"""Standard deviation of the result: near and far, likewise; of a low sun more than the 0.7 that the
two maps show, as two are few."""
LEAST_GAIN = 1.0
"""Stops that the sun must gain: with less it was not clipped, or not by more than the estimate's error."""
LEAST_ELEVATION = 0.5
"""Degrees below which a sun's flux does not follow from its horizontal irradiance: more than half is set."""


@dataclass(frozen=True)
class Estimate:
    """Flux of a sun."""

    flux: np.ndarray  # (3,), irradiance on a surface that faces it, linear RGB
    stops: float  # standard deviation of log2 of it


def air_mass(elevation: float) -> float:
    """Return the relative optical air mass at an elevation in degrees (Kasten and Young 1989, Eq. 3)."""
    elevation = max(elevation, 0.0)
    return 1 / (math.sin(math.radians(elevation)) + 0.50572 * (elevation + 6.07995) ** -1.6364)


def analytic_fluxes(elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return flux of the sun and horizontal irradiance of the sky (3,) in the analytic model."""
    width = 128
    elevation = float(np.clip(elevation, 1, 90))
    sky = analytic_sky.sunsky(width, 0, elevation, TURBIDITY, sun_scale=0).astype(np.float64)
    sun = analytic_sky.sunsky(width, 0, elevation, TURBIDITY, sky_scale=0, ground_albedo=0).astype(np.float64)
    omega = latlong.lookup_solid_angles(width // 2, width)[:, None, None]
    cosine = np.maximum(latlong.directions(width // 2, width)[..., 1:2], 0)
    return (sun * omega).sum(axis=(0, 1)), (sky * omega * cosine).sum(axis=(0, 1))


def estimate(light: ClippedLight) -> Estimate:
    """Estimate the flux of a clipped sun, of which a ring is measured."""
    first = min(light.first or 0, len(AUREOLE) - 1)
    near = RING_DEGREES[first] <= NEAR_DEGREES
    haze = _haze(light.elevation)

    # ---- Two estimates of the logarithm, and their mean, weighted by precision
    sun, sky = analytic_fluxes(light.elevation)
    ring = sun if light.first is None else light.rings[light.first]  # clipped all around: the sun's colour
    by_aureole = _log2(luminance(ring)) - AUREOLE[first] - HAZE_STOPS * haze
    by_sky = _log2(luminance(light.sky_irradiance)) + _log2(luminance(sun)) - _log2(luminance(sky))
    by_sky += float(np.interp(haze, (0, 1), SKY_OFFSET))
    precision = np.array([AUREOLE_STOPS[0 if near else 1], SKY_STOPS]) ** -2.0
    if not light.has_aureole:
        precision[0] = 0  # no aureole: of a rendered sky, or of cloud
    stops = float(precision @ [by_aureole, by_sky] / precision.sum())

    # ---- The colour: the aureole's near the sun; farther out it is bluer than the sun
    colour = ring if near else np.sqrt(ring * sun)

    # ---- Its error, also of the elevation: the middle of a large region may be off by half its radius
    spread = FLUX_STOPS[2] if haze > 0 else FLUX_STOPS[0 if near else 1]
    hazes = [_haze(light.elevation + sign * light.radius / 2) for sign in (-1, 1)]
    spread = math.hypot(spread, HAZE_STOPS * (hazes[0] - hazes[1]) / 2)
    return Estimate(2.0**stops * _unit(colour), spread)


def _haze(elevation):
    """Return how far haze takes the light of a sun at an elevation, 0 to 1."""
    return float(np.interp(air_mass(elevation), HAZE_AIR_MASS, (0, 1)))


def with_sun(radiance: np.ndarray) -> tuple[np.ndarray, str]:
    """Return a map (H, W, 3) with its sun, if that was clipped, and what was done, a clause."""
    light = find(radiance)
    if light is None:
        return radiance, "nothing is clipped above the horizon: no sun was added"
    if light.kind != "sun":
        return radiance, f"a {light.kind} is clipped, as {light.reason}: no sun was added"
    sun = estimate(light)
    if not is_clipped(light, sun.flux):
        return radiance, "the sun has the flux that is expected: none was added"
    sentence = f"sun of flux {luminance(sun.flux):.4g} added, standard deviation {sun.stops:.1f} stops"
    return restored(radiance, light, sun.flux), "; ".join(filter(None, [sentence, doubt(light)]))


def doubt(light: ClippedLight) -> str:
    """Return a clause on a sun that may be none, "" for a clear one."""
    if light.kind != "sun" or light.contrast > CLEAR_CONTRAST:
        return ""
    return (
        "the sun is clipped close to the brightness of the sky, where half of such regions are bright cloud"
    )


def is_clipped(light: ClippedLight, flux: np.ndarray) -> bool:
    """Say whether a flux (3,) is enough more than what the map has."""
    return _log2(luminance(flux)) - _log2(light.core_flux) > LEAST_GAIN


def coloured(light: ClippedLight, flux: float) -> np.ndarray:
    """Return a flux (3,) of a luminance in the colour of a light; under a black sky in an analytic sun's."""
    colour = estimate(light).flux
    if not colour.any():
        colour, _ = analytic_fluxes(light.elevation)
    return flux * _unit(colour)


def flux_of_ratio(light: ClippedLight, ratio: float) -> float:
    """Return the flux, luminance, of a sun whose horizontal irradiance is ``ratio`` times the sky's.

    ConfigError if it stands less than :data:`LEAST_ELEVATION` above the horizon.
    """
    if light.elevation < LEAST_ELEVATION:
        raise ConfigError(
            f"--ratio: the light is {light.elevation:.1f} degrees above the horizon, where a sun has no "
            f"horizontal irradiance to speak of: give --flux"
        )
    return ratio * float(luminance(light.sky_irradiance)) / float(light.direction[1])


def restored(radiance: np.ndarray, light: ClippedLight, flux: np.ndarray) -> np.ndarray:
    """Return a map with its sun: the aureole in the clipped region, and a disc.

    The aureole in the region is a power of the angle in each channel: at the region's radius as bright as the
    plateau, at the core as :data:`AUREOLE` has it for this flux. Clipped texels are raised to it, if the
    light has an aureole.
    The disc, 0.54 degrees across, has the flux that the core lacks.

    ``radiance`` (H, W, 3) is the map in which the light has been found, ``flux`` (3,) the irradiance of the
    sun on a surface that faces it. Returns (H, W, 3) float32: all other texels have their bits.
    """
    image = np.array(radiance, np.float32)
    if light.has_aureole and light.radius > CORE_DEGREES:
        _fill(image, light, flux)
    lacking = max(1 - light.core_flux / max(float(luminance(flux)), 1e-300), 0.0)
    radius = math.radians(analytic_sky.SUN_APERTURE / 2)
    points = analytic_sky.disc(light.direction, radius, image.shape[1])
    share = np.broadcast_to(lacking * np.asarray(flux, np.float64) / len(points), points.shape)
    analytic_sky.add_flux(image, points, share)
    return image


def _fill(image, light, flux):
    """Raise clipped texels to the aureole, in place, in bands of rows."""
    height, width, _ = image.shape
    share = 2.0 ** np.interp(np.log(CORE_DEGREES), np.log(RING_DEGREES[: len(AUREOLE)]), AUREOLE)
    core = np.maximum(share * np.asarray(flux, np.float64), light.level)
    exponent = np.log(core / light.level) / math.log(light.radius / CORE_DEGREES)
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    for top in range(0, height, 64):
        rows = np.arange(top, min(top + 64, height))
        theta = np.pi * rows / max(height - 1, 1)
        directions = latlong.on_sphere(theta[:, None], phi)
        angle = np.degrees(np.arccos(np.clip(directions @ light.direction, -1, 1)))
        clipped = (image[rows] >= PLATEAU * light.level).any(axis=2)
        inside = clipped & (angle < light.radius) & (directions[..., 1] > 0)
        factor = (light.radius / np.maximum(angle[inside], CORE_DEGREES))[:, None] ** exponent
        aureole = (factor * light.level).astype(np.float32)
        band = image[top : top + len(rows)]
        band[inside] = np.maximum(band[inside], aureole)


def _unit(colour):
    """Return a colour (3,) of luminance 1."""
    return np.asarray(colour, np.float64) / max(float(luminance(colour)), 1e-300)


def _log2(value):
    """Return log2, of what is 0 that of 1e-300."""
    return math.log2(max(float(value), 1e-300))
