"""What a configuration starts from: its map, the rows of it that may change, its scene."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from envedit import config
from envedit.config.presets import MAP_WORDS
from envedit.core import latlong, primaries
from envedit.core.errors import ConfigError, InputError, NumericalError
from envedit.core.primaries import Chromaticities
from envedit.core.radiance import BRIGHTEST, require_radiance
from envedit.core.rows import Rows
from envedit.images import analytic_sky, images, map_regions
from envedit.representations.layers import unclip
from envedit.representations.layers.oriented import oriented, oriented_share
from envedit.representations.layers.placed_lights import ByHand, PlacedLights, missing
from envedit.scene import built_scene, supported
from envedit.scene.scene import Scene

AUTO, SCENE, SUNSKY = MAP_WORDS
"""Words for ``[input] envmap``: the scene's own light if it has one; that light; Mitsuba's analytic sky."""
_ROUNDING = 1e-6  # of a texel's largest channel


@dataclass(frozen=True)
class Replacements:
    """Arrays and objects that take the place of a configuration's files."""

    scene: Scene | None = None
    # (H, 2 H, 3), the map to edit, linear radiance in the units of a file, which the ``scale`` multiplies
    envmap: np.ndarray | None = None
    target_map: np.ndarray | None = None  # (H, 2 H, 3), the map under which the target is rendered; likewise
    target: np.ndarray | None = None  # (h, w, 3), a painted picture, linear radiance
    # (h, w), where it was painted, in [0, 1]; None: where it differs from the initial rendering
    mask: np.ndarray | None = None


NO_REPLACEMENTS = Replacements()
"""Everything is read from the configuration's files."""


@dataclass(frozen=True)
class InputMap:
    """The map that is edited, as its file holds it and as it reaches the scene.

    Everything is computed with :attr:`radiance` = ``scale`` * ``stored``; what is written goes back through
    :meth:`as_stored`, so that it can stand in the scene in the place of the file.
    """

    source: str  # the file, "sunsky", or "scene" for its own light that is no file
    stored: np.ndarray  # (H, W, 3) float32, linear values as in the file, at the width asked for
    scale: float  # what the scene's emitter multiplies them by
    size: tuple[int, int]  # width and height of the file
    warnings: list[str]  # what was repaired, or is odd
    # Colour space of the file (:mod:`.primaries`); None: Rec. 709
    chromaticities: Chromaticities | None = None
    # The map as the file has it, where lights of it were placed by hand; ``stored`` has them placed
    placed: PlacedLights | None = None
    array: np.ndarray | None = None  # (H, W, 3), the whole map, where it came as an array and not from a file
    # (H, W, 3), the :attr:`radiance` of the file, where lights were placed or the map was rotated by hand
    unmoved: np.ndarray | None = None
    # (H, W, 3), what of :attr:`radiance` is of lights that ``[[input.lights]]`` locks
    locked: np.ndarray | None = None
    # (H, W), how far ``[[input.regions]]`` keep a texel of :attr:`radiance`, 0 to 1; None: nowhere
    kept: np.ndarray | None = None
    half: bool = False  # whether the file is OpenEXR in half
    unclipped: str = ""  # what was done about a clipped sun, a clause; "" where that was not asked for

    @functools.cached_property
    def radiance(self) -> np.ndarray:
        """Linear radiance (H, W, 3) float32 that reaches the scene, in Rec. 709; no channel is negative.

        InputError if it is more than :data:`.radiance.BRIGHTEST` somewhere.
        """
        colours = self._in_rec709
        if self.chromaticities is not None:
            np.maximum(colours, 0, out=colours)
            require_radiance(colours, f"{self.source} in Rec. 709", brightest=BRIGHTEST)
        return scaled(colours, self.scale, self.source)

    @property
    def _in_rec709(self):
        """The stored values in Rec. 709, where colours outside it have negative channels: converted anew."""
        if self.chromaticities is None:
            return self.stored
        return primaries.converted(self.stored, primaries.to_rec709(self.chromaticities))

    @property
    def outside(self) -> float:
        """Share of the texels whose colour is outside Rec. 709: a channel of theirs is taken as 0."""
        if self.chromaticities is None:
            return 0.0
        colours = self._in_rec709
        return float((colours < -_ROUNDING * np.abs(colours).max(axis=2, keepdims=True)).any(axis=2).mean())

    def at_file_size(self, settings: config.Input, widest: int | None = None) -> InputMap:
        """Read the map anew, as wide as its file or ``widest``; errors as of :func:`.images.load_envmap`."""
        if self.source == SUNSKY:
            return self
        width = None if widest is None else min(widest, self.size[0])
        return read_file(self.source if self.array is None else self.array, width, settings, self.scale)

    def as_stored(self, edited: np.ndarray, degrees: float = 0.0) -> np.ndarray:
        """Return an edited map in the units of the file; a texel that was not edited keeps its bits.

        ``edited`` is linear radiance (H, W, 3) in the scene; the map was turned by ``degrees`` before it was
        edited. NumericalError if a value is too large for the file, as ``scale`` is too small.
        """
        if self.scale == 1 and self.chromaticities is None:
            return edited
        with np.errstate(over="ignore"):
            stored = (edited / np.float64(self.scale)).astype(np.float32)
        if self.chromaticities is not None:
            back = np.linalg.inv(primaries.to_rec709(self.chromaticities))
            stored = np.maximum(primaries.converted(stored, back), 0)
        if not np.isfinite(stored).all():
            raise NumericalError(
                f"the edited map divided by the scene's scale {self.scale:g} overflows float32: "
                "raise the emitter's scale"
            )
        same = (edited == latlong.rotate(self.radiance, degrees)).all(axis=2, keepdims=True)
        return np.where(same, latlong.rotate(self.stored, degrees), stored)


def scaled(stored: np.ndarray, scale: float, source: str) -> np.ndarray:
    """Return radiance in the scene: ``scale`` times what a file holds; errors as of :class:`InputMap`."""
    if scale == 1:
        return stored
    with np.errstate(over="ignore"):
        radiance = (stored * np.float64(scale)).astype(np.float32)
    require_radiance(radiance, f"{source} times the scene's scale, {scale:g}", brightest=BRIGHTEST)
    return radiance


def source_of(settings: config.Input, scene: Scene | None) -> str:
    """Return the file of a configuration's map, "sunsky", or "scene" for a light of its own that is no file.

    Where the scene's own light is asked for, ConfigError if there is no scene or it is made for any map,
    InputError if it has none or its file is not there.
    """
    if settings.envmap not in (AUTO, SCENE):
        return settings.envmap
    own = supported.OwnMap(None, 1.0) if scene is None else scene.own
    if own.missing:
        raise InputError(own.missing)
    if own.light is not None:
        return SCENE
    if own.file is None:
        if settings.envmap == AUTO:
            return SUNSKY
        where = "no scene is given" if scene is None else f"{scene.path} has no light of its own"
        raise ConfigError(f'input.envmap: got "scene", but {where}: name a map, or "sunsky"')
    if not os.path.isfile(own.file):  # no error for a name that no file can have
        raise InputError(f"{own.file}: the scene's own map is missing; name another with [input] envmap")
    return str(own.file)


def read_map(
    settings: config.Input,
    scene: Scene | None,
    width: int | None = None,
    array: np.ndarray | None = None,
) -> InputMap:
    """Read the map of a configuration, or take it from an ``array`` (H, 2 H, 3).

    ``scene`` is what its own light and scale are taken from; without one the scale is 1. The map has
    ``width`` texels across, by default as many as its file (one that is made: the working width). Errors are
    those of :func:`source_of` and :func:`.images.load_envmap`.
    """
    scale = 1.0 if scene is None else scene.own.scale
    if array is not None:
        return _by_hand(settings, read_file(array, width, settings, scale))
    source = source_of(settings, scene)
    if source == SUNSKY:
        width = width or settings.width
        sky = analytic_sky.sunsky(width, settings.azimuth, settings.elevation, settings.turbidity)
        input_map = InputMap(source, sky, scale, (width, width // 2), [])
    elif source == SCENE and scene is not None and scene.own.light is not None:
        light = scene.own.light.map(width or settings.width, scene.to_world)
        input_map = replace(read_file(light, width, settings, scale), source=SCENE)
    else:
        input_map = read_file(source, width, settings, scale)
    return _by_hand(settings, input_map)


def _by_hand(settings, input_map):
    """Return a map as ``lights``, ``regions`` and its orientation ask, in this order."""
    if not settings.lights and not settings.regions and not any(settings.orientation):
        return input_map
    placed = None
    warnings = [*input_map.warnings]
    if settings.lights or any(region["action"] == "keep" for region in settings.regions):
        placed = PlacedLights(input_map.radiance, settings.horizon)
        changed = placed.by_hand(settings.lights, settings.regions)
        if lacking := missing(settings.lights, len(placed.lights)):
            numbers = ", ".join(map(str, lacking))
            has = f"the map has {len(placed.lights)}: what is said of others is ignored"
            warnings.append(f"input.lights: got light = {numbers}, but {has}")
    else:
        changed = ByHand(map_regions.changed(input_map.radiance, settings.regions))
    return replace(
        input_map,
        stored=oriented(input_map.as_stored(changed.envmap), settings.orientation),
        warnings=warnings,
        placed=placed,
        unmoved=input_map.radiance,
        locked=None if changed.locked is None else oriented(changed.locked, settings.orientation),
        kept=None if changed.kept is None else oriented_share(changed.kept, settings.orientation),
    )


def read_file(source: str | np.ndarray, width: int | None, settings: config.Input, scale: float) -> InputMap:
    """Read a map from its file, or take it from an array (H, 2 H, 3).

    It has ``width`` texels across, by default as many as the file; ``scale`` is what the scene multiplies it
    by. Of the settings ``repair``, ``unclip`` and ``colour_space`` count. Errors are those of
    :func:`.images.load_envmap`.
    """
    stored, info = images.load_envmap(
        source,
        None if settings.unclip else width,
        settings.repair,
        convert=False,
        name="envmap",
        space=settings.colour_space,
    )
    array = source if isinstance(source, np.ndarray) else None
    name = images.ARRAY if isinstance(source, np.ndarray) else source
    warnings = [f"{info['path']}: {line}" for line in info["warnings"]]
    space = info["chromaticities"]
    half = info.get("half", False)
    input_map = InputMap(name, stored, scale, info["size"], warnings, space, array=array, half=half)
    if settings.unclip:
        input_map = _unclipped(input_map, width)
    if input_map.outside > 0:
        space = primaries.name_of(input_map.chromaticities)
        warnings.append(
            f"{info['path']}: {100 * input_map.outside:.2g} % of its texels have colours of {space} "
            "outside Rec. 709: their negative channels are set to 0 while editing; "
            "unedited texels keep their colour"
        )
    return input_map


def _unclipped(input_map, width):
    """Return a map of its file's size with its sun, if that was clipped, at a width."""
    plain = replace(input_map, scale=1.0)
    radiance, done = unclip.with_sun(plain.radiance)
    stored = plain.as_stored(radiance)
    if width is not None:
        stored = latlong.resize(stored, width // 2, width)
    return replace(input_map, stored=stored, unclipped=done)


def load_map(settings: config.Input, scene: Scene | None = None) -> tuple[np.ndarray, list[str]]:
    """Load the map of a configuration at working width: radiance (H, W, 3) in the scene, and warnings.

    Errors are those of :func:`read_map` and :attr:`InputMap.radiance`.
    """
    input_map = read_map(settings, scene, settings.width)
    return input_map.radiance, input_map.warnings


def notes(settings: config.Input, scene: Scene, input_map: InputMap) -> list[str]:
    """Say which map a run took and what the scene's file has that is used otherwise."""
    own = scene.own
    source = input_map.source
    lines = []
    if source == SCENE and own.light is not None:
        lines.append(f"map: the scene's own light, {own.light.plugin}")
    elif settings.envmap == AUTO and source == SUNSKY:
        lines.append("map: the analytic sky, as the scene is made for any map")
    elif settings.envmap == AUTO:
        lines.append(f"map: the scene's own, {source}")
    if own.scale != 1:
        # Files are the same by whatever names.
        same_file = own.file is not None and os.path.realpath(source) == os.path.realpath(own.file)
        if source == SCENE or same_file:
            lines.append(f"the scene multiplies it by scale {own.scale:g}")
        else:
            lines.append(
                f"the scene multiplies the map (which is not the scene's own) by scale {own.scale:g}; "
                "scene.scale = 1 drops that"
            )
    lines += scene.notes
    if input_map.unclipped:
        lines.append(f"input.unclip: {input_map.unclipped}")
    if input_map.chromaticities is not None:
        space = primaries.name_of(input_map.chromaticities)
        lines.append(f"map in {space}: edited in Rec. 709, written in {space}")
    return lines


def share(scene: Scene, radiance: np.ndarray, seed: int) -> float:
    """Return the share of the picture's radiance that the map gives; 1 where the scene has no other lamps."""
    spp = 16  # a pixel
    black = scene.render(np.zeros((4, 8, 3), np.float32), spp, seed).mean(dtype=np.float64)
    return float(1 - black / max(scene.render(radiance, spp, seed).mean(dtype=np.float64), 1e-30))


def active_rows(rows: str | tuple[int, int], height: int) -> Rows:
    """Return the rows that may change: all, those above the horizon (paper, Sec. 5.1), or (first, last)."""
    if isinstance(rows, str):
        return Rows.of(height, last=(height + 1) // 2 - 1 if rows == "upper" else -1)
    return Rows.of(height, *rows)


def load_scene(settings: config.Scene, base: Path | None = None) -> Scene:
    """Load the scene of a configuration; ``base`` and errors as of :func:`.scene.load`."""
    return built_scene.load(settings.file, settings, base)
