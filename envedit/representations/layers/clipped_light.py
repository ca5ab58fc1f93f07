"""The clipped light of a map: which texels are cut at the map's maximum, and whether they are a sun.

All is measured on a copy of at most :data:`COPY_WIDTH` columns, in angles and in luminance over the sky's
horizontal irradiance: it means the same at any resolution and exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from envedit.core import latlong
from envedit.core.color import luminance
from envedit.representations.layers.separation import components

COPY_WIDTH = 1024
"""Most columns of the copy that is measured: a texel is 0.35 degrees, less than a sun."""
PLATEAU = 0.95
"""Share of the map's largest channel from which on a channel is clipped. Derived: 250 of 255 in sRGB is
0.957: the noise of a good JPEG stays within the plateau."""
RING_DEGREES = 0.7 * 2 ** (np.arange(15) / 2)
"""Middles of the rings of a profile, 0.7 to 90 degrees; each reaches a quarter of an octave to both sides.
Derived: nearer than 0.6 degrees a texel of a map of 1024 columns may hold part of the disc."""
CLIPPED_SHARE = 0.5
"""Share of a ring below which clipping leaves its median. Derived."""
LARGEST_DEGREES = 45.0
"""Radius from which on a clipped region is no aureole: half of the sky or more is as bright."""
LEAST_FALL = (0.52, 0.95)
"""Exponents of :attr:`ClippedLight.fall` below which a region is cloud. Chosen by the nine maps of
``experiments/unclip`` that choices are made by: suns have at least 0.59 and 1.0, but for one that is clipped
at 3; clouds that are clipped at 10 and more have less than 0.46, or less than 0.75."""
EDGE = 0.1
"""Luminance of the first ring over the plateau's below which a region wider than :data:`CORE_DEGREES` has the
sharp edge of a lamp. Derived: a sun's aureole falls by at most 2^2.5 from ring to ring (:mod:`.unclip`)."""
CORE_DEGREES = 1.0
"""Radius of what is called the sun: the disc, and what lens and resampling spread of it."""
DARK_SKY = 0.2
"""Median luminance of the upper half, times pi over its horizontal irradiance, below which it is no sky but a
room. Derived: 1 for a uniform sky, at least 0.37 far from the sun in the analytic one."""
SEVERAL_SHARE = 0.25
"""Area of another clipped region over that of the first from which on it is one more of its kind."""
CLEAR_CONTRAST = 5.0
"""Luminance of the plateau, times pi over the sky's horizontal irradiance, from which on several regions are
lamps, as clouds are darker; below, a sun may be a cloud. Chosen by the same nine maps."""
LEAST_TEXELS = 2
"""Texels of a plateau: a single one as bright as that is a maximum, not clipped. Derived."""


@dataclass(frozen=True)
class ClippedLight:
    """A clipped region of a map."""

    kind: str  # "sun", "lamp" or "cloud"
    reason: str  # why, a clause
    direction: np.ndarray  # (3,), unit vector to its middle, in the map's frame
    radius: float  # of a disc of its solid angle, degrees
    level: float  # the map's largest channel value
    # (15, 3), median radiance at :data:`RING_DEGREES` from its middle, above the horizon; NaN where most is
    # clipped
    rings: np.ndarray
    sky_irradiance: np.ndarray  # (3,), of the map without its core, on a horizontal surface
    core_flux: float  # what the clipped map has within :data:`CORE_DEGREES` over its surroundings, luminance

    @property
    def elevation(self) -> float:
        """Degrees above the horizon."""
        return float(np.degrees(np.arcsin(np.clip(self.direction[1], -1, 1))))

    @property
    def azimuth(self) -> float:
        """Degrees along the columns, in [0, 360)."""
        return float(np.degrees(np.arctan2(self.direction[0], -self.direction[2])) % 360)

    @property
    def contrast(self) -> float:
        """Luminance of the plateau, if it is grey, times pi over the sky's horizontal irradiance."""
        return self.level * np.pi / max(float(luminance(self.sky_irradiance)), 1e-300)

    @property
    def fall(self) -> tuple[float, float]:
        """Exponents by which luminance, and luminance over the darkest ring's, fall with the angle.

        From the first ring that is measured, over an octave; 0 without such rings.
        """
        profile = luminance(self.rings)
        measured = np.flatnonzero(np.isfinite(profile))
        if len(measured) < 3 or not profile[measured].min() > 0:
            return 0.0, 0.0
        first, last = measured[[0, 2]]
        octaves = np.log2(RING_DEGREES[last] / RING_DEGREES[first])
        darkest = (1 - 1e-6) * profile[measured].min()
        over = (profile[first] - darkest) / (profile[last] - darkest)
        falls = np.log2([profile[first] / profile[last], max(over, 1e-6)]) / octaves
        return float(falls[0]), float(falls[1])

    @property
    def has_aureole(self) -> bool:
        """Whether it falls as around a sun."""
        return all(fall >= least for fall, least in zip(self.fall, LEAST_FALL, strict=True))

    @property
    def first(self) -> int | None:
        """Index of the first ring that is measured; None without one."""
        measured = np.flatnonzero(np.isfinite(self.rings[:, 0]))
        return int(measured[0]) if len(measured) else None


def find(radiance: np.ndarray) -> ClippedLight | None:
    """Find the clipped region of a map (H, W, 3) that is most like a sun, and say what it is.

    None where less than :data:`LEAST_TEXELS` above the horizon are on the plateau, or all is black. Radiance
    is linear, finite and not negative.
    """
    height, width, _ = radiance.shape
    level = float(radiance.max(initial=0))
    upper = (height + 1) // 2
    if not level > 0:
        return None

    # ---- The plateau, of the most channels that are clipped in one texel above the horizon
    channels = np.zeros((height, width), np.uint8)
    for channel in range(3):
        channels += radiance[..., channel] >= PLATEAU * level
    most = int(channels[:upper].max())
    plateau = channels == most
    plateau[upper:] = False
    if most == 0 or plateau.sum() < LEAST_TEXELS:
        return None

    # ---- A copy of a size that does not depend on the file's
    w = min(width, COPY_WIDTH)
    h = max(w * height // width, 1)
    small = latlong.resize(radiance, h, w).astype(np.float64)
    covered = latlong.resize(plateau[..., None].astype(np.float32), h, w)[..., 0].astype(np.float64)
    clipped = latlong.resize((channels > 0)[..., None].astype(np.float32), h, w)[..., 0]
    omega = np.repeat(latlong.lookup_solid_angles(h, w)[:, None], w, axis=1)
    directions = latlong.directions(h, w)

    # ---- The region, its middle and what is around it
    region, others = _region(covered, omega, directions)
    area = float((covered * omega)[region].sum())
    radius = float(np.degrees(np.arccos(np.clip(1 - area / (2 * np.pi), -1, 1))))
    middle = _middle(directions[region], (covered * omega)[region], radius)
    angle = np.degrees(np.arccos(np.clip(directions @ middle, -1, 1)))
    above = directions[..., 1] > 0
    rings = _rings(small, clipped, angle, radius, above)
    outside = (angle > CORE_DEGREES) & above
    sky_irradiance = (small * (omega * directions[..., 1] * outside)[..., None]).sum(axis=(0, 1))
    core_flux = _core_flux(small, omega, angle)
    light = ClippedLight("cloud", "", middle, radius, level, rings, sky_irradiance, core_flux)
    kind, reason = _kind(light, float(np.median(luminance(small[above]))), others)
    return replace(light, kind=kind, reason=reason)


def _region(covered, omega, directions):
    """Return the texels of the largest and roundest connected region, and how many others are as large.

    Roundness: share of the area within a disc of the same solid angle, widened by a fifth, at the centroid.
    """
    parts = components(covered > 0)
    numbers, inverse = np.unique(parts, return_inverse=True)
    areas = np.bincount(inverse.ravel(), (covered * omega).ravel())
    areas[numbers < 0] = 0
    best, score = 0, -1.0
    for index in np.argsort(-areas, kind="stable")[:4]:
        if areas[index] < areas.max() / 8:
            break
        inside = parts == numbers[index]
        weight = (covered * omega)[inside]
        centroid = weight @ directions[inside]
        centroid /= max(np.linalg.norm(centroid), 1e-12)
        radius = np.arccos(np.clip(1 - areas[index] / (2 * np.pi), -1, 1))
        near = directions[inside] @ centroid > np.cos(min(1.2 * radius + 0.005, np.pi))
        roundness = weight[near].sum() / areas[index]
        if areas[index] * roundness**3 > score:
            best, score = index, areas[index] * roundness**3
    others = int((np.delete(areas, best) > SEVERAL_SHARE * areas[best]).sum())
    return parts == numbers[best], others


def _middle(points, weight, radius):
    """Return where a region is densest: its centroid would follow clouds that are joined to it.

    Mean shift by a Gaussian of half its radius, from the best of the region's points.
    """
    step = max(1, len(points) // 1500)
    points, weight = points[::step], weight[::step]
    width = max(np.radians(0.5 * radius), np.radians(0.35))
    density = np.exp(-(1 - points @ points.T) / width**2) @ weight
    middle = points[np.argmax(density)]
    for _ in range(20):
        middle = (np.exp(-(1 - points @ middle) / width**2) * weight) @ points
        middle /= np.linalg.norm(middle)
    return middle


def _rings(image, clipped, angle, radius, above):
    """Return the median radiance of each ring outside a region; NaN where it is clipped, or has no texels."""
    rings = np.full((len(RING_DEGREES), 3), np.nan)
    border = np.digitize(angle, [RING_DEGREES[0] * 2**-0.25, *(RING_DEGREES * 2**0.25)]) - 1
    for i, degrees in enumerate(RING_DEGREES):
        inside = (border == i) & above
        if degrees >= radius and inside.sum() >= 4 and clipped[inside].mean() < CLIPPED_SHARE:
            rings[i] = np.median(image[inside], axis=0)
    return rings


def _core_flux(image, omega, angle):
    """Return the flux within the core over the median of the ring around it, luminance."""
    around = (angle > 1.5 * CORE_DEGREES) & (angle < 2.5 * CORE_DEGREES)
    core = angle < CORE_DEGREES
    if not (around.any() and core.any()):
        return 0.0
    base = np.median(image[around], axis=0)
    return float(luminance((np.maximum(image[core] - base, 0) * omega[core][:, None]).sum(axis=0)))


def _kind(light, median, others):
    """Return "sun", "lamp" or "cloud", and why; ``median`` luminance is of the upper half."""
    sky = float(luminance(light.sky_irradiance))
    if light.radius > LARGEST_DEGREES or light.first is None or not sky > 0:
        return "cloud", f"the sky is clipped over {light.radius:.0f} degrees to each side"
    if median * np.pi < DARK_SKY * sky:
        return "lamp", "its surroundings are dark, as in a room"
    fall = f"luminance around it falls as angle^-{light.fall[0]:.1f}, over the sky's ^-{light.fall[1]:.1f}"
    sharp = luminance(light.rings[light.first]) < EDGE * light.level
    if sharp and light.radius > CORE_DEGREES:
        return "lamp", "it has a sharp edge, without an aureole"
    if not light.has_aureole and not sharp:
        return "cloud", fall
    if others and light.contrast > CLEAR_CONTRAST:
        return "lamp", f"{others + 1} regions of its kind are clipped"
    return "sun", fall if light.has_aureole else "it is a disc of the sun's size, without glare"
