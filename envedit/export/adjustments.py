"""Adjustments of a map that need no target: exposure, white balance, lights made softer and less bright.

They act on the edited map at last, at whatever resolution it is written. Lights are those that
:mod:`.separation` separates from the background; their flux is kept.
"""

from __future__ import annotations

import math

import numpy as np

from envedit import config
from envedit.core import latlong
from envedit.core.errors import NumericalError, counted
from envedit.core.rows import bands
from envedit.representations.layers import file_lights
from envedit.targets.strokes import balance, gains

WIDEST = 60.0
"""Largest radius in degrees over which a light is spread to keep to a bound."""
SPREAD_TEXELS = 24
"""Texels in the radius of a disc that a light is spread over, at most: of a finer map it is spread on a
coarser grid and interpolated, with an error of 1 / (4 24^2), 0.04 %."""
SEARCH_WIDTH = 1024
"""Most columns of the copy on which the radius that keeps to a bound is searched: ten spreads."""
GROWTH = 1.05
"""Factor on that radius while the map at its own resolution is still above the bound."""
_NOTHING = 1e-9  # share of a peak that is rounding of a transform


def adjust(
    envmap: np.ndarray, lights: config.Lights, output: config.Output, scale: float = 1.0
) -> tuple[np.ndarray, list[str]]:
    """Adjust a map: exposure and white balance, then its lights; NumericalError where it leaves float32.

    ``envmap`` (H, W, 3) float32 is linear radiance that reaches the scene, ``scale`` what the scene
    multiplies the map's file by: ``max_radiance`` is in the units of the file. Returns the adjusted map, or
    the map itself where nothing is asked, and what was done.
    """
    colour = output.white_balance or output.temperature
    if not (lights.max_radiance or lights.soften_degrees or output.exposure or colour):
        return envmap, []

    # ---- One factor for each channel
    gain = np.ones(3)
    notes = []
    if output.exposure:
        gain *= 2.0**output.exposure
        notes.append(f"exposure of the map changed by {output.exposure:+g} stops")
    if output.white_balance:
        gain *= balance(output.white_balance)
        notes.append(f"white balance: light of {output.white_balance:g} K becomes neutral")
    if output.temperature:
        gain *= gains(output.temperature)
        notes.append(f"temperature: light of {output.temperature:g} K in place of 6500 K")

    # ---- The map times it, in double precision, some rows at a time
    result = np.empty(envmap.shape, np.float32)
    with np.errstate(over="ignore"):
        for rows in bands(len(envmap)):
            result[rows] = envmap[rows] * gain
    if not np.isfinite(result).all():
        raise NumericalError("the adjusted map leaves float32: lower output.exposure")
    if lights.soften_degrees or lights.max_radiance:
        notes += _soften(result, lights.soften_degrees, lights.max_radiance * scale)
    return result, notes


def spread(core: np.ndarray, degrees: float) -> np.ndarray:
    """Spread every texel over a disc on the sphere, with its flux.

    The disc's radiance falls as 1 - (1 - cos g) / (1 - cos r) with the angle g to its centre. Flux is
    radiance times :func:`.latlong.lookup_solid_angles`; it is kept exactly. A radius of less than a texel
    changes nothing. ``core`` (H, W, 3) is radiance of a light, black elsewhere; ``degrees`` the radius r.
    """
    height, width, _ = core.shape
    across = min(width, 2 * math.ceil(SPREAD_TEXELS * 180 / max(degrees, 1e-3)))
    if across < width:
        coarse = latlong.resize(core, across // 2, across).astype(np.float64)
        result = latlong.resize(_spread(coarse, degrees), height, width)
    else:
        result = _spread(core, degrees)
    result *= flux_ratio(core, result)
    return result


def _spread(core, degrees):
    """Spread on the grid of the core itself; flux is kept to rounding."""
    height, width, _ = core.shape
    omega = latlong.lookup_solid_angles(height, width)
    theta = np.pi * np.arange(height) / (height - 1)
    sources = np.flatnonzero(core.any(axis=(1, 2)))
    radius = np.radians(min(degrees, 179.0))
    near = np.abs(theta[:, None] - theta[sources]) <= radius
    targets = np.flatnonzero(near.any(axis=1))
    around = np.cos(2 * np.pi * np.arange(width) / width)
    slope = 1 / max(1 - np.cos(radius), 1e-300)

    def kernel(row):
        """Return weights (n, W) from the rows of the light within the radius, by difference in azimuth."""
        rows = sources[near[row]]
        across = np.sin(theta[row]) * np.sin(theta[rows])[:, None] * around
        cosine = np.cos(theta[row]) * np.cos(theta[rows])[:, None] + across
        weights = np.maximum(1 - slope * np.maximum(1 - np.minimum(cosine, 1), 0), 0)
        weights[rows == row, 0] = np.maximum(weights[rows == row, 0], 1)  # its own texel
        return weights

    total = np.zeros(len(sources))
    for row in targets:
        total[near[row]] += omega[row] * kernel(row).sum(axis=1)
    flux = np.fft.rfft(core[sources] * (omega[sources] / total)[:, None, None], axis=1)
    result = np.zeros_like(core)
    for row in targets:
        transform = np.fft.rfft(kernel(row), axis=1)[..., None]
        result[row] = np.fft.irfft((flux[near[row]] * transform).sum(axis=0), width, axis=0)
    result[result < _NOTHING * result.max(initial=0)] = 0
    return result


def flux_ratio(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the flux (3,) of one map (H, W, 3) over that of another; 1 where the second has none."""
    omega = latlong.lookup_solid_angles(*before.shape[:2])
    fluxes = [np.einsum("h,hwc->c", omega, envmap, dtype=np.float64) for envmap in (before, after)]
    return np.where(fluxes[1] > 0, fluxes[0] / np.where(fluxes[1] > 0, fluxes[1], 1), 1)


def _soften(envmap, degrees, most):
    """Soften the lights of a map in place and bound what it shows; ``most`` 0: no bound. Returns notes."""
    lights = file_lights.lights_of(envmap)
    notes = [f"{counted(len(lights), 'light', 'lights')} softened by {degrees:g} degrees"] if degrees else []
    if degrees and not lights:
        notes = ["no light was found: lights.soften_degrees changes nothing"]
    file_lights.take_out(envmap, lights)
    for i, light in enumerate(lights):
        core = np.zeros(envmap.shape, np.float32)
        core.reshape(-1, 3)[light.texels] = light.radiance
        if degrees:
            core = spread(core, degrees)
        if most:
            core, radius = _bounded(core, envmap, most)
            if radius:
                notes.append(f"light {i + 1} spread over {radius:.3g} degrees, to keep to max_radiance")
        envmap += core
    if not most:
        return notes
    over = (envmap > most).any(axis=2)
    if over.any():
        lost = 100 * float(np.maximum(envmap[over] - most, 0).sum() / envmap.sum(dtype=np.float64))
        texels_are = counted(over.sum(), "texel is", "texels are")
        notes.append(f"{texels_are} still above max_radiance and cut: {lost:.2g} % of the light")
    np.minimum(envmap, np.float32(most), out=envmap)
    return notes


def _bounded(core, others, most):
    """Spread a light until it and what is behind it keep to a bound; returns it and the radius, or 0."""
    if not _exceeds(core, others, most):
        return core, 0.0
    small, behind = core, others
    if core.shape[1] > SEARCH_WIDTH:
        size = SEARCH_WIDTH // 2, SEARCH_WIDTH
        small, behind = (latlong.resize(image, *size) for image in (core, others))
    low, high = np.log(180 / len(core)), np.log(WIDEST)
    while high - low >= 0.01:
        middle = (low + high) / 2
        exceeds = _exceeds(spread(small, np.exp(middle)), behind, most)
        low, high = (middle, high) if exceeds else (low, middle)
    radius = float(np.exp(high))
    while _exceeds(result := spread(core, radius), others, most) and radius * GROWTH < WIDEST:
        radius *= GROWTH
    return result, radius


def _exceeds(light, others, most):
    """Say whether a light lifts anything above a bound that is below it otherwise."""
    rows = np.flatnonzero(light.any(axis=(1, 2)))
    light, others = light[rows], others[rows]
    return bool(((light > 0) & (light + others > most) & (others <= most)).any())
