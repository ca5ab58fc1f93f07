"""Paint on renderings as lighting artists do: twelve edits, by functions that know the scene's geometry.

A painter gets what the camera sees (:class:`View`) and the rendering under the map, and returns a
:class:`Paint`, or None where the picture has nothing to paint on, such as no visible shadow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.color import luminance
from envedit.representations.layers import placed_lights
from envedit.representations.layers.separation import separate
from envedit.scene.scene import Scene

UNIT = 64
"""Widths of brushes and blurs are given in this part of the picture's width."""
LEAST_AREA = 0.015
"""Share of the picture that a shadow must have to be painted."""
LEAST_CONTRAST = 1.15
"""Radiance beside a shadow over that in it, below which it is not to be seen."""
LEAST_COVERAGE = 1 / 255
"""Coverage below which a pixel is not painted: a step of a mask of 8 bits."""
ELEVATIONS = np.degrees((0.1, 1.5))
"""The least and the largest elevation of a lowered sun, degrees."""


@dataclass(frozen=True)
class Paint:
    """A painted picture."""

    picture: np.ndarray  # (h, w, 3), linear radiance
    coverage: np.ndarray  # (h, w), how much each pixel was painted, in [0, 1]
    # (3,), where a sun makes what was painted, a unit vector in the map's frame
    sun: np.ndarray | None = None


@dataclass(frozen=True)
class View:
    """What the camera of a scene with one view sees, by a ray through the middle of each pixel."""

    scene: Scene
    envmap: np.ndarray | None = None  # (H, W, 3), the map that lights it

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        return self.scene.height, self.scene.width

    @property
    def column(self) -> np.ndarray:
        """Column of each pixel, (h, w)."""
        return np.mgrid[: self.shape[0], : self.shape[1]][1]

    @cached_property
    def sun(self) -> np.ndarray | None:
        """Direction of the map's brightest light; None if it has none."""
        lights = separate(self.envmap).lights
        return lights[0].direction if lights else None

    @cached_property
    def _rays(self):
        height, width = self.shape
        row, column = np.mgrid[:height, :width]
        at = mi.Point2f((column.ravel() + 0.5) / width, (row.ravel() + 0.5) / height)
        sensor = self.scene.mi.sensors()[0]
        return sensor.sample_ray_differential(0.0, 0.5, at, mi.Point2f(0.5, 0.5))[0]

    @cached_property
    def _hit(self):
        return self.scene.mi.ray_intersect(self._rays)

    @cached_property
    def surface(self) -> np.ndarray:
        """Pixels that see a surface, bool (h, w)."""
        return np.array(self._hit.is_valid()).reshape(self.shape)

    @cached_property
    def normal(self) -> np.ndarray:
        """Shading normals, (h, w, 3)."""
        return np.array(self._hit.sh_frame.n).T.reshape(*self.shape, 3)

    @cached_property
    def facing(self) -> np.ndarray:
        """Cosine between normal and direction to the camera, (h, w)."""
        return -(self.normal * np.array(self._rays.d).T.reshape(*self.shape, 3)).sum(axis=2)

    @cached_property
    def floor(self) -> np.ndarray:
        """Pixels of the shape that most of those which face upwards see, bool (h, w)."""
        up = self.scene.to_world @ np.array([0.0, 1.0, 0.0])
        flat = self.surface & (self.normal @ up > 0.99)
        shapes = np.array(dr.reinterpret_array(mi.UInt32, self._hit.shape)).reshape(self.shape)
        if not flat.any():
            return flat
        names, counts = np.unique(shapes[flat], return_counts=True)
        return self.surface & (shapes == names[counts.argmax()])

    @cached_property
    def object(self) -> np.ndarray:
        """All other pixels that see a surface, bool (h, w)."""
        return self.surface & ~self.floor

    def blocked(self, direction: np.ndarray) -> np.ndarray:
        """Return where a direction of the map is blocked on the floor, bool (h, w)."""
        world = self.scene.to_world @ direction
        blocked = self.scene.mi.ray_test(self._hit.spawn_ray(mi.Vector3f(*world.tolist())))
        return np.array(blocked).reshape(self.shape) & self.floor

    def shadow(self, direction: np.ndarray) -> np.ndarray | None:
        """Return where a direction of the map is blocked on the floor; None if that is too small an area."""
        shaded = self.blocked(direction)
        return shaded if shaded.mean() >= LEAST_AREA else None

    def blurred(self, values: np.ndarray, deviation: float) -> np.ndarray:
        """Return values (h, w) under a Gaussian filter, its standard deviation in 1 / UNIT of the width."""
        pixels = deviation * self.shape[1] / UNIT
        margin = int(np.ceil(4 * pixels))
        padded = np.pad(np.asarray(values, np.float64), margin, mode="edge")
        vertical = np.fft.fftfreq(padded.shape[0])[:, None]
        horizontal = np.fft.rfftfreq(padded.shape[1])[None]
        response = np.exp(-2 * (np.pi * pixels) ** 2 * (horizontal**2 + vertical**2))
        smooth = np.fft.irfft2(np.fft.rfft2(padded) * response, s=padded.shape)
        return np.clip(smooth[margin:-margin, margin:-margin], 0, np.max(values))

    def brush(self, mask: np.ndarray, deviation: float, surface: np.ndarray) -> np.ndarray:
        """Return how much each pixel of a surface is painted by a soft brush over a mask, in [0, 1]."""
        covered = self.blurred(mask, deviation) * surface
        return np.where(covered < LEAST_COVERAGE, 0, covered)


def turned(toward: np.ndarray, degrees: float, lift: float = 0.0) -> np.ndarray:
    """Return a direction turned about the vertical, and lifted, by degrees."""
    azimuth, elevation = placed_lights.angles(toward)
    if lift:
        elevation = float(np.clip(elevation + lift, *ELEVATIONS))
    return placed_lights.direction(azimuth - degrees, elevation)


# ---- Shadows -----------------------------------------------------------------------------------------------


def _of_shadow(view, picture, shadow, surroundings):
    """Return the floor's radiance beside a shadow and in its middle, (3,) each; None if it is not visible."""
    ring = view.floor & (view.blurred(shadow, 6) > 0.02) & surroundings
    middle = shadow & (view.blurred(~shadow, 2) <= 0.5)
    if not ring.any():
        return None
    light = np.median(picture[ring], axis=0)
    dark = np.median(picture[middle if middle.any() else shadow], axis=0)
    return (light, dark) if (light / np.maximum(dark, 1e-6)).mean() >= LEAST_CONTRAST else None


def moved_shadow(view: View, picture: np.ndarray, degrees: float = 0.0, lift: float = 0.0) -> Paint | None:
    """Erase the sun's shadow, and paint that of the sun turned about the vertical or lifted."""
    if view.sun is None:
        return None
    sun = turned(view.sun, degrees, lift)
    old, new = view.shadow(view.sun), view.shadow(sun)
    if old is None or new is None or not (radiance := _of_shadow(view, picture, old, ~old & ~new)):
        return None
    light, dark = radiance
    erased = view.brush(old, 1, view.floor)[..., None]
    painted = view.brush(new, 1, view.floor)[..., None]
    without = picture * (1 - erased) + erased * light
    shaded = without * (1 - painted + painted * np.minimum(dark / light, 1))
    return Paint(shaded, np.maximum(erased, painted)[..., 0], sun)


def softer_shadow(view: View, picture: np.ndarray) -> Paint | None:
    """Blur the floor along the shadow's edge."""
    shadow = None if view.sun is None else view.shadow(view.sun)
    if shadow is None or not _of_shadow(view, picture, shadow, ~shadow):
        return None
    smooth = view.blurred(shadow, 3)
    edge = view.floor & (smooth > 0.1) & (smooth < 0.9)
    brush = view.brush(edge, 1, view.floor)
    known = np.maximum(view.blurred(view.floor, 5), 0.05)
    soft = np.stack([view.blurred(p * view.floor, 5) / known for p in np.moveaxis(picture, 2, 0)], axis=2)
    return Paint(picture + brush[..., None] * (soft - picture), brush, view.sun)


def lifted_shadow(view: View, picture: np.ndarray) -> Paint | None:
    """Make the shadow brighter, by half of what it takes, as a ratio."""
    shadow = None if view.sun is None else view.shadow(view.sun)
    if shadow is None or not (radiance := _of_shadow(view, picture, shadow, ~shadow)):
        return None
    light, dark = radiance
    brush = view.brush(shadow, 1, view.floor)
    factor = np.sqrt(light / np.maximum(dark, 1e-6))
    return Paint(picture * (1 + brush[..., None] * (factor - 1)), brush)


# ---- Shading and highlights --------------------------------------------------------------------------------


def warm_rim(view: View, picture: np.ndarray) -> Paint | None:
    """Add warm light along the left contour of the object."""
    left = view.column < np.median(view.column[view.object])
    brush = view.brush(view.object & (view.facing < 0.45) & left, 0.8, view.object)
    return Paint(picture + 0.8 * brush[..., None] * [1.0, 0.8, 0.6], brush) if brush.any() else None


def highlight(view: View, picture: np.ndarray) -> Paint | None:
    """Add a highlight in the upper right of the object."""
    row, column = np.nonzero(view.object)
    away = np.mgrid[: view.shape[0], : view.shape[1]]
    away = np.hypot(away[0] - np.quantile(row, 0.35), away[1] - np.quantile(column, 0.72))
    brush = np.exp(-0.5 * (away / (3.5 * view.shape[1] / UNIT)) ** 2) * view.object
    brush = np.where(brush < 0.02, 0, brush)
    return Paint(picture + 1.2 * brush[..., None], np.minimum(1, 2 * brush))


def brighter_dark_side(view: View, picture: np.ndarray) -> Paint | None:
    """Brighten the darker two fifths of the object by 80 %."""
    shown = luminance(picture)
    smooth = view.blurred(np.where(view.object, shown, np.median(shown[view.object])), 3)
    dark = view.object & (smooth < np.quantile(smooth[view.object], 0.4))
    brush = view.brush(dark, 1.5, view.object)
    return Paint(picture * (1 + 0.8 * brush[..., None]), brush)


def no_highlight(view: View, picture: np.ndarray) -> Paint | None:
    """Paint over the brightest 6 % of the object, or all that is white, in the colour of its surroundings."""
    shown = luminance(picture)
    bright = view.object & (shown > min(np.quantile(shown[view.object], 0.94), 1))
    brush = view.brush(bright, 1.5, view.object)
    ring = view.object & (view.blurred(bright, 4) > 0.03) & (brush < 0.05) & (shown < 1)
    if not ring.any():
        return None
    return Paint(picture + brush[..., None] * (np.median(picture[ring], axis=0) - picture), brush)


# ---- The whole picture -------------------------------------------------------------------------------------


def all_warm(view: View, picture: np.ndarray) -> Paint | None:
    """Make all of the picture warmer, at its luminance."""
    colour = np.array([1.25, 1.0, 0.68])
    return Paint(picture * colour / luminance(colour[None])[0], np.ones(view.shape))


def dark_sky(view: View, picture: np.ndarray) -> Paint | None:
    """Darken all that the sun does not light: the darker, the more, down to 45 %."""
    shown = luminance(picture)
    share = np.clip(shown / np.quantile(shown, 0.9), 0, 1)[..., None]
    return Paint(picture * (0.45 + 0.55 * share), np.ones(view.shape))


def left_dimmed(view: View, picture: np.ndarray) -> Paint | None:
    """Darken the left of the object by 40 %, as if a window there were dimmed."""
    left = view.column < np.quantile(view.column[view.object], 0.4)
    brush = view.brush(view.object & left, 2, view.object)
    return Paint(picture * (1 - 0.4 * brush[..., None]), brush)


SHADOWS: dict[str, Callable[[View, np.ndarray], Paint | None]] = {
    "shadow to the other side": lambda view, picture: moved_shadow(view, picture, degrees=150),
    "shadow moved by 60 degrees": lambda view, picture: moved_shadow(view, picture, degrees=60),
    "longer shadow": lambda view, picture: moved_shadow(view, picture, lift=-20),
    "softer shadow": softer_shadow,
    "lifted shadow": lifted_shadow,
}
"""Edits of the sun's shadow, by name."""
PAINTERS = SHADOWS | {
    "warm rim": warm_rim,
    "highlight at a spot": highlight,
    "brighter dark side": brighter_dark_side,
    "highlight removed": no_highlight,
    "all warm": all_warm,
    "dark sky, sun kept": dark_sky,
    "left half dimmed": left_dimmed,
}
"""All twelve."""
