"""Load a Mitsuba scene and render it under any environment map: the reference renderer.

A scene comes from an XML file, a dict or the name of a shipped scene. Mitsuba's parser turns it into a list
of nodes, and five things are changed there before anything is built, so that a broken reference in a part
that is not used cannot get in the way:

- the environment emitter, whatever its kind, becomes an ``envmap`` with the same orientation whose texels
  are set by :meth:`Scene.set_envmap`; where there is none, one is added;
- the film gets the asked size and float32 RGB; its reconstruction filter stays the author's;
- the integrator gives way to ``path``, with ``max_depth``, ``rr_depth`` and ``hide_emitters`` of its own;
- a rough BSDF whose alpha is at most 1e-4, which Mitsuba would clamp, becomes its limit, the smooth one;
- a shape with the properties ``fit_height`` (and ``fit_up``, one of x, y, z with or without a minus) is
  centred on the y axis, set on the plane y = 0 and scaled to that height, or to 1.5 times it in width.

Maps are radiance as it reaches the scene: a ``scale`` of the environment emitter is in them, and not in what
is built (:mod:`envedit.inputs` applies it to what a file holds). With scene and camera fixed a rendering is
I = T E + I_0: linear in the map E, plus a constant I_0 where the scene has lamps besides its environment,
which stay as they are.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config
from envedit.config.validators import meant
from envedit.core import installed_plugins, latlong, shipped
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError, EnveditError, InputError, NumericalError, texels_are
from envedit.core.quiet_libraries import quiet_libraries
from envedit.core.radiance import unmasked
from envedit.core.types import ArrayLike, FilePath
from envedit.scene import film, parser, scene_files, scene_text, supported, vertex_normals
from envedit.scene.scene_files import SceneFile
from envedit.scene.usd import conversion as usd

QUIET_DECIBELS = 48.0
"""PSNR of a rendering that is quiet, against one without noise: beyond what an edit reaches under a sun."""
QUIET_LEAST, QUIET_MOST = 256, 768
"""Samples a pixel between which a rendering of "auto" ends."""
_QUIET_PASS = 64  # samples a pixel
_ALPHA_SPP = 256
_SAMPLED = 3e-4  # of the radiance of a pole's row, in the next row, which adds 0.2 % to the light
_PASS_SAMPLES = 2**22  # bounds the memory of a wavefront, whatever the film and spp


# ---- The scene ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class View:
    """One of the pictures that a scene's rendering consists of: the name of its sensor, and its rows."""

    name: str
    rows: slice


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene under one replaceable environment map; made by :func:`load`.

    Attributes
    ----------
    mi : mitsuba.Scene
        The scene itself; its environment is an ``envmap``, other lamps stay.
    path : Path or None
        The XML file, None for a dict.
    width, height : int
        Size of a rendering in pixels, the pictures of all views below each other.
    views : tuple of View
        Name and rows of each view, in the order of ``mi.sensors()``; usually one.
    envmap_key : str
        Name of the texels in ``params``; their layout is :func:`envedit.core.latlong.to_envmap_data`'s.
    to_world : array (3, 3) float64
        Rotation from the emitter's frame to the scene's.
    digest : str
        SHA-256 (hex) of all that a rendering depends on but the map: objects, files they name, camera, film.
        Comments and the place of the files do not count.
    params : mitsuba.SceneParameters
        ``mi.traverse`` of the scene.
    own : supported.OwnMap
        File and scale of the map that the scene itself names.
    integrator : supported.Integrator
        What the scene's integrator asks for.
    notes : tuple of str
        What of the file is not used, or used otherwise.
    parameters : dict
        Values that were filled in for the ``$names`` of the XML.
    resized : callable or None
        Loads it with a film of another (width, height), in pixels, height 0 by the aspect; errors as of
        :func:`load`. None of a scene that was not loaded from a file or dict.
    files : tuple of str
        What it was loaded from beside :attr:`path`: meshes, textures, its own map.
    """

    mi: mi.Scene
    path: Path | None
    width: int
    height: int
    envmap_key: str
    to_world: np.ndarray
    digest: str
    params: mi.SceneParameters
    views: tuple[View, ...]
    own: supported.OwnMap = supported.OwnMap(None, 1.0)
    integrator: supported.Integrator = supported.Integrator()
    notes: tuple[str, ...] = ()
    parameters: dict[str, str | float | bool] = field(default_factory=dict)
    resized: Callable[[int, int], Scene] | None = None
    files: tuple[str, ...] = ()

    @functools.cached_property
    def alpha(self) -> np.ndarray | None:
        """Share of each pixel that sees a surface, (h, w) float32; None unless emitters are hidden."""
        if not self.integrator.hide_emitters:
            return None
        self.set_envmap(np.zeros((4, 8, 3), np.float32))
        picture = self._pass(min(_ALPHA_SPP, self._pass_samples()), 0, 0, 2)
        return np.clip(picture[..., 3], 0, 1).astype(np.float32)

    @property
    def rows(self) -> tuple[slice, ...]:
        """Rows of each view."""
        return tuple(view.rows for view in self.views)

    def view(self, identifier: int | str, key: str) -> int:
        """Return the index of a view by index or name; ConfigError, which names ``key``, if there is none."""
        names = [view.name for view in self.views]
        return supported.index_of(identifier, names, names, f"{key}: got view", "; see [scene] sensors")

    def set_envmap(self, image: ArrayLike) -> None:
        """Light the scene by a map (H, W, 3) of linear radiance, of any resolution.

        InputError if the shape is not that of a map. NumericalError if a texel is not finite or is negative
        in float32: one such texel spoils every lit pixel.
        """
        image = unmasked(image, "environment map")
        if image.ndim != 3 or image.shape[2] != 3 or not np.issubdtype(image.dtype, np.number):
            what = f"shape {image.shape} of {image.dtype}"
            raise InputError(f"environment map: got {what}, expected (H, W, 3) numbers")
        with np.errstate(over="ignore"):  # a float64 too large for float32 becomes inf, and is named below
            image = image.astype(np.float32)
        if (bad := ~(np.isfinite(image) & (image >= 0))).any():
            raise NumericalError(f"environment map: {texels_are(bad, 'not finite or negative')}")
        if not image[1:-1].any():  # Mitsuba's density has a factor sin(theta): it would sample nothing
            image = image.copy()
            image[[1, -2]] = np.maximum(image[[1, -2]], _SAMPLED * image[[0, -1]])
        self.params[self.envmap_key] = mi.TensorXf(latlong.to_envmap_data(image))
        self.params.update()

    def render(
        self, image: ArrayLike, spp: int = 64, seed: int = 0, max_depth: int | None = None
    ) -> np.ndarray:
        """Render the scene under a map by Mitsuba's ``path`` integrator, with fresh samples.

        ``image`` (H, W, 3) is linear radiance, as the returned rendering (height, width, 3) float32. There
        are ``spp`` samples a pixel, in passes of at most 2^22 samples, which are averaged in float64; the
        same ``seed`` gives the same ones. ``max_depth`` is the longest path in segments, as Mitsuba counts
        them: 2 is direct light; -1 has no bound. None: the scene's own.

        ConfigError if ``spp``, ``seed`` or ``max_depth`` is out of range. InputError and NumericalError as of
        :meth:`set_envmap`; also NumericalError if a pixel comes out non-finite.
        """
        spp = _whole("spp", spp, 1)
        seed = _whole("seed", seed, 0)
        max_depth = self.integrator.max_depth if max_depth is None else _whole("max_depth", max_depth, -1)
        self.set_envmap(image)
        most = self._pass_samples()
        counts = [most] * (spp // most) + ([spp % most] if spp % most else [])
        total = np.zeros((self.height, self.width, 3))
        for i, count in enumerate(counts):
            total += count / spp * self._pass(count, seed, i, max_depth)[..., :3]
        return self._checked(total)

    def sampled(
        self, image: ArrayLike, spp: int | str = "auto", seed: int = 0, exactly: int | None = None
    ) -> tuple[np.ndarray, int, np.ndarray | None]:
        """Render as :meth:`render`, its errors included, with "auto" by as many samples as quiet takes.

        Passes of 64 samples a pixel are added until the error of their mean, estimated from how much their
        display values clip(x, 0, 1)^(1/2.2) differ, is :data:`QUIET_DECIBELS` below white: 256 samples at
        least, 768 at most; or ``exactly`` as many as another rendering took, to be judged beside it: with the
        same seed they are the same samples.

        Returns the picture (height, width, 3) float32, linear radiance; the samples a pixel that were taken;
        and the standard error of display values, RMS over channels, (height, width) float64, None where
        ``spp`` is a number.
        """
        if not isinstance(spp, str):
            return self.render(image, spp, seed), spp, None
        seed = _whole("seed", seed, 0)
        self.set_envmap(image)
        count = min(self._pass_samples(), _QUIET_PASS)
        total: Any = 0.0  # then arrays
        shown, power = total, total
        for i in range(QUIET_MOST // count):
            picture = self._pass(count, seed, i, self.integrator.max_depth)[..., :3]
            display = tonemap(picture)
            total, shown, power = total + picture, shown + display, power + display**2
            n = i + 1
            if n * count >= QUIET_LEAST:
                variance = np.maximum(power / n - (shown / n) ** 2, 0).mean(axis=2) / max(n - 1, 1)
                quiet = variance.mean() < 10 ** (-QUIET_DECIBELS / 10)
                if quiet if exactly is None else n * count >= exactly:
                    break
        return self._checked(total / n), n * count, np.sqrt(variance)

    def _pass_samples(self):
        """Most samples a pixel of one pass: a power of four, for as many strata across as down."""
        return 4 ** (max(0, (_PASS_SAMPLES // (self.width * self.height)).bit_length() - 1) // 2)

    def _pass(self, count, seed, i, max_depth):
        """Render one pass of every view with alpha, (h, w, 4) float64."""
        installed_plugins.come_first()
        own = self.integrator
        options = {"max_depth": max_depth, "rr_depth": own.rr_depth, "hide_emitters": own.hide_emitters}
        integrator = mi.load_dict({"type": "path", **options})
        pictures = []
        for k in range(len(self.views)):
            pass_seed = int(np.random.SeedSequence([seed, i, k]).generate_state(1)[0])
            pictures.append(film.render(self.mi, integrator, count, pass_seed, k))
        return np.concatenate(pictures)

    def _checked(self, total):
        """Round to float32, refusing what is not finite."""
        with np.errstate(over="ignore"):
            result = total.astype(np.float32)
        if (bad := ~np.isfinite(result).all(axis=2)).any():
            raise NumericalError(
                f"rendering of {self.path or 'the scene'}: {texels_are(bad, 'not finite', unit='pixel')}; "
                "look for broken materials or too much light"
            )
        return result


def load(
    file: FilePath | dict,
    width: int | None = None,
    height: int | None = None,
    parameters: Mapping[str, Any] | None = None,
    base: FilePath | None = None,
    sampler: str = "multijitter",
    sensors: str | Sequence[int | str] = (0,),
    up: str = "auto",
    scale: float | str = "auto",
) -> Scene:
    """Load a scene and make its environment emitter replaceable; it gets one if it has none.

    ``parameters``, ``base`` and ``sensors`` are those of :func:`.api.load_scene`. The scene is lit by a grey
    map until :meth:`Scene.set_envmap` or :meth:`Scene.render` sets another. ConfigError if a parameter or
    sensor is unknown, missing or unusable, or the size is. InputError if files are missing or damaged, all of
    which are named, the scene has several environment emitters, or something that is not supported.

    ``file`` is a Mitsuba XML file, a USD file (:func:`.usd.conversion.kept`), the name of a shipped scene
    (:func:`.shipped.scenes`, with or without ``.xml``; a file of that name in the working folder comes
    first), or a dict as ``mi.load_dict`` takes it. ``width`` and ``height`` are of the rendering, pixels;
    None or 0: the scene's own, or by its aspect if one of both is given. ``sampler`` is that of Mitsuba's
    renderings where the scene has none or ``independent``: stratified samples, 256 a pixel, have 8 dB less
    noise than as many independent ones in the shipped scenes. ``up`` is the axis of the map's zenith, as of
    :func:`.parser.replace_environment`, ``scale`` what maps are multiplied by in place of the ``scale`` of
    the emitter.
    """
    if not (mi.variant() or "").endswith("_rgb"):
        raise ConfigError(f"variant: got {mi.variant()}, expected one that ends in _rgb, such as llvm_ad_rgb")

    # ---- Parse
    width, height = width or 0, height or 0
    parsed = _parsed(file, parameters, base)
    state, where, folders = parsed.state, parsed.where, parsed.folders

    # ---- What is read of emitter, integrator and sensors
    own = supported.own_map(state, where, folders, scale)
    integrator = supported.take_integrator(state, where)
    if usd.is_usd(file) and sensors != "all" and tuple(sensors) == (0,):
        supported.require_one_sensor(state, where)
    sensor_indices, names, sensor_notes = supported.take_sensors(state, where, sensors)

    # ---- What is changed of film, emitter, BSDFs, files and shapes
    for sensor in sensor_indices:
        parser.set_film(state, where, sensor, width, height)
    emitter, to_world, turned = parser.replace_environment(state, where, up)
    _change_nodes(state, where, folders)

    # ---- Notes, files and digest
    notes = (
        *parsed.notes,
        *own.notes,
        *turned,
        *integrator.notes,
        *supported.polarised(state),
        *sensor_notes,
    )
    read = [node.props["filename"] for node in state.nodes if "filename" in node.props]
    read += [] if own.file is None else [str(own.file)]
    digest = hashlib.sha256(b"envedit scene 1")
    for node in state.nodes:
        parser.hash_node(digest, node)
    emitter["bitmap"] = mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32))
    name = str(emitter.id())
    for sensor in sensor_indices:  # after the digest: light transport has its own samples
        parser.set_sampler(state, sensor, sampler)

    # ---- All properties count as unread: Mitsuba refuses those that no plugin reads, such as typing errors
    for node in state.nodes:
        for key in node.props.keys():  # noqa: SIM118 (no dict)
            node.props.mark_queried(key, False)

    # ---- Build
    # On one thread Mitsuba waits for ever for an EXR texture; libjpeg prints about odd textures.
    with film.threads(max(2, dr.thread_count())), quiet_libraries():
        scene = parser.instantiated(parsed.config, state, where)
    if scene.environment() is None or scene.environment().id() != name:
        raise InputError(f"{where}: a ready-made environment emitter cannot be replaced; give its dict")
    params = mi.traverse(scene)
    vertex_normals.summed_in_order(params)
    key = next(k for k, _ in params if k.split(".")[-2:] == [name, "data"])
    columns, views = views_of(scene, names)
    return Scene(
        scene,
        parsed.path,
        columns,
        views[-1].rows.stop,
        key,
        to_world,
        digest.hexdigest(),
        params,
        views,
        own=own,
        integrator=integrator,
        notes=notes,
        parameters=dict(parameters or {}),
        resized=lambda wide, high: load(file, wide, high, parameters, base, sampler, sensors, up, scale),
        files=tuple(read),
    )


def _change_nodes(state, where, folders):
    """Change BSDFs, find the files that nodes name, and fit shapes; all files that are wrong are named."""
    for node in state.nodes:
        parser.smooth_limit(state, node)
    files = []
    wrong = []
    for node in state.nodes:
        try:
            if file := parser.find_file(state, node, where, folders):
                files.append(file)
        except InputError as error:
            wrong.append(error)
    wrong += scene_files.errors(files)
    if wrong:
        first, *others = dict.fromkeys(str(error).replace("\n", ", ") for error in wrong)
        raise InputError(f"{first}\nalso: {'; '.join(others)}" if others else str(wrong[0]))
    for node in state.nodes:
        parser.fit_to_stage(state, node)


def views_of(scene: mi.Scene, names: Sequence[str]) -> tuple[int, tuple[View, ...]]:
    """Return the width that all views have, and name and rows of each; ConfigError if widths differ."""
    views = []
    sizes = [[int(n) for n in s.film().crop_size()] for s in scene.sensors()]
    first = 0
    for name, (width, height) in zip(names, sizes, strict=True):
        if width != sizes[0][0]:
            raise ConfigError(
                f"scene.sensors: {names[0]} is {sizes[0][0]} pixels wide and {name} is {width}: views need "
                "the same width; set [scene] width, or choose other sensors"
            )
        views.append(View(name, slice(first, first + height)))
        first += height
    return sizes[0][0], tuple(views)


class _Parsed(NamedTuple):
    """A scene as Mitsuba's parser has it."""

    config: mi.parser.ParserConfig
    state: mi.parser.ParserState
    path: Path | None  # its file; None: a dict
    where: str  # what errors call it
    folders: tuple[Path, ...]  # where the files lie that it names
    notes: tuple[str, ...]  # what of a USD file is not used


def _parsed(file, parameters, base):
    """Parse a scene; a USD file becomes a Mitsuba scene first."""
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = False  # shapes keep their names
    config.unused_parameters = mi.LogLevel.Debug  # checked here, with the nearest name
    base = Path(base or ".").absolute()
    notes: tuple[str, ...] = ()
    if isinstance(file, dict):
        if parameters:
            raise ConfigError("scene.parameters: a scene given as a dict has no $names to fill")
        path = None
        where = "scene dict"
        folders = (base,)
        installed_plugins.come_first()
        installed_plugins.check_dict(file, where)
        state = parser.called(where, mi.parser.parse_dict, config, file)
    else:
        path = find(file)
        text = path
        if usd.is_usd(path):
            text, notes = usd.kept(path)[:2]
        filled = _as_text(parameters or {})
        outline = _outline(text, filled)
        where, folders = str(path), (text.parent, base, *outline.folders)
        if wrong := scene_files.errors([SceneFile("spectrum", file) for file in outline.spectra]):
            raise wrong[0]
        with installed_plugins.restored():
            state = parser.called(where, mi.parser.parse_file, config, str(text), **filled)
    parser.check_references(state, where)
    parser.called(where, mi.parser.transform_all, config, state)
    installed_plugins.come_first()
    for node in state.nodes:
        parser.check_plugin(state, node, where)
    return _Parsed(config, state, path, where, folders, notes)


def relit(chosen: config.Scene, envmap: str, base: FilePath | None = None) -> str:
    """Return the XML of a scene under another map, otherwise as its author has it; errors as of :func:`load`.

    Film, sampler, integrator and all sensors stay; parameters are filled in, files named by absolute paths,
    and what plain Mitsuba does not know (``fit_height``, names in capitals) is written out. The environment
    emitter becomes an ``envmap`` of the file ``envmap``, as it shall stand in the XML, with the rotation and
    ``scale`` of :func:`load`, or one is added; a scene without an integrator gets ``path``.
    """
    parsed = _parsed(chosen.file, dict(chosen.parameters), base)
    state, where, folders = parsed.state, parsed.where, parsed.folders
    own = supported.own_map(state, where, folders, chosen.scale)
    emitter, _, _ = parser.replace_environment(state, where, chosen.up)
    _change_nodes(state, where, folders)
    emitter["filename"] = envmap
    emitter["scale"] = own.scale
    if not any(node.type == mi.ObjectType.Integrator for node in state.nodes):
        parser.append(state, mi.ObjectType.Integrator, "path")
    return mi.parser.write_string(state)


# ---- Files and parameters ----------------------------------------------------------------------------------


def find(file: FilePath) -> Path:
    """Return the XML or USD file meant by a path, or by the bare name of a shipped scene."""
    path = Path(file)
    if os.path.isfile(path):  # False, and no error, in a folder that may not be entered
        return path.absolute()
    name = path.name.removesuffix(".xml")
    bare = path.name == str(file)
    names = shipped.scenes()
    if bare and name in names:
        return shipped.folder() / f"{name}.xml"
    if os.path.isdir(path):
        raise InputError(f"scene {file}: this is a folder, expected a Mitsuba XML or USD file")
    expected = f"expected a Mitsuba XML or USD file or one of {', '.join(names)}"
    hint = meant(name, names, expected) if bare else expected
    raise InputError(f"scene {file}: no such file; {hint}")


def files(chosen: config.Scene, base: FilePath | None = None) -> list[Path]:
    """List what a scene may read, itself included: every file that it names, in every folder of :func:`load`.

    Nothing is built. A scene that cannot be read has itself only.
    """
    path = Path(chosen.file).absolute()
    sources: tuple[str, ...] = ()
    try:
        text = path = find(chosen.file)
        if usd.is_usd(path):
            converted = usd.kept(path)
            text, sources = converted.xml, converted.sources
        outline = scene_text.read(text, _as_text(chosen.parameters))
    except EnveditError:
        return [path]
    folders = text.parent, Path(base or ".").absolute(), *outline.folders
    return [path, *map(Path, sources), *(folder / name for name in outline.files for folder in folders)]


def _as_text(parameters: Mapping[str, object]) -> dict[str, str]:
    """Return the values of parameters as they stand in XML."""
    return {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in parameters.items()}


def _outline(path: Path, parameters: dict[str, str]) -> scene_text.Outline:
    """Read a scene's XML, and compare the names of parameters with its ``$names``."""
    outline = scene_text.read(path, parameters)
    used, defaults = outline.used, outline.defaults
    for name in parameters:
        if name not in used | defaults:
            known = ", ".join(sorted(used | defaults)) or "none"
            hint = meant(name, used | defaults, "")
            hint = f"; {hint}" if hint else ""
            raise ConfigError(f"scene.parameters: {path.name} has no parameter {name}{hint} (known: {known})")
    if missing := sorted(used - defaults - parameters.keys()):
        raise ConfigError(
            f"scene.parameters: {path.name} needs {', '.join(missing)}, which has no default; give it: "
            + " ".join(f"--set scene.parameters.{name}=VALUE" for name in missing)
        )
    return outline


def _whole(name: str, value: Any, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < low:
        raise ConfigError(f"{name}: got {value!r}, expected a whole number of at least {low}")
    return int(value)
