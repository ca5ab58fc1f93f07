"""An edit or a fit from Python, without files: ``envedit.edit(config)``, ``envedit.fit(image)``."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from envedit import config, inputs
from envedit.config.validators import Integer, named, show
from envedit.core.errors import ConfigError, InputError
from envedit.core.radiance import unmasked
from envedit.images import analytic_sky, images
from envedit.images.headers import MAX_SIDE
from envedit.pipeline import Watch, run
from envedit.representations.siren import fit as siren
from envedit.representations.siren.fit import Fitted
from envedit.results import Result
from envedit.scene import built_scene
from envedit.scene.scene import Scene

__all__ = ["edit", "fit", "load_map", "load_scene", "sunsky"]

GIVEN = "given"
"""What a scene without a file is called."""


def edit(
    settings: config.Config | Mapping[str, Any] | str | PathLike[str] | None = None,
    *,
    envmap: ArrayLike | None = None,
    target: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    target_map: ArrayLike | None = None,
    scene: Scene | mi.Scene | Mapping[str, Any] | str | PathLike[str] | None = None,
    base: str | PathLike[str] | None = None,
    watch: Watch | None = None,
) -> Result:
    """Carry out an edit without writing files.

    Every array takes the place of what the configuration names; without any, ``envedit.edit("config.toml")``
    is the run of the command line.

    Parameters
    ----------
    settings : Config, dict or path, optional
        A configuration; nested dicts with its tables and keys, ``{"scene": {"file": "mirror"}}``, whose
        relative paths start from the working folder; or the TOML file of one. By default all defaults.
    envmap : array (H, 2 H, 3), optional
        The map to edit: linear radiance, finite, Rec. 709, +Y up, the zenith in row 0. The ``scale`` of the
        scene's emitter multiplies it, as it does a file.
    target : array (h, w, 3), optional
        The rendering as it should look, linear radiance: a rendering, or one with something painted over it.
        Several views are below each other. Where it differs from the initial rendering it is asked for; all
        else is to stay.
    mask : array (h, w), optional
        How much each pixel of ``target`` is asked for, in [0, 1], in place of comparing.
    target_map : array (H, 2 H, 3), optional
        The scene shall look as under this map, radiance as of ``envmap``; in place of ``target``.
    scene : Scene, mitsuba.Scene, dict, or path, optional
        What the map lights: what :func:`load_scene` returned; a scene that Mitsuba has built, lit by an
        ``envmap``, rendered at the size of its film, with its own map again when this returns; a dict of
        ``mi.load_dict``; or a file. Without ``envmap``, a built scene's own map is edited.
    base : path, optional
        Folder that file names in scene parameters are relative to; by default the configuration's.
    watch : Watch, optional
        Receives progress.

    Returns
    -------
    Result
        ``envmap``, ``render``, ``metrics``, ``history``; ``save(folder)`` writes what a run leaves.

    Raises
    ------
    ConfigError
        The configuration has an unknown key or an unusable value, which the message names, or arguments do
        not go together.
    InputError
        A file or an array cannot be used: missing, of another shape, not finite, masked.
    EnveditError
        As :func:`envedit.pipeline.run`.

    Examples
    --------
    >>> result = envedit.edit({"preset": "draft"}, envmap=sky, target=picture)  # doctest: +SKIP
    """
    if mask is not None and target is None:
        raise ConfigError("mask: got one without a target; expected both: it says where that was painted")
    if target is not None and target_map is not None:
        raise ConfigError("target, target_map: got both, expected one: a picture, or a map to render under")
    _require("watch", watch, Watch, "a Watch")
    _require("base", base, str | PathLike, "a path")
    named = {"envmap": envmap, "target": target, "mask": mask, "target_map": target_map}
    arrays = {name: _array(name, value) for name, value in named.items() if value is not None}
    chosen, folder = _settings(settings)
    base = folder if base is None else Path(base)
    mi.set_variant(chosen.variant)
    with contextlib.ExitStack() as stack:
        loaded = None
        if scene is not None:
            if built_scene.is_built(scene):
                if envmap is None and chosen.input.envmap in (inputs.AUTO, inputs.SCENE):
                    arrays["envmap"] = built_scene.own_map(scene)
                stack.enter_context(built_scene.kept(scene))
            loaded = built_scene.load(scene, chosen.scene, base)
            chosen = _of_scene(chosen, loaded)
        given = inputs.Replacements(
            scene=loaded,
            envmap=arrays.get("envmap"),
            target_map=arrays.get("target_map"),
            target=arrays.get("target"),
            mask=arrays.get("mask"),
        )
        result = run(_of_arrays(chosen, arrays), base=base, watch=watch, replacements=given)
    of_codes = [_warning_of_codes(name, named[name]) for name in arrays if name != "mask"]
    if any(of_codes):
        result.warnings[:0] = filter(None, of_codes)
    return result


def fit(
    image: ArrayLike,
    network: config.Representation | Mapping[str, Any] | None = None,
    settings: config.Fit | Mapping[str, Any] | None = None,
    seed: int = 0,
    rows: tuple[int, int] | None = None,
    *,
    folder: str | PathLike[str] | None = None,
    progress: Callable[[int, int, float], None] | None = None,
) -> Fitted:
    """Fit a SIREN to an image in normalised log space, under weight perturbation (paper, Sec. 4).

    Parameters
    ----------
    image : array (H, W, 3)
        Linear radiance, finite and not negative.
    network : Representation or dict, optional
        Width, depth and frequency, keys of ``[representation]``; the standard preset's by default.
    settings : Fit or dict, optional
        The recipe, keys of ``[fit]``; the standard preset's by default.
    seed : int
        Seed of the initial weights.
    rows : (int, int), optional
        First row of the image in its map, and the rows of that map; None: the image is a whole map.
    folder : path, optional
        Where fits are kept under a hash of image and settings, half-made ones too; None: nowhere.
    progress : callable, optional
        Called with (epoch, epochs, loss) now and then.

    Returns
    -------
    Fitted
        ``params``, ``normalisation``, ``log_psnr`` (dB), ``peak_ratio`` (of the brightest texel).

    Raises
    ------
    ConfigError
        A key is unknown, or its value cannot be used.
    InputError
        The image has another shape, or a texel is not finite or is negative.
    NumericalError
        Too many steps were not finite.
    """
    pixels = _array("image", image)
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise InputError(f"image: got an array of shape {pixels.shape}, expected (H, W, 3)")
    config.Config(seed=seed)  # checks it
    if isinstance(network, Mapping):
        network = config.Representation(**{"kind": "siren", **network})
    if isinstance(settings, Mapping):
        settings = config.Fit(**settings)
    _require("network", network, config.Representation, "a Representation or a dict of its keys")
    _require("settings", settings, config.Fit, "a Fit or a dict of its keys")
    _require("folder", folder, str | PathLike, "a path")
    _require("progress", progress, Callable, "a function of (epoch, epochs, loss)")
    folder = None if folder is None else Path(folder)
    _select_variant()
    return siren.fit(pixels, network, settings, seed, rows, folder=folder, progress=progress)


def load_scene(
    scene: mi.Scene | Mapping[str, Any] | str | PathLike[str],
    width: int = 128,
    height: int = 0,
    *,
    parameters: Mapping[str, Any] | None = None,
    sensors: str | Sequence[int | str] = (0,),
    base: str | PathLike[str] | None = None,
) -> Scene:
    """Load a scene for :class:`LightTransport`, :func:`edit`, and to render under any map.

    Parameters
    ----------
    scene : mitsuba.Scene, dict or path
        A Mitsuba XML or USD file, the name of a shipped scene, such as "sphere", a dict of ``mi.load_dict``,
        or a scene that Mitsuba has built, whose environment map is replaced when it is rendered.
    width, height : int
        Size of the rendering, pixels; height 0: by the scene's aspect. A built scene has its film's.
    parameters : dict, optional
        Values for the defaults, ``$name``, of the XML.
    sensors : "all" or sequence of int and str
        Sensors whose pictures a rendering consists of, below each other.
    base : path, optional
        Folder that file names in ``parameters`` are relative to; by default the working folder.

    Returns
    -------
    Scene
        ``render(envmap, spp, seed)`` returns linear radiance (h, w, 3) float32.

    Raises
    ------
    ConfigError
        A parameter, a sensor or the size cannot be used.
    InputError
        A file is missing or damaged, or the scene has something that is not supported.
    """
    _require("base", base, str | PathLike, "a path")
    _select_variant()
    settings = config.Scene(
        width=width,
        height=height,
        parameters=dict(parameters) if isinstance(parameters, Mapping) else parameters or {},
        sensors=tuple(sensors) if isinstance(sensors, Sequence) and not isinstance(sensors, str) else sensors,
    )
    return built_scene.load(scene, settings, base)


def load_map(file: str | PathLike[str], width: int | None = None) -> np.ndarray:
    """Read an environment map.

    Parameters
    ----------
    file : path
        OpenEXR or Radiance HDR, lat-long 2:1, at least 6 x 3.
    width : int, optional
        Texels across, even: resampled with the flux kept; by default the file's.

    Returns
    -------
    ndarray (width / 2, width, 3) float32
        Linear radiance in Rec. 709, finite and not negative; row 0 is the zenith.

    Warns
    -----
    UserWarning
        The map is odd but usable: a negative texel that is set to 0, a light cut at 65504.

    Raises
    ------
    InputError
        The file cannot be read, is no 2:1, or has a texel that is not finite.
    ConfigError
        ``width`` is odd or out of range.
    """
    if width is not None:
        width = named("width", Integer(6, MAX_SIDE, even=True), width)
    envmap, info = images.load_envmap(file, width)
    for line in info["warnings"]:
        warnings.warn(f"{info['path']}: {line}", stacklevel=2)
    return envmap


def sunsky(
    width: int = 256, azimuth: float = 90.0, elevation: float = 35.0, turbidity: float = 3.0
) -> np.ndarray:
    """Make an analytic sky with a sun: Hosek and Wilkie 2012, 2013, by Mitsuba's ``sunsky``.

    Parameters
    ----------
    width : int
        Texels across, even, from 6 to 16384.
    azimuth, elevation : float
        Of the sun, degrees: along the columns, and above the horizon (0 to 90).
    turbidity : float
        Haziness of the air, 1 (pure) to 10.

    Returns
    -------
    ndarray (width / 2, width, 3) float32
        Linear radiance; grey ground below the horizon.

    Raises
    ------
    ConfigError
        A value is out of its range.
    """
    checked = config.Input(width=width, azimuth=azimuth, elevation=elevation, turbidity=turbidity)
    _select_variant()
    return analytic_sky.sunsky(checked.width, checked.azimuth, checked.elevation, checked.turbidity)


def _select_variant() -> None:
    """Select the default variant of Mitsuba where none is selected."""
    if mi.variant() is None:
        mi.set_variant(config.Config().variant)


def _of_scene(settings: config.Config, scene: Scene) -> config.Config:
    """Describe a scene in a configuration as far as that is possible; a built one is not kept on disk."""
    heights = {rows.stop - rows.start for rows in scene.rows}
    height = heights.pop() if len(heights) == 1 else 0
    if scene.path is None:
        if scene.digest.startswith(built_scene.UNKNOWN):
            settings = replace(settings, renderer=replace(settings.renderer, cache=False))
        return replace(settings, scene=config.Scene(file=GIVEN, width=scene.width, height=height))
    described = config.Scene(
        file=str(scene.path),
        width=scene.width,
        height=height,
        sensors=settings.scene.sensors if len(scene.views) == 1 else "all",
        parameters=scene.parameters,
        up=settings.scene.up,
        scale=settings.scene.scale,
    )
    return replace(settings, scene=described)


def _require(name: str, value: object, kind: Any, expected: str) -> None:
    """Raise ConfigError unless an argument is None or of a kind."""
    if value is not None and not isinstance(value, kind):
        raise ConfigError(f"{name}: got {show(value)}, expected {expected}")


def _settings(settings: object) -> tuple[config.Config, Path | None]:
    """Return a configuration, and the folder that its files are relative to."""
    if settings is None:
        return config.from_dict({}), None
    if isinstance(settings, config.Config):
        return settings, None
    if isinstance(settings, Mapping):
        return config.from_dict(dict(settings), name="settings"), None
    if isinstance(settings, str | PathLike):
        return config.load(settings), Path(settings).absolute().parent
    kinds = "a Config, a dict of tables, or the path of a TOML file"
    raise ConfigError(f"settings: got {show(settings)}, expected {kinds}")


def _array(name: str, value: ArrayLike) -> np.ndarray:
    """Return an argument as float32, as which it is saved; shape and values are checked where it is used."""
    array = unmasked(value, name)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name}: got {show(value)}, expected an array of numbers")
    with np.errstate(over="ignore"):  # what leaves float32 becomes infinite, and is refused as such
        return array.astype(np.float32)


def _warning_of_codes(name: str, value: ArrayLike | None) -> str:
    """Return a warning of an array that may hold codes of a picture, not radiance; "" for others."""
    array = np.asarray(value)
    if array.dtype not in (np.uint8, np.uint16) or not (array > 1).any():
        return ""
    return (
        f"{name}: got {array.dtype} up to {array.max()}, taken as linear radiance as it is; "
        "if it holds codes of a picture, undo their display curve first"
    )


def _of_arrays(settings: config.Config, arrays: Mapping[str, np.ndarray]) -> config.Config:
    """Say in a configuration what comes as an array, so that presets and reports know."""
    if "envmap" in arrays:
        settings = replace(settings, input=replace(settings.input, envmap=images.ARRAY))
    if "target" in arrays or "target_map" in arrays:
        table = settings.target
        kept = {key: getattr(table, key) for key in table.given & {"tonemap", "paint", "rest", "hold", "spp"}}
        kind = "envmap"
        if "target" in arrays:
            kind = "rendering" if table.kind == "rendering" else "image"
        settings = replace(settings, target=config.Target(kind=kind, file=images.ARRAY, **kept))
    return settings
