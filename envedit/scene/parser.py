"""Changes to the nodes of a parsed Mitsuba scene before it is built, and the digest of what they hold.

Each function takes the parser's ``state`` or one of its ``nodes`` and changes it in place; ``where`` is what
errors call the scene. What is changed and why is said in :mod:`envedit.scene.scene`.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from envedit.core import atomic_files, installed_plugins, rotations
from envedit.core.errors import ConfigError, InputError
from envedit.scene.scene_files import SceneFile
from envedit.scene.scene_text import DEEPEST

# Emitters at infinity that shine from every direction, with the axis of their zenith. Mitsuba's sky models
# stand upright on z; a constant light has no zenith.
_ENVIRONMENTS = {"envmap": "y", "constant": None, "sky": "z", "sunsky": "z", "timed_sunsky": "z"}
_SMOOTH = {"roughconductor": "conductor", "roughplastic": "plastic", "roughdielectric": "dielectric"}
_SMALLEST_ALPHA = 1e-4  # Mitsuba's own clamp
_ROUNDING = 1e-4  # of a rotation's columns
_LEVEL = 1e-3  # of a sensor's right: how far from a level one it may be
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
_REQUIRED = {"bitmap": ("filename", "bitmap", "data"), "blendbsdf": ("weight",), "normalmap": ("normalmap",)}
"""Of which one must be given: Mitsuba 3.9 reads beyond the properties of such a plugin that has none."""
_MESHES = {".ply": "ply", ".obj": "obj", ".serialized": "serialized"}
_MOST_WIDTH_PER_HEIGHT = 1.5


# ---- Words for errors --------------------------------------------------------------------------------------


def called(where: str, call: Callable, /, *arguments: Any, **filled: Any) -> Any:
    """Call a function of the parser; its errors become an InputError of one line that names the file."""
    try:
        return call(*arguments, **filled)
    except (RuntimeError, ValueError, TypeError, LookupError, OSError) as error:
        text = re.sub(r"\[[A-Za-z][\w.]*(:\d+)?\] ", "", str(error))
        text = "".join(c if c.isprintable() else " " for c in text)
        text = " ".join(text.split())
        file = re.escape(where)
        text = re.sub(f'At {file} |(Error w|W)hile loading {file} |At dictionary node "root": ', "", text)
        text = re.sub(f'Parsing of XML file "?{file}"? failed: ', "", text)
        hint = r"\g<0>; give it: --set scene.parameters.\1=VALUE"
        text = re.sub(r"undefined parameter: \$(\w+)", hint, text)
        raise InputError(f"{where}: {text if len(text) <= 300 else text[:297] + '...'}") from None


def place_of(state: mi.parser.ParserState, node: mi.parser.SceneNode, where: str) -> str:
    """Say where a node stands: file and line, or its name in a dict."""
    return mi.parser.file_location(state, node) if state.files else f"{where}, {node.props.id()}"


# ---- Nodes -------------------------------------------------------------------------------------------------


def references(node: mi.parser.SceneNode) -> dict[str, int]:
    """Return the indices of the nodes that a node refers to, by the names of its properties."""
    kind = mi.Properties.ResolvedReference
    return {name: value.index() for name, value in node.props.items() if isinstance(value, kind)}


def inside(state: mi.parser.ParserState, node: mi.parser.SceneNode, kind: mi.ObjectType) -> list[int]:
    """Return the indices of the nodes of a kind that a node refers to."""
    return [i for i in references(node).values() if state.nodes[i].type == kind]


def check_references(state: mi.parser.ParserState, where: str) -> None:
    """Refuse a scene whose objects refer to one another too deeply for Mitsuba's recursion, with InputError.

    That is in a chain longer than :data:`.scene_text.DEEPEST`, or in a circle.
    """
    by_name = dict(state.id_to_index)
    below = []
    for node in state.nodes:
        named = [by_name[name] for _, name in node.props.references() if name in by_name]
        below.append({*references(node).values(), *named})
    ends = set(range(len(below)))  # of chains of one more reference in each round
    for _ in range(DEEPEST):
        ends = {child for node in ends for child in below[node]}
    if ends:
        raise InputError(f"{where}: objects refer to one another in a circle, or more than {DEEPEST} deep")


def instantiated(config: mi.parser.ParserConfig, state: mi.parser.ParserState, where: str) -> mi.Scene:
    """Build a parsed scene; InputError if Mitsuba cannot."""
    built = called(where, mi.parser.instantiate, config, state)
    return built[0] if isinstance(built, list | tuple) else built


# ---- Changes -----------------------------------------------------------------------------------------------


def check_plugin(state: mi.parser.ParserState, node: mi.parser.SceneNode, where: str) -> None:
    """Refuse a plugin that is not installed, or lacks a property without which Mitsuba stops with a signal.

    Its name becomes that of Mitsuba 3: older ones took ``Rectangle`` too.
    """
    props = node.props
    name = props.plugin_name().lower()
    if name != props.plugin_name():
        props.set_plugin_name(name)
    place = place_of(state, node, where)
    installed_plugins.check(name, place)
    needed = _REQUIRED.get(name, ())
    if needed and not any(key in props for key in needed):
        raise InputError(f"{place}: {name} has no {' or '.join(needed)}; give it one")


def environment(state: mi.parser.ParserState, where: str) -> int | None:
    """Return the index of the environment emitter's node; None if there is none, InputError if several."""
    emitters = [i for i, n in enumerate(state.nodes) if n.type == mi.ObjectType.Emitter]
    environments = [i for i in emitters if state.nodes[i].props.plugin_name() in _ENVIRONMENTS]
    if len(environments) > 1:
        kinds = ", ".join(state.nodes[i].props.plugin_name() for i in environments)
        raise InputError(
            f"{where}: {len(environments)} environment emitters ({kinds}); expected one: remove others"
        )
    return environments[0] if environments else None


def replace_environment(
    state: mi.parser.ParserState, where: str, up: str = "auto"
) -> tuple[mi.Properties, np.ndarray, tuple[str, ...]]:
    """Put an ``envmap`` in place of the environment emitter, or add one; may move nodes, as :func:`append`.

    ``up`` is the axis of the map's zenith where the emitter has none: x, y, z, with or without a minus;
    "auto": that of the first sensor (:func:`_sensor_up`). Returns the properties of the ``envmap``; its
    rotation (3, 3); and notes, where its zenith is unless that is +y or the emitter's own.
    """
    # ---- Where the map's zenith and its first azimuth are
    index = environment(state, where)
    note = ""
    plugin = "constant" if index is None else state.nodes[index].props.plugin_name()
    matrix = np.eye(4)
    if (zenith := _ENVIRONMENTS[plugin]) is None:
        zenith = _sensor_up(state) if up == "auto" else up
        if zenith != "y" or up != "auto":
            why = "the sensor's up" if up == "auto" else "as scene.up says"
            note = f"map: its zenith is the scene's {zenith if zenith[0] == '-' else f'+{zenith}'}, {why}"
            note += "; scene.up sets another" if up == "auto" else ""
    else:
        place = place_of(state, state.nodes[index], where)
        props = state.nodes[index].props
        matrix = _matrix(props["to_world"], place) if "to_world" in props else matrix
        if up != "auto":
            note = f"scene.up has no effect: the scene's {plugin} has an orientation of its own"

    # ---- Only the rotation counts: a uniform scale has no meaning at infinity
    rotation = rotations.rotation_in(matrix[:3, :3], _ROUNDING)
    if rotation is None:
        raise InputError(
            f"{place}: to_world of the environment emitter stretches, shears or "
            "mirrors; expected a rotation (the axis of <rotate> has length 1)"
        )
    rotation = rotation @ _upright(zenith).T
    matrix = np.eye(4)  # where an environment stands has no meaning: a translation is dropped
    matrix[:3, :3] = rotation

    # ---- The envmap, under a name of its own
    if index is None:
        index = append(state, mi.ObjectType.Emitter, "envmap")
    taken = {n.props.id() for i, n in enumerate(state.nodes) if i != index}
    emitter = mi.Properties("envmap")
    emitter.set_id(next(name for i in range(len(taken) + 1) if (name := f"envmap{i or ''}") not in taken))
    emitter["to_world"] = mi.ScalarTransform4d(matrix)
    state.nodes[index].props = emitter
    return state.nodes[index].props, rotation, (note,) if note else ()


def _sensor_up(state):
    """Return the axis +x, +y or +z that is up for the first sensor: perpendicular to what is right of it.

    Of two, the one that the sensor is tilted less against. +y where there is none.
    """
    sensor = next((n for n in state.nodes if n.type == mi.ObjectType.Sensor), None)
    if sensor is None or "to_world" not in sensor.props:
        return "y"
    right, upward = _matrix(sensor.props["to_world"], "sensor")[:3, :2].T
    level = [k for k in range(3) if abs(right[k]) < _LEVEL * np.linalg.norm(right) and upward[k] > 0]
    return "xyz"[max(level, key=lambda k: (upward[k], k == 1))] if level else "y"


def append(state: mi.parser.ParserState, kind: mi.ObjectType, plugin: str, parent: int | None = None) -> int:
    """Add a node inside another, by default the scene, and return its index.

    Moves the scene's nodes in memory: nodes and properties taken from ``state`` before are void.
    """
    if parent is None:
        parent = next(i for i, n in enumerate(state.nodes) if n.type == mi.ObjectType.Scene)
    # Before the append, which moves the nodes.
    state.nodes[parent].props[f"added_{plugin}"] = mi.Properties.ResolvedReference(len(state.nodes))
    node = mi.parser.SceneNode()
    node.type, node.props = kind, mi.Properties(plugin)
    state.nodes.append(node)
    return len(state.nodes) - 1


def set_film(state: mi.parser.ParserState, where: str, sensor: int, width: int, height: int) -> None:
    """Give the film of a sensor, a node's index, the asked size and float32 RGB pixels.

    The size is that of the picture: of the crop, where the film has one, which keeps its part of the film to
    half a pixel. May move the scene's nodes in memory, as :func:`append`.
    """
    films = inside(state, state.nodes[sensor], mi.ObjectType.Film)
    if not films:
        films = [append(state, mi.ObjectType.Film, "hdrfilm", sensor)]  # what Mitsuba takes
    place = place_of(state, state.nodes[films[0]], where)
    film = state.nodes[films[0]].props
    if film.plugin_name() != "hdrfilm":
        raise InputError(f'{place}: the sensor needs a <film type="hdrfilm">, got {film.plugin_name()}')
    film["pixel_format"], film["component_format"] = "rgb", "float32"
    own = film.get("width", 768), film.get("height", 576)  # Mitsuba's defaults
    crop = film.get("crop_width", own[0]), film.get("crop_height", own[1])
    offset = film.get("crop_offset_x", 0), film.get("crop_offset_y", 0)
    numbers = *own, *crop, *(n + 1 if isinstance(n, int) else n for n in offset)
    whole = all(isinstance(n, int) and n > 0 for n in numbers)
    if not whole or any(crop[k] + offset[k] > own[k] for k in (0, 1)):
        part = "" if crop == own else f", its crop {crop[0]} x {crop[1]} at {offset[0]}, {offset[1]}"
        raise InputError(
            f"{place}: the film is {own[0]} x {own[1]}{part}, expected whole numbers above 0, the crop inside"
        )
    cropped = any(str(name).startswith("crop_") for name, _ in film.items())
    for k, size in enumerate(_of_aspect(width, height, *crop)):
        side = ("width", "height")[k]
        scale = size / crop[k]
        film[side] = max(size, round(scale * own[k]))
        if cropped:
            film[f"crop_{side}"] = size
            film[f"crop_offset_{'xy'[k]}"] = min(round(scale * offset[k]), film[side] - size)


def _of_aspect(width, height, own_width, own_height):
    """Return both sides of a picture of which any may be 0: by the aspect of the other, or its own."""
    if not width and not height:
        return own_width, own_height
    return (
        width or max(1, round(height * own_width / own_height)),
        height or max(1, round(width * own_height / own_width)),
    )


def set_sampler(state: mi.parser.ParserState, sensor: int, plugin: str) -> None:
    """Give a sensor, a node's index, a sampler of the asked kind, unless it has another than ``independent``.

    May move the scene's nodes in memory: nodes and properties taken from ``state`` before are void.
    """
    samplers = inside(state, state.nodes[sensor], mi.ObjectType.Sampler)
    if not samplers:
        append(state, mi.ObjectType.Sampler, plugin, sensor)
    elif (props := state.nodes[samplers[0]].props).plugin_name() == "independent":
        props.set_plugin_name(plugin)


def find_file(
    state: mi.parser.ParserState, node: mi.parser.SceneNode, where: str, folders: Iterable[Path]
) -> SceneFile | None:
    """Make the name of a node's file absolute, and return it with what is to read it.

    An environment map is replaced and need not exist: None, as where a node names no file.
    """
    if "filename" not in node.props or node.props.plugin_name() == "envmap":
        return None
    if not isinstance(name := node.props["filename"], str):
        raise InputError(f"{place_of(state, node, where)}: filename is {name}, expected a text")
    existing = [folder / name for folder in folders if os.path.isfile(folder / name)]
    if not existing:
        kind = str(node.type).rpartition(".")[2].lower()
        raise InputError(
            f"{place_of(state, node, where)}: the {kind} names a missing file: {name or '(empty)'}\n"
            f"looked in {' and '.join(dict.fromkeys(map(str, folders)))}"
        )
    file = existing[0]
    node.props["filename"] = str(file)
    plugin = node.props.plugin_name()
    if "fit_height" in node.props:  # a mesh of any kind, see fit_to_stage
        plugin = _MESHES.get(file.suffix.lower(), "")
    shape_index = node.props.get("shape_index", 0)
    return SceneFile(plugin, str(file), shape_index if isinstance(shape_index, int) else 0)


def smooth_limit(state: mi.parser.ParserState, node: mi.parser.SceneNode) -> None:
    """Turn a rough BSDF whose alpha is at most 1e-4 into the smooth one; refuse a negative roughness."""
    props = node.props
    if node.type != mi.ObjectType.BSDF or props.plugin_name() not in _SMOOTH:
        return
    alphas = [k for k in ("alpha", "alpha_u", "alpha_v") if isinstance(props.get(k, None), float | int)]
    for key in alphas:
        if not props[key] >= 0:
            where = place_of(state, node, "scene")
            raise ConfigError(f"{where}: roughness {key} is {props[key]}, expected 0 or more")
    if alphas and all(props[k] <= _SMALLEST_ALPHA for k in alphas):
        for key in (*alphas, "distribution", "sample_visible"):
            if key in props:
                del props[key]
        props.set_plugin_name(_SMOOTH[props.plugin_name()])


def fit_to_stage(state: mi.parser.ParserState, node: mi.parser.SceneNode) -> None:
    """Set a shape that carries ``fit_height`` on the plane y = 0, centred and scaled; see the module."""
    props = node.props
    if node.type != mi.ObjectType.Shape or "fit_height" not in props:
        return
    where = place_of(state, node, "scene")
    target, up = props["fit_height"], str(props.get("fit_up", "y")).lower()
    for key in ("fit_height", "fit_up"):
        if key in props:
            del props[key]
    if not (isinstance(target, int | float) and np.isfinite(target) and target > 0):
        raise ConfigError(f"{where}: fit_height is {target}, expected a positive number")
    if up.removeprefix("-") not in _AXES:
        raise ConfigError(f"{where}: the up axis is {up!r}, expected x, y, z, -x, -y or -z")
    filename = str(props.get("filename", ""))
    if filename:
        if (suffix := Path(filename).suffix.lower()) not in _MESHES:
            raise InputError(f"{filename}: cannot read a mesh of this kind; expected {', '.join(_MESHES)}")
        props.set_plugin_name(_MESHES[suffix])

    # First the mesh's own up to +y, then the author's to_world (a turn about y, say), then size and place.
    transform = np.eye(4)
    transform[:3, :3] = _upright(up)
    if "to_world" in props:
        transform = _matrix(props["to_world"], where) @ transform
    props["to_world"] = mi.ScalarTransform4d(transform)
    probe = {k: v for k, v in props.items() if not isinstance(v, mi.Properties.ResolvedReference)}
    box = called(where, mi.load_dict, {"type": props.plugin_name(), **probe}).bbox()
    low, high = (np.array(v, np.float64).ravel() for v in (box.min, box.max))
    extent = high - low
    if not (np.isfinite(extent).all() and extent[1] > 0):
        raise InputError(f"{filename or where}: the mesh has no height along its up axis {up}")
    scale = min(target / extent[1], _MOST_WIDTH_PER_HEIGHT * target / max(extent[0], extent[2], 1e-30))
    place = np.eye(4)
    place[:3, :3] *= scale
    place[:3, 3] = -scale * np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    props["to_world"] = mi.ScalarTransform4d(place @ transform)


def _matrix(transform: Any, where: str) -> np.ndarray:
    """Return a transformation's matrix (4, 4)."""
    if not hasattr(transform, "matrix"):
        raise InputError(f"{where}: to_world is {str(transform)[:60]!r}, expected a <transform>")
    return np.array(transform.matrix, np.float64).reshape(4, 4)


def _upright(up: str) -> np.ndarray:
    """Return the rotation (3, 3) about a coordinate axis that brings an axis to +y."""
    if up == "-y":
        return np.diag([1.0, -1, -1])
    axis = np.array(_AXES[up.removeprefix("-")], float) * (-1 if up.startswith("-") else 1)
    turn = rotations.rotation_between(axis, np.array([0.0, 1, 0]))
    return np.round(rotations.rotation_matrix(turn))


# ---- Digest ------------------------------------------------------------------------------------------------


def hash_node(digest: hashlib._Hash, node: mi.parser.SceneNode) -> None:
    """Add all that a node holds to a digest, the content of files in place of their names."""
    digest.update(f"{node.type}|{node.props.plugin_name()}\n".encode())
    for key, value in node.props.items():
        digest.update(f"{key}=".encode())
        if key == "filename":
            digest.update(atomic_files.digest(value))
        else:
            _hash_value(digest, value)


def _hash_value(digest: hashlib._Hash, value: Any) -> None:
    if isinstance(value, bool | int | float | str):
        digest.update(repr(value).encode())
    elif isinstance(value, mi.Properties.ResolvedReference):
        digest.update(f"@{value.index()}".encode())
    elif hasattr(value, "matrix"):
        digest.update(np.array(value.matrix, np.float64).tobytes())
    elif hasattr(value, "wavelengths"):
        digest.update(repr((list(value.wavelengths), list(value.values))).encode())
    elif isinstance(value, mi.Object) and not isinstance(value, mi.Bitmap):
        digest.update(type(value).__name__.encode())
        for key, inner in mi.traverse(value).items():
            digest.update(key.rpartition(".")[2].encode())
            _hash_value(digest, inner)
    else:
        array = np.array(value)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes() if array.dtype != object else repr(value).encode())
    digest.update(b"\n")
