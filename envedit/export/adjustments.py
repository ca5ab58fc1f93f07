"""Adjustments of a map that need no target: exposure, white balance, lights made softer and less bright.

They act on the edited map at last, at whatever resolution it is written. Lights are those that
:mod:`.separation` separates from the background; their flux is kept.
"""

from __future__ import annotations

import numpy as np

from envedit import config
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.core.errors import NumericalError
from envedit.representations.layers.separation import separate
from envedit.targets.strokes import gains

WIDEST = 60.0
"""Largest radius in degrees over which a light is spread to keep to a bound."""
_SEARCH, _NOTHING = 20, 1e-9  # halvings of a radius; share of a peak that is rounding of a transform


def any_asked(lights: config.Lights, output: config.Output) -> bool:
    """Return whether anything is to be adjusted."""
    colour = output.white_balance or output.temperature
    return bool(lights.max_radiance or lights.soften_degrees or output.exposure or colour)


def adjust(
    envmap: np.ndarray, lights: config.Lights, output: config.Output, scale: float = 1.0
) -> tuple[np.ndarray, list[str]]:
    """Adjust a map: exposure and white balance, then its lights.

    Parameters
    ----------
    envmap : ndarray (H, W, 3) float32
        Linear radiance that reaches the scene.
    lights : config.Lights
        How its lights are changed.
    output : config.Output
        Exposure, white balance and temperature.
    scale : float
        What the scene multiplies the map's file by; ``max_radiance`` is in the units of the file.

    Returns
    -------
    adjusted : ndarray (H, W, 3) float32
        The map itself where nothing is asked.
    notes : list of str
        What was done.

    Raises
    ------
    NumericalError
        The adjusted map leaves single precision.
    """
    if not any_asked(lights, output):
        return envmap, []
    found, notes = envmap.astype(np.float64), []
    if output.exposure:
        found *= 2.0**output.exposure
        notes.append(f"exposure of the map changed by {output.exposure:+g} stops")
    if output.white_balance:
        found *= balance(output.white_balance)
        notes.append(f"white balance: light of {output.white_balance:g} K becomes neutral")
    if output.temperature:
        found *= gains(output.temperature)
        notes.append(f"temperature: light of {output.temperature:g} K in place of 6500 K")
    if lights.soften_degrees or lights.max_radiance:
        found, said = _lights(found, lights.soften_degrees, lights.max_radiance * scale)
        notes += said
    with np.errstate(over="ignore"):
        result = found.astype(np.float32)
    if not np.isfinite(result).all():
        raise NumericalError("the adjusted map leaves float32: lower output.exposure")
    return result, notes


def balance(kelvin: float) -> np.ndarray:
    """Return factors (3,) that make the light of a black body neutral and keep the luminance of grey."""
    gain = 1 / gains(kelvin)
    return gain / float(luminance(gain))


def spread(core: np.ndarray, degrees: float) -> np.ndarray:
    """Spread every texel over a disc on the sphere, with its flux.

    The disc's radiance falls as 1 - (1 - cos g) / (1 - cos r) with the angle g to its centre. Flux is
    radiance times :func:`.latlong.lookup_solid_angles`; it is kept exactly. A radius of less than a texel
    changes nothing.

    Parameters
    ----------
    core : ndarray (H, W, 3)
        Radiance of a light, black elsewhere.
    degrees : float
        Radius r of the disc.
    """
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
        """Return weights (sources, W) from rows of the light to another, by the difference in azimuth."""
        across = np.sin(theta[row]) * np.sin(theta[sources])[:, None] * around
        cosine = np.cos(theta[row]) * np.cos(theta[sources])[:, None] + across
        return np.maximum(1 - slope * np.maximum(1 - np.minimum(cosine, 1), 0), 0)

    itself = np.zeros((len(sources), width))
    itself[:, 0] = 1
    total = np.zeros(len(sources))
    for row in targets:
        total += omega[row] * np.maximum(kernel(row), itself * (sources == row)[:, None]).sum(axis=1)
    flux = np.fft.rfft(core[sources] * (omega[sources] / total)[:, None, None], axis=1)
    result = np.zeros_like(core)
    for row in targets:
        weights = np.maximum(kernel(row), itself * (sources == row)[:, None])
        transform = np.fft.rfft(weights, axis=1)[..., None]
        result[row] = np.fft.irfft((flux * transform).sum(axis=0), width, axis=0)
    result[result < _NOTHING * result.max(initial=0)] = 0
    after = (result * omega[:, None, None]).sum(axis=(0, 1))
    before = (core * omega[:, None, None]).sum(axis=(0, 1))
    return result * np.where(after > 0, before / np.where(after > 0, after, 1), 1)


def _lights(envmap, degrees, most):
    """Soften the lights of a map and bound what it shows; ``most`` 0: no bound."""
    separated = separate(envmap)
    rest = envmap - separated.core
    cores = []
    for light in separated.lights:
        core = np.zeros_like(envmap)
        core.reshape(-1, 3)[light.texels] = light.radiance
        cores.append(spread(core, degrees) if degrees else core)
    notes = [f"{len(cores)} lights softened by {degrees:g} degrees"] if degrees else []
    if degrees and not cores:
        notes = ["no light was found: lights.soften_degrees changes nothing"]
    total = rest + sum(cores)
    if not most:
        return total, notes
    for i, core in enumerate(cores):
        others = total - core
        cores[i], radius = _bounded(core, others, most)
        total = others + cores[i]
        if radius:
            notes.append(f"light {i + 1} spread over {radius:.3g} degrees, to keep to max_radiance")
    over = (total > most).any(axis=2)
    if over.any():
        lost = 100 * float(np.maximum(total - most, 0).sum() / total.sum())
        notes.append(
            f"{over.sum()} texels are still above max_radiance and are cut: {lost:.2g} % of the light"
        )
    return np.minimum(total, most), notes


def _bounded(core, others, most):
    """Spread a light until it and what is behind it keep to a bound; returns it and the radius, or 0."""

    def exceeds(light):
        return ((light > 0) & (light + others > most) & (others <= most)).any()

    if not exceeds(core):
        return core, 0.0
    low, high = np.log(180 / core.shape[0]), np.log(WIDEST)
    for _ in range(_SEARCH):
        middle = (low + high) / 2
        low, high = (middle, high) if exceeds(spread(core, np.exp(middle))) else (low, middle)
        if high - low < 0.01:
            break
    return spread(core, np.exp(high)), float(np.exp(high))
